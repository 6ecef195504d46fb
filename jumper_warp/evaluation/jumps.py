"""Following jumps through an environment: one in every world at once, from the command to the landing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch

STANCE, LANDED = 0, 2
"""Values of the jump's phase before takeoff and after touchdown."""
REST_SPEED = 0.1
"""[m/s] Of the base's centre of mass, below which it is at rest."""
REST_TIME = 1.0
"""[s] After touchdown, when it should be."""
MAX_SECONDS = 8.0
"""Longest evaluation."""
CAME_APART = "came_apart"
COLLIDED = "collided"
NO_END = "no_end"
"""Outcome of a jump that was still under way at the end."""

Figures = dict[str, float | int | None]


class EvaluationEnv(Protocol):
    """What following jumps asks of an environment; `jumper_warp.envs.env.Env` is one."""

    num_envs: int
    device: torch.device
    step_dt: float
    obs: torch.Tensor
    task: Any
    sim: Any

    def evaluation_reset(self, commands: np.ndarray, headings: np.ndarray | float = 0.0) -> None:
        """Stand every world still with its command, and end no episode."""

    def command(self, commands: np.ndarray, worlds: np.ndarray | None = None) -> None:
        """Give some of the worlds another command."""

    def step(self, action: torch.Tensor) -> None:
        """Advance one policy step."""

    def task_arrays(self) -> dict[str, np.ndarray]:
        """Return the state of every world's episode, one array a field of `JumpTask`, and of its base."""


def jump_commands(goals: np.ndarray, delay: np.ndarray | float, step_dt: float) -> np.ndarray:
    """Return commands (num_envs, 4) of jump tasks.

    goals [m]: (num_envs, 3), landing x, y relative to start and heading, and base height at the apex, 0 if any will do.
    delay [s]: until the jump is commanded; (num_envs,) or one for all.
    """
    steps = np.broadcast_to(np.round(np.asarray(delay) / step_dt), len(goals))
    return np.concatenate([goals, steps[:, None]], axis=1).astype(np.float32)


class JumpLog(ABC):
    """Asks every world for a jump, and keeps what became of it."""

    seen: dict[str, np.ndarray]
    """What was seen of the environment last."""

    @abstractmethod
    def begin(self, env: EvaluationEnv) -> None:
        """Stand every world at its start."""

    @abstractmethod
    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all jumps have ended."""

    @abstractmethod
    def columns(self) -> dict[str, list]:
        """Return what to tell of every jump, one list a quantity."""

    @abstractmethod
    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return what to draw of some worlds over time, `group/quantity [unit]` to its present value."""

    def marks(self, worlds: Sequence[int]) -> np.ndarray | None:
        """Return places to mark in a picture [m], world frame, (worlds, places a world, 3), if there are any."""
        return None

    def look(self, env: EvaluationEnv) -> dict[str, np.ndarray]:
        """Return what is to be known of every world after a policy step."""
        return env.task_arrays()

    def follow(self, env: EvaluationEnv) -> bool:
        """Look at the environment after a policy step; return whether all jumps have ended."""
        self.seen = self.look(env)
        return self.update(self.seen, env.step_dt)


def run(
    act: Callable[[torch.Tensor], torch.Tensor],
    env: EvaluationEnv,
    log: JumpLog,
    seconds: float = MAX_SECONDS,
    watch: Callable[[], None] | None = None,
) -> None:
    """Let every world jump as the log asks, until all jumps have ended.

    Args:
        act: Observations (num_envs, num_obs) to actions, such as `Policy.act`.
        env: One world a row of the log.
        log: What is asked for, and what becomes of it.
        seconds: Simulated time after which what has not ended is a failure [s].
        watch: Called after every policy step.
    """
    log.begin(env)
    for _ in range(round(seconds / env.step_dt)):
        env.step(act(env.obs))
        ended = log.follow(env)
        if watch is not None:
            watch()
        if ended:
            return


