"""Optimisation problems of jumps (`jumper_warp.trajectory.problem`), their search, and their replay."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from jumper_warp.robot.motors import (
    FilterCfg,
    MotorCfg,
    horizontal_jump_filter,
    jumping_motors,
    loose_filter,
    vertical_jump_filter,
)
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.trajectory import jumps
from jumper_warp.trajectory.augmented_lagrangian import Progress, minimise
from jumper_warp.trajectory.problem import Knots, Problem, Term
from jumper_warp.trajectory.smoothing import Stage, smoothed
from support.motion_replay import TAKEOFF_SPEED, MotionReplay
from support.scripts import announce

PITCH, AWAY, AHEAD = math.radians(29.8), 0.2985, 0.045
"""[rad], [m], [m] Largest pitch at landing, distance of the base from its start in stance, and distance of hind paws on
the ground ahead of their start; slightly inside 30 degrees, 0.3 m (the task's limit) and 0.05 m."""
FREE = 100.0  # [rad], [m] Value of a limit that never binds
TILT = math.radians(8.0)  # [rad] Largest tilt of vertical jumps at any time
DRIFT = 0.15  # [m] Largest distance of the base from its start in vertical jumps at any time
HEIGHT = 0.80  # [m] Apex height of the jump with the least work
STILL_HEIGHT = 0.65  # [m] Apex height of the jump that lands still
SOFT = 4.5  # [g] Largest acceleration of the base over a policy step of the landing; the tasks end an episode at 5
APEX_STEPS = 61  # Number of policy steps of a motion up to the apex
BACK, LEAN = (0.28, 1.0)  # [m], [1] Largest backward shift of the base that early stages of the search reward; weight
POSTURES = np.array([[-0.2, -0.7, 0.7, -0.3], [0.6, 0.0, 0.3, 0.8], [0.9, 0.5, 0.9, 0.5]])
"""[1] Actions of a run-up in place: base behind the paws, hind legs folded under it, crouch."""
SCATTER = 0.35  # [1] Standard deviation of these postures


def squats(knots: Knots, count: int, rng: np.random.Generator, push: int = 32) -> np.ndarray:
    """Return random candidates of squat jumps: actions [1], (count, len(knots)), two postures, then extension.

    The extension begins around step `push`, separately for front and hind legs; left and right are equal.
    """
    shape, step = (count, 1, 4), np.array(knots.at)[None, :, None]
    first, second = rng.uniform(-1.0, 1.0, shape), rng.uniform(-0.2, 1.0, shape)
    switch_step = rng.uniform(8.0, push - 4.0, (count, 1, 1))
    extend_step = np.repeat(rng.uniform(push - 8.0, push + 8.0, (count, 1, 2)), 2, axis=2)
    return np.where(step < extend_step, np.where(step < switch_step, first, second), -1.0).reshape(count, -1)


def run_ups(knots: Knots, count: int, rng: np.random.Generator, push: int = 40) -> np.ndarray:
    """Return random candidates of jumps that begin with a fall forward: actions [1], (count, len(knots)).

    The robot leans back, falls forward, crouches, extends the hind legs, then the front legs. Postures scatter around
    POSTURES, times are random; the hind legs push around step `push`; left and right are equal.
    """
    step, shape = np.array(knots.at)[None, :, None], (count, 1, 1)
    lean, fall, crouch = np.clip(POSTURES[:, None, None] + SCATTER * rng.normal(size=(3, count, 1, 4)), -1.0, 1.0)
    hind = rng.uniform(push - 5.0, push + 3.0, shape)
    front = hind + rng.uniform(0.0, 4.0, shape)
    crouch_step = hind - rng.uniform(2.0, 8.0, shape)
    fall_step = crouch_step - rng.uniform(4.0, 10.0, shape)
    before = np.where(step < fall_step, lean, np.where(step < crouch_step, fall, crouch))
    extend_step = np.concatenate([front, front, hind, hind], axis=2)
    return np.where(step < extend_step, before, -1.0).reshape(count, -1)


def noisy_variants(solution: np.ndarray, knots: Knots, rng: np.random.Generator) -> np.ndarray:
    """Return 64 noisy copies of a solution, as candidates of another optimisation, (64, len(knots)).

    They are the solution (n,) plus noise of standard deviation 0 to 0.2. The solution may be of a shorter motion;
    missing knots are 0 before the noise.
    """
    actions = np.zeros((len(knots.at), 4))
    actions[: len(solution) // 4] = solution.reshape(-1, 4)
    spread = np.linspace(0.0, 0.2, 64)[:, None]
    return np.clip(actions.ravel() + spread * rng.normal(size=(64, actions.size)), -1.0, 1.0)


@dataclass(frozen=True)
class Jump:
    """A jump to optimise: its problem, the stages of the search, and the reported value."""

    label: str  # Name in tables and plots
    unit: str  # Unit of `value`
    make: Callable[..., Problem]  # make(**settings of a stage, device=, threads=); settings: e.g. `FINE`
    stages: tuple[tuple[Mapping[str, Any], Stage], ...]  # Stages of the search, each with its settings of `make`
    value: Callable[[MotionReplay], float]  # Returns the reported value of a replay
    draw: Callable[[Knots, int, np.random.Generator], np.ndarray] = squats  # Returns random candidates
    samples: int = 2048  # Default number of random candidates
    polish: int = 40  # Default number of iterations of the last descent
    after: str = ""  # Key in `JUMPS` of the jump whose solution is also a candidate; empty: none

    def replay(self, targets: np.ndarray, device: str | None = None) -> MotionReplay:
        """Replay the jump with motor targets [rad], (steps, 12), in the simulation that trains policies."""
        return MotionReplay(targets, self.make(**FINE, device=device, threads=1), notes={"jump": self.label})

    def scaled(self, effort: float) -> Jump:
        """Return a copy whose search stages have `effort` [1] times as many iterations, at least 1; `polish` stays."""
        stages = ((made, replace(s, iterations=max(1, round(effort * s.iterations)))) for made, s in self.stages)
        return replace(self, stages=tuple(stages))


FORWARD_KNOTS = Knots((0.0, 8.0, 16.0, *map(float, range(24, 48))), steps=53)  # Knots of the farthest flight


def motors_of(torque: float, speed: float = 1.0) -> MotorCfg:
    """Return the settings of motors with a torque limit [N m].

    speed [1]: factor on all speed limits of the transversal motors.
    """
    motors = jumping_motors(torque, lateral_torque=12.0)
    stock = motors.transversal
    faster = replace(stock, cutoff_speed=speed * stock.cutoff_speed, no_load_speed=speed * stock.no_load_speed)
    return replace(motors, transversal=faster, fade_start=speed * motors.fade_start, fade_end=speed * motors.fade_end)


def _far(
    lean: float = 0.0, *, torque: float = 18.0, speed: float = 1.0, pitch: float = PITCH, away: float = AWAY,
    command_filter: Callable[[], FilterCfg] = horizontal_jump_filter, **settings: Any,
) -> Problem:  # fmt: skip
    """Return the optimisation problem of the farthest flight.

    lean [1]: weight of leaning back before it, up to BACK; torque [N m] and speed [1]: as for `motors_of`; pitch [rad],
    away [m]: limits PITCH, AWAY; settings: further arguments of `Problem`.
    """
    constraints = (
        jumps.landing_pitch(pitch), jumps.stays(away, TAKEOFF_SPEED), jumps.clear(speed=TAKEOFF_SPEED),
        jumps.no_run_up(AHEAD), jumps.takes_off(TAKEOFF_SPEED),
    )  # fmt: skip
    far, back = jumps.farthest(TAKEOFF_SPEED), jumps.leans_back(BACK, TAKEOFF_SPEED)
    objective = (lambda motion: far(motion) + lean * back(motion)) if lean else far
    return Problem(FORWARD_KNOTS, objective, constraints, motors_of(torque, speed), command_filter(), **settings)


UP = Knots((0.0, 6.0, 12.0, 18.0, 22.0, *map(float, range(24, 44, 1))), steps=APEX_STEPS)
"""Knots of vertical jumps: squat within half a second, push-off, legs extended or folded."""
LANDING = Knots((*UP.at, 48.0, 52.0, *map(float, range(54, 74, 2)), 80.0, 90.0, 100.0), steps=126)
"""Knots of vertical jumps, continued to a second after touchdown."""


def _vertical(
    objective: Term, *more: Term, torque: float = 18.0, knots: Knots = UP, **settings: Any
) -> Problem:  # fmt: skip
    """Return the optimisation problem of a vertical jump; more: additional constraints; torque [N m]: limit."""
    constraints = (jumps.clear(), jumps.upright(TILT, at_end=False), jumps.drifts(DRIFT), *more)
    return Problem(knots, objective, constraints, jumping_motors(torque), vertical_jump_filter(), **settings)


FINE: dict[str, Any] = {"substeps": SUBSTEPS}  # Arguments of `Problem`: physics steps per policy step
COARSE = FINE | {"substeps": 4}  # Fewer physics steps per policy step, for the first stages of a search
QUICK = FINE | {"double": False, "tolerance": None}  # Single precision, and its tolerance of the contact iteration
UPWARD = (
    (COARSE, Stage(32, 40, rate=0.05, noise=0.05, final_fraction=1.0)),
    (COARSE, Stage(12, 100, rate=0.04, noise=0.04)),
    (FINE, Stage(4, 100, rate=0.02, noise=0.02, penalty=100.0)),
)
CALM: dict[str, Any] = {"slack": 0.03, "check_every": 5, "return_scale": 0.7}
"""Settings of stages that often return to the best motion and continue with smaller steps."""
CALMEST: dict[str, Any] = CALM | {"slack": 0.02}
FORWARD = (
    (QUICK | {"lean": LEAN}, Stage(40, 40, rate=0.05, noise=0.05, final_fraction=1.0, slack=0.1)),
    (QUICK | {"lean": LEAN}, Stage(16, 40, rate=0.05, noise=0.05, final_fraction=1.0, slack=0.1)),
    (QUICK, Stage(10, 60, rate=0.04, noise=0.03, final_fraction=0.5, slack=0.1)),
    (QUICK, Stage(10, 80, rate=0.02, noise=0.015, final_fraction=0.2, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(8, 80, rate=0.02, noise=0.015, final_fraction=0.2, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(6, 80, rate=0.02, noise=0.01, final_fraction=0.2, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(4, 100, rate=0.015, noise=0.006, final_fraction=0.1, penalty=40.0, dual=2.0, crossings=40, **CALM)),
    (QUICK, Stage(3, 150, rate=0.01, noise=0.003, final_fraction=0.1, penalty=100.0, dual=4.0, **CALMEST)),
)
JUMPS = {
    "farthest": Jump(
        "farthest flight, 18 N m", "m", _far, FORWARD,
        lambda replay: -float(jumps.farthest(TAKEOFF_SPEED)(replay.motion)), draw=run_ups, samples=768, polish=5,
    ),
    "highest": Jump(
        "highest jump, 18 N m", "m", lambda **s: _vertical(jumps.highest(), jumps.takes_off(), **s), UPWARD,
        lambda replay: replay.apex,
    ),
    "highest_24_8": Jump(
        "highest jump, 24.8 N m", "m",
        lambda **s: _vertical(jumps.highest(), jumps.takes_off(), torque=24.8, **s), UPWARD,
        lambda replay: replay.apex,
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
            (FINE, Stage(16, 60, rate=0.05, noise=0.05, final_fraction=1.0)),
            (FINE, Stage(6, 100, rate=0.03, noise=0.03)),
        ),
        lambda replay: replay.longest_lift, draw=partial(squats, push=30), samples=1024, after="least_work",
    ),
}  # fmt: skip
LIMITS: dict[str, tuple[str, dict[str, Any]]] = {
    "torque_24_8": ("24.8 N m", {"torque": 24.8}), "speed": ("motor speeds × 1.5", {"speed": 1.5}),
    "friction_1_5": ("friction 1.5", {"friction": 1.5}), "friction_0_6": ("friction 0.6", {"friction": 0.6}),
    "pitch": ("any pitch at landing", {"pitch": FREE}), "stance": ("stance beyond 0.3 m", {"away": FREE}),
    "filter": ("loose command filter", {"command_filter": loose_filter}),
}  # fmt: skip
"""Limits of the farthest flight: label, and the changed settings of its problem."""
LIMITED = {
    f"farthest_{name}": replace(
        JUMPS["farthest"], label=f"farthest flight, {label}", make=partial(_far, **changed), after="farthest"
    )
    for name, (label, changed) in LIMITS.items()
}


def optimise(
    jump: Jump, begin: np.ndarray, seed: int, polish: int, **settings: Any
) -> tuple[Progress, dict[str, float]]:
    """Optimise a jump by all search stages and a last descent (`minimise`); return its result and the simulated steps.

    Keys: `simulated_steps` and `reverse_steps`, of all worlds.
    begin: candidates, (n, len(knots)); seed: of displacements; polish: iterations of the last descent; settings:
    device, threads.
    """
    problems = {str(how): jump.make(**how, **settings) for how in (FINE, *(how for how, _ in jump.stages))}
    costs: list[torch.Tensor] = []
    candidates = begin
    for number, (how, stage) in enumerate(jump.stages):
        problem, record = problems[str(how)], lambda _, last: costs.append(last)
        candidates = smoothed(problem, candidates, stages=(stage,), seed=seed + number, callback=record)
        best = float(costs[-1][0])
        announce(f"{jump.label}, stage {number + 1} of {len(jump.stages)}: cost with penalties {best:.3f}")
    progress = minimise(problems[str(FINE)], candidates, iterations=polish, step=0.01, seed=seed)
    return progress, {
        "simulated_steps": float(sum(problem.world_steps for problem in problems.values())),
        "reverse_steps": float(sum(problem.reverse_steps for problem in problems.values())),
    }
