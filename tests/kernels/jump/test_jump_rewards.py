import math

import numpy as np
import pytest

from jump_helpers import DEFAULT_ANGLE, DEG, Table, functions, make_episode, make_view
from jumper_warp.kernels.jump import rewards
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE

NAMES = """jump_height estimated_jump_height horizontal_velocity orientation angular_velocity joint_symmetry
ground_posture air_posture post_landing_posture paws_down soft_impact stance_impact catch_landing damp_landing
squat touchdown_tracking folded_legs"""
reward = Table(functions(rewards, NAMES), float)
E = math.exp
PHASES = [int(STANCE), int(FLIGHT), int(LANDED)]
TRANSVERSAL = np.tile([0.0, 1.0, 1.0], 4)  # 1 for outer and inner motors
LATERAL = 1.0 - TRANSVERSAL  # 1 for lateral motors
HEIGHT = {"std_fine": 0.10, "scale_sharp": 0.05, "std_wide": 0.4}  # [m]


def name_of(value):
    """Return the id of a parameter in a table of terms: the term's name, other values have none."""
    return value if isinstance(value, str) else ""


@pytest.mark.parametrize(
    ("error", "expected"),
    [(0.0, 5.0), (0.05, E(-0.25) + 3.0 * E(-1.0) + E(-1.0 / 64.0)), (-0.1, E(-1.0) + 3.0 * E(-2.0) + E(-1.0 / 16.0))],
)
def test_jump_height_is_paid_at_the_apex_only(error, expected):
    at_apex = make_episode(phase=FLIGHT, at_apex=1, apex_passed=1, max_height=0.9 + error, goal=(0.0, 0.0, 0.9))
    assert reward("jump_height", make_view(), at_apex, **HEIGHT) == pytest.approx(expected, rel=1e-4)
    at_apex.at_apex = 0
    assert reward("jump_height", make_view(), at_apex, **HEIGHT) == 0.0


def test_estimated_jump_height_is_ballistic_and_paid_in_flight_before_the_apex():
    # rising with 1.962 m/s from 0.6 m: 0.6 + 1.962^2 / 19.62 = 0.7962 m, 0.05 m above the goal
    view = make_view(pos=(0.0, 0.0, 0.6), lin_vel=(0.3, 0.0, 1.962))
    fields = {"goal": (0.0, 0.0, 0.7462), "max_height": 0.6}
    rising = make_episode(phase=FLIGHT, **fields)
    expected = E(-0.25) + 3.0 * E(-1.0) + E(-1.0 / 64.0)
    assert reward("estimated_jump_height", view, rising, **HEIGHT) == pytest.approx(expected, rel=1e-4)
    for episode in (
        make_episode(phase=FLIGHT, apex_passed=1, **fields),
        make_episode(phase=STANCE, **fields),
        make_episode(phase=LANDED, **fields),
    ):
        assert reward("estimated_jump_height", view, episode, **HEIGHT) == 0.0


ALWAYS_PAID = [
    (
        "horizontal_velocity",
        {"lin_vel": (0.03, -0.04, 7.0)},
        {"speed_scale": 0.05, "waiting_scale": 0.25},
        [E(-1.0), 2.0 * E(-1.0)],
    ),
    (
        "orientation",
        {"projected_gravity": (0.06, -0.08, -0.995)},
        {"std": 0.1, "waiting_scale": 0.25},
        [E(-1.0), E(-1.0)],
    ),
    ("angular_velocity", {"ang_vel": (2.0, -1.0, 2.0)}, {"std": 3.0, "waiting_scale": 0.25}, [E(-1.0), E(-1.0)]),
    # transversal angles 0.5 and 0.9 in equal number: variance 0.04; |lateral| = sqrt(4) * 0.1
    (
        "joint_symmetry",
        {"angle": np.tile([0.1, 0.5, 0.9], 4)},
        {"std_variance": 0.04, "std_lateral": 0.2, "waiting_scale": 0.25},
        [E(-2.0), E(-2.0)],
    ),
]  # (term, robot, numbers, value in [stance, off stance])


@pytest.mark.parametrize(("term", "robot", "numbers", "values"), ALWAYS_PAID, ids=name_of)
def test_always_paid_terms_count_less_while_a_jump_is_due(term, robot, numbers, values):
    view = make_view(**robot)
    before_command = make_episode(phase=STANCE, steps=9, command_step=10)
    assert reward(term, view, before_command, **numbers) == pytest.approx(values[0], rel=1e-4)
    due = make_episode(phase=STANCE, steps=10, command_step=10)
    assert reward(term, view, due, **numbers) == pytest.approx(0.25 * values[0], rel=1e-4)
    for phase in (FLIGHT, LANDED):
        jumped = make_episode(phase=phase, steps=10, command_step=10)
        assert reward(term, view, jumped, **numbers) == pytest.approx(values[1], rel=1e-4)


