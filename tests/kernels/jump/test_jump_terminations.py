"""Terminations of jumps by hand."""

import pytest
from scipy.spatial.transform import Rotation

from jump_helpers import DEG, PHASES, Table
from jumper_warp.kernels.jump import terminations

S, F, L = PHASES
GOAL = {"goal": (1.0, 2.0, 0.0)}
RISING = {"pos": (0.2, 0.3, 0.52625), "lin_vel": (1.0, -0.6, 2.0)}  # lands 0.5 s later, 0.3 m high, at (0.7, 0)
PREDICTED = {"tolerance": 0.55, "steps": 6.0, "height": 0.3}  # [m], policy steps, [m]
IDLE = {"steps": 180.0, "idle_steps": 60.0}
SQUAT = {"tolerance": 0.04, "takeoff_height": 0.3, "acceleration": 50.0, "floor": 0.15}
CROUCH = {"height": 0.28, "start_steps": 18.0, "landing_steps": 90.0}
LOW, HIGH = {"pos": (0.0, 0.0, 0.27)}, {"pos": (0.0, 0.0, 0.29)}
UP = {"contacts": 0, "lin_vel": (3.0, 0.0, 0.26)}


def at(event, rows):
    """Return rows that hold in the step of an event only; event: field of the episode."""
    return [(held and happens, robot, episode | {event: int(happens)})
            for held, robot, episode in rows for happens in (True, False)]  # fmt: skip


def impacts(limit, phase):
    """Return rows of a base that falls at 1 m/s and changes its velocity by about `limit` [m/s^2] within a step."""
    return [(hard, {"prev_lin_vel": (0.0, 0.0, -1.0), "lin_acc": (0.0, 0.0, acc),
                    "lin_vel": (0.0, 0.0, -1.0 + acc / 60.0)}, {"phase": phase})
            for acc, hard in ((limit - 0.1, False), (limit + 0.1, True), (-limit - 0.1, False))]  # fmt: skip


def turned():
    """Return rows of attitudes at touchdown, from headings across 180 degrees, with both signs of the quaternion."""
    rows = []
    for yaw, pitch, is_turned in (
        (0.0, 0.0, False), (9.5, 0.0, False), (-9.5, 0.0, False), (10.5, 0.0, True), (-10.5, 0.0, True),
        (0.0, 29.5, False), (0.0, 30.5, True), (180.0, 0.0, True),
        (9.0, 29.0, True), (9.0, 28.0, False),  # neither alone, but 30.3 and 29.4 degrees together
    ):  # fmt: skip
        for heading in (0.0, 100.0, 175.0, 180.0, -175.0):
            quat = Rotation.from_euler("ZYX", [heading + yaw, pitch, 0.0], degrees=True).as_quat()
            rows += [(is_turned, {"quat": sign * quat}, {"phase": L, "heading": heading * DEG}) for sign in (1.0, -1.0)]
    return rows


