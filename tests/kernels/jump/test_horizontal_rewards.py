import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jump_helpers import (
    DEFAULT_ANGLE,
    DEG,
    Table,
    make_env,
    make_episode,
    make_view,
    random_actions,
    tilted_by,
)  # fmt: skip
from jump_oracle import expected_terms, robot_of
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE
from jumper_warp.registry import make_task
from jumper_warp.tasks.jump.cfg import StartProbability

TASK = make_task("horizontal-jump")
E = math.exp
PHASES = [int(STANCE), int(FLIGHT), int(LANDED)]
TRANSVERSAL = np.tile([0.0, 1.0, 1.0], 4)  # 1 for outer and inner motors
ESTIMATE = {"std_middle": 0.30, "std_wide": 0.50, "std_fine": 0.10, "height": 0.30}
reward = Table([term.func for term in TASK.rewards], float)
"""reward(name, view, episode, **numbers): value of a reward term before its weight."""


@pytest.mark.parametrize(
    ("miss", "expected"),
    [(0.0, 1.6), (0.03, E(-0.04) + 0.6 * E(-1.0)), (0.15, E(-1.0) + 0.6 * E(-25.0)), (0.30, E(-4.0))],
)
def test_tracking_has_a_wide_and_a_narrow_kernel_and_is_paid_after_takeoff(miss, expected):
    # horizontal miss by a 3-4-5 triangle; the height does not matter
    view = make_view(pos=(1.0 + 0.6 * miss, -2.0 + 0.8 * miss, 0.7))
    widths = {"std_wide": 0.15, "std_fine": 0.03, "fine_weight": 0.6}
    for phase in (FLIGHT, LANDED):
        task = make_episode(phase=phase, goal=(1.0, -2.0, 0.0))
        assert reward("tracking", view, task, **widths) == pytest.approx(expected, rel=1e-4)
    assert reward("tracking", view, make_episode(goal=(1.0, -2.0, 0.0)), **widths) == 0.0


@pytest.mark.parametrize(
    ("miss", "expected"),
    [
        (0.0, 1.4),
        (0.10, E(-1.0 / 9.0) + 0.1 * E(-0.04) + 0.3 * E(-1.0)),
        (0.30, E(-1.0) + 0.1 * E(-0.36) + 0.3 * E(-9.0)),
        (0.50, E(-25.0 / 9.0) + 0.1 * E(-1.0) + 0.3 * E(-25.0)),
    ],
)
def test_est_tracking_is_paid_for_the_ballistic_landing_in_flight(miss, expected):
    # half a second from z = 0.52625 m upward with 2 m/s to 0.3 m: 0.52625 + 2 / 2 - 9.81 / 8 = 0.3
    view = make_view(pos=(0.2, 0.3, 0.52625), lin_vel=(1.0, -0.6, 2.0))
    goal = (0.7 + 0.6 * miss, -0.8 * miss, 0.0)
    flying = make_episode(phase=FLIGHT, goal=goal)
    assert reward("estimated_tracking", view, flying, **ESTIMATE) == pytest.approx(expected, rel=1e-3)
    for phase in (STANCE, LANDED):
        assert reward("estimated_tracking", view, make_episode(phase=phase, goal=goal), **ESTIMATE) == 0.0


@pytest.mark.parametrize("rise", [0.08, -0.2])
def test_est_tracking_predicts_the_landing_above_the_ground_at_the_goal(rise):
    # as above, all of it higher by the ground at the goal
    view = make_view(pos=(0.2, 0.3, 0.52625 + rise), lin_vel=(1.0, -0.6, 2.0))
    flying = make_episode(phase=FLIGHT, goal=(0.7, 0.0, 0.0), goal_ground=rise)
    assert reward("estimated_tracking", view, flying, **ESTIMATE) == pytest.approx(1.4, rel=1e-4)


@pytest.mark.parametrize("heading", [0.0, 90.0, 179.0, -179.0, 180.0])
@pytest.mark.parametrize(("yaw", "pitch"), [(2.0, 0.0), (-2.0, 0.0), (0.0, 8.0), (6.0, -8.0)])
def test_flight_orientation_is_the_rotation_from_level_and_heading(heading, yaw, pitch):
    quat = Rotation.from_euler("ZYX", [heading + yaw, pitch, 0.0], degrees=True).as_quat()
    # turns about perpendicular axes: cos(w / 2) = cos(yaw / 2) cos(pitch / 2)
    angle = 2.0 * math.acos(math.cos(0.5 * yaw * DEG) * math.cos(0.5 * pitch * DEG))
    expected = E(-((angle / (10.0 * DEG)) ** 2))
    for sign in (1.0, -1.0):  # both quaternions of the orientation
        view = make_view(quat=sign * quat, lin_vel=(1.0, 0.0, 0.0))
        flying = make_episode(phase=FLIGHT, heading=heading * DEG, goal=(1.0, 0.0, 0.0))
        assert reward("flight_orientation", view, flying, std=10.0 * DEG) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(
    ("vel", "factor"),
    [((0.1, 5.0, 0.0), 1.0), ((0.0, 5.0, 3.0), 0.0), ((-0.1, 0.0, 3.0), 0.0), ((0.0, 0.0, -3.0), 0.0)],
)
def test_flight_orientation_is_paid_while_moving_towards_the_goal(vel, factor):
    fields = {"goal": (2.0, 1.0, 0.0)}
    view = make_view(pos=(1.0, 1.0, 0.5), lin_vel=vel)
    flying = make_episode(phase=FLIGHT, **fields)
    assert reward("flight_orientation", view, flying, std=10.0 * DEG) == pytest.approx(factor)
    for phase in (STANCE, LANDED):
        assert reward("flight_orientation", view, make_episode(phase=phase, **fields), std=10.0 * DEG) == 0.0


