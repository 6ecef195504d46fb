"""Jumps that `jumper_warp.optim.trajectory` optimises, and their replay in the simulation that trains policies."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jumper_warp.evaluation.motion_replay import SPEED, Replay
from jumper_warp.evaluation.takeoff_search import KNOTS, TICKS
from jumper_warp.optim import jumps
from jumper_warp.optim.augmented_lagrangian import Progress, minimise
from jumper_warp.optim.smoothing import Stage, smoothed
from jumper_warp.optim.trajectory import Knots, Problem, Term
from jumper_warp.robot.motors import FilterCfg, horizontal_jump_filter, jumping_motors, vertical_jump_filter
from jumper_warp.sim.simulation import SUBSTEPS

PITCH, AWAY, AHEAD = math.radians(29.8), 0.2985, 0.045
"""[rad], [m], [m] Most pitch at landing, of the base from its start in stance, of hind paws on the ground; a little
less than `jumper_warp.evaluation.takeoff_search` allows."""
TILT = math.radians(8.0)
"""[rad] Most of vertical jumps, at any time."""
DRIFT = 0.15
"""[m] Most of the base from its start in vertical jumps, at any time."""
HEIGHT = 0.80
"""[m] Of the jump with the least work."""
STILL_HEIGHT = 0.65
"""[m] Of the jump that lands still."""
SOFT = 4.5
"""[g] Most acceleration of the base over a policy step of its landing; the tasks end an episode at 5."""
ESTIMATE = 61
"""Policy steps of a motion up to the apex."""


@dataclass(frozen=True)
class Jump:
    """What is optimised."""

    label: str
    unit: str
    """Of what `told` returns."""
    make: Callable[..., Problem]
    """Returns the problem, given substeps, device and threads."""
    stages: tuple[tuple[int, Stage], ...]
    """Parts of the search: physics steps in a policy step, and the part."""
    told: Callable[[Replay], float | None]
    """What is told of the replay."""
    torque: float = 18.0
    """[N m] Limit of the transversal motors."""
    lateral_torque: float = 18.0
    """[N m]"""
    command_filter: Callable[[], FilterCfg] = vertical_jump_filter
    samples: int = 2048
    """Random squats, among which the search begins."""
    after: str = ""
    """Name of the jump whose best motion is a start too."""

    def replay(self, targets: np.ndarray, **settings: Any) -> Replay:
        """Return a motion of these targets [rad] (steps, 12); settings: as of `Replay`."""
        motors = jumping_motors(self.torque, lateral_torque=self.lateral_torque)
        return Replay(targets, motors, self.command_filter(), **settings)

    def scaled(self, effort: float) -> Jump:
        """Return the same with other numbers of iterations."""
        stages = tuple(
            (n, replace(part, iterations=max(1, round(effort * part.iterations)))) for n, part in self.stages
        )
        return replace(self, stages=stages)


def squats(knots: Knots, count: int, rng: np.random.Generator, push: int) -> np.ndarray:
    """Return random candidates: two postures, then stretched legs, front and hind at their times, around step `push`.

    Shape (count, len(knots)), equal left and right.
    """
    shape, now = (count, 1, 4), np.array(knots.at)[None, :, None]
    first, second = rng.uniform(-1.0, 1.0, shape), rng.uniform(-0.2, 1.0, shape)
    change = rng.uniform(8.0, push - 4.0, (count, 1, 1))
    stretch = np.repeat(rng.uniform(push - 8.0, push + 8.0, (count, 1, 2)), 2, axis=2)
    return np.where(now < stretch, np.where(now < change, first, second), -1.0).reshape(count, -1)


def _far(**settings: Any) -> Problem:
    knots = Knots(tuple(map(float, KNOTS)), steps=TICKS + 5)
    constraints = (
        jumps.landing_pitch(PITCH), jumps.stays(AWAY, SPEED), jumps.clear(speed=SPEED), jumps.no_run_up(AHEAD),
        jumps.takes_off(SPEED),
    )  # fmt: skip
    return Problem(
        knots, jumps.farthest(SPEED), constraints, jumping_motors(18.0, lateral_torque=12.0), horizontal_jump_filter(),
        **settings,
    )  # fmt: skip


UP = Knots((0.0, 6.0, 12.0, 18.0, 22.0, *map(float, range(24, 44, 1))), steps=ESTIMATE)
"""Of vertical jumps: squat within half a second, push-off, legs stretched or drawn in."""
LANDING = Knots((*UP.at, 48.0, 52.0, *map(float, range(54, 74, 2)), 80.0, 90.0, 100.0), steps=126)
"""The same, on to a second after touchdown."""


def _vertical(
    objective: Term, *more: Term, torque: float = 18.0, knots: Knots = UP, **settings: Any
) -> Problem:  # fmt: skip
    constraints = (jumps.clear(), jumps.upright(TILT, at_end=False), jumps.drifts(DRIFT), *more)
    return Problem(knots, objective, constraints, jumping_motors(torque), vertical_jump_filter(), **settings)


COARSE = 4
"""Physics steps in a policy step of the first parts of a search."""
UPWARD = (
    (COARSE, Stage(32, 40, rate=0.05, noise=0.05, fall=False)),
    (COARSE, Stage(12, 100, rate=0.04, noise=0.04)),
    (SUBSTEPS, Stage(4, 100, rate=0.02, noise=0.02, penalty=100.0)),
)
JUMPS = {
    "farthest": Jump(
        "farthest flight, 18 N m", "m", _far,
        (
            (SUBSTEPS, Stage(24, 60, rate=0.05, noise=0.05, fall=False)),
            (SUBSTEPS, Stage(10, 200, rate=0.05, noise=0.05)),
            (SUBSTEPS, Stage(5, 200, rate=0.03, noise=0.03, penalty=50.0)),
        ),
        lambda replay: None, lateral_torque=12.0, command_filter=horizontal_jump_filter,
    ),
    "highest": Jump(
        "highest jump, 18 N m", "m", lambda **s: _vertical(jumps.highest(), jumps.takes_off(), **s), UPWARD,
        lambda replay: replay.apex,
    ),
    "highest_24_8": Jump(
        "highest jump, 24.8 N m", "m",
        lambda **s: _vertical(jumps.highest(), jumps.takes_off(), torque=24.8, **s), UPWARD,
        lambda replay: replay.apex, torque=24.8,
    ),
    "least_work": Jump(
        f"least work to {HEIGHT:g} m", "J",
        lambda **s: _vertical(jumps.positive_work(), jumps.reaches(HEIGHT), jumps.takes_off(), **s), UPWARD,
        lambda replay: replay.work,
    ),
    "still": Jump(
        f"still landing from {STILL_HEIGHT:g} m", "s",
        lambda **s: _vertical(jumps.still(), jumps.reaches(STILL_HEIGHT), jumps.soft(SOFT), knots=LANDING, **s),
        (
            (SUBSTEPS, Stage(16, 60, rate=0.05, noise=0.05, fall=False)),
            (SUBSTEPS, Stage(6, 100, rate=0.03, noise=0.03)),
        ),
        lambda replay: replay.longest_lift, samples=1024, after="least_work",
    ),
}  # fmt: skip


def optimise(
    jump: Jump, begin: np.ndarray, *, seed: int, polish: int, tell: Callable[[str], None], **settings: Any
) -> tuple[Progress, list[Problem]]:
    """Return what was found from candidates, and the problems that counted the steps; settings: device, threads."""
    problems = {n: jump.make(substeps=n, **settings) for n in sorted({SUBSTEPS, *(n for n, _ in jump.stages)})}
    fine, found = problems[SUBSTEPS], begin
    for number, (substeps, stage) in enumerate(jump.stages):
        found = smoothed(problems[substeps], found, stages=(stage,), seed=seed + number)
        tell(f"part {number + 1}: {len(found)} starts")
    return minimise(fine, found, iterations=polish, step=0.01, seed=seed), list(problems.values())
