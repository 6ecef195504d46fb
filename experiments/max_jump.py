"""How far does a policy jump? Distances grow from 1 m by bins of 0.1 m until fewer than half of them succeed.

    python experiments/max_jump.py --policy horizontal_jump --out outputs/max

Each bin holds evenly spaced goals straight ahead, within 0.05 m of its middle, and headings from the full circle.
Errors and success are those of `horizontal_jump_sweep.py`: where the base is a second after touchdown counts. Until
then a landing may go on with steps or a second hop, and far goals are reached that way. So three distances are told,
each the largest middle of a bin up to which at least 95 % of the jumps succeed: at all; without a second hop, for which
all paws are off the ground again for more than 0.05 s; without a step, for which any paw that had come down is off it
again for 0.05 s. How far the base itself flew is told by its distance from the start at touchdown, the mean of a bin's
successes. In range are goals of 1.0 to 1.4 m, the upper part of what the paper reaches always.
Published distances, as the paper compares them, were jumped by real robots; ours is a simulation.
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

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.jumps import largest, mean, within
from jumper_warp.evaluation.landings import Landings, landing_figures, random_headings, trained_range
from jumper_warp.evaluation.trial import Trial, TrialArgs

matplotlib.use("Agg")
import matplotlib.pyplot as plt

BIN = 0.1
"""[m]"""
FIRST = 1.0
"""[m] Middle of the first bin."""
LAST = 2.5
"""[m] No bin beyond."""
IN_RANGE = (1.0, 1.4)
"""[m]"""
RELIABLE, GIVEN_UP = 0.95, 0.5
KINDS = {"": "success_rate", "_without_hop": "single_jump_success_rate", "_without_step": "step_free_success_rate"}
"""What a reliable distance is told of: the end of its name, and the rate that it takes."""
EACH = (
    *KINDS.values(),
    "mean_error_m",
    "mean_error_of_successes_m",
    "mean_error_at_touchdown_m",
    "mean_error_0_3_s_after_touchdown_m",
    "fall_rate",
)
"""Figures with an entry a bin."""
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
            raise ValueError(f"need at least one jump, and first in 0.1..{LAST:g} m, got {self.jumps}, {self.first}")


def figures(bins: dict[float, Landings]) -> dict[str, Any]:
    """Return the figures over all bins (middle [m] to jumps), and lists with an entry a bin."""
    each = [landing_figures(landings) for landings in bins.values()]
    lists = {name: [values[name] for values in each] for name in EACH}
    flown = [base_at_touchdown(landings) for landings in bins.values()]
    landed = [landings.landing[landings.success][:, 0] for landings in bins.values()]
    inside = [landings.success[within(landings.goals[..., 0], IN_RANGE)] for landings in bins.values()]
    values: dict[str, Any] = {
        "jumps": sum(values["jumps"] for values in each),
        "mean_error_m": mean(lists["mean_error_m"]),
        "success_rate_in_range": mean(np.concatenate(inside)),
        **{rate: mean(lists[rate]) for rate in KINDS.values()},
    }
    for kind, rate in KINDS.items():
        bad = next((i for i, share in enumerate(lists[rate]) if share < RELIABLE), len(bins))
        values[f"largest_reliable{kind}_m"] = list(bins)[bad - 1] if bad else None
        values[f"base_at_touchdown{kind}_m"] = flown[bad - 1] if bad else None
    values["farthest_success_m"] = largest(np.concatenate(landed))
    values |= {"bin_m": list(bins), "bin_base_at_touchdown_m": flown}
    return values | {f"bin_{name}": column for name, column in lists.items()}


def base_at_touchdown(landings: Landings) -> float | None:
    """Return the mean distance [m] of the base from its start when the first paw comes down, over the successes."""
    return mean(np.linalg.norm(landings.touchdown[landings.success], axis=-1))


def plot(values: dict[str, Any], path: Path, title: str) -> None:
    """Draw success and error over the distance."""
    fig, (top, bottom) = plt.subplots(2, 1, figsize=(7, 6), sharex=True, constrained_layout=True)
    for kind, rate in KINDS.items():
        label = f"success{kind.replace('_', ' ')}"
        top.plot(values["bin_m"], [100.0 * share for share in values[f"bin_{rate}"]], marker="o", label=label)
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


def row_of(values: dict[str, Any], i: int) -> list[str]:
    """Return a bin's distance, success, success without a hop and without a step, and base at touchdown, as text."""
    flown = values["bin_base_at_touchdown_m"][i]
    shares = [f"{100.0 * values[f'bin_{rate}'][i]:.1f}" for rate in KINDS.values()]
    return [f"{values['bin_m'][i]:.1f}", *shares, "" if flown is None else f"{flown:.2f}"]


def print_progress(values: dict[str, Any]) -> None:
    """Print a line on a single bin."""
    distance, success, single, free, flown = row_of(values, 0)
    hops = f"{single} % without a second hop, {free} % without a step"
    print(f"{distance} m: {success} % success, {hops}, base at touchdown {flown or '-'} m", flush=True)


def print_tables(values: dict[str, Any]) -> None:
    """Print each bin, published distances beside ours, and what ours are."""
    bins = Table("distance [m]", "success [%]", "without a second hop", "without a step", "base at touchdown [m]")
    for i in range(len(values["bin_m"])):
        bins.add_row(*row_of(values, i))
    works = Table("work", "jump [m]")
    for work, distance in PUBLISHED.items():
        works.add_row(work, f"{distance:g}")
    for kind in KINDS:
        distance = values[f"largest_reliable{kind}_m"]
        name = f"here, simulated, {100 * RELIABLE:g} % success{kind.replace('_', ' ')}"
        works.add_row(name, "none" if distance is None else f"{distance:.1f}")
    console = Console()
    console.print(bins)
    console.print(works)
    print(verdict(values))


def verdict(values: dict[str, Any]) -> str:
    """Return what the largest reliable distance is, in a line."""
    line = "Where the base is a second after touchdown counts: a landing may go on with steps or a second hop."
    distance, flown = values["largest_reliable_m"], values["base_at_touchdown_m"]
    if distance is None:
        return line
    return f"{line} Of {distance:.1f} m the base itself flew to {flown:.2f} m from its start, where the paws came down."


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
        print_progress(figures({middle: bins[middle]}))
        if bins[middle].success.mean() < GIVEN_UP:
            break
    values = figures(bins) | trained_range(env.task)
    plot(values, trial.folder / "max_jump.png", trial.title)
    print_tables(values)
    return trial.report(values, PAPER)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