@pytest.mark.parametrize("phase", PHASES)
def test_flight_angular_velocity_is_phi_of_the_speed_in_flight_only(phase):
    # |(6, 0, -8)| = 10 rad/s
    view = make_view(ang_vel=(6.0, 0.0, -8.0))
    expected, task = E(-1.0) if phase == FLIGHT else 0.0, make_episode(phase=phase)
    assert reward("flight_angular_velocity", view, task, std=10.0) == pytest.approx(expected, rel=1e-4)


def test_left_right_symmetry_compares_transversal_motors_of_a_pair():
    # legs FL, FR, BL, BR; lateral motors differ, transversal ones are equal
    mirrored = make_view(angle=np.array([0.3, 0.1, 0.9, -0.5, 0.1, 0.9, 0.2, 1.1, 0.4, 0.0, 1.1, 0.4]))
    before_command = make_episode(command_step=1)
    assert reward("left_right_symmetry", mirrored, before_command, std=0.5, waiting_scale=0.1) == pytest.approx(1.0)
    # one of the four pairs differs by 1 rad: rms 0.5
    for motor in (1, 2, 4, 5, 7, 8, 10, 11):
        view = make_view(angle=DEFAULT_ANGLE + np.eye(12)[motor])
        for task, factor in ((before_command, 1.0), (make_episode(), 0.1)):
            value = reward("left_right_symmetry", view, task, std=0.5, waiting_scale=0.1)
            assert value == pytest.approx(factor * E(-1.0), rel=1e-4)


REST_CASES = [
    ({"steps": 9, "command_step": 10}, True),
    ({"steps": 10, "command_step": 10}, False),
    ({"phase": FLIGHT, "steps": 9, "command_step": 10}, False),
    ({"phase": FLIGHT, "phase_steps": 60}, False),
    ({"phase": LANDED, "phase_steps": 0}, False),
    ({"phase": LANDED, "phase_steps": 29}, False),
    ({"phase": LANDED, "phase_steps": 30}, True),
]


@pytest.mark.parametrize(("episode", "due"), REST_CASES)
def test_posture_and_rest_are_paid_before_the_command_and_half_a_second_after_touchdown(episode, due):
    task = make_episode(**episode)
    posture, still = {"std": 20.0 * DEG, "shift": 25.0 * DEG}, {"std_lin_vel": 0.1, "std_ang_vel": 0.5}
    target = make_view(angle=DEFAULT_ANGLE + 25.0 * DEG * TRANSVERSAL)
    assert reward("standing_posture", target, task, **posture) == pytest.approx(float(due))
    offset = make_view(angle=DEFAULT_ANGLE + 25.0 * DEG * TRANSVERSAL + 20.0 * DEG)
    assert reward("standing_posture", offset, task, **posture) == pytest.approx(due * E(-1.0), rel=1e-4)
    assert reward("base_at_rest", make_view(), task, **still) == pytest.approx(float(due))
    slow = make_view(lin_vel=(0.06, 0.0, -0.08))  # 0.1 m/s; with 0.5 rad/s below
    assert reward("base_at_rest", slow, task, **still) == pytest.approx(due * E(-1.0), rel=1e-4)
    turning = make_view(lin_vel=(0.06, 0.0, -0.08), ang_vel=(0.3, 0.4, 0.0))
    assert reward("base_at_rest", turning, task, **still) == pytest.approx(due * E(-2.0), rel=1e-4)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.6, -0.8, 0.0)])
