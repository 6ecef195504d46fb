"""Jumps that `jumper_warp.trajectory.problem` optimises, and their replay in the simulation that trains policies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from jumper_warp.robot.motors import FilterCfg, horizontal_jump_filter, jumping_motors, vertical_jump_filter
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.trajectory import jumps
from jumper_warp.trajectory.augmented_lagrangian import Progress, minimise
from jumper_warp.trajectory.problem import Knots, Problem, Term
from jumper_warp.trajectory.smoothing import Stage, smoothed
from support.motion_replay import SPEED, Replay
from support.takeoff_search import KNOTS, TICKS

PITCH, AWAY, AHEAD = math.radians(29.8), 0.2985, 0.045
"""[rad], [m], [m] Most pitch at landing, of the base from its start in stance, of hind paws on the ground; a little
less than `support.takeoff_search` allows."""
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
BACK, LEAN = 0.28, 1.0
"""[m], [1] How far back the base is drawn in the first parts of the search for the farthest flight, and its weight."""
POSTURES = np.array([[-0.2, -0.7, 0.7, -0.3], [0.6, 0.0, 0.3, 0.8], [0.9, 0.5, 0.9, 0.5]])
"""[1] Actions of a run-up in place: base behind the paws, hind legs drawn in under it, crouch."""
SCATTER = 0.35
"""[1] Standard deviation of these postures."""


def squats(knots: Knots, count: int, rng: np.random.Generator, push: int = 32) -> np.ndarray:
    """Return random candidates: two postures, then stretched legs, front and hind at their times, around step `push`.

    Shape (count, len(knots)), equal left and right.
    """
    shape, now = (count, 1, 4), np.array(knots.at)[None, :, None]
    first, second = rng.uniform(-1.0, 1.0, shape), rng.uniform(-0.2, 1.0, shape)
    change = rng.uniform(8.0, push - 4.0, (count, 1, 1))
    stretch = np.repeat(rng.uniform(push - 8.0, push + 8.0, (count, 1, 2)), 2, axis=2)
    return np.where(now < stretch, np.where(now < change, first, second), -1.0).reshape(count, -1)


def run_ups(knots: Knots, count: int, rng: np.random.Generator, push: int = 40) -> np.ndarray:
    """Return random candidates that lean back, fall forward into a crouch, and stretch the hind legs, then the front.

    Postures scatter around POSTURES, times are random; the hind legs push around step `push`. Shape (count,
    len(knots)), equal left and right.
    """
    now, each = np.array(knots.at)[None, :, None], (count, 1, 1)
    lean, fall, crouch = np.clip(POSTURES[:, None, None] + SCATTER * rng.normal(size=(3, count, 1, 4)), -1.0, 1.0)
    hind = rng.uniform(push - 5.0, push + 3.0, each)
    front = hind + rng.uniform(0.0, 4.0, each)
    crouching = hind - rng.uniform(2.0, 8.0, each)
    falling = crouching - rng.uniform(4.0, 10.0, each)
    before = np.where(now < falling, lean, np.where(now < crouching, fall, crouch))
    stretch = np.concatenate([front, front, hind, hind], axis=2)
    return np.where(now < stretch, before, -1.0).reshape(count, -1)


@dataclass(frozen=True)
class Jump:
    """What is optimised."""

    label: str
    unit: str
    """Of what `told` returns."""
    make: Callable[..., Problem]
    """Returns the problem, given a part's settings, device and threads."""
    stages: tuple[tuple[Mapping[str, Any], Stage], ...]
    """Parts of the search: settings of `make`, and the part."""
    told: Callable[[Replay], float | None]
    """What is told of the replay."""
    torque: float = 18.0
    """[N m] Limit of the transversal motors."""
    lateral_torque: float = 18.0
    """[N m]"""
    command_filter: Callable[[], FilterCfg] = vertical_jump_filter
    draw: Callable[[Knots, int, np.random.Generator], np.ndarray] = squats
    """Returns so many random candidates."""
    samples: int = 2048
    """Random candidates, among which the search begins."""
    polish: int = 40
    """Iterations of the last descent."""
    after: str = ""
    """Name of the jump whose best motion is a start too."""

    def replay(self, targets: np.ndarray, **settings: Any) -> Replay:
        """Return a motion of these targets [rad] (steps, 12); settings: as of `Replay`."""
        motors = jumping_motors(self.torque, lateral_torque=self.lateral_torque)
        return Replay(targets, motors, self.command_filter(), **settings)

    def scaled(self, effort: float) -> Jump:
        """Return the same with other numbers of iterations."""
        stages = tuple(
            (how, replace(part, iterations=max(1, round(effort * part.iterations)))) for how, part in self.stages
        )
        return replace(self, stages=stages)


