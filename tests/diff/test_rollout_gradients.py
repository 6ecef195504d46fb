"""Gradients of a whole jump, through filter, latency, motors, dynamics, stops and contact, against differences.

The loss is a random weighted sum of states, torques and impulses at all times. A difference is wrong where the
perturbation switches a contact, a stop or a branch of filter and motors; the motions are chosen so that none switches.
"""

import numpy as np
import pytest
import warp as wp

from columns import X
from jumper_warp.diff.rollout import GEOMETRY_NAMES, Rollout
from jumper_warp.kernels import layout
from jumper_warp.robot.model import build_model
from jumper_warp.robot.motors import vertical_jump_filter
from tests.helpers.rollout_helpers import (
    DT,
    defaults,
    differences,
    gradients,
    push_off,
    rollout,
    run,
    squat,
    weighted_sum,
    weights,
)

ARMATURE, BASE, DAMPING, FRICTION, GRAVITY, INNER_SHANK, KNEE_DAMPING, LEG, LOWER, MU_DYNAMIC, MU_STATIC = (
    int(getattr(layout, name)) for name in ("ARMATURE", "BASE", "DAMPING", "FRICTION", "GRAVITY", "INNER_SHANK",
                                            "KNEE_DAMPING", "LEG_ROWS", "LOWER", "MU_DYNAMIC", "MU_STATIC")
)  # fmt: skip
OUTER_THIGH, SPRING, STOP_KD, STOP_KE = map(int, (layout.OUTER_THIGH, layout.SPRING, layout.STOP_KD, layout.STOP_KE))
MU_ROWS = [leg * LEG + row for leg in range(4) for row in (MU_DYNAMIC, MU_STATIC)]
MASSES = [BASE, BASE + 1, BASE + 4, OUTER_THIGH + LEG, INNER_SHANK + 3, INNER_SHANK + 6]
JOINTS = [ARMATURE + 1, FRICTION + 1, DAMPING + LEG, KNEE_DAMPING + 2 * LEG]


def jump(**changes) -> dict[str, np.ndarray]:
    """Return the inputs of a jump with a latency of 6.1 ms, a wrench, and fading motors."""
    values = defaults()
    values["latency"] = np.array(0.0061)
    values["wrench"][5:15] = [3.0, -2.0, 4.0, 0.1, -0.2, 0.3]  # [N], [N m] in policy steps 5 to 14
    values["fade"] = np.array([4.0, 60.0])  # [rad/s] speeds at which torque begins and ends to fade
    return values | changes


def sliding() -> dict[str, np.ndarray]:
    """Return the inputs of a jump from a forward speed on slippery ground."""
    values = jump()
    values["table"][MU_ROWS] = [0.25, 0.3] * 4  # dynamic and static friction by leg
    values["qd"][X] = 1.5  # [m/s]
    return values


def folding() -> dict[str, np.ndarray]:
    """Return the inputs of a jump whose targets press the legs against narrow stops."""
    values = jump()
    for leg in range(4):
        first = leg * LEG + LOWER
        values["table"][first : first + 3] = [-0.6, 0.25, 0.3]  # [rad] lateral, outer, inner
    return values


def sprung() -> dict[str, np.ndarray]:
    """Return the inputs of a jump with four different springs between the knees."""
    values = jump()
    for leg in range(4):
        stiffness = leg * LEG + SPRING
        values["table"][stiffness : stiffness + 2] = [300.0 + 40.0 * leg, 0.17 + 0.01 * leg]  # [N/m], length [m]
    return values