TERMS = [  # (term, numbers, rows (whether it holds, robot, episode), phases in which it can hold)
    ("landed_for", {"steps": 60.0}, [(steps == 60, {}, {"phase_steps": steps}) for steps in (59, 60)], [L]),
    ("wrong_height", {"tolerance": 0.1}, at("touched_down", [
        (abs(error) > 0.1, {}, {"phase": L, "max_height": 0.8 + error, "goal": (0.0, 0.0, 0.8)})
        for error in (0.0, 0.09, -0.09, 0.11, -0.11)])),
    ("low_touchdown", {"height": 0.2}, at("touched_down", [
        (z < 0.2, {"pos": (0.0, 0.0, z)}, {}) for z in (0.21, 0.19)])),
    ("moved_away", {"distance": 0.2}, [  # in the plane
        (False, {"pos": (1.11, -0.85, 1.2)}, {"start": (1.0, -1.0, 0.3)}),  # 0.186 m
        (True, {"pos": (1.13, -0.84, 0.3)}, {"start": (1.0, -1.0, 0.3)})]),  # 0.206 m
    ("left_stance", {"distance": 0.3}, [
        (miss > 0.3, {"pos": (1.0 + 0.6 * miss, -1.0 - 0.8 * miss, 0.9)}, {"start": (1.0, -1.0, 0.3)})
        for miss in (0.29, 0.31)], [S]),
    ("slanted_takeoff", {"speed": 0.75}, at("took_off", [  # 0.6, 0.45: 0.75 m/s
        (vx > 0.6, {"lin_vel": (vx, -0.45, 3.0)}, {"phase": F}) for vx in (0.59, 0.61)])),
    ("hard_impact", {"stance": 25.0, "flight": 50.0}, [
        *impacts(25.0, S), *impacts(50.0, F), *impacts(50.0, L),
        # a landing that stops within a step: 3 m/s lost in 1/60 s
        (True, {"prev_lin_vel": (0.0, 0.0, -3.0), "lin_acc": (0.0, 0.0, 180.0)}, {"phase": L, "touched_down": 1})]),
    ("no_jump", IDLE, [(steps == 211, {}, {"steps": steps, "command_step": 30}) for steps in (210, 211)], [S]),
    ("no_jump", IDLE, [(idle == 61, {}, {"steps": 100, "command_step": 30, "idle_steps": idle})
                       for idle in (60, 61)], [S]),
    ("no_jump", IDLE, [(False, {}, {"steps": 20, "command_step": 30, "idle_steps": 99})]),
    ("early_takeoff", {}, at("took_off", [(steps == 29, {}, {"phase": F, "steps": steps, "command_step": 30})
                                          for steps in (29, 30)])),
    ("second_takeoff", {"speed": 0.25}, [(True, UP, {}), (False, UP | {"lin_vel": (3.0, 0.0, 0.24)}, {}),
                                         (False, {"contacts": 1, "lin_vel": (3.0, 0.0, 2.0)}, {})], [L]),
    ("shallow_squat", SQUAT, at("took_off", [  # wanted: 0.3 - 9.81 * 0.5 / 50 = 0.2019 m
        (squat > 0.2419, {}, {"phase": F, "squat": squat, "goal": (0.0, 0.0, 0.8)}) for squat in (0.240, 0.243)])),
    ("crouched", CROUCH, [
        (True, LOW, {"steps": 19, "command_step": 60}), (False, HIGH, {"steps": 19, "command_step": 60}),
        (False, LOW, {"steps": 18, "command_step": 60}),
        (False, LOW, {"steps": 60, "command_step": 60}),  # it squats for the jump
        (False, LOW, {"phase": L, "steps": 200, "phase_steps": 90}),
        (True, LOW, {"phase": L, "steps": 200, "phase_steps": 91}),
        (False, HIGH, {"phase": L, "steps": 200, "phase_steps": 91}), (False, LOW, {"phase": F, "phase_steps": 200})]),
    ("missed_goal", {"tolerance": 0.5}, at("touched_down", [
        (miss > 0.5, {"pos": (1.0 - 0.6 * miss, 2.0 + 0.8 * miss, 0.9)}, GOAL | {"phase": L})
        for miss in (0.49, 0.51)])),
    ("walked", {"margin": 0.1, "fraction": 0.4}, at("touched_down", [  # 1.5 m from start to goal: at most 0.7 m off
        (miss > 0.7, {"pos": (1.0 - 0.6 * miss, 2.0 + 0.8 * miss, 0.9)}, GOAL | {"phase": L, "start": (0.1, 0.8, 0.3)})
        for miss in (0.69, 0.71)])),
    ("walked", {"margin": 0.1, "fraction": 0.4}, [
        (way > 0.7, {"pos": (0.1 - 0.6 * way, 0.8 + 0.8 * way, 0.9)}, GOAL | {"start": (0.1, 0.8, 0.3)})
        for way in (0.69, 0.71)], [S]),
    ("predicted_miss", PREDICTED, [  # decided once, 0.1 s after takeoff
        (miss > 0.55 and steps == 6, RISING, {"phase_steps": steps, "goal": (0.7 + 0.6 * miss, -0.8 * miss, 0.0)})
        for miss in (0.54, 0.56) for steps in range(12)], [F]),
    ("predicted_miss", PREDICTED, [  # above the ground at the goal: half a second to 0.38 m
        (miss > 0.55, {"pos": (0.2, 0.0, 0.60625), "lin_vel": (1.0, 0.0, 2.0)},
         {"phase": F, "phase_steps": 6, "goal": (0.7 + miss, 0.0, 0.0), "goal_ground": 0.08})
        for miss in (0.54, 0.56)]),
    ("turned_touchdown", {"rotation": 30.0 * DEG, "yaw": 10.0 * DEG}, at("touched_down", turned())),
]  # fmt: skip
holds = Table([getattr(terminations, name) for name in dict.fromkeys(row[0] for row in TERMS)], bool)


@pytest.mark.parametrize("row", TERMS, ids=lambda row: row[0])
def test_termination_by_hand(row):
    holds.check(*row)