def test_joint_symmetry_falls_with_variance_and_with_lateral_angles():
    lateral_only = make_view(angle=np.tile([0.1, 0.7, 0.7], 4))
    variance_only = make_view(angle=np.tile([0.0, 0.5, 0.9], 4))
    task = make_episode(command_step=1)
    widths = {"std_variance": 0.04, "std_lateral": 0.2, "waiting_scale": 1.0}
    assert reward("joint_symmetry", lateral_only, task, **widths) == pytest.approx(E(-1.0), rel=1e-4)
    assert reward("joint_symmetry", variance_only, task, **widths) == pytest.approx(E(-1.0), rel=1e-4)


POSTURES = [
    ("ground_posture", 35.0 * DEG, {"std": 10.0 * DEG, "shift": 35.0 * DEG, "waiting_scale": 1.0}, PHASES[0::2]),
    ("air_posture", 0.0, {"std": 10.0 * DEG}, PHASES[1:2]),
    ("post_landing_posture", 15.0 * DEG, {"std": 10.0 * DEG, "shift": 15.0 * DEG}, PHASES[2:]),
]


@pytest.mark.parametrize(("term", "shift", "numbers", "phases"), POSTURES, ids=name_of)
def test_postures_are_phi_of_the_rms_motor_offset_in_their_phases(term, shift, numbers, phases):
    target = DEFAULT_ANGLE + shift * TRANSVERSAL
    one_motor_off = target.copy()
    one_motor_off[4] += math.sqrt(12.0) * 10.0 * DEG
    laterals_off = target + math.sqrt(3.0) * 10.0 * DEG * LATERAL
    for phase in PHASES:
        task = make_episode(phase=phase)
        due = 1.0 if phase in phases else 0.0
        assert reward(term, make_view(angle=target), task, **numbers) == pytest.approx(due)
        assert reward(term, make_view(angle=one_motor_off), task, **numbers) == pytest.approx(due * E(-1.0), rel=1e-4)
        assert reward(term, make_view(angle=laterals_off), task, **numbers) == pytest.approx(due * E(-1.0), rel=1e-4)


LANDING_TERMS = [
    ("post_landing_posture", make_view(), {"std": 0.2, "shift": 0.0}, 1.0),
    ("soft_impact", make_view(), {"limit": 49.05}, 1.0),
    ("catch_landing", make_view(lin_vel=(0.0, 0.0, -0.4)), {}, 0.4),
    ("damp_landing", make_view(rate=0.5 * TRANSVERSAL), {}, 0.5),
]


@pytest.mark.parametrize(("term", "view", "numbers", "expected"), LANDING_TERMS, ids=name_of)
def test_landing_terms_are_paid_for_18_policy_steps_from_touchdown(term, view, numbers, expected):
    assert reward(term, view, make_episode(phase=LANDED, phase_steps=0), **numbers) == pytest.approx(expected)
    assert reward(term, view, make_episode(phase=LANDED, phase_steps=17), **numbers) == pytest.approx(expected)
    assert reward(term, view, make_episode(phase=LANDED, phase_steps=18), **numbers) == 0.0
    assert reward(term, view, make_episode(phase=STANCE), **numbers) == 0.0
    assert reward(term, view, make_episode(phase=FLIGHT), **numbers) == 0.0


IMPACTS = [
    ((0.0, 0.0, -2.0), (0.0, 0.0, 10.0), 0.8, -0.4),  # falling, slowed down by 10 m/s^2
    ((0.0, 0.0, -2.0), (0.0, 0.0, 80.0), 0.0, -1.0),  # beyond both limits
    ((0.0, 0.0, -2.0), (0.0, 0.0, -9.81), 1.0, 0.0),  # speeding up
    ((0.0, 0.0, 2.0), (0.0, 0.0, 30.0), 1.0, 0.0),  # taking off
    ((3.0, 0.0, -4.0), (-5.0, 0.0, 10.0), 0.78, -0.44),  # (-5 * 3 - 10 * 4) / 5 = -11
    ((0.0, 0.0, 0.0), (0.0, 0.0, 30.0), 1.0, 0.0),  # no direction of motion
    ((0.0, 0.0, -3.0), (0.0, 0.0, 180.0), 0.0, -1.0),  # a landing within the step
    ((0.0, 0.0, -3.0), (0.0, 0.0, 240.0), 0.0, -1.0),  # likewise, rebounding with 1 m/s
    ((0.0, 0.0, -0.05), (0.0, 0.0, 40.0), 0.94, -0.12),  # pushing off while sinking: 0.05 m/s were lost, 3 m/s^2
]  # (previous velocity [m/s], mean acceleration [m/s^2], soft impact, stance impact)


