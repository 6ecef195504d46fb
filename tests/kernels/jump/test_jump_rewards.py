"""Rewards of jumps by hand, and those of a rollout against a NumPy oracle."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jump_helpers import DEFAULT_ANGLE, DEG, PHASES, Table, make_env, random_actions, tilted_by
from jump_oracle import expected_terms, robot_of
from jumper_warp.kernels.jump import rewards
from jumper_warp.registry import make_task
from jumper_warp.tasks.jump.cfg import StartProbability

E = math.exp
S, F, L = PHASES
TRANSVERSAL = np.tile([0.0, 1.0, 1.0], 4)  # 1 for outer and inner motors
HEIGHT = {"std_fine": 0.10, "scale_sharp": 0.05, "std_wide": 0.4}  # [m]
AT_APEX = {"phase": F, "at_apex": 1, "apex_passed": 1, "goal": (0.0, 0.0, 0.9)}
RISING = {"pos": (0.0, 0.0, 0.6), "lin_vel": (0.3, 0.0, 1.962)}  # apex 0.6 + 1.962^2 / 19.62 = 0.7962 m
BELOW = {"goal": (0.0, 0.0, 0.7462), "max_height": 0.6}  # 0.05 m below that apex
BEFORE, DUE = {"phase": S, "steps": 9, "command_step": 10}, {"phase": S, "steps": 10, "command_step": 10}
FLOWN = [{"phase": phase, "steps": 10, "command_step": 10} for phase in (F, L)]
JUST, LAST, LATE = ({"phase": L, "phase_steps": steps} for steps in (0, 17, 18))  # just landed: less than 0.3 s
ESTIMATE = {"std_middle": 0.30, "std_wide": 0.50, "std_fine": 0.10, "height": 0.30}
FLYING = {"pos": (0.2, 0.3, 0.52625), "lin_vel": (1.0, -0.6, 2.0)}  # lands 0.5 s later, 0.3 m high, at (0.7, 0)
SQUAT = {"std": 0.02, "takeoff_height": 0.3, "acceleration": 50.0, "floor": 0.15}
RESTS = [  # (episode, whether the robot should rest)
    ({"steps": 9, "command_step": 10}, True), ({"steps": 10, "command_step": 10}, False),
    ({"phase": F, "steps": 9, "command_step": 10}, False), ({"phase": F, "phase_steps": 60}, False),
    ({"phase": L, "phase_steps": 0}, False), ({"phase": L, "phase_steps": 29}, False),
    ({"phase": L, "phase_steps": 30}, True),
]  # fmt: skip
RIPPLE = {
    "torque": np.arange(12.0), "prev_torque": np.arange(12.0) - 0.5, "paw_force": (30.0, 30.0, 30.0, 30.0),
    "peak_force": (30.0, 40.0, 30.0, 30.0), "action": np.full(12, 0.1), "prev_action": np.zeros(12),
}  # fmt: skip
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
IMPACTS = [({"prev_lin_vel": vel, "lin_acc": acc, "lin_vel": np.array(vel) + np.array(acc) / 60.0}, soft, stance)
           for vel, acc, soft, stance in IMPACTS]  # fmt: skip


def one_off(target, size):
    """Return motor angles [rad] at a target but for one motor, and but for the laterals, by an rms of `size` [rad]."""
    return target + math.sqrt(12.0) * size * np.eye(12)[4], target + math.sqrt(3.0) * size * (1.0 - TRANSVERSAL)


def posture(shift, std):
    """Return rows of a posture reward, with the rewarded offset `shift` of transversal motors and its width [rad]."""
    target = DEFAULT_ANGLE + shift * TRANSVERSAL
    return [(1.0, {"angle": target}, {}), *((E(-1.0), {"angle": angle}, {}) for angle in one_off(target, std))]


def while_due(robot, stance, flown):
    """Return rows of a reward of 0.25 while a jump is due, else `stance` and, off the stance, `flown`."""
    episodes = [(stance, BEFORE), (0.25 * stance, DUE), *((flown, episode) for episode in FLOWN)]
    return [(value, robot, episode) for value, episode in episodes]


def just_landed(value, robot):
    """Return rows of a reward that is paid for 0.3 s from the touchdown on."""
    return [(value, robot, JUST), (value, robot, LAST), *((0.0, robot, e) for e in (LATE, {"phase": S}, {"phase": F}))]


def resting(value, robot):
    """Return rows of a reward that is paid while the robot should rest."""
    return [(value * due, robot, episode) for episode, due in RESTS]


def missed(miss, **episode):
    """Return a goal missed by the landing of FLYING, by a 3-4-5 triangle; miss [m]."""
    return {"goal": (0.7 + 0.6 * miss, -0.8 * miss, 0.0)} | episode


def left_right():
    """Return rows of the left-right symmetry: laterals do not matter; one of four pairs differs by 1 rad, rms 0.5."""
    mirrored = {"angle": [0.3, 0.1, 0.9, -0.5, 0.1, 0.9, 0.2, 1.1, 0.4, 0.0, 1.1, 0.4]}
    rows = [(1.0, mirrored, BEFORE)]
    for motor in np.flatnonzero(TRANSVERSAL):
        angle = {"angle": DEFAULT_ANGLE + np.eye(12)[motor]}
        rows += [(E(-1.0), angle, BEFORE), (0.1 * E(-1.0), angle, {})]
    return rows


def turned():
    """Return rows of the flight orientation, across headings of 180 degrees and with both signs of the quaternion."""
    rows = []
    for heading in (0.0, 90.0, 179.0, -179.0, 180.0):
        for yaw, pitch in ((2.0, 0.0), (-2.0, 0.0), (0.0, 8.0), (6.0, -8.0)):
            quat = Rotation.from_euler("ZYX", [heading + yaw, pitch, 0.0], degrees=True).as_quat()
            # turns about perpendicular axes: cos(w / 2) = cos(yaw / 2) cos(pitch / 2)
            angle = 2.0 * math.acos(math.cos(0.5 * yaw * DEG) * math.cos(0.5 * pitch * DEG))
            episode = {"phase": F, "heading": heading * DEG, "goal": (1.0, 0.0, 0.0)}
            rows += [(E(-((angle / (10.0 * DEG)) ** 2)), {"quat": sign * quat, "lin_vel": (1.0, 0.0, 0.0)}, episode)
                     for sign in (1.0, -1.0)]  # fmt: skip
    return rows


def tilts(degrees, **robot):
    """Return rows of a squared tilt, 1 at 10 degrees, for a tilt about two horizontal axes."""
    value = (math.sin(degrees * DEG) / math.sin(10.0 * DEG)) ** 2
    return [(value, tilted_by(degrees * DEG, axis) | robot, {}) for axis in ((1.0, 0.0, 0.0), (0.6, -0.8, 0.0))]


def squats():
    """Return rows of the squat, paid at the apex for the depth that the height needs."""
    rows = []
    # 50 m/s^2 from the squat up to 0.3 m give the speed of the apex: v^2 = 2 * 9.81 (apex - 0.3) = 2 * 50 (0.3 - squat)
    for height, wanted in ((0.8, 0.3 - 9.81 * 0.5 / 50.0), (0.25, 0.3), (3.0, 0.15)):
        for offset, value in ((0.0, 1.0), (0.02, E(-1.0)), (-0.02, E(-1.0))):
            fields = {"phase": F, "squat": wanted + offset, "goal": (0.0, 0.0, height)}
            rows += [(value, {}, fields | {"at_apex": 1}), (0.0, {}, fields)]
    return rows


UP = {"lin_vel": (0.0, 0.0, 3.0)}
TO_GOAL = [({"lin_vel": vel, "pos": (1.0, 1.0, 0.5)}, value) for vel, value in (
    ((0.1, 5.0, 0.0), 1.0), ((0.0, 5.0, 3.0), 0.0), ((-0.1, 0.0, 3.0), 0.0), ((0.0, 0.0, -3.0), 0.0))]  # fmt: skip
ON_WAY = [(miss, {"pos": (1.0 + 0.6 * miss, -2.0 + 0.8 * miss, 0.7)}) for miss in (0.0, 0.03, 0.15, 0.30)]
STOP = 2.0 * math.sqrt(0.24525 / 9.81)  # [m] way of a pendulum 0.24525 m high from 2 m/s on; with g / 4 twice as far
CAPTURE = {"pos": (0.0, 0.0, 0.24525), "lin_vel": (2.0, 0.0, -3.0), "paw_pos": np.tile([STOP, 0.0, 0.0], 4)}
# FL down; FR up for 0.1 s after contact; BL up for 0.02 s after contact; BR without contact yet
HOP, HOPPED = {"contact": (1.0, 0.0, 0.0, 0.0), "air_time": (0.0, 0.1, 0.02, 0.4)}, {"paws_landed": 0b0111}
WIDTHS = {"std_variance": 0.04, "std_lateral": 0.2}
AIR, GROUND, LANDING = 0.0, 35.0 * DEG, 15.0 * DEG  # [rad] offsets of the postures
WIDTH = {"std": 10.0 * DEG}
STAND = {"std": 20.0 * DEG, "shift": 25.0 * DEG}
STANDING = DEFAULT_ANGLE + 25.0 * DEG * TRANSVERSAL
STILL = {"std_lin_vel": 0.1, "std_ang_vel": 0.5}
SLOW = {"lin_vel": (0.06, 0.0, -0.08)}  # 0.1 m/s
TRACKING = {"std_wide": 0.15, "std_fine": 0.03, "fine_weight": 0.6}
TRACKED = (1.6, E(-0.04) + 0.6 * E(-1.0), E(-1.0) + 0.6 * E(-25.0), E(-4.0))
TERMS = [  # (term, numbers, rows (value, robot, episode), phases in which it is paid)
    ("jump_height", HEIGHT, [
        (5.0, {}, AT_APEX | {"max_height": 0.9}), (0.0, {}, AT_APEX | {"max_height": 0.9, "at_apex": 0}),
        (E(-0.25) + 3.0 * E(-1.0) + E(-1.0 / 64.0), {}, AT_APEX | {"max_height": 0.95}),
        (E(-1.0) + 3.0 * E(-2.0) + E(-1.0 / 16.0), {}, AT_APEX | {"max_height": 0.8})]),
    ("estimated_jump_height", HEIGHT, [(E(-0.25) + 3.0 * E(-1.0) + E(-1.0 / 64.0), RISING, BELOW)], [F]),
    ("estimated_jump_height", HEIGHT, [(0.0, RISING, BELOW | {"phase": F, "apex_passed": 1})]),
    ("horizontal_velocity", {"speed_scale": 0.05, "waiting_scale": 0.25},
     while_due({"lin_vel": (0.03, -0.04, 7.0)}, E(-1.0), 2.0 * E(-1.0))),
    ("orientation", {"std": 0.1, "waiting_scale": 0.25},
     while_due({"projected_gravity": (0.06, -0.08, -0.995)}, E(-1.0), E(-1.0))),
    ("angular_velocity", {"std": 3.0, "waiting_scale": 0.25},
     while_due({"ang_vel": (2.0, -1.0, 2.0)}, E(-1.0), E(-1.0))),
    # transversal angles 0.5 and 0.9 in equal number: variance 0.04; |lateral| = sqrt(4) * 0.1
    ("joint_symmetry", WIDTHS | {"waiting_scale": 0.25},
     while_due({"angle": np.tile([0.1, 0.5, 0.9], 4)}, E(-2.0), E(-2.0))),
    ("joint_symmetry", WIDTHS | {"waiting_scale": 1.0},
     [(E(-1.0), {"angle": np.tile(angles, 4)}, {}) for angles in ([0.1, 0.7, 0.7], [0.0, 0.5, 0.9])]),
    ("ground_posture", WIDTH | {"shift": GROUND, "waiting_scale": 1.0}, posture(GROUND, 10.0 * DEG), [S, L]),
    ("air_posture", WIDTH, posture(AIR, 10.0 * DEG), [F]),
    ("post_landing_posture", WIDTH | {"shift": LANDING}, posture(LANDING, 10.0 * DEG), [L]),
    ("post_landing_posture", {"std": 0.2, "shift": 0.0}, just_landed(1.0, {})),
    ("soft_impact", {"limit": 50.0}, [(soft, robot, {"phase": L}) for robot, soft, _ in IMPACTS]),
    ("soft_impact", {"limit": 50.0}, just_landed(0.8, IMPACTS[0][0])),
    ("stance_impact", {"limit": 25.0}, [(stance, robot, {}) for robot, _, stance in IMPACTS], [S]),
    ("catch_landing", {}, just_landed(0.4, {"lin_vel": (1.0, 1.0, -0.4)})),
    ("catch_landing", {}, [(value, {"lin_vel": (1.0, 1.0, up)}, JUST) for up, value in ((0.3, 0.0), (-2.5, 1.0))]),
    ("damp_landing", {}, just_landed(0.5, {"rate": 0.5 * TRANSVERSAL})),
    # per leg: lateral ignored, outer 3 -> 1, inner -2 -> 0
    ("damp_landing", {}, [(0.5, {"rate": np.tile([9.0, 3.0, -2.0], 4)}, JUST)]),
    ("paws_down", {}, [(3.0, {"contact": (1.0, 1.0, 0.0, 1.0), "contacts": 3}, {})], [L]),
    ("squat", SQUAT, squats()),
    ("touchdown_tracking", {"std": 0.1}, [  # 0.1 m away
        (E(-1.0) * touches, {"pos": (1.06, -2.08, 0.3)},
         {"phase": L, "touched_down": touches, "goal": (1.0, -2.0, 0.0)}) for touches in (0, 1)]),
    ("settled", {"first": 54.0, "last": 66.0, "std": 0.1}, [
        (value, {"lin_vel": (0.06, 0.0, -0.08)}, {"phase_steps": steps})
        for steps, value in ((53, 0.0), (54, E(-1.0)), (65, E(-1.0)), (66, 0.0))], [L]),
    ("tracking", TRACKING, [(value, robot, {"goal": (1.0, -2.0, 0.0)})
                            for (_, robot), value in zip(ON_WAY, TRACKED, strict=True)], [F, L]),
    ("estimated_tracking", ESTIMATE, [(1.4, FLYING, missed(0.0)), (
        E(-1.0 / 9.0) + 0.1 * E(-0.04) + 0.3 * E(-1.0), FLYING, missed(0.1)), (
        E(-1.0) + 0.1 * E(-0.36) + 0.3 * E(-9.0), FLYING, missed(0.3)), (
        E(-25.0 / 9.0) + 0.1 * E(-1.0) + 0.3 * E(-25.0), FLYING, missed(0.5))], [F]),
    # all of it higher by the ground at the goal
    ("estimated_tracking", ESTIMATE, [
        (1.4, FLYING | {"pos": (0.2, 0.3, 0.52625 + rise)}, missed(0.0, phase=F, goal_ground=rise))
        for rise in (0.08, -0.2)]),
    ("flight_orientation", {"std": 10.0 * DEG}, turned()),
    ("flight_orientation", {"std": 10.0 * DEG}, [(value, robot, {"goal": (2.0, 1.0, 0.0)})
                                                 for robot, value in TO_GOAL], [F]),
    ("flight_angular_velocity", {"std": 10.0}, [(E(-1.0), {"ang_vel": (6.0, 0.0, -8.0)}, {})], [F]),  # 10 rad/s
    ("left_right_symmetry", {"std": 0.5, "waiting_scale": 0.1}, left_right()),
    ("standing_posture", STAND, [*resting(1.0, {"angle": STANDING}),
                                 *resting(E(-1.0), {"angle": STANDING + 20.0 * DEG})]),
    ("base_at_rest", STILL, [*resting(1.0, {}), *resting(E(-1.0), SLOW),
                             *resting(E(-2.0), SLOW | {"ang_vel": (0.3, 0.4, 0.0)})]),
    ("landing_tilt", {"angle": 10.0 * DEG}, [*tilts(10.0), *tilts(5.0), *tilts(0.0)], [L]),
    ("descent_tilt", {"angle": 10.0 * DEG}, tilts(20.0, lin_vel=(1.0, 0.0, -0.1)), [F]),
    ("descent_tilt", {"angle": 10.0 * DEG}, [(0.0, tilted_by(20.0 * DEG) | UP, {"phase": F})]),
    ("lifted_again", {"threshold": 0.05}, [(1.0, HOP, HOPPED)], [L]),
    ("lifted_again", {"threshold": 0.0}, [(2.0, HOP, HOPPED)], [L]),
    ("capture_point", {"std": STOP},
     [(1.0, CAPTURE, {}), (E(-1.0), CAPTURE | {"gravity_magnitude": 2.4525}, {})], [L]),
    ("torque_ripple", {}, resting(3.0, RIPPLE)),
    ("resting_action_rate", {}, resting(0.12, RIPPLE)),
    ("force_ripple", {"weight_force": 100.0}, resting(0.01, RIPPLE)),
]  # fmt: skip
reward = Table([getattr(rewards, name) for name in dict.fromkeys(row[0] for row in TERMS)], float)
TASK = make_task("horizontal-jump")


@pytest.mark.parametrize("row", TERMS, ids=lambda row: row[0])
def test_reward_by_hand(row):
    reward.check(*row)


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
        logged.append(env.skills[0].term_value.numpy().copy())
        expected.append(expected_terms(TASK, before, robot_of(env), action.clamp(-1.0, 1.0).numpy().T))
        env._reset_worlds(env._part(), env.episodes.done)
    return np.array(logged), np.array(expected)


@pytest.mark.parametrize("index", range(len(TASK.rewards)), ids=[term.name for term in TASK.rewards])
def test_a_logged_reward_term_equals_the_numpy_oracle(rollout, index):
    logged, expected = (values[:, index] for values in rollout)
    assert expected.any()
    np.testing.assert_allclose(logged, expected, rtol=2e-3, atol=2e-4 * np.abs(expected).max())