CASES = {  # inputs, name of the input, its entries, step of the differences in the entry's unit
    "targets": (jump, "targets", [(0, 1), (3, 0), (4, 4), (8, 7), (20, 8)], 2.0e-6),
    "position": (jump, "q", [0, 2, 3, 4, 5, 7, 8, 12, 18], 1.0e-7),
    "velocity": (jump, "qd", [0, 2, 3, 5, 6, 7, 14], 2.0e-6),
    "initial_target": (jump, "initial_target", [1, 5], 1.0e-5),
    "wrench": (jump, "wrench", [(0, 2), (6, 0), (6, 5), (30, 1)], 1.0e-4),
    "masses": (jump, "table", MASSES, 1.0e-6),
    "joints": (jump, "table", JOINTS, 1.0e-6),
    "gravity": (jump, "table", [GRAVITY, GRAVITY + 2], 1.0e-5),
    "latency": (jump, "latency", [()], 1.0e-8),
    "filter": (jump, "filter", [8, 12], 1.0e-6),
    "kp": (jump, "kp", [1, 8], 1.0e-4),
    "kd": (jump, "kd", [1, 8], 1.0e-5),
    "saturation": (jump, "saturation", [1, 8], 1.0e-4),
    "offset": (jump, "offset", [1, 6], 1.0e-6),
    "fade": (jump, "fade", [0, 1], 1.0e-4),
    "friction": (sliding, "table", MU_ROWS, 1.0e-6),
    "sliding": (sliding, "qd", [0, 1, 5], 1.0e-6),
    "springs": (sprung, "table", [SPRING + LEG, SPRING + 1, SPRING + 1 + 2 * LEG], 1.0e-5),
    "sprung": (sprung, "targets", [(0, 1), (3, 0), (4, 4), (8, 7)], 2.0e-6),
    "stops": (folding, "table", [LOWER + 1, STOP_KE, STOP_KD + LEG], 1.0e-6),
    "pressed": (folding, "targets", [(4, 4), (8, 7)], 1.0e-6),
}


@pytest.mark.parametrize("case", CASES)
def test_gradient_matches_differences(case):
    """The gradient of the weighted sum by entries of one input equals differences of the sum."""
    make, name, entries, h = CASES[case]
    values = make()
    weights_by, gradient_by = gradients(rollout(), values)
    expected = differences(values, weights_by, name, entries, h)
    scale = np.abs(expected).max()
    assert scale > 1.0e-6, "the sum does not depend on this input: the comparison means nothing"
    np.testing.assert_allclose([gradient_by[name][entry] for entry in entries], expected, rtol=0.0, atol=1.0e-6 * scale)


def test_gradients_by_leg_lengths_match_differences():
    values = jump()
    weights_by, gradient_by = gradients(rollout(), values)
    lengths = rollout().geometry()
    expected = np.zeros((2, 10))
    for row, leg in enumerate((0, 3)):  # FL, BR
        for column in range(10):
            for side in (-1.0, 1.0):
                moved = lengths.copy()
                moved[leg, column] += side * 1.0e-7  # [m]
                rollout().set_geometry(moved)
                expected[row, column] += side * weighted_sum(run(rollout(), values), weights_by)[0] / 2.0e-7
    rollout().set_geometry(lengths)
    assert np.abs(expected[:, GEOMETRY_NAMES.index("thigh")]).min() > 1.0
    np.testing.assert_allclose(
        gradient_by["geometry"][[0, 3]], expected, rtol=0.0, atol=2.0e-6 * np.abs(expected).max()
    )


def test_gradients_on_uneven_ground_match_differences():
    values = jump()
    values["q"] = values["q"].copy()
    values["q"][2] += 0.012  # [m]
    weights_by, gradient_by = gradients(rollout(ground="uneven"), values)
    entries = [0, 1, 2, 3, 4, 8]  # x, y, z, quaternion x and y, FL_outer
    expected = differences(values, weights_by, "q", entries, 1.0e-7, ground="uneven")
    assert np.abs(expected[:2]).max() > 1.0e-2  # the horizontal position matters
    np.testing.assert_allclose(gradient_by["q"][entries], expected, rtol=0.0, atol=2.0e-6 * np.abs(expected).max())


def test_gradients_of_a_hung_robot_match_differences():
    """A held base keeps its pose, while the legs swing."""
    values = jump()
    values["q"][2], values["qd"][:6] = 1.0, 0.0  # 1 m above the ground, at rest
    for of in (rollout(), rollout(8)):
        of.hold()
    try:
        weights_by, gradient_by = gradients(rollout(), values)
        expected = differences(values, weights_by, "kp", [1, 8], 1.0e-4)  # FL_outer, BL_inner
        held = run(rollout(), values).q.numpy()
    finally:
        for of in (rollout(), rollout(8)):
            of.hold(False)
    assert (held[:, :7] == held[0, :7]).all() and np.ptp(held[:, 8]) > 0.5  # [rad] FL_outer
    np.testing.assert_allclose(gradient_by["kp"][[1, 8]], expected, rtol=1.0e-6)


