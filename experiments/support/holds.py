"""Squats that are held: how quietly a robot waits for the command to jump."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.evaluation.log import EvaluationLog, Metrics, mean, mean_and_max

DOWN = 0.1
"""[N] Of a paw that is on the ground."""


@dataclass
class Holds(EvaluationLog):
    """What robots do that squat and wait, a world each; nothing of one is looked at after its end."""

    goals: np.ndarray
    """[m] (num_envs, 3) For which they squat: place relative to start and heading, and height."""
    hold: float = 3.0
    """[s] Until the jump would be commanded; all that is followed."""
    window: float = 1.0
    """[s] At the end of it, what is looked at."""
    row = "squat"

    def __post_init__(self) -> None:
        """Begin with nothing seen."""
        self.count, self.step_dt = len(self.goals), 1.0 / 60.0
        self.over = np.zeros(self.count, dtype=bool)  # whether each episode ended before the command
        # in each policy step, (num_envs, 4), (num_envs, 4), (num_envs, 12)
        self.peaks: list[np.ndarray] = []  # [N] largest force on each paw, of all its physics steps
        self.forces: list[np.ndarray] = []  # [N] force on each paw at the end of it
        self.torques: list[np.ndarray] = []  # [N m] of the motors

    @property
    def seconds(self) -> float:
        """[s] Simulated time."""
        return self.hold

    def begin(self, env: Env) -> None:
        """Stand every robot still, with a goal and no command yet."""
        self.step_dt = env.step_dt
        env.evaluation_reset(jump_commands(self.goals, self.hold + 1.0, env.step_dt))

    def look(self, env: Any) -> dict[str, np.ndarray]:
        """Return forces, torques and ends."""
        return {
            "peak": env.sim.physics.peak_paw_force.numpy().T.copy(),
            "force": np.linalg.norm(env.sim.paw_force.numpy(), axis=2).T.copy(),
            "torque": env.sim.torque.numpy().T.copy(), "termination": env.episodes.termination.numpy().copy(),
        }  # fmt: skip

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all have ended."""
        self.over |= arrays["termination"] >= 0
        for kept, name in ((self.peaks, "peak"), (self.forces, "force"), (self.torques, "torque")):
            kept.append(arrays[name])
        return bool(self.over.all())

    def last(self, values: list[np.ndarray]) -> np.ndarray:
        """Return what was seen in the window, of the robots that still hold, (steps, robots, ...)."""
        return np.array(values[-round(self.window / self.step_dt) :])[:, ~self.over]

    @property
    def force_range(self) -> np.ndarray:
        """[N] (robots,) Between the largest and the smallest force on a paw in the window, the largest of the four."""
        return (self.last(self.peaks).max(axis=0) - self.last(self.forces).min(axis=0)).max(axis=1)

    @property
    def torque_ripple(self) -> np.ndarray:
        """[N m] (robots,) Standard deviation of a motor's torque in the window, root mean square over motors."""
        return np.sqrt(self.last(self.torques).var(axis=0).mean(axis=1))

    def columns(self) -> dict[str, list]:
        """Return force and torque of each robot that holds."""
        return {"paw_force_range_n": self.force_range.tolist(), "torque_ripple_nm": self.torque_ripple.tolist()}

    def series(self, worlds: Sequence[int]) -> dict[str, float]:
        """Return the forces on the paws."""
        names = ("front left", "front right", "back left", "back right")
        return {
            f"force/{name} of {world} [N]": float(self.forces[-1][world, paw])
            for world in worlds
            for paw, name in enumerate(names)
        }


def hold_goals(count: int, reach: tuple[float, float], *, up: bool) -> np.ndarray:
    """Return goals, evenly over a reach [m], as `Holds` takes them, (count, 3); up: heights, else places ahead."""
    goals = np.zeros((count, 3))
    goals[:, 2 if up else 0] = np.linspace(*reach, count)
    return goals


def hold_metrics(holds: Holds) -> Metrics:
    """Return the metrics of robots that squat and wait; forces and torques are of those that still do at the end."""
    spread, ripple = holds.force_range, holds.torque_ripple
    return {
        "squats": len(holds.over),
        "holding_rate": float((~holds.over).mean()),
        **mean_and_max("paw_force_range_n", spread),
        "median_paw_force_range_n": float(np.median(spread)) if len(spread) else None,
        "lost_paw_share": mean((holds.last(holds.forces) < DOWN).ravel()),
        **mean_and_max("torque_ripple_nm", ripple),
    }