def _far(lean: float = 0.0, **settings: Any) -> Problem:
    """Return the farthest flight; lean: [1] weight of how far back the base goes before it, up to BACK."""
    knots = Knots(tuple(map(float, KNOTS)), steps=TICKS + 5)
    constraints = (
        jumps.landing_pitch(PITCH), jumps.stays(AWAY, SPEED), jumps.clear(speed=SPEED), jumps.no_run_up(AHEAD),
        jumps.takes_off(SPEED),
    )  # fmt: skip
    far, back = jumps.farthest(SPEED), jumps.leans_back(BACK, SPEED)
    objective = (lambda motion: far(motion) + lean * back(motion)) if lean else far
    return Problem(
        knots, objective, constraints, jumping_motors(18.0, lateral_torque=12.0), horizontal_jump_filter(), **settings
    )


UP = Knots((0.0, 6.0, 12.0, 18.0, 22.0, *map(float, range(24, 44, 1))), steps=ESTIMATE)
"""Of vertical jumps: squat within half a second, push-off, legs stretched or drawn in."""
LANDING = Knots((*UP.at, 48.0, 52.0, *map(float, range(54, 74, 2)), 80.0, 90.0, 100.0), steps=126)
"""The same, on to a second after touchdown."""


def _vertical(
    objective: Term, *more: Term, torque: float = 18.0, knots: Knots = UP, **settings: Any
) -> Problem:  # fmt: skip
    constraints = (jumps.clear(), jumps.upright(TILT, at_end=False), jumps.drifts(DRIFT), *more)
    return Problem(knots, objective, constraints, jumping_motors(torque), vertical_jump_filter(), **settings)


FINE: dict[str, Any] = {"substeps": SUBSTEPS}
COARSE = FINE | {"substeps": 4}
"""Fewer physics steps in a policy step, for the first parts of a search."""
QUICK = FINE | {"double": False, "tolerance": None}
"""Single precision, and its tolerance of the contact iteration."""
UPWARD = (
    (COARSE, Stage(32, 40, rate=0.05, noise=0.05, least=1.0)),
    (COARSE, Stage(12, 100, rate=0.04, noise=0.04)),
    (FINE, Stage(4, 100, rate=0.02, noise=0.02, penalty=100.0)),
)
CALM: dict[str, Any] = {"slack": 0.03, "look": 5, "calmer": 0.7}
"""Starts that go back often, and on with smaller steps."""
FORWARD = (
    (QUICK | {"lean": LEAN}, Stage(40, 40, rate=0.05, noise=0.05, least=1.0, slack=0.1)),
    (QUICK | {"lean": LEAN}, Stage(16, 40, rate=0.05, noise=0.05, least=1.0, slack=0.1)),
    (QUICK, Stage(10, 60, rate=0.04, noise=0.03, least=0.5, slack=0.1)),
    (QUICK, Stage(10, 80, rate=0.02, noise=0.015, least=0.2, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(8, 80, rate=0.02, noise=0.015, least=0.2, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(6, 80, rate=0.02, noise=0.01, least=0.2, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(4, 100, rate=0.015, noise=0.006, least=0.1, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(3, 150, rate=0.01, noise=0.003, least=0.1, penalty=100.0, dual=4.0, **(CALM | {"slack": 0.02}))),
)
JUMPS = {
    "farthest": Jump(
        "farthest flight, 18 N m", "m", _far, FORWARD, lambda replay: None, lateral_torque=12.0,
        command_filter=horizontal_jump_filter, draw=run_ups, samples=768,
        polish=5,
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
            (FINE, Stage(16, 60, rate=0.05, noise=0.05, least=1.0)),
            (FINE, Stage(6, 100, rate=0.03, noise=0.03)),
        ),
        lambda replay: replay.longest_lift, draw=partial(squats, push=30), samples=1024, after="least_work",
    ),
}  # fmt: skip


def optimise(
    jump: Jump, begin: np.ndarray, *, seed: int, polish: int, tell: Callable[[str], None], **settings: Any
) -> tuple[Progress, list[Problem]]:
    """Return what was found from candidates, and the problems that counted the steps; settings: device, threads."""
    problems = {str(how): jump.make(**how, **settings) for how in (FINE, *(how for how, _ in jump.stages))}
    merits: list[torch.Tensor] = []
    found = begin
    for number, (how, stage) in enumerate(jump.stages):
        found = smoothed(
            problems[str(how)], found, stages=(stage,), seed=seed + number, tell=lambda _, last: merits.append(last)
        )
        tell(f"part {number + 1}: {len(found)} starts, objective with penalties {float(merits[-1][0]):.3f}")
    return minimise(problems[str(FINE)], found, iterations=polish, step=0.01, seed=seed), list(problems.values())
