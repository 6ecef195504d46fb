"""Gradients of a whole jump, through filter, motors, dynamics and contact, against central differences in float64.

The jump starts in a squat, on the ground, pushes off and reaches its apex in flight: 34 policy steps of 4 physics steps
of 1/240 s. A difference is wrong, not the gradient, where the perturbation makes a contact or a branch of filter and
motors change sides; so each difference is taken with two steps a factor of 4 apart, which must agree.

At a contact switch the motion is continuous and has a kink: the gradient is that of the mode which the forward pass
found, and equals the one-sided difference on its own side (`test_touchdown_...`, `test_start_of_sliding_...`). A
central difference across the kink gives neither.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import warp as wp

from jumper_warp.optim.rollout import DifferentiableRollout, Trajectory
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import build_model, standing_configuration
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.sim.differentiable import DifferentiableStep
from kernels.layout import BASE, LEG_ROWS, MU_DYNAMIC, MU_STATIC, STOP_KD, STOP_KE, SUM_UPPER

DT = 1.0 / 240.0
SUBSTEPS = 4
TICKS = 34
SQUAT = math.radians(85.0)
GRAVITY = 9.81
MOTOR_COORDS = [7 + 5 * leg + j for leg in range(4) for j in (0, 1, 3)]
MOTOR_DOFS = [6 + 5 * leg + j for leg in range(4) for j in (0, 1, 3)]
BASE_ROW = int(BASE)
MU_ROWS = [leg * int(LEG_ROWS) + int(row) for leg in range(4) for row in (MU_DYNAMIC, MU_STATIC)]

Loss = Callable[[Trajectory], tuple[wp.array, int]]
"""Picks an array of the rollout and, of its entries for one world, the one to differentiate."""


def apex(rollout: Trajectory):
    return rollout.apex, 0


def ballistic_apex(rollout: Trajectory):
    return rollout.ballistic_apex, 0


def final_height(rollout: Trajectory):
    return rollout.joint_q[-1], 2


def final_forward_speed(rollout: Trajectory):
    return rollout.joint_qd[-1], 0


def final_outer_angle(rollout: Trajectory):
    return rollout.joint_q[-1], MOTOR_COORDS[1]


def jump_inputs() -> dict[str, np.ndarray]:
    """Targets (TICKS, 12), q (43,) and qd (38,) of a jump in which no two legs do the same."""
    targets = np.zeros((TICKS, 4, 3))
    targets[:2, :, 1:] = SQUAT
    targets[2:] = np.radians([[1.0, -5.0, -8.0], [-1.0, -3.0, -9.0], [2.0, 2.0, -8.0], [0.0, 1.0, -4.0]])
    squat = dataclasses.replace(load_description(), poses={"squat": (0.0, SQUAT)})
    q, qd = standing_configuration(squat, "squat"), np.zeros(38)
    q[2] -= 1.0e-4
    qd[:6] = [0.1, 0.05, 0.0, 0.02, -0.03, 0.1]
    return {"targets": targets.reshape(TICKS, 12), "q": q, "qd": qd}


class Jump:
    """Rollouts from NumPy arrays, in one world or in several that differ."""

    def __init__(self, num_worlds: int, double: bool, substeps: int):
        self.model = build_model(num_worlds, visuals=False, requires_grad=True)
        self.rollout = DifferentiableRollout(
            self.model, jumping_motors(), vertical_jump_filter(), double=double, dt=DT, substeps=substeps
        )
        self.dynamics = self.rollout.dynamics
        self.parameters = {
            "table": self.dynamics.robot.table,
            "saturation": self.rollout.motors.saturation,
            "kp": self.rollout.motors.kp,
        }
        self.values = jump_inputs() | {
            name: array.numpy()[:, 0].astype(float) for name, array in self.parameters.items()
        }

    def run(self, changes: dict[str, np.ndarray], pack: Callable[[], None] | None = None) -> tuple[dict, Trajectory]:
        """Run with arrays (num_worlds, ...) or (...) in place of the standard values.

        Returns the input arrays and the rollout. pack: reads parameters from the model first.
        """
        n, real = self.model.world_count, self.rollout.real
        full = {
            name: np.broadcast_to(changes.get(name, value), (n, *np.shape(changes.get(name, value))[-value.ndim :]))
            for name, value in self.values.items()
        }
        arrays = dict(self.parameters)
        for name, array in arrays.items():
            array.assign(full[name].T)
        arrays["targets"] = wp.array(np.moveaxis(full["targets"], 0, -1), dtype=real, requires_grad=True)
        for name in ("q", "qd"):
            arrays[name] = wp.array(full[name].flatten(), dtype=real, requires_grad=True)
        if pack is not None:
            pack()
        return arrays, self.rollout.run(arrays["targets"], arrays["q"], arrays["qd"])


@cache
def jump(num_worlds: int = 1, double: bool = True, substeps: int = SUBSTEPS) -> Jump:
    return Jump(num_worlds, double, substeps)


def gradients(of: Jump, loss: Loss, changes: dict | None = None, pack=None) -> dict[str, np.ndarray]:
    """Gradients of a loss by the tape, in one world, by the names of `Jump.values` and of the model's arrays."""
    with wp.Tape() as tape:
        arrays, rollout = of.run(changes or {}, pack)
    array, entry = loss(rollout)
    seed = wp.zeros_like(array, requires_grad=False)
    seed[entry : entry + 1].fill_(1.0)
    tape.backward(grads={array: seed})
    arrays |= {"body_mass": of.model.body_mass, "shape_mu": of.model.shape_material_mu}
    grads = {name: array.grad.numpy().astype(float) for name, array in arrays.items()}
    grads = {name: value[..., 0] if value.ndim > 1 else value for name, value in grads.items()}
    tape.zero()
    return grads


