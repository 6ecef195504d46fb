"""Jumps in all directions: goals spread evenly over a ring around the start.

    python experiments/ring_jump.py --policy omnidirectional_jump --radius 0.5 --out outputs/ring

Starts, errors and success are those of `horizontal_jump_sweep.py`; directions are relative to the robot's heading. What
a policy for all directions loses in distance against one that jumps ahead only is seen with `max_jump.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.landings import FALLS, MISSED, Landings
from jumper_warp.evaluation.log import termination_names
from jumper_warp.evaluation.places import landing_metrics, random_headings
from jumper_warp.evaluation.plots import draw_landings, drawn
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.utils.errors import InputError

SECTORS = ("ahead", "left", "back", "right")
"""Quarters of the ring, each centred on its direction."""


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    policy: str = "omnidirectional_jump"
    """Name or folder of a policy, a run's folder, or a checkpoint."""
    jumps: int = 200
    """Number of jumps, one world each."""
    radius: float = 0.5
    """[m] Of the ring."""

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if self.jumps < len(SECTORS) or not 0.0 < self.radius < 3.0:
            raise InputError(
                f"need at least {len(SECTORS)} jumps and a radius in (0, 3) m, got {self.jumps}, {self.radius}"
            )


def sectors(goals: np.ndarray) -> np.ndarray:
    """Return the index in SECTORS of each goal (..., 2)."""
    angle = np.arctan2(goals[..., 1], goals[..., 0])
    return np.round(angle / (0.5 * np.pi)).astype(int) % len(SECTORS)


def metrics(landings: Landings) -> dict:
    """Return the metrics of the ring, with successes, falls and misses of each quarter."""
    values = landing_metrics(landings)
    sector = sectors(landings.goals)
    for index, name in enumerate(SECTORS):
        for rate, counts in {
            "success_rate": landings.success,
            "fall_rate": np.isin(landings.ends, FALLS),
            "miss_rate": landings.outcomes == MISSED,
        }.items():
            values[f"{rate}_{name}"] = float(counts[sector == index].mean())
    return values


def main(args: Args) -> dict:
    """Jump to the ring and return the figures."""
    run = EvaluationRun.of("ring_jump", args)
    angle = np.linspace(0.0, 2.0 * np.pi, args.jumps, endpoint=False)
    goals = args.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    env = run.env(args.jumps)
    asked = Landings(goals, termination_names(env.task), random_headings(args.jumps, args.seed))
    landings = run.follow(env, asked, film="jumps")
    with drawn(run.folder / "landings.png", figsize=(6, 6.5)) as axis:
        draw_landings(axis, landings, f"{args.jumps} jumps over {args.radius:g} m, {run.title}")
    return run.report(metrics(landings), {})


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