@pytest.mark.parametrize(("vel", "acc", "soft", "stance"), IMPACTS)
def test_impacts_are_the_loss_of_the_previous_speed_over_the_limit(vel, acc, soft, stance):
    view = make_view(prev_lin_vel=vel, lin_acc=acc, lin_vel=np.array(vel) + np.array(acc) / 60.0)
    assert reward("soft_impact", view, make_episode(phase=LANDED), limit=50.0) == pytest.approx(soft)
    assert reward("stance_impact", view, make_episode(phase=STANCE), limit=25.0) == pytest.approx(stance)
    for phase in (FLIGHT, LANDED):
        assert reward("stance_impact", view, make_episode(phase=phase), limit=25.0) == 0.0


@pytest.mark.parametrize(("vz", "expected"), [(0.3, 0.0), (-0.3, 0.3), (-2.5, 1.0)])
def test_catch_landing_is_the_clamped_speed_of_the_fall(vz, expected):
    falling = make_view(lin_vel=(1.0, 1.0, vz))
    assert reward("catch_landing", falling, make_episode(phase=LANDED)) == pytest.approx(expected)


def test_damp_landing_is_the_mean_of_clamped_folding_rates():
    # per leg: lateral ignored, outer 3 -> 1, inner -2 -> 0
    view = make_view(rate=np.tile([9.0, 3.0, -2.0], 4))
    assert reward("damp_landing", view, make_episode(phase=LANDED)) == pytest.approx(0.5)


def test_paws_down_is_the_number_of_contacts_after_touchdown():
    view = make_view(contact=(1.0, 1.0, 0.0, 1.0), contacts=3)
    assert reward("paws_down", view, make_episode(phase=LANDED)) == 3.0
    for phase in (STANCE, FLIGHT):
        assert reward("paws_down", view, make_episode(phase=phase)) == 0.0


@pytest.mark.parametrize(
    ("height", "wanted"),
    # 50 m/s^2 from the squat up to 0.3 m give the speed of the apex: v^2 = 2 * 9.81 (apex - 0.3) = 2 * 50 (0.3 - squat)
    [(0.8, 0.3 - 9.81 * 0.5 / 50.0), (0.25, 0.3), (3.0, 0.15)],
)
def test_squat_is_paid_at_the_apex_for_the_depth_that_the_height_needs(height, wanted):
    numbers = {"std": 0.02, "takeoff_height": 0.3, "acceleration": 50.0, "floor": 0.15}
    for offset, expected in ((0.0, 1.0), (0.02, E(-1.0)), (-0.02, E(-1.0))):
        fields = {"phase": FLIGHT, "squat": wanted + offset, "goal": (0.0, 0.0, height)}
        at_apex = make_episode(at_apex=1, **fields)
        assert reward("squat", make_view(), at_apex, **numbers) == pytest.approx(expected, rel=1e-4)
        assert reward("squat", make_view(), make_episode(at_apex=0, **fields), **numbers) == 0.0


def test_touchdown_tracking_is_paid_once_for_the_distance_from_the_goal():
    view, goal = make_view(pos=(1.06, -2.08, 0.3)), {"goal": (1.0, -2.0, 0.0)}  # 0.1 m away
    touching = make_episode(phase=LANDED, touched_down=1, **goal)
    assert reward("touchdown_tracking", view, touching, std=0.1) == pytest.approx(E(-1.0), rel=1e-4)
    assert reward("touchdown_tracking", view, make_episode(phase=LANDED, **goal), std=0.1) == 0.0


def test_folded_legs_counts_transversal_angles_beyond_the_limit_in_flight():
    angle = np.zeros(12)
    angle[[0, 1, 5, 8]] = [3.0, 2.2, 2.4, 1.9]  # lateral, outer, inner, inner
    view = make_view(angle=angle)
    expected = 0.2**2 + 0.4**2  # [rad^2] beyond 2 rad
    assert reward("folded_legs", view, make_episode(phase=FLIGHT), angle=2.0) == pytest.approx(expected, rel=1e-4)
    for phase in (STANCE, LANDED):
        assert reward("folded_legs", view, make_episode(phase=phase), angle=2.0) == 0.0