def differences(loss: Loss, name: str, directions: np.ndarray, h: float, changes: dict | None = None, **setup):
    """Central differences of a loss along directions (n, ...) of one input, all in one batch of worlds."""
    batch = jump(2 * len(directions), **setup)
    middle = (changes or {}).get(name, batch.values[name])
    ends = np.concatenate([middle + h * directions, middle - h * directions])
    array, entry = loss(batch.run((changes or {}) | {name: ends})[1])
    ahead, behind = np.split(array.numpy().reshape(2 * len(directions), -1)[:, entry], 2)
    return (ahead - behind) / (2.0 * h)


def assert_matches(found, loss: Loss, name: str, directions: np.ndarray, h: float, changes=None, **setup):
    """Check derivatives to 1e-5 relative against differences that do not depend on their step."""
    fine, coarse = (differences(loss, name, directions, step, changes, **setup) for step in (h, 4.0 * h))
    scale = np.abs(fine).max()
    assert scale > 1.0e-6, "the loss does not depend on this input: the comparison means nothing"
    np.testing.assert_allclose(fine, coarse, rtol=1.0e-4, atol=1.0e-5 * scale)
    np.testing.assert_allclose(found, fine, rtol=1.0e-5, atol=1.0e-6 * scale)


def unit(shape: tuple[int, ...], entries: list) -> np.ndarray:
    """Directions along single entries of an input, (n, *shape)."""
    directions = np.zeros((len(entries), *shape))
    for direction, entry in zip(directions, entries, strict=True):
        direction[entry] = 1.0
    return directions


# by input: entries to check, step of the difference
CHECKED = {
    # motors saturate in steps 2 and 3 (derivative zero), the filter holds back from step 8 on
    "targets": ([(t, m) for t in (0, 2, 4, 6, 8, 9) for m in (1, 5)] + [(10, 0), (14, 9)], 2.0e-6),
    "q": ([2, 3, 4, 5, *MOTOR_COORDS], 1.0e-7),
    "qd": ([*range(6), *MOTOR_DOFS], 1.0e-6),
    "saturation": ([1, 2, 4, 5, 7, 8, 10, 11], 1.0e-5),
    "kp": ([0, 1, 2, 5, 7, 9, 11], 1.0e-5),
    # mass moments of the base, of the first leg's housing and inner shank, armature, knee damping
    "table": ([BASE_ROW, BASE_ROW + 1, BASE_ROW + 3, BASE_ROW + 5, 0, 40, 50, 51, 59], 1.0e-6),
}


@pytest.mark.parametrize("loss", [apex, ballistic_apex])
@pytest.mark.parametrize("name", CHECKED)
def test_jump_gradient_matches_differences(name, loss):
    entries, h = CHECKED[name]
    gradient = gradients(jump(), loss)[name]
    directions = unit(gradient.shape, entries)
    assert_matches([gradient[entry] for entry in entries], loss, name, directions, h)


