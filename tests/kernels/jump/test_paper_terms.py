"""Reward and termination terms of the paper's jumps, by hand numbers."""

import math

import numpy as np
import pytest
import warp as wp

from jump_helpers import DEFAULT_ANGLE, DEG, PHASES, Table
from jumper_warp.kernels.jump import paper

E = math.exp
S, F, L = PHASES
RISING = {"pos": (0.0, 0.0, 0.6), "lin_vel": (0.3, 0.0, 1.962)}  # [m], [m/s] apex 0.6 + 1.962^2 / 19.62 = 0.7962 m
HEIGHT = {"std": 0.1, "scale": 0.05}
BELOW = {"goal": (0.0, 0.0, 0.7462)}  # 0.05 m below the estimate
ROLLED = {"quat": tuple(wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.2)), "lin_vel": (1.0, 0.0, 0.0)}
AHEAD, PAST = {"goal": (1.0, 0.0, 0.0)}, {"goal": (-1.0, 0.0, 0.0)}
POSTURE = DEFAULT_ANGLE + 20.0 * DEG * (np.arange(12) % 3 != 0)
POSTURE[0] += math.sqrt(12.0) * 10.0 * DEG  # rms offset 10 degrees
IMPACTS = [({"lin_vel": vel, "lin_acc": acc}, soft) for vel, acc, soft in (  # along the velocity after the step
    ((0.0, 0.0, -2.0), (0.0, 0.0, 10.0), 0.8),  # falling, slowed down by 10 m/s^2
    ((0.0, 0.0, -2.0), (0.0, 0.0, -9.81), 1.0),  # speeding up
    ((3.0, 0.0, -4.0), (-5.0, 0.0, 10.0), 0.78),  # (-5 * 3 - 10 * 4) / 5 = -11
    ((0.0, 0.0, 1.0), (0.0, 0.0, 240.0), 1.0),  # already moving up
    ((0.0, 0.0, -2.0), (0.0, 0.0, 80.0), 0.0),  # beyond the limit
)]  # fmt: skip
REWARDS = [  # (term, numbers, rows (value, robot, episode), phases in which it is paid)
    ("jump_height", HEIGHT, [
        (at_apex * value, {}, {"phase": F, "at_apex": at_apex, "max_height": 0.9 + error, "goal": (0.0, 0.0, 0.9)})
        for error, value in ((0.0, 4.0), (0.05, E(-0.25) + 3.0 * E(-1.0)), (-0.4, E(-16.0) + 3.0 * E(-8.0)))
        for at_apex in (0, 1)]),
    ("estimated_jump_height", HEIGHT, [(E(-0.25) + 3.0 * E(-1.0), RISING, BELOW)], [F]),
    ("estimated_jump_height", HEIGHT, [(0.0, RISING, BELOW | {"phase": F, "apex_passed": 1})]),
    ("tracking", {"std": 0.1}, [(E(-1.0), {"pos": (0.5, 0.0, 0.4)}, {"goal": (0.56, 0.08, 0.0)})], PHASES),
    # from 0.3 m upward with 2.4525 m/s: back at 0.3 m after 0.5 s, 0.5 m ahead of 0.1 m
    ("estimated_tracking", {"std": 0.3, "std_wide": 0.6, "height": 0.3}, [
        (E(-1.0) + 0.1 * E(-0.25), {"pos": (0.1, 0.0, 0.3), "lin_vel": (1.0, 0.0, 2.4525)}, {"goal": (0.9, 0.0, 0.0)})],
     [F]),
    ("orientation_error", {"std": 0.04}, [(E(-1.0), ROLLED, AHEAD)], PHASES),
    ("orientation_error", {"std": 0.04}, [(E(-1.0), {}, AHEAD | {"heading": 0.2})]),
    ("flight_orientation_error", {"std": 0.04}, [(E(-1.0), ROLLED, AHEAD), (0.0, ROLLED, PAST)], [F]),
    ("landed_posture", {"std": 10.0 * DEG, "shift": 20.0 * DEG}, [(E(-1.0), {"angle": POSTURE}, {})], [L]),
    ("soft_impact", {"limit": 50.0}, [(soft * (steps == 17), robot, {"phase": L, "phase_steps": steps})
                                      for robot, soft in IMPACTS for steps in (17, 18)]),
]  # fmt: skip
MISS = {"tolerance": 0.1, "steps": 6.0}
ENDS = [
    ("hard_impact", {"stance": 10.5, "flight": 70.0}, [(soft < 0.79, robot, {"phase": S}) for robot, soft in IMPACTS]),
    ("hard_impact", {"stance": 10.5, "flight": 70.0}, [(soft == 0.0, robot, {"phase": L}) for robot, soft in IMPACTS]),
    ("predicted_height_miss", MISS, [(miss, RISING, {"phase_steps": 6, "goal": (0.0, 0.0, goal)})
                                     for goal, miss in ((0.85, False), (0.95, True), (0.65, True))], [F]),
    ("predicted_height_miss", MISS, [(False, RISING, {"phase": F, "goal": (0.0, 0.0, 0.95)} | other)
                                     for other in ({"phase_steps": 5}, {"phase_steps": 6, "apex_passed": 1})]),
]  # fmt: skip
reward, ends = (
    Table([getattr(paper, name) for name in dict.fromkeys(row[0] for row in rows)], kind)
    for rows, kind in ((REWARDS, float), (ENDS, bool))
)


@pytest.mark.parametrize("row", REWARDS, ids=lambda row: row[0])
def test_reward_by_hand(row):
    reward.check(*row)


@pytest.mark.parametrize("row", ENDS, ids=lambda row: row[0])
def test_termination_by_hand(row):
    ends.check(*row)
