"""Evaluation of vertical jumps: many commanded heights at once, each from standing still."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.figures import output_dir, write_figures
from jumper_warp.policy import add_files, find_policy
from jumper_warp.policy_interface import PolicyError
from jumper_warp.saved_run import Conditions, env_of_policy, is_run, open_policy

LANDED = 2
"""Value of the jump's phase after touchdown."""
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
TASK = "vertical-jump"


class EvaluationEnv(Protocol):
    """What evaluation asks of an environment; `jumper_warp.env.JumpEnv` is one."""

    num_envs: int
    device: torch.device
    step_dt: float
    obs: torch.Tensor
    task: Any

    def evaluation_reset(self, goals: np.ndarray) -> None:
        """Stand every world still with its goal (num_envs, 3), and end no episode."""

    def step(self, action: torch.Tensor) -> None:
        """Advance one policy step."""

    def task_arrays(self) -> dict[str, np.ndarray]:
        """Return goal, phase, phase_steps, max_height, peak_tilt, base_vel and rule of every world."""


@dataclass
class Jumps:
    """What became of one jump per world; each array has shape (num_envs,). Nothing changes after a jump's end."""

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

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Take in a policy step; return whether all jumps have ended."""
        running = self.end < 0
        self.apex[running] = arrays["max_height"][running]
        self.tilt[running] = arrays["peak_tilt"][running]
        due = running & (arrays["phase"] == LANDED) & (arrays["phase_steps"] == round(REST_TIME / step_dt))
        self.rest_speed[due] = np.linalg.norm(arrays["base_vel"][due], axis=1)
        ended = running & (arrays["rule"] >= 0)
        self.end[ended] = arrays["rule"][ended]
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


def run_jumps(
    act: Callable[[torch.Tensor], torch.Tensor],
    env: EvaluationEnv,
    heights: np.ndarray,
    max_seconds: float = MAX_SECONDS,
) -> Jumps:
    """Let every world jump once, from the default pose, and return what became of it.

    Args:
        act: Observations (num_envs, num_obs) to actions, such as `Policy.act`.
        env: One world a jump.
        heights: (num_envs,) commanded base heights [m].
        max_seconds: Simulated time after which what has not ended is a failure [s].
    """
    goals = np.zeros((env.num_envs, 3), dtype=np.float32)
    goals[:, 2] = heights
    env.evaluation_reset(goals)
    jumps = Jumps(np.asarray(heights, dtype=float), tuple(rule.name for rule in env.task.rules))
    for _ in range(round(max_seconds / env.step_dt)):
        env.step(act(env.obs))
        if jumps.update(env.task_arrays(), env.step_dt):
            break
    return jumps


def jump_figures(jumps: Jumps, in_range: tuple[float, float]) -> dict[str, float | int | None]:
    """Return the figures of an evaluation.

    Errors are over all jumps, failed ones included, but those whose simulation came apart, which `came_apart` counts.
    Landing figures are over the successful jumps. in_range [m]: targets that `success_rate_in_range` counts.
    """
    # Half a millimetre, so that evenly spaced targets do not fall out by rounding.
    inside = (jumps.target >= in_range[0] - 5e-4) & (jumps.target <= in_range[1] + 5e-4)
    error, success = np.abs(jumps.error), jumps.success

    def mean(values: np.ndarray) -> float | None:
        values = values[~np.isnan(values)]
        return float(values.mean()) if len(values) else None

    def largest(values: np.ndarray) -> float | None:
        return float(values.max()) if len(values) else None

    figures: dict[str, float | int | None] = {
        "jumps": len(jumps.target),
        "mean_abs_error_m": mean(error),
        "mean_abs_error_in_range_m": mean(error[inside]),
        "max_abs_error_of_successes_m": largest(error[success]),
        "success_rate": float(success.mean()),
        "success_rate_in_range": mean(success[inside].astype(float)),
        "range_lower_m": in_range[0],
        "range_upper_m": in_range[1],
        "at_rest_within_1_s_rate": mean((jumps.rest_speed < REST_SPEED)[success].astype(float)),
        "mean_landing_tilt_deg": mean(np.degrees(jumps.tilt[success])),
        "max_landing_tilt_deg": largest(np.degrees(jumps.tilt[success])),
        "collision_rate": float((jumps.outcomes == COLLIDED).mean()),
        CAME_APART: int(np.isnan(jumps.error).sum()),
    }
    failures = jumps.outcomes[~success]
    return figures | {f"failed_by_{name}": int((failures == name).sum()) for name in sorted(set(failures))}


@dataclass(frozen=True)
class EvaluateCfg:
    """Let a policy jump to many heights and report how well it did."""

    policy: tyro.conf.Positional[str]
    """Name or folder of a policy, a run's folder, or a checkpoint."""
    jumps: int = 200
    """Number of jumps, with evenly spaced heights."""
    lower: float = 0.5
    """[m] Lowest commanded base height."""
    upper: float = 1.2
    """[m] Highest."""
    in_range: tuple[float, float] = (0.5, 1.1)
    """[m] Heights that the success rate in range counts."""
    conditions: Annotated[Conditions, tyro.conf.arg(name="")] = field(default_factory=Conditions)
    """What the policy is tried in."""
    out: Path | None = None
    """Folder for figures.json and jumps.csv (default: outputs/evaluate/<time>)."""
    keep: bool = False
    """Also put the figures into the policy's folder."""

    def __post_init__(self) -> None:
        """Raises ValueError: a setting is out of range."""
        if self.jumps < 1:
            raise ValueError(f"jumps must be at least 1, got {self.jumps}")
        for low, high in ((self.lower, self.upper), self.in_range):
            if not 0.0 < low <= high < 10.0:
                raise ValueError(f"heights must be in (0, 10) m and rise, got {low}, {high}")