@dataclass
class Jumps(JumpLog):
    """What became of one vertical jump per world; each array has shape (num_envs,). Nothing changes after its end."""

    target: np.ndarray
    """[m] Commanded base height."""
    rules: tuple[str, ...]
    """Names of the ends of an episode; the first is the success."""
    end: np.ndarray = field(init=False)
    """Index of the end in `rules`, -1 before it."""
    apex: np.ndarray = field(init=False)
    """[m] Largest base height."""
    tilt: np.ndarray = field(init=False)
    """[rad] Largest since touchdown."""
    rest_speed: np.ndarray = field(init=False)
    """[m/s] Of the base REST_TIME after touchdown; infinite before."""

    def __post_init__(self) -> None:
        """Begin with no jump ended."""
        count = len(self.target)
        self.end = np.full(count, -1)
        self.apex, self.tilt = np.zeros(count), np.zeros(count)
        self.rest_speed = np.full(count, np.inf)

    def begin(self, env: EvaluationEnv) -> None:
        """Stand every world in the default pose with its height to reach."""
        goals = np.zeros((env.num_envs, 3))
        goals[:, 2] = self.target
        env.evaluation_reset(jump_commands(goals, 0.5, env.step_dt))

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all jumps have ended."""
        running = self.end < 0
        self.apex[running] = arrays["max_height"][running]
        self.tilt[running] = arrays["peak_tilt"][running]
        due = running & (arrays["phase"] == LANDED) & (arrays["phase_steps"] == round(REST_TIME / step_dt))
        self.rest_speed[due] = np.linalg.norm(arrays["base_vel"][due], axis=1)
        ended = running & (arrays["ending"] >= 0)
        self.end[ended] = arrays["ending"][ended]
        return bool((self.end >= 0).all())

    @property
    def error(self) -> np.ndarray:
        """[m] Apex minus target; not a number where the simulation came apart."""
        broken = np.isin(self.outcomes, CAME_APART) | ~np.isfinite(self.apex)
        return np.where(broken, np.nan, self.apex - self.target)

    @property
    def success(self) -> np.ndarray:
        """Whether the jump met its height within the task's limit and was landed."""
        return self.end == 0

    @property
    def outcomes(self) -> np.ndarray:
        """Name of each jump's end."""
        return np.array([*self.rules, NO_END])[self.end]

    def columns(self) -> dict[str, list]:
        """Return targets, apexes and errors [m] and the ends."""
        numbers = {"target_m": self.target, "apex_m": self.apex, "error_m": self.error}
        return {name: finite(values) for name, values in numbers.items()} | {"end": self.outcomes.tolist()}

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the base's height and the commanded one [m]."""
        series = {}
        for world in worlds:
            series[f"height/base of {world} [m]"] = self.seen["base_pos"][world, 2]
            series[f"height/target of {world} [m]"] = self.target[world]
        return series


def run_jumps(
    act: Callable[[torch.Tensor], torch.Tensor],
    env: EvaluationEnv,
    heights: np.ndarray,
    max_seconds: float = MAX_SECONDS,
    watch: Callable[[], None] | None = None,
) -> Jumps:
    """Let every world jump to its height (num_envs,) [m] once, from the default pose; arguments as for `run`."""
    jumps = Jumps(np.asarray(heights, dtype=float), rule_names(env))
    run(act, env, jumps, max_seconds, watch)
    return jumps


def rule_names(env: EvaluationEnv) -> tuple[str, ...]:
    """Return the names of the ends of an episode."""
    return tuple(term.name for term in env.task.terminations)


def jump_figures(jumps: Jumps, in_range: tuple[float, float]) -> Figures:
    """Return the figures of vertical jumps.

    Errors are over all jumps, failed ones included, but those whose simulation came apart, which `came_apart` counts.
    Landing figures are over the successful jumps. in_range [m]: targets that `success_rate_in_range` counts.
    """
    inside = within(jumps.target, in_range)
    error, success = np.abs(jumps.error), jumps.success
    figures: Figures = {
        "jumps": len(jumps.target),
        "mean_abs_error_m": mean(error),
        "mean_abs_error_in_range_m": mean(error[inside]),
        "max_abs_error_of_successes_m": largest(error[success]),
        "success_rate": float(success.mean()),
        "success_rate_in_range": mean(success[inside]),
        "range_lower_m": in_range[0],
        "range_upper_m": in_range[1],
        "at_rest_within_1_s_rate": mean((jumps.rest_speed < REST_SPEED)[success]),
        "mean_landing_tilt_deg": mean(np.degrees(jumps.tilt[success])),
        "max_landing_tilt_deg": largest(np.degrees(jumps.tilt[success])),
        "collision_rate": float((jumps.outcomes == COLLIDED).mean()),
        CAME_APART: int(np.isnan(jumps.error).sum()),
    }
    return figures | failures(jumps.outcomes[~success])


def within(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Return which values [m] are between limits, give or take half a millimetre for those that were evenly spaced."""
    return (values >= limits[0] - 5e-4) & (values <= limits[1] + 5e-4)


def mean(values: np.ndarray | Sequence[float | None]) -> float | None:
    """Return the mean of what is a number, None if nothing is."""
    values = np.asarray(values, dtype=float)
    values = values[~np.isnan(values)]
    return float(values.mean()) if len(values) else None


def largest(values: np.ndarray) -> float | None:
    """Return the largest of what is a number, None if nothing is."""
    values = values[~np.isnan(values)]
    return float(values.max()) if len(values) else None


def failures(outcomes: np.ndarray) -> Figures:
    """Return how many of the failed jumps ended in which way."""
    return {f"failed_by_{name}": int((outcomes == name).sum()) for name in sorted(set(outcomes))}


def finite(values: np.ndarray) -> list[float | None]:
    """Return values as JSON holds them, None where there is no number."""
    return [float(value) if np.isfinite(value) else None for value in values]