def test_targets_within_the_limits_pass_the_filter_untouched():
    """With and without a filter the jump and its gradient are the same."""
    targets = np.tile(np.radians([0.0, 20.0, 25.0]), (TICKS, 4))
    found = []
    for command_filter in (None, vertical_jump_filter()):
        rollout = DifferentiableRollout(jump().model, command_filter=command_filter, double=True, dt=DT, substeps=4)
        inputs = [targets[:, :, None], jump().values["q"], jump().values["qd"]]
        arrays = [wp.array(values, dtype=wp.float64, requires_grad=True) for values in inputs]
        with wp.Tape() as tape:
            apexes = rollout.run(*arrays).apex
        tape.backward(grads={apexes: wp.ones_like(apexes)})
        found.append((apexes.numpy()[0], arrays[0].grad.numpy()))
    assert found[0][0] == pytest.approx(found[1][0], abs=1.0e-12)
    assert np.abs(found[0][1]).max() > 1.0e-3
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=0.0, atol=1.0e-12)


def mass_directions(model, bodies: list[int]) -> np.ndarray:
    """What 1 kg more of each body, its density scaled at fixed inertia about the com, adds to the parameter table.

    By the parallel axis theorem: mass 1, first moments c, second moments (xx, yy, zz, xy, xz, yz) c c^T.
    """
    directions = np.zeros((len(bodies), len(jump().values["table"])))
    for direction, body in zip(directions, bodies, strict=True):
        leg, link = divmod(body - 1, 5)
        row = BASE_ROW if body == 0 else leg * int(LEG_ROWS) + 10 * link
        c = model.body_com.numpy()[body].astype(float)
        direction[row : row + 10] = [1.0, *c, *(c * c), c[0] * c[1], c[0] * c[2], c[1] * c[2]]
    return directions


@pytest.mark.parametrize("loss", [apex, ballistic_apex])
def test_mass_gradient_of_the_model_matches_differences(loss):
    bodies = [0, 1, 2, 8, 15, 20]
    found = gradients(jump(), loss, pack=jump().dynamics.pack_masses)["body_mass"][bodies]
    assert_matches(found, loss, "table", mass_directions(jump().model, bodies), 1.0e-6)
    assert found[0] < 0.0  # a heavier body jumps lower


def sliding(static: float = 0.3) -> dict[str, np.ndarray]:
    """The jump from a forward speed of 1.5 m/s on slippery ground, dynamic friction 0.25."""
    table, qd = jump().values["table"].copy(), jump().values["qd"].copy()
    table[MU_ROWS] = [0.25, static] * 4
    qd[0] = 1.5
    return {"table": table, "qd": qd}


@pytest.mark.parametrize("loss", [apex, final_forward_speed])
def test_friction_gradient_of_a_sliding_jump_matches_differences(loss):
    found = gradients(jump(), loss, sliding())["table"][MU_ROWS]
    directions = unit(jump().values["table"].shape, MU_ROWS)
    assert_matches(found, loss, "table", directions, 1.0e-6, sliding())


def test_friction_gradient_reaches_the_model():
    """Static and dynamic friction follow the paws' coefficient, which is larger than the ground's."""
    model = jump().model
    paws = np.array([label.endswith("_paw") for label in model.shape_label])
    model.shape_material_mu.assign(np.where(paws, 0.25, 0.0))
    fast = {"qd": sliding()["qd"]}
    found = gradients(jump(), final_forward_speed, fast, pack=jump().dynamics.pack_friction)["shape_mu"]
    directions = np.zeros((4, len(jump().values["table"])))
    for leg, direction in enumerate(directions):
        direction[MU_ROWS[2 * leg : 2 * leg + 2]] = 1.0
    assert_matches(found[paws], final_forward_speed, "table", directions, 1.0e-6, sliding(static=0.25))
    assert not found[~paws].any()


@pytest.mark.parametrize("name", ["targets", "q", "qd"])
def test_gradients_of_a_sliding_jump_match_differences(name):
    entries, h = CHECKED[name]
    gradient = gradients(jump(), apex, sliding())[name]
    directions = unit(gradient.shape, entries)
    assert_matches([gradient[entry] for entry in entries], apex, name, directions, h, sliding())


@pytest.mark.parametrize("name", [*CHECKED])
def test_single_precision_gradients_are_those_of_double_precision(name):
    """Worst seen: 1.1e-4 of the largest entry."""
    single, double = (gradients(jump(double=precision), apex)[name] for precision in (False, True))
    np.testing.assert_allclose(single, double, rtol=0.0, atol=5.0e-4 * np.abs(double).max())


PRESSED = 8
"""Policy steps in which the legs press their stops."""


