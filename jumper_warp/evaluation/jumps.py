"""Jumps to heights: one in every world at once, from the command to the landing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from jumper_warp.evaluation.angles import wrapped, yaw_of
from jumper_warp.evaluation.film import Film, Strip, moments
from jumper_warp.evaluation.log import (
    CAME_APART,
    NO_END,
    EvaluationEnv,
    EvaluationLog,
    finite,
    run_evaluation,
    success_index,
    termination_names,
)
from jumper_warp.evaluation.paws import Paws, paw_arrays, stepped

STANCE, LANDED = 0, 2
"""Values of the jump's phase before takeoff and after touchdown."""
REST_SPEED = 0.1
"""[m/s] Of the base's centre of mass, below which it is at rest."""
REST_TIME = 1.0
"""[s] After touchdown, when it should be."""
DELAY = 0.5
"""[s] Until the jump is commanded."""
LOWEST, HIGHEST, ABOVE = -0.37, 1.47, 0.45
"""[m] What pictures of a jump show at least, from the ground before it up, and what they leave above the base."""
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
    """Names of the ends of an episode, SUCCESS among them."""
    rest: float = REST_TIME
    """[s] From touchdown until the jump is over, at least REST_TIME."""
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
    drift: np.ndarray = field(init=False)
    """[m] Of the base in the plane, from the start to the end."""
    yaw: np.ndarray = field(init=False)
    """[rad] Of the base at the end, from the jump's heading."""
    lift_time: np.ndarray = field(init=False)
    """[s] Longest that any paw was off the ground again after its own first contact since touchdown."""
    takeoffs: np.ndarray = field(init=False)
    """Number of times that the robot took off again after touchdown."""

    def __post_init__(self) -> None:
        """Begin with no jump ended."""
        count = len(self.target)
        self.end = np.full(count, -1)
        self.apex, self.tilt = np.zeros(count), np.zeros(count)
        self.rest_speed, self.early = np.full(count, np.inf), np.zeros(count, dtype=bool)
        self.drift, self.yaw, self.lift_time = (np.zeros(count) for _ in range(3))
        self.takeoffs, self._paws = np.zeros(count, dtype=int), Paws(count)
        self._success = success_index(self.terminations)

    @property
    def seconds(self) -> float:
        """[s] In which a jump has ended."""
        return 7.0 + self.rest

    def begin(self, env: EvaluationEnv) -> None:
        """Stand every world in the default pose with its height to reach."""
        goals = np.zeros((env.num_envs, 3))
        goals[:, 2] = self.target
        env.evaluation_reset(jump_commands(goals, DELAY, env.step_dt))

    def look(self, env: EvaluationEnv) -> dict[str, np.ndarray]:
        """Return the state of every world's episode, which of its paws are on the ground, and how fast it rises."""
        return env.task_arrays() | paw_arrays(env)

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all jumps have ended."""
        commanded = arrays["steps"] == arrays["command_step"]
        self.early[commanded] = arrays["phase"][commanded] != STANCE
        running = self.end < 0
        self.apex[running] = arrays["max_height"][running]
        self.tilt[running] = arrays["peak_tilt"][running]
        self.drift[running] = np.linalg.norm((arrays["base_pos"] - arrays["start"])[running, :2], axis=1)
        self.yaw[running] = wrapped(yaw_of(arrays["base_quat"]) - arrays["heading"])[running]
        landed = arrays["phase"] == LANDED
        self._follow_paws(arrays, np.flatnonzero(running), landed, step_dt)
        due = running & landed & (arrays["phase_steps"] == round(REST_TIME / step_dt))
        self.rest_speed[due] = np.linalg.norm(arrays["base_vel"][due], axis=1)
        failed = running & (arrays["ending"] >= 0) & (arrays["ending"] != self._success)
        rested = running & ~failed & landed & (arrays["phase_steps"] >= round(self.rest / step_dt))
        self.end[failed], self.end[rested] = arrays["ending"][failed], self._success
        return bool((self.end >= 0).all())

    def _follow_paws(self, arrays: dict[str, np.ndarray], row: np.ndarray, landed: np.ndarray, step_dt: float) -> None:
        """Take in what the paws of some worlds do after touchdown."""
        lifted = self._paws.update(row, landed[row], arrays["paws_down"][row], arrays["up"][row], step_dt)
        self.lift_time[row] = np.maximum(self.lift_time[row], lifted.paw)
        self.takeoffs[row] += lifted.takeoff

    @property
    def error(self) -> np.ndarray:
        """[m] Apex minus target; not a number where the simulation came apart."""
        broken = np.isin(self.outcomes, CAME_APART) | ~np.isfinite(self.apex)
        return np.where(broken, np.nan, self.apex - self.target)

    @property
    def success(self) -> np.ndarray:
        """Whether the jump met its height within the task's limit, if it has one, and was landed."""
        return self.end == self._success

    @property
    def still(self) -> np.ndarray:
        """Whether the robot landed, and lifted no paw again for `jumper_warp.evaluation.paws.HOP_TIME` or longer."""
        return self.success & ~stepped(self.lift_time)

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
        eye, target, size = view_of(float(height[frames].max()))
        return Strip(index, frames, captions, eye, target, size, name=f"jump_{targets[index]:.2f}_m")


def view_of(apex: float) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[int, int]]:
    """Return eye and target [m] and size [px] of pictures of a jump to an apex [m], as tall as it needs, one scale."""
    taller = max(1.0, (apex + ABOVE - LOWEST) / (HIGHEST - LOWEST))
    middle = LOWEST + 0.5 * taller * (HIGHEST - LOWEST)
    return (1.5 * taller, 2.0 * taller, middle + 0.35 * taller), (0.0, 0.0, middle), (320, round(420 * taller))


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