def evaluate(cfg: EvaluateCfg) -> dict[str, Any]:
    """Evaluate, print a table, write `figures.json` and `jumps.csv`, and return the figures.

    Raises:
        PolicyError: The policy cannot be used, or does not jump vertically.
        CheckpointError: The checkpoint cannot be used.
    """
    policy = open_policy(cfg.policy)
    check_task(policy.interface.task)
    if cfg.keep and is_run(cfg.policy):
        raise PolicyError(f"{cfg.policy}: a run keeps no figures; export it first")
    env = env_of_policy(policy, cfg.jumps, cfg.conditions)
    policy.to(env.device)
    jumps = run_jumps(policy.act, env, np.linspace(cfg.lower, cfg.upper, cfg.jumps))
    figures = {
        "task": policy.interface.task,
        **{name: getattr(cfg.conditions, name) for name in ("solver", "randomize", "noise", "seed")},
        **jump_figures(jumps, cfg.in_range),
    }
    folder = output_dir("evaluate", cfg.out)
    write_figures(folder, figures)
    (folder / "jumps.csv").write_text(csv_text(jumps))
    if cfg.keep:
        keep_figures(cfg.policy, folder)
    print_figures(figures)
    Console(stderr=True).print(f"{folder}/figures.json", highlight=False, soft_wrap=True)
    return figures


def check_task(task: str) -> None:
    """Raise a PolicyError unless the task is the vertical jump."""
    if task != TASK:
        raise PolicyError(f"only policies of {TASK} are evaluated and played so far, this one is of {task!r:.60}")


def keep_figures(policy: str, folder: Path) -> None:
    """Copy figures, what made them, and the list of jumps from a folder into a policy's."""

    add_files(
        find_policy(policy), {name: (folder / name).read_bytes() for name in ("figures.json", "run.json", "jumps.csv")}
    )


def csv_text(jumps: Jumps) -> str:
    """Return one line a jump: target and apex [m], and how it ended."""
    lines = ["target_m,apex_m,end"]
    for target, apex, end in zip(jumps.target, jumps.apex, jumps.outcomes, strict=True):
        lines.append(f"{target:.6f},{apex:.6f},{end}")
    return "\n".join(lines) + "\n"


def print_figures(figures: dict[str, Any]) -> None:
    """Print a table of figures to standard output."""
    table = Table("figure", "value", box=None)
    for name, value in figures.items():
        table.add_row(name, f"{value:.4g}" if isinstance(value, float) else json.dumps(value))
    Console().print(table)
