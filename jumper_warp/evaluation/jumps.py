"""Jumps to heights: one in every world at once, from the command to the landing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from jumper_warp.evaluation.film import Film, Strip, moments
from jumper_warp.evaluation.log import (
    CAME_APART,
    NO_END,
    EvaluationEnv,
    EvaluationLog,
    finite,
    run_evaluation,
    termination_names,
)

STANCE, LANDED = 0, 2
"""Values of the jump's phase before takeoff and after touchdown."""
REST_SPEED = 0.1
"""[m/s] Of the base's centre of mass, below which it is at rest."""
REST_TIME = 1.0
"""[s] After touchdown, when it should be."""
DELAY = 0.5
"""[s] Until the jump is commanded."""
SHOWN_HEIGHT = 1.0
"""[m] The filmstrip shows the jump nearest to this."""


def jump_commands(goals: np.ndarray, delay: np.ndarray | float, step_dt: float) -> np.ndarray:
    """Return commands (num_envs, 4) of jump tasks.

    goals [m]: (num_envs, 3), landing x, y relative to start and heading, and base height at the apex, 0 if any will do.
    delay [s]: until the jump is commanded; (num_envs,) or one for all.
    """
    steps = np.broadcast_to(np.round(np.asarray(delay) / step_dt), len(goals))
    return np.concatenate([goals, steps[:, None]], axis=1).astype(np.float32)


@dataclass
class Jumps(EvaluationLog):
    """What became of one vertical jump per world; each array has shape (num_envs,). Nothing changes after its end."""

    target: np.ndarray
    """[m] Commanded base height."""
    terminations: tuple[str, ...]
    """Names of the ends of an episode; the first is the success."""
    end: np.ndarray = field(init=False)
    """Index of the end in `terminations`, -1 before it."""
    apex: np.ndarray = field(init=False)
    """[m] Largest base height."""
    tilt: np.ndarray = field(init=False)
    """[rad] Largest since touchdown."""
    rest_speed: np.ndarray = field(init=False)
    """[m/s] Of the base REST_TIME after touchdown; infinite before."""
    early: np.ndarray = field(init=False)
    """Whether the jump began before the command."""

    seconds = 8.0

    def __post_init__(self) -> None:
        """Begin with no jump ended."""
        count = len(self.target)
        self.end = np.full(count, -1)
        self.apex, self.tilt = np.zeros(count), np.zeros(count)
        self.rest_speed, self.early = np.full(count, np.inf), np.zeros(count, dtype=bool)

    def begin(self, env: EvaluationEnv) -> None:
        """Stand every world in the default pose with its height to reach."""
        goals = np.zeros((env.num_envs, 3))
        goals[:, 2] = self.target
        env.evaluation_reset(jump_commands(goals, DELAY, env.step_dt))

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all jumps have ended."""
        commanded = arrays["steps"] == arrays["command_step"]
        self.early[commanded] = arrays["phase"][commanded] != STANCE
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
        return np.array([*self.terminations, NO_END])[self.end]

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

    def notes(self, worlds: Sequence[int]) -> dict[str, Any]:
        """Return the commanded heights [m]."""
        return {"targets_m": self.target[list(worlds)].tolist()}

    def strip(self, film: Film) -> Strip:
        """Return pictures of the jump nearest to SHOWN_HEIGHT."""
        targets = self.target[film.worlds]
        index = int(np.argmin(np.abs(targets - SHOWN_HEIGHT)))
        height = film.base(index)[:, 2]
        frames = moments(height, round(DELAY / film.env.step_dt) - 1)
        captions = [f"{(frame + 1) * film.env.step_dt:.2f} s, {height[frame]:.2f} m" for frame in frames]
        view = {"eye": (1.5, 2.0, 0.9), "target": (0.0, 0.0, 0.55), "size": (320, 420)}
        return Strip(index, frames, captions, **view, name=f"jump_{targets[index]:.2f}_m")


def run_jumps(
    act: Callable[[torch.Tensor], torch.Tensor],
    env: EvaluationEnv,
    heights: np.ndarray,
    watch: Callable[[], object] | None = None,
) -> Jumps:
    """Let every world jump to its height (num_envs,) [m] once; act, watch: as of `run_evaluation`."""
    jumps = Jumps(np.asarray(heights, dtype=float), termination_names(env.task))
    run_evaluation(act, env, jumps, watch=watch)
    return jumps
