"""Settings of `jumper finetune`; this module does not import PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from jumper_warp.evaluation.log import check
from jumper_warp.utils.checks import check_positive


@dataclass(frozen=True)
class FinetuneCfg:
    """Settings of fine-tuning: numbers of jumps, ranges of goals, and standard deviations that weight errors."""

    num_goals: int = 64  # Number of jumps of the nominal robot, spread evenly over the goals
    num_delayed: int = 32  # Number of jumps of the nominal robot with latencies sampled from the training's range
    num_randomized: int = 64  # Number of jumps of robots randomised as in the training, with noise, latency and pushes
    height_range: tuple[float, float] = (0.5, 1.075)
    """[m] Lowest and highest commanded base height in jumps to heights."""
    distance_range: tuple[float, float] = (0.3, 1.4)  # [m] Nearest and farthest goal ahead in jumps to positions
    iterations: int = 6  # Number of Gauss-Newton steps; 0, for landing positions only: correct the aim alone
    miss_std: float = 0.001
    """[m] Error of the nominal robot that costs as much as a change of the actions by --action-std."""
    delayed_std: float = 0.003  # [m] Error of a robot with latency that costs as much as --action-std
    randomized_std: float = 0.01  # [m] Error of a randomised robot that costs as much as --action-std
    action_std: float = 0.02
    """[1] Standard deviation of the change of the actions, root of the sum of squares over the motors."""
    landing_std: float = 0.005  # [1] Standard deviation of the change of the actions after touchdown
    seed: int = 0  # Seed of commands, latencies and robots (stream: tuning)
    device: str | None = None  # Warp device (default: a GPU if there is one)
    threads: int | None = None  # CPU threads that share the worlds (default: all cores); results do not depend on it
    robot: Path | None = None
    """Robot overlay file, as written by `jumper sysid fit`, to adapt to (default: the overlay of the training, if it
    had one)."""

    def __post_init__(self) -> None:
        """Raise InputError for a number, standard deviation or range that fine-tuning cannot use."""
        enough = self.num_goals >= 2 and min(self.num_delayed, self.num_randomized, self.iterations) >= 0
        check(enough, "fine-tuning needs at least 2 goals; numbers of jumps and steps must not be negative")
        for name in ("miss_std", "delayed_std", "randomized_std", "action_std", "landing_std"):
            check_positive(name, getattr(self, name))
        for name in ("height_range", "distance_range"):
            low, high = getattr(self, name)
            check(0.0 < low < high < 10.0, f"{name} must be in (0, 10) m and rise, got {low}, {high}")


@dataclass(frozen=True)
class FinetuneArgs(FinetuneCfg):
    """Reduce the errors of a jumping policy, by gradients through physics, motors and network."""

    out: Path | None = None  # Folder of the new policy (default: <policy>_finetuned)
    overwrite: bool = False  # Replace an existing policy in that folder
    json: tyro.conf.FlagCreatePairsOff[bool] = False  # Print finetuning.json; progress goes to standard error