def test_landing_tilt_is_1_at_its_limit_and_counts_after_touchdown(axis):
    view = make_view(**tilted_by(10.0 * DEG, axis))
    half = make_view(**tilted_by(5.0 * DEG, axis))
    assert reward("landing_tilt", view, make_episode(phase=LANDED), angle=10.0 * DEG) == pytest.approx(1.0, rel=1e-4)
    factor = (math.sin(5.0 * DEG) / math.sin(10.0 * DEG)) ** 2
    assert reward("landing_tilt", half, make_episode(phase=LANDED), angle=10.0 * DEG) == pytest.approx(factor, rel=1e-4)
    assert reward("landing_tilt", make_view(), make_episode(phase=LANDED), angle=10.0 * DEG) == 0.0
    for phase in (STANCE, FLIGHT):
        assert reward("landing_tilt", view, make_episode(phase=phase), angle=10.0 * DEG) == 0.0


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.6, -0.8, 0.0)])
def test_descent_tilt_counts_in_flight_while_the_base_falls(axis):
    view = make_view(**tilted_by(20.0 * DEG, axis), lin_vel=(1.0, 0.0, -0.1))
    factor = (math.sin(20.0 * DEG) / math.sin(10.0 * DEG)) ** 2
    assert reward("descent_tilt", view, make_episode(phase=FLIGHT), angle=10.0 * DEG) == pytest.approx(factor, rel=1e-4)
    rising = make_view(**tilted_by(20.0 * DEG, axis), lin_vel=(1.0, 0.0, 0.1))
    assert reward("descent_tilt", rising, make_episode(phase=FLIGHT), angle=10.0 * DEG) == 0.0
    for phase in (STANCE, LANDED):
        assert reward("descent_tilt", view, make_episode(phase=phase), angle=10.0 * DEG) == 0.0


@pytest.fixture(scope="module")
def rollout():
    """Return logged reward terms, and those of the NumPy oracle, of jumps from all starts, (steps, terms, worlds)."""
    starts = StartProbability(standing=0.2, default=0.2, in_flight=0.2, touchdown=0.2, after_landing=0.2)
    env = make_env(64, task=TASK, reset=dataclasses.replace(TASK.reset.settings, start_probability=starts), seed=3)
    env.auto_reset = False
    logged, expected = [], []
    for step, action in enumerate(0.2 * random_actions(64, 60)):
        action[:, TRANSVERSAL > 0.0] += 0.6 if step < 40 else -1.0
        before = robot_of(env)
        env.step(action)
        after = robot_of(env)
        logged.append(env.skills[0].term_value.numpy().copy())
        expected.append(expected_terms(TASK, before, after, action.clamp(-1.0, 1.0).numpy().T))
        env._reset_worlds(env._part(), env.episodes.done)
    return np.array(logged), np.array(expected)


@pytest.mark.parametrize("index", range(len(TASK.rewards)), ids=[term.name for term in TASK.rewards])
def test_a_logged_reward_term_equals_the_numpy_oracle(rollout, index):
    logged, expected = (values[:, index] for values in rollout)
    assert expected.any()
    np.testing.assert_allclose(logged, expected, rtol=2e-3, atol=2e-4 * np.abs(expected).max())


def test_lifted_again_counts_paws_in_the_air_after_their_own_first_contact():
    """Paws: FL down; FR up for 0.1 s after contact; BL up for 0.02 s after contact; BR without contact yet."""
    view = make_view(contact=(1.0, 0.0, 0.0, 0.0), air_time=(0.0, 0.1, 0.02, 0.4))
    landed = make_episode(phase=LANDED, paws_landed=0b0111)
    assert reward("lifted_again", view, landed, threshold=0.05) == 1.0
    assert reward("lifted_again", view, landed, threshold=0.0) == 2.0
    assert reward("lifted_again", view, make_episode(phase=FLIGHT, paws_landed=0b0111), threshold=0.0) == 0.0


def test_capture_point_is_paid_where_a_pendulum_stops_over_the_paws():
    # 0.2453 m high on Earth: sqrt(h / g) = 0.1581 s; at 2 m/s it stops 0.3162 m ahead
    paws = np.tile([0.3162, 0.0, 0.0], (4, 1))
    view = make_view(pos=(0.0, 0.0, 0.24525), lin_vel=(2.0, 0.0, -3.0), paw_pos=paws.ravel())
    landed = make_episode(phase=LANDED)
    assert reward("capture_point", view, landed, std=0.1) == pytest.approx(1.0, abs=1e-4)
    view.gravity_magnitude = 9.81 / 4.0  # twice as far
    assert reward("capture_point", view, landed, std=0.3162) == pytest.approx(E(-1.0), rel=1e-3)
    assert reward("capture_point", view, make_episode(phase=FLIGHT), std=0.1) == 0.0


def test_ripple_and_action_rate_count_only_while_the_robot_should_rest():
    view = make_view(
        torque=np.arange(12.0), prev_torque=np.arange(12.0) - 0.5, paw_force=(30.0, 30.0, 30.0, 30.0),
        peak_force=(30.0, 40.0, 30.0, 30.0), action=np.full(12, 0.1), prev_action=np.zeros(12),
    )  # fmt: skip
    resting = (make_episode(steps=3, command_step=9), make_episode(phase=LANDED, phase_steps=30))
    moving = (make_episode(steps=9, command_step=9), make_episode(phase=FLIGHT), make_episode(phase=LANDED))
    for name, value, numbers in (("torque_ripple", 3.0, {}), ("resting_action_rate", 0.12, {}),
                                 ("force_ripple", 0.01, {"weight_force": 100.0})):  # fmt: skip
        assert all(reward(name, view, task, **numbers) == pytest.approx(value, rel=1e-4) for task in resting), name
        assert not any(reward(name, view, task, **numbers) for task in moving), name
