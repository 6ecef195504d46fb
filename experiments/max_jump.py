"""How far does a policy jump? Distances grow from 1 m by bins of 0.1 m until fewer than half of the jumps are good.

    python experiments/max_jump.py --policy horizontal_jump --out outputs/max

Each bin holds evenly spaced goals straight ahead, within 0.05 m of its middle, and headings from the full circle.
Errors and success are those of `horizontal_jump_sweep.py`; a good jump succeeds and is a single one: after touchdown
the robot is not off the ground again for more than 0.05 s. Without that a policy reaches far goals by a second hop.
The distance that counts is the largest middle of a bin up to which at least 95 % of the jumps are good; where the base
is at touchdown tells how much of it was flown. Published distances, as the paper compares them, were jumped by real
robots; ours is a simulation.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.landings import Landings, landing_figures, random_headings
from jumper_warp.trial import Trial, TrialArgs

matplotlib.use("Agg")
import matplotlib.pyplot as plt

BIN = 0.1
"""[m]"""
FIRST = 1.0
"""[m] Middle of the first bin."""
LAST = 2.5
"""[m] No bin beyond."""
RELIABLE, GIVEN_UP = 0.95, 0.5
PUBLISHED = {
    "Barkour (Caluwaerts et al. 2023)": 0.5,
    "Margolis et al. 2021": 0.66,
    "Liu et al. 2023": 0.8,
    "Cheng et al. 2024": 0.8,
    "Atanassov et al. 2024": 0.9,
    "Jumper, the paper's robot": 1.25,
}
"""[m] The paper's table of jump distances."""
PAPER = {"largest_reliable_m": 1.25}


@dataclass(frozen=True)
class Args(TrialArgs):
    """Flags."""

    jumps: int = 100
    """Number of jumps in each bin."""
    first: float = FIRST
    """[m] Middle of the first bin."""

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if self.jumps < 1 or not 0.1 <= self.first <= LAST:
            raise ValueError(f"need a jump and first in 0.1..{LAST:g} m, got {self.jumps}, {self.first}")


def figures(bins: dict[float, Landings]) -> dict[str, Any]:
    """Return the figures over all bins (middle [m] to jumps), and lists with an entry a bin."""
    each = [landing_figures(landings) for landings in bins.values()]
    rates = [values["single_jump_success_rate"] for values in each]
    reliable = next((i for i, rate in enumerate(rates) if rate < RELIABLE), len(rates))
    middles = list(bins)
    landed = [landings.landing[landings.single][:, 0] for landings in bins.values()]
    farthest = max((float(reached.max()) for reached in landed if len(reached)), default=None)
    weight = [values["jumps"] for values in each]
    return {
        "jumps": sum(weight),
        "mean_error_m": _mean([values["mean_error_m"] for values in each]),
        "success_rate": _mean([values["success_rate"] for values in each]),
        "success_rate_in_range": _mean([values["success_rate"] for values in each[:reliable]]),
        "single_jump_success_rate": _mean(rates),
        "largest_reliable_m": middles[reliable - 1] if reliable else None,
        "base_at_touchdown_m": _flown(list(bins.values())[reliable - 1]) if reliable else None,
        "farthest_good_m": farthest,
        "bin_m": middles,
        "bin_single_jump_success_rate": rates,
        "bin_success_rate": [values["success_rate"] for values in each],
        "bin_mean_error_at_touchdown_m": [values["mean_error_at_touchdown_m"] for values in each],
        "bin_mean_error_m": [values["mean_error_m"] for values in each],
        "bin_mean_error_of_successes_m": [values["mean_error_of_successes_m"] for values in each],
        "bin_fall_rate": [values["fall_rate"] for values in each],
    }


def _flown(landings: Landings) -> float:
    """Return the mean distance [m] of the base from its start at touchdown."""
    return float(np.linalg.norm(landings.touchdown[landings.single], axis=-1).mean())


def _mean(values: list[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers)) if numbers else None


def plot(values: dict[str, Any], path: Path, title: str) -> None:
    """Draw success and error over the distance."""
    fig, (top, bottom) = plt.subplots(2, 1, figsize=(7, 6), sharex=True, constrained_layout=True)
    for name, label in (("bin_single_jump_success_rate", "in a single jump"), ("bin_success_rate", "in all")):
        top.plot(values["bin_m"], [100.0 * rate for rate in values[name]], marker="o", label=label)
    top.axhline(100.0 * RELIABLE, color="0.5", linestyle="--", linewidth=1.0)
    for work, distance in PUBLISHED.items():
        if distance >= values["bin_m"][0]:
            top.axvline(distance, color="tab:green", linewidth=1.0, label=f"{work}, {distance:g} m")
    top.set(ylabel="success [%]", ylim=(0.0, 103.0), title=title)
    top.legend(loc="lower left")
    error = [np.nan if value is None else value for value in values["bin_mean_error_of_successes_m"]]
    bottom.plot(values["bin_m"], error, marker="o")
    bottom.set(xlabel="commanded distance [m]", ylabel="mean error of successes [m]", ylim=(0.0, None))
    fig.savefig(path, dpi=110)
    plt.close(fig)


def print_tables(values: dict[str, Any]) -> None:
    """Print success and error of each bin, and published distances beside ours."""
    bins = Table("distance [m]", "single [%]", "success [%]", "mean error [m]", "of successes [m]", "at touchdown [m]")
    rates = ("bin_single_jump_success_rate", "bin_success_rate")
    errors = ("bin_mean_error_m", "bin_mean_error_of_successes_m", "bin_mean_error_at_touchdown_m")
    for i, middle in enumerate(values["bin_m"]):
        shares = [f"{100.0 * values[name][i]:.1f}" for name in rates]
        lengths = ["" if values[name][i] is None else f"{values[name][i]:.3f}" for name in errors]
        bins.add_row(f"{middle:.1f}", *shares, *lengths)
    works = Table("work", "jump [m]")
    for work, distance in PUBLISHED.items():
        works.add_row(work, f"{distance:g}")
    ours = values["largest_reliable_m"]
    works.add_row(f"here, simulated, {100 * RELIABLE:g} % good", "none" if ours is None else f"{ours:.1f}")
    console = Console()
    console.print(bins)
    console.print(works)


def main(args: Args) -> dict:
    """Let the distance grow and return the figures."""
    trial = Trial("max_jump", args)
    env = trial.env(args.jumps)
    headings = random_headings(args.jumps, args.seed)
    bins: dict[float, Landings] = {}
    for number in range(round((LAST - args.first) / BIN) + 1):
        middle = round(args.first + number * BIN, 6)
        goals = np.zeros((args.jumps, 1, 2))
        goals[:, 0, 0] = middle + BIN * (np.linspace(0.0, 1.0, args.jumps) - 0.5 if args.jumps > 1 else 0.0)
        bins[middle] = trial.jump(env, goals, film=f"jump_{middle:.1f}_m", headings=headings)
        if bins[middle].single.mean() < GIVEN_UP:
            break
    values = figures(bins)
    plot(values, trial.folder / "max_jump.png", trial.title)
    print_tables(values)
    return trial.report(values, PAPER)


if __name__ == "__main__":
    main(tyro.cli(Args))
