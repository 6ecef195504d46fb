"""Gradients of steps on Warp's tape against central differences in double precision."""

import math

import numpy as np
import pytest
import warp as wp

from columns import MOTOR_COORDS, MOTOR_DOFS
from jumper_warp.kernels.layout import LEG_ROWS, MU_DYNAMIC, MU_STATIC, UPPER
from jumper_warp.robot.model import build_model
from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.sim.solver import SolverJumper
from jumper_warp.sim.tape import DifferentiableStep
from tests.helpers.rollout_helpers import squat

N, STEPS, DT = 4, 3, 1.0 / 960.0  # worlds, steps, [s]
COORDS, DOFS = [*range(7), *MOTOR_COORDS], [*range(6), *MOTOR_DOFS]  # base and motors in joint_q and joint_qd


class TapeSteps:
    """STEPS steps in double precision, whose loss is a randomly weighted sum of base and motors of the last state."""

    def __init__(self):
        self.dynamics = JumperDynamics(build_model(N, visuals=False, requires_grad=True, device="cpu"), double=True)
        self.stepper = DifferentiableStep(self.dynamics, 200, 1.0e-13)  # iterations, tolerance [m/s]
        rng = np.random.default_rng(0)
        start, rates = squat()
        q, qd, force = np.zeros((N, 43)), np.zeros((N, 38)), np.zeros((STEPS, N, 38))
        q[:, COORDS], qd[:, DOFS] = start, rates
        qd[1, 0], q[3, 2] = 1.5, q[3, 2] + 0.3  # world 1 slides at 1.5 m/s, world 3 flies
        force[:, :, DOFS] = 3.0 * rng.normal(size=(STEPS, N, 18))
        table = self.dynamics.robot.table.numpy().copy()
        for leg in range(4):
            table[[leg * int(LEG_ROWS) + int(row) for row in (MU_DYNAMIC, MU_STATIC)], 1] = 0.25  # friction of world 1
            table[leg * int(LEG_ROWS) + int(UPPER) + 1, 2] = math.radians(85.0) - 1.0e-3  # world 2 presses outer stops
        self.values = {"q": q, "qd": qd, "joint_f": force, "table": table}
        self.values["body_f"] = rng.integers(-256, 257, (STEPS, N * 21, 6)) / 128.0
        self.weights = np.zeros((N, 43)), np.zeros((N, 38))
        self.weights[0][:, COORDS], self.weights[1][:, DOFS] = rng.normal(size=(N, 19)), rng.normal(size=(N, 18))

    def record(self, values):
        """Return a tape of the steps from values by name, its inputs by name, and the last (joint_q, joint_qd)."""
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
        """Return values as a flat float64 array with gradients."""
        return wp.array(values.ravel(), dtype=wp.float64, requires_grad=True)

    def backward(self, tape, ends):
        """Add the loss's gradients to the arrays of a tape; ends: last state."""
        tape.backward(
            grads={end: wp.array(w.ravel(), dtype=wp.float64) for end, w in zip(ends, self.weights, strict=True)}
        )

    def loss(self, values):
        """Return the loss of values by name."""
        ends = self.record(values)[2]
        return sum(float(end.numpy() @ weights.ravel()) for end, weights in zip(ends, self.weights, strict=True))


@pytest.fixture(scope="module")
def steps():
    """Steps of robots in a squat that stand, slide, press stops and fly."""
    return TapeSteps()


def gradient(arrays, name):
    """Return the gradient with respect to an input, with the steps as first axis for forces."""
    value = arrays[name]
    return np.array([a.grad.numpy() for a in value]) if isinstance(value, list) else value.grad.numpy().copy()


@pytest.mark.parametrize(
    ("name", "h", "rel"),  # input, step of the difference, relative tolerance
    [("q", 3e-9, 1e-6), ("qd", 1e-6, 1e-6), ("joint_f", 1e-4, 1e-6), ("table", 1e-6, 1e-5), ("body_f", 2.0**-7, 1e-4)],
)
def test_gradients_match_central_differences(steps, name, h, rel):
    """Derivatives are along random directions; wrenches have single precision, so h is a power of two."""
    tape, arrays, ends = steps.record(steps.values)
    tape.zero()
    steps.backward(tape, ends)
    found = gradient(arrays, name).reshape(steps.values[name].shape)
    tape.zero()
    rng = np.random.default_rng(1)
    for _ in range(3):
        direction = rng.normal(size=found.shape) * (found != 0.0)
        direction = 1.0e-2 * np.abs(steps.values[name]) * direction if name == "table" else direction
        direction = np.sign(direction) if name == "body_f" else direction
        sides = [steps.loss(steps.values | {name: steps.values[name] + side * h * direction}) for side in (1.0, -1.0)]
        assert (found * direction).sum() == pytest.approx((sides[0] - sides[1]) / (2.0 * h), rel=rel)


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
    """In single precision, gradients exist with respect to masses and a force on a flying robot's base."""
    model = build_model(1, visuals=False, requires_grad=True, ground=None, device="cpu")
    solver, control, before, after = SolverJumper(model), model.control(), model.state(), model.state()
    before.joint_q.assign(model.joint_q)
    control.joint_f.assign(np.eye(38)[2] * 40.0)
    with wp.Tape() as tape:
        solver.dynamics.pack_masses()
        solver.step(before, after, control, None, DT)
    tape.backward(grads={after.joint_qd: wp.array(np.eye(38)[2], dtype=wp.float32)})
    mass = float(model.body_mass.numpy().sum())
    assert control.joint_f.grad.numpy()[2] > 0.5 * DT / mass  # more than DT / mass, since legs do not follow rigidly
    assert (model.body_mass.grad.numpy() != 0.0).any()
    with pytest.raises(ValueError, match="must not be state_in"):
        solver.step(after, after, control, None, DT)
