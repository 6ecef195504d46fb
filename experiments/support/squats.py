"""Held squats: log and metrics of paw forces and motor torques before the command to jump."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.evaluation.log import EvaluationLog
from jumper_warp.utils.metrics import Metrics, MetricValue, largest, mean, rate

CONTACT_FORCE = 0.1  # [N] Smallest force on a paw that is on the ground


@dataclass
class SquatLog(EvaluationLog):
    """Log of robots that squat and wait, one per world; samples after an episode's end are ignored."""

    goals: np.ndarray  # [m] (num_envs, 3) Goals of the jumps: x, y relative to start and heading, and apex height z
    hold: float = 3.0  # [s] Simulated time, within which the jump is not commanded
    window: float = 1.0  # [s] Window at its end over which forces and torques are evaluated
    row_name = "squat"

    def __post_init__(self) -> None:
        """Prepare empty lists, which get an array per policy step."""
        self.count = len(self.goals)
        self.step_dt = 1.0 / 60.0
        self.ended = np.zeros(self.count, dtype=bool)  # (num_envs,) whether each episode has ended
        # one array per policy step
        self.peaks: list[np.ndarray] = []  # [N] (num_envs, 4) largest force on each paw over its physics steps
        self.forces: list[np.ndarray] = []  # [N] (num_envs, 4) force on each paw at its end
        self.torques: list[np.ndarray] = []  # [N m] (num_envs, 12) motor torques at its end

    @property
    def seconds(self) -> float:
        """Simulated time [s]."""
        return self.hold

    def begin(self, env: Env) -> None:
        """Reset every robot to the default pose, with a goal whose jump would be commanded after the end."""
        self.step_dt = env.step_dt
        env.evaluation_reset(jump_commands(self.goals, self.hold + 1.0, env.step_dt))

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return paw forces, motor torques and termination of the robots by name, for `update`.

        `peak` and `force` (num_envs, 4) [N], `torque` (num_envs, 12) [N m], `termination` (num_envs,).
        """
        return {
            "peak": env.sim.peak_paw_force.numpy().T.copy(),
            "force": np.linalg.norm(env.sim.paw_force.numpy(), axis=2).T.copy(),
            "torque": env.sim.torque.numpy().T.copy(), "termination": env.episodes.termination.numpy().copy(),
        }  # fmt: skip

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record a policy step from the arrays of `read_env`; return whether all episodes have ended."""
        self.ended |= arrays["termination"] >= 0
        for history, name in ((self.peaks, "peak"), (self.forces, "force"), (self.torques, "torque")):
            history.append(arrays[name])
        return bool(self.ended.all())

    def in_window(self, values: list[np.ndarray]) -> np.ndarray:
        """Return the values within the evaluated window, of the robots whose episodes have not ended.

        values: arrays per policy step; the result is (steps, robots, ...).
        """
        return np.array(values[-round(self.window / self.step_dt) :])[:, ~self.ended]

    @property
    def force_range(self) -> np.ndarray:
        """Largest minus smallest force on a paw within the window [N], maximum over the paws.

        The largest is over all physics steps, the smallest over the ends of policy steps, as the simulation only keeps
        peaks in between. One value for each robot that has not ended.
        """
        return (self.in_window(self.peaks).max(axis=0) - self.in_window(self.forces).min(axis=0)).max(axis=1)

    @property
    def torque_ripple(self) -> np.ndarray:
        """Standard deviation of a motor's torque within the window [N m], RMS over motors.

        One value for each robot that has not ended.
        """
        return np.sqrt(self.in_window(self.torques).var(axis=0).mean(axis=1))

    def columns(self) -> dict[str, list]:
        """Return force range and torque ripple of each robot whose episode has not ended, as lists by name."""
        return {"paw_force_range_n": self.force_range.tolist(), "torque_ripple_nm": self.torque_ripple.tolist()}

    def series(self) -> dict[str, np.ndarray]:
        """Return the last force [N] on every paw of all worlds."""
        names = ("front left", "front right", "back left", "back right")
        return {f"force/{name} of {{}} [N]": self.forces[-1][:, paw] for paw, name in enumerate(names)}


def squat_goals(count: int, reach: tuple[float, float], *, up: bool) -> np.ndarray:
    """Return evenly spaced goals [m] for `SquatLog`, (count, 3); reach [m]: limits of apex heights (up) or x."""
    goals = np.zeros((count, 3))
    goals[:, 2 if up else 0] = np.linspace(*reach, count)
    return goals


def squat_metrics(squats: SquatLog) -> Metrics:
    """Return the metrics of held squats by name; forces and torques are of the robots that hold to the end."""
    spread = squats.force_range
    ripple = squats.torque_ripple
    over = "robots that held to the end"
    median = float(np.median(spread)) if len(spread) else None
    lost = squats.in_window(squats.forces) < CONTACT_FORCE
    return {
        "holding_rate": rate(~squats.ended, "robots"),
        "paw_force_range_mean_n": mean(spread, over),
        "paw_force_range_median_n": MetricValue(median, len(spread), None, over),
        "paw_force_range_max_n": largest(spread, over),
        "lost_paw_share_mean": mean(lost.mean(axis=(0, 2)), over),
        "torque_ripple_mean_nm": mean(ripple, over),
        "torque_ripple_max_nm": largest(ripple, over),
    }
