"""Tests of single policies or of three in combination, such as sideways goals, farthest jumps, terrains and courses.

Each test is a command that writes metrics.json. The ten conditions that all policies share are in `policy_conditions`.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

COMBINED = "combined"  # Name that stands for walking and jumping with three policies, in place of a policy's


class PolicyTest(NamedTuple):
    """Test of some policies: its description in tables, the policies, and its command."""

    words: str
    policies: tuple[str, ...]
    command: str  # With {policy}; `jumper` or a script of experiments/ begins it


SLIPPERY = ("slippery_jump", "slippery_waiting_jump")
AHEAD = ("horizontal_jump", "sighted_jump", *SLIPPERY)
AROUND = ("omnidirectional_jump", "horizontal_jump", *SLIPPERY)
MARS = ("mars_horizontal_jump", "mars_springs_jump")
JUMPS = ("vertical_jump", *AHEAD, "omnidirectional_jump")
RANDOM = "--randomize --noise"
EVALUATE, FEWER = (f"jumper evaluate {{policy}} --num-jumps {count}" for count in (4096, 1024))
DIAGONAL, SIDE = "--goal-x 0.25 1.5 --goal-y -0.5 0.5", "--goal-x 0 0 --goal-y 0.3 0.7"
DIAGONAL_WORDS, SIDE_WORDS = "0.25 to 1.5 m ahead, up to 0.5 m aside", "straight to the side, 0.3 to 0.7 m"
FARTHEST = "jumper evaluate {policy} --suite max --num-recorded 0"
GROUNDS = "jumper evaluate {policy} --suite platform --num-jumps 300 --randomize --num-recorded 0"
HOLD = "experiments/squat_hold.py --policy {policy} --num-squats 200 --num-recorded 0"
TERRAIN = "experiments/walking_terrain.py --policy {policy} --num-robots 100 --num-recorded 0"
TRACKING = "experiments/walking_tracking.py --policy {policy} --commands-per-axis 6 --num-recorded 0"
FLIGHT = "experiments/flight_attitude.py --num-recorded 0"
FROM_JUMP = "--takeoff policy --landing-policy mars_vertical_jump --height-range 1.5 3.1"
COURSE = "experiments/walk_jump_walk.py --num-robots 100 --num-recorded 0"
TESTS = {
    "diagonal": PolicyTest(DIAGONAL_WORDS, AHEAD, f"{EVALUATE} {DIAGONAL}"),
    "diagonal_friction_0.4": PolicyTest(f"{DIAGONAL_WORDS}, friction 0.4", AHEAD,
                                        f"{EVALUATE} {DIAGONAL} --friction 0.4"),
    "diagonal_friction_0.4_randomised": PolicyTest(f"{DIAGONAL_WORDS}, friction 0.4, else randomised", AHEAD,
                                                   f"{EVALUATE} {DIAGONAL} --friction 0.4 {RANDOM}"),
    "side": PolicyTest(SIDE_WORDS, AROUND, f"{FEWER} {SIDE}"),
    "side_friction_0.4": PolicyTest(f"{SIDE_WORDS}, friction 0.4", AROUND, f"{EVALUATE} {SIDE} --friction 0.4"),
    "side_friction_0.4_randomised": PolicyTest(f"{SIDE_WORDS}, friction 0.4, else randomised", AROUND,
                                               f"{FEWER} {SIDE} --friction 0.4 {RANDOM}"),
    "friction_0.3": PolicyTest("0.3 to 1.5 m ahead, friction 0.3", ("horizontal_jump", *SLIPPERY),
                               f"{FEWER} --friction 0.3"),
    "grid": PolicyTest("grid, 0.35 to 1.4 m ahead, up to 0.35 m aside", ("horizontal_jump",),
                       "jumper evaluate {policy} --suite grid --num-jumps 20 --num-recorded 0"),
    "consecutive": PolicyTest("two jumps in a row, the paper's goals", ("horizontal_jump",),
                              "jumper evaluate {policy} --suite consecutive --num-jumps 100 --num-recorded 0"),
    **{f"grounds_{edge}": PolicyTest(f"edge at {edge} m", ("horizontal_jump", "sighted_jump"),
                                     f"{GROUNDS} --edge {edge}") for edge in ("0.35", "0.45", "0.50")},
    "farthest": PolicyTest("ahead", AHEAD, FARTHEST),
    "farthest_randomised": PolicyTest("ahead, randomised", AHEAD, f"{FARTHEST} --randomize"),
    **{f"farthest_{words}{suffix}": PolicyTest(f"{words}{suffix.replace('_', ', ')}", ("omnidirectional_jump",),
                                               f"{FARTHEST} --min-distance 0.4 --direction {angle}{flags}")
       for suffix, flags in (("", ""), ("_randomised", " --randomize"))
       for words, angle in (("ahead", 0), ("left", 90), ("back", 180))},
    "farthest_mars": PolicyTest("ahead", MARS, f"{FARTHEST} --num-jumps 50 --min-distance 3.4 --max-distance 9"),
    "wait": PolicyTest("nominal", JUMPS, f"{HOLD}"),
    "wait_randomised": PolicyTest("randomised", JUMPS, f"{HOLD} --randomize"),
    "terrain": PolicyTest("nominal", ("walking_rough",), TERRAIN),
    "terrain_randomised": PolicyTest("randomised", ("walking_rough",), f"{TERRAIN} --randomize"),
    "tracking": PolicyTest("nominal", ("walking_flat",), TRACKING),
    "tracking_randomised": PolicyTest("randomised", ("walking_flat",), f"{TRACKING} --randomize"),
    "flight_15_ms": PolicyTest("legs up to 15 ms late, nominal", ("attitude",), f"{FLIGHT} --num-flights 200"),
    "flight_25_ms": PolicyTest("legs up to 25 ms late, nominal", ("attitude",),
                               f"{FLIGHT} --num-flights 200 --max-leg-delay 25"),
    "flight_jump": PolicyTest("takeoff by mars_vertical_jump, nominal", ("attitude",),
                              f"{FLIGHT} --num-flights 200 {FROM_JUMP}"),
    "flight_jump_randomised": PolicyTest("takeoff by mars_vertical_jump, randomised", ("attitude",),
                                         f"{FLIGHT} --num-flights 300 {FROM_JUMP} --randomize"),
    "walk_jump_walk": PolicyTest("walk, jump up, walk, jump ahead, walk; nominal", (COMBINED,), COURSE),
    "walk_jump_walk_randomised": PolicyTest("the same, randomised", (COMBINED,), f"{COURSE} --randomize"),
    "walk_jump_walk_mujoco": PolicyTest("the same, SolverMuJoCo", (COMBINED,), f"{COURSE} --solver mujoco"),
    "course_level": PolicyTest("ten random commands, no blocks; nominal", (COMBINED,),
                               f"{COURSE} --course --no-blocks"),
    "course_level_randomised": PolicyTest("the same, randomised", (COMBINED,),
                                          f"{COURSE} --course --no-blocks --randomize"),
    "course": PolicyTest("ten random commands with blocks; nominal", (COMBINED,), f"{COURSE} --course"),
    "course_randomised": PolicyTest("the same, randomised", (COMBINED,), f"{COURSE} --course --randomize"),
}  # fmt: skip
"""Tests by name, in the order of the tables."""


def run_test(policy: str, name: str, out: Path, flags: list[str]) -> None:
    """Run the command of a test for a policy, which writes `out`/metrics.json; flags: added to the command.

    Raises subprocess.CalledProcessError: the command failed; its errors are on standard error.
    """
    program, *args = shlex.split(TESTS[name].command.format(policy=policy))
    start = ["-P", "-m", "jumper_warp"] if program == "jumper" else [program]
    command = [sys.executable, *start, *args, *flags, "--out", str(out)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
