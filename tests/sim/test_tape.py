"""Gradients of steps on Warp's tape against central differences in double precision."""

import math

import numpy as np
import pytest
import warp as wp

from jumper_warp.kernels.layout import LEG_ROWS, MU_DYNAMIC, MU_STATIC, UPPER
from jumper_warp.robot.model import build_model
from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.sim.solver import SolverJumper
from jumper_warp.sim.tape import DifferentiableStep
from tests.helpers.rollout_helpers import squat

N, STEPS, DT = 4, 3, 1.0 / 960.0
SLOTS = [*range(7), *(7 + 5 * leg + j for leg in range(4) for j in (0, 1, 3))]
DOFS = [*range(6), *(6 + 5 * leg + j for leg in range(4) for j in (0, 1, 3))]


class TapeSteps:
    """Inputs of some steps in double precision, and the gradient of a random weighted sum of the last state."""

    def __init__(self):
        self.dynamics = JumperDynamics(build_model(N, visuals=False, requires_grad=True, device="cpu"), double=True)
        self.stepper = DifferentiableStep(self.dynamics, 200, 1.0e-13)
        rng = np.random.default_rng(0)
        start, rates = squat()
        q, qd, force = np.zeros((N, 43)), np.zeros((N, 38)), np.zeros((STEPS, N, 38))
        q[:, SLOTS], qd[:, DOFS] = start, rates
        qd[1, 0], q[3, 2] = 1.5, q[3, 2] + 0.3
        force[:, :, DOFS] = 3.0 * rng.normal(size=(STEPS, N, 18))
        table = self.dynamics.robot.table.numpy().copy()
        for leg in range(4):
            table[[leg * int(LEG_ROWS) + int(row) for row in (MU_DYNAMIC, MU_STATIC)], 1] = 0.25
            table[leg * int(LEG_ROWS) + int(UPPER) + 1, 2] = math.radians(85.0) - 1.0e-3
        self.values = {"q": q, "qd": qd, "joint_f": force, "table": table}
        self.values["body_f"] = rng.integers(-256, 257, (STEPS, N * 21, 6)) / 128.0
        self.weights = np.zeros((N, 43)), np.zeros((N, 38))
        self.weights[0][:, SLOTS], self.weights[1][:, DOFS] = rng.normal(size=(N, 19)), rng.normal(size=(N, 18))

    def record(self, values):
        """Return the tape, its arrays by name and the last state."""
        self.dynamics.work.impulse.zero_()
        self.dynamics.robot.table.assign(values["table"])
        arrays = {name: self.array(values[name]) for name in ("q", "qd")} | {"table": self.dynamics.robot.table}
        arrays["joint_f"] = [self.array(force) for force in values["joint_f"]]
        arrays["body_f"] = [wp.array(f, dtype=wp.spatial_vector, requires_grad=True) for f in values["body_f"]]
        q, qd = arrays["q"], arrays["qd"]
        with wp.Tape() as tape:
            for force, wrench in zip(arrays["joint_f"], arrays["body_f"], strict=True):
                ends = self.array(np.zeros((N, 43))), self.array(np.zeros((N, 38)))
                self.stepper.step(q, qd, force, wrench, *ends, DT)
                q, qd = ends
        return tape, arrays, (q, qd)

    def array(self, values):
        return wp.array(values.ravel(), dtype=wp.float64, requires_grad=True)

    def backward(self, tape, ends):
        tape.backward(
            grads={end: wp.array(w.ravel(), dtype=wp.float64) for end, w in zip(ends, self.weights, strict=True)}
        )

    def sum(self, values):
        ends = self.record(values)[2]
        return sum(float(end.numpy() @ weights.ravel()) for end, weights in zip(ends, self.weights, strict=True))


@pytest.fixture(scope="module")
def steps():
    return TapeSteps()


def gradient(arrays, name):
    """Return the gradient by an input."""
    found = arrays[name]
    return np.array([a.grad.numpy() for a in found]) if isinstance(found, list) else found.grad.numpy().copy()


@pytest.mark.parametrize(
    ("name", "h", "rel"),
    [("q", 3e-9, 1e-6), ("qd", 1e-6, 1e-6), ("joint_f", 1e-4, 1e-6), ("table", 1e-6, 1e-5), ("body_f", 2.0**-7, 1e-4)],
)
def test_gradients_match_central_differences(steps, name, h, rel):
    """Along random ways; wrenches are of single precision, so by a step that rounds nothing."""
    tape, arrays, ends = steps.record(steps.values)
    tape.zero()
    steps.backward(tape, ends)
    found = gradient(arrays, name).reshape(steps.values[name].shape)
    tape.zero()
    rng = np.random.default_rng(1)
    for _ in range(3):
        way = rng.normal(size=found.shape) * (found != 0.0)
        way = 1.0e-2 * np.abs(steps.values[name]) * way if name == "table" else way
        way = np.sign(way) if name == "body_f" else way
        sides = [steps.sum(steps.values | {name: steps.values[name] + side * h * way}) for side in (1.0, -1.0)]
        assert (found * way).sum() == pytest.approx((sides[0] - sides[1]) / (2.0 * h), rel=rel)


def test_gradients_accumulate_until_zeroed(steps):
    tape, arrays, ends = steps.record(steps.values)
    steps.backward(tape, ends)
    once = {name: gradient(arrays, name) for name in arrays}
    steps.backward(tape, ends)
    for name, expected in once.items():
        np.testing.assert_allclose(gradient(arrays, name), 2.0 * expected, rtol=1.0e-12)
    tape.zero()
    assert not any(gradient(arrays, name).any() for name in arrays)


def test_tape_records_solver_steps_and_packed_model():
    """In single precision: a force on a flying robot's base, and its mass."""
    model = build_model(1, visuals=False, requires_grad=True, ground=None, device="cpu")
    solver, control, before, after = SolverJumper(model), model.control(), model.state(), model.state()
    before.joint_q.assign(model.joint_q)
    control.joint_f.assign(np.eye(38)[2] * 40.0)
    with wp.Tape() as tape:
        solver.dynamics.pack_masses()
        solver.step(before, after, control, None, DT)
    tape.backward(grads={after.joint_qd: wp.array(np.eye(38)[2], dtype=wp.float32)})
    mass = float(model.body_mass.numpy().sum())
    assert control.joint_f.grad.numpy()[2] > 0.5 * DT / mass  # more, as legs hang from springs of inertia
    assert (model.body_mass.grad.numpy() != 0.0).any()
    with pytest.raises(ValueError, match="must not be state_in"):
        solver.step(after, after, control, None, DT)