def on_the_stops(pushes: bool) -> dict[str, np.ndarray]:
    """The robot in its squat at 120 degrees, motors pressing every leg on its stop; then it stays, or jumps."""
    squat = dataclasses.replace(load_description(), poses={"squat": (0.0, math.radians(120.0))})
    q, qd = standing_configuration(squat, "squat"), np.zeros(38)
    q[2] -= 1.0e-4
    q[[coord for coord in MOTOR_COORDS if coord % 5 != 2]] += 3.0e-4
    qd[:6] = [0.1, 0.05, -0.2, 0.02, -0.03, 0.1]
    press = np.radians([[1.0, 126.0, 128.0], [-1.0, 130.0, 127.0], [2.0, 129.0, 133.0], [0.0, 127.0, 126.0]])
    targets = np.concatenate([np.tile(press.ravel(), (PRESSED, 1)), jump().values["targets"][2:]])
    return {"targets": targets if pushes else targets[:PRESSED], "q": q, "qd": qd}


# by input: entries to check, step of the difference; rows: stops of the sums, mass, a housing's mass, armature
ON_STOPS = {
    "targets": ([(t, m) for t in (0, 2, 5) for m in (0, 1, 5, 11)], 2.0e-6),
    "q": ([2, 3, 4, 5, *MOTOR_COORDS], 1.0e-7),
    "qd": ([*range(6), *MOTOR_DOFS], 1.0e-6),
    "table": ([*(leg * int(LEG_ROWS) + int(SUM_UPPER) for leg in range(4)), BASE_ROW, 0, 51], 1.0e-7),
}


@pytest.mark.parametrize("loss", [final_height, final_forward_speed])
@pytest.mark.parametrize("name", ON_STOPS)
def test_gradients_of_a_robot_on_its_stops_match_differences(name, loss):
    entries, h = ON_STOPS[name]
    inputs = on_the_stops(pushes=False)
    gradient = gradients(jump(), loss, inputs)[name]
    assert (jump().dynamics.work.contact_force.numpy()[:, 0, 2] > 10.0).all()
    assert_matches([gradient[entry] for entry in entries], loss, name, unit(gradient.shape, entries), h, inputs)


def test_gradient_with_respect_to_a_stops_strength_matches_differences():
    rows, inputs = [int(STOP_KE), int(STOP_KD)], on_the_stops(pushes=False)
    scale = np.array([1.0e4, 1.0e2])  # [N m/rad], [N m s/rad]
    found = scale * gradients(jump(), final_outer_angle, inputs)["table"][rows]
    directions = scale[:, None] * unit(jump().values["table"].shape, rows)
    assert_matches(found, final_outer_angle, "table", directions, 1.0e-3, inputs)


@pytest.mark.parametrize("name", ["targets", "table"])
def test_gradient_of_a_jump_off_the_stops_matches_differences(name):
    entries, h = ON_STOPS[name]
    inputs = on_the_stops(pushes=True)
    gradient = gradients(jump(), apex, inputs)[name]
    assert_matches([gradient[entry] for entry in entries], apex, name, unit(gradient.shape, entries), h, inputs)


def airborne(height: float, speed: float) -> dict[str, np.ndarray]:
    """The squat in the air, level, at a vertical speed, the motors holding their angles."""
    q, qd = jump().values["q"].copy(), np.zeros(38)
    q[2], qd[2] = height, speed
    return {"q": q, "qd": qd, "targets": np.tile([0.0, SQUAT, SQUAT], (10, 4))}


def test_apex_of_a_throw():
    """Steps of dt from speed v lift by dt (v - g dt), dt (v - 2 g dt), ...: the apex is a sum worked by hand.

    v = 10.5 g dt leaves ten rising steps and, g dt being the speed lost in one, 55 losses until the top.
    """
    loss_a_step = GRAVITY * DT
    of = jump()
    _, rollout = of.run(airborne(2.0, 10.5 * loss_a_step))
    top = 2.0 + DT * loss_a_step * (10 * 10.5 - 55.0)
    assert rollout.apex_row.numpy()[0] == 10
    assert rollout.takeoff_row.numpy()[0] == 0
    assert rollout.apex.numpy()[0] == pytest.approx(top, abs=1.0e-9)
    ballistic = 2.0 + (10.5 * loss_a_step) ** 2 / (2.0 * GRAVITY)
    assert rollout.ballistic_apex.numpy()[0] == pytest.approx(ballistic, abs=1.0e-6)
    assert gradients(of, apex, airborne(2.0, 10.5 * loss_a_step))["qd"][2] == pytest.approx(10 * DT)
    assert gradients(of, ballistic_apex, airborne(2.0, 2.0))["qd"][2] == pytest.approx(2.0 / GRAVITY, rel=1.0e-6)