def test_single_precision_gradients_match_double_precision():
    """Gradients of the height in flight agree to 1e-3 of the largest entry; the largest difference is 2.4e-4."""
    values = defaults()
    height = {"q": np.zeros((len(push_off()) + 1, 19, 1))}
    height["q"][30, 2] = 1.0  # z after policy step 30
    _, double = gradients(rollout(), values, height)
    _, single = gradients(rollout(double=False), values, height)
    for name in ("targets", "q", "qd", "kp", "saturation", "table", "geometry"):
        np.testing.assert_allclose(single[name], double[name], rtol=0.0, atol=1.0e-3 * np.abs(double[name]).max())


def one_step(height: float = 0.0, speed: float = 0.0, friction: float | None = None) -> dict[str, np.ndarray]:
    """Return the inputs of one policy step in the squat; height [m] is added to z, speed [m/s] is along x."""
    values = defaults() | {"qd": np.zeros(18), "targets": np.tile(squat()[0][7:], (1, 1)), "wrench": np.zeros((1, 6))}
    values["q"][2] += height
    values["qd"][0] = speed
    if friction is not None:
        values["table"][MU_ROWS] = friction
    return values


def final_entry(name: str, entry: int) -> dict[str, np.ndarray]:
    """Return weights that select one entry of q or qd at the end of a single policy step."""
    weights_by = {name: np.zeros((2, {"q": 19, "qd": 18}[name], 1))}
    weights_by[name][1, entry] = 1.0
    return weights_by


@pytest.mark.parametrize("touches", [False, True])
def test_touchdown_gradient_matches_differences_on_either_side(touches):
    """A robot falls for four steps from rest, by g dt^2 (1 + 2 + 3 + 4), and lands if it starts closer to the ground.

    In the air the final height changes as much as the initial one; on the ground the paws resist.
    """
    gap = 9.81 * DT * DT * 10.0 + 1.0e-4  # the squat starts 0.1 mm in the ground
    height = gap - 2.0e-5 if touches else gap + 2.0e-5
    values = one_step(height=height)
    weights_by, gradient_by = gradients(rollout(), values, final_entry("q", 2))
    expected = differences(values, weights_by, "q", [2], 1.0e-6)[0]
    assert gradient_by["q"][2] == pytest.approx(expected, rel=1.0e-6)
    assert (gradient_by["q"][2] == pytest.approx(1.0, abs=1.0e-9)) != touches


@pytest.mark.parametrize("slides", [False, True])
def test_gradient_of_speed_by_friction_is_negative_while_sliding_and_zero_while_sticking(slides):
    values = one_step(speed=0.02, friction=0.05 if slides else 5.0)
    _, gradient_by = gradients(rollout(), values, final_entry("qd", 0))
    by_friction = gradient_by["table"][MU_ROWS].sum()
    assert by_friction < -1.0e-3 if slides else by_friction == 0.0  # [m/s]


def test_gradients_with_a_row_by_policy_step_match_those_by_physics_step():
    values = jump()
    weights_by = weights(run(rollout(), values), ("torque", "impulse"))
    (_, few), (_, many) = (gradients(of, values, weights_by) for of in (rollout(), rollout(every=1)))
    for name, gradient in few.items():
        np.testing.assert_allclose(many[name], gradient, rtol=0.0, atol=1.0e-9 * np.abs(gradient).max() + 1.0e-30)


def test_zero_cotangent_gives_zero_gradients():
    trajectory = run(rollout(), jump())
    gradient_by = rollout().backward(trajectory, q=wp.zeros_like(trajectory.q))
    assert not any(array.numpy().any() for array in gradient_by.values())


def test_gradient_by_stiffness_of_many_worlds_matches_a_forward_difference():
    many = Rollout(build_model(64, visuals=False), command_filter=vertical_jump_filter(), double=True)
    many.parameters["latency"].fill_(0.006)  # [s]
    targets, start = np.tile([0.0, 0.3, 0.3], (30, 4)), many.standing()
    jump = many.run(targets, *start)
    by_state = np.zeros(jump.q.shape)
    by_state[-1, 2] = 1.0  # the last base heights
    gradient = many.backward(jump, q=wp.array(by_state, dtype=jump.q.dtype, device=many.device))
    by_stiffness, heights = gradient["kp"].numpy(), jump.q.numpy()[-1, 2]
    many.parameters["kp"].assign(many.parameters["kp"].numpy() + 1.0e-4)
    higher = many.run(targets, *start).q.numpy()[-1, 2]
    assert (higher - heights) / 1.0e-4 == pytest.approx(by_stiffness.sum(axis=0), rel=1.0e-3)