def one_step(**changes) -> dict[str, np.ndarray]:
    """Inputs of a single physics step in the squat, at rest, with `height` [m] added, `speed` [m/s] and friction."""
    values = {name: jump().values[name].copy() for name in ("q", "qd", "table")}
    values["q"][2] += changes.get("height", 0.0)
    values["qd"][:] = 0.0
    values["qd"][0] = changes.get("speed", 0.0)
    if "friction" in changes:
        values["table"][MU_ROWS] = changes["friction"]
    return values | {"targets": np.tile([0.0, SQUAT, SQUAT], (1, 4))}


@pytest.mark.parametrize("touches", [False, True])
def test_touchdown_has_the_gradient_of_its_side(touches):
    """In one step from rest the robot falls by g dt^2; a paw closer to the ground than that lands.

    Not landing, the new height follows the old one exactly. Landing, the paws close the gap and hold the base back.
    """
    paw_gap = GRAVITY * DT * DT + 1.0e-4  # the squat starts 0.1 mm in the ground
    side = -1.0 if touches else 1.0
    near, at = (one_step(height=paw_gap + side * offset) for offset in (1.0e-5, 0.0))
    found = gradients(jump(substeps=1), final_height, near)["q"]
    entries = unit((43,), [2])
    assert_matches(found[[2]], final_height, "q", entries, 1.0e-7, near, substeps=1)
    assert (found[2] == pytest.approx(1.0, abs=1.0e-9)) != touches

    across = differences(final_height, "q", entries, 1.0e-5, at, substeps=1)[0]
    other = gradients(jump(substeps=1), final_height, one_step(height=paw_gap - side * 1.0e-5))["q"][2]
    assert across == pytest.approx(0.5 * (found[2] + other), rel=1.0e-3)


@pytest.mark.parametrize("slides", [False, True])
def test_start_of_sliding_has_the_gradient_of_its_side(slides):
    """In one step at 0.02 m/s the first paw slides once friction is below the ratio of its forces while all stick."""
    of = jump(substeps=1)
    of.run(one_step(speed=0.02, friction=5.0))
    force = of.dynamics.work.contact_force.numpy()[:, 0]
    needed = (np.linalg.norm(force[:, :2], axis=1) / force[:, 2]).max()
    near = one_step(speed=0.02, friction=needed * (0.999 if slides else 1.001))
    all_rows = np.zeros((1, len(near["table"])))
    all_rows[0, MU_ROWS] = 1.0
    found = gradients(of, final_forward_speed, near)["table"][MU_ROWS].sum()
    difference = differences(final_forward_speed, "table", all_rows, 1.0e-5, near, substeps=1)[0]
    assert found == pytest.approx(difference, rel=1.0e-5, abs=1.0e-9)
    assert (found < -1.0e-3) == slides  # more friction, less speed


def test_a_step_must_not_overwrite_its_input():
    dynamics = jump().dynamics
    step = DifferentiableStep(dynamics, 50, 1.0e-9)
    q, qd, force = (wp.zeros(size, dtype=dynamics.real) for size in (43, 38, 38))
    wrench = wp.zeros(21, dtype=wp.spatial_vector)
    for q_out, qd_out in ((q, wp.clone(qd)), (wp.clone(q), qd)):
        with pytest.raises(ValueError, match="state_out must not be state_in"):
            step.step(q, qd, force, wrench, q_out, qd_out, DT)


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (((12, 1), 43, 38), "targets must have shape"),
        (((0, 12, 1), 43, 38), "T >= 1"),
        (((2, 12, 2), 43, 38), "targets must have shape"),
        (((2, 12, 1), 42, 38), "joint_q must have shape"),
        (((2, 12, 1), 43, 37), "joint_qd must have shape"),
    ],
)
def test_run_refuses_other_shapes(shapes, message):
    with pytest.raises(ValueError, match=message):
        jump().rollout.run(*(wp.zeros(shape, dtype=wp.float64) for shape in shapes))


def test_run_refuses_the_other_precision():
    arrays = [wp.zeros(shape, dtype=wp.float64) for shape in ((2, 12, 1), 43)]
    with pytest.raises(ValueError, match="joint_qd must be of float64"):
        jump().rollout.run(*arrays, wp.zeros(38, dtype=wp.float32))


@pytest.mark.parametrize("setting", [{"dt": 0.0}, {"dt": math.nan}, {"substeps": 0}])
def test_rollout_refuses_bad_settings(setting):
    with pytest.raises(ValueError, match="dt must be > 0"):
        DifferentiableRollout(jump().model, **setting)


def test_rollout_refuses_a_model_without_gradients():
    with pytest.raises(ValueError, match="requires_grad"):
        DifferentiableRollout(build_model(1, visuals=False))
