"""How far does a policy jump? Distances grow from 1 m by bins of 0.1 m until fewer than half of them succeed.

    python experiments/max_jump.py --policy horizontal_jump --out outputs/max
    python experiments/max_jump.py --policy omnidirectional_jump --first 0.4 --direction 90       # to the left

Each bin holds evenly spaced goals in one direction, straight ahead unless told otherwise, within 0.05 m of its middle,
and headings from the full circle. Errors and success are those of `horizontal_jump_sweep.py`: where the base is a
second after touchdown counts. Until then a landing may go on with steps or a second hop, and far goals are reached that
way. So three distances are told, each the largest middle of a bin up to which at least 95 % of the jumps succeed: at
all; without a second hop, for which all paws are off the ground again for more than 0.05 s; without a step, for which
any paw that had come down is off it again for 0.05 s. How far the base itself flew is told by its distance from the
start at touchdown, the mean of a bin's successes. In range are goals of 1.0 to 1.4 m, the upper part of what the paper
reaches always.
Published distances, as the paper compares them, were jumped by real robots; ours is a simulation. The one that stands
beside the paper's 1.25 m is that without a second hop (`hop_free_distance_m`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.cli.main import run_command
from jumper_warp.evaluation.landings import Landings
from jumper_warp.evaluation.log import termination_names
from jumper_warp.evaluation.places import random_headings, trained_range
from jumper_warp.evaluation.plots import drawn
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.utils.errors import InputError
from support.distances import KINDS, PUBLISHED, RELIABLE, distance_metrics, progress, row_of, verdict

BIN = 0.1
"""[m]"""
FIRST = 1.0
"""[m] Middle of the first bin."""
LAST = 2.5
"""[m] No bin beyond, unless asked for."""
LIMIT = 9.0
"""[m] Of both."""
IN_RANGE = (1.0, 1.4)
"""[m]"""
GIVEN_UP = 0.5
"""[1] Success below which no farther bin is tried."""
PAPER = {"hop_free_distance_m": 1.25}
WORDS = {"_without_hop": "without a second hop", "_without_step": "without a step", "": "hops and steps counted in"}
"""How each kind of distance is told, the one that stands beside the paper's first."""


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags."""

    jumps: int = 100
    """Number of jumps in each bin."""
    first: float = FIRST
    """[m] Middle of the first bin."""
    last: float = LAST
    """[m] No bin beyond."""
    direction: float = 0.0
    """[deg] Of the goals from the robot: 0 ahead, 90 to the left, 180 back."""

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        if self.jumps < 1 or not 0.1 <= self.first <= self.last <= LIMIT:
            raise InputError(
                f"need at least one jump, and 0.1 <= first <= last <= {LIMIT:g} m, "
                f"got {self.jumps}, {self.first} and {self.last}"
            )
        if not -180.0 <= self.direction <= 180.0:
            raise InputError(f"direction must be in -180..180 deg, got {self.direction}")


def goals(args: Args, middle: float) -> np.ndarray:
    """Return the goals of the bin around a distance [m], (jumps, 1, 2) [m] in the robot's frame."""
    distance = middle + BIN * (np.linspace(0.0, 1.0, args.jumps) - 0.5 if args.jumps > 1 else np.zeros(1))
    angle = math.radians(args.direction)
    return distance[:, None, None] * np.array([math.cos(angle), math.sin(angle)])


def plot(values: dict[str, Any], run: EvaluationRun) -> None:
    """Draw success and error over the distance."""
    with drawn(run.folder / "max_jump.png", 2, 1, figsize=(7, 6), sharex=True) as (top, bottom):
        for kind, rate in KINDS.items():
            label = f"success{kind.replace('_', ' ')}"
            top.plot(values["bin_m"], [100.0 * share for share in values[f"bin_{rate}"]], marker="o", label=label)
        top.axhline(100.0 * RELIABLE, color="0.5", linestyle="--", linewidth=1.0)
        for work, distance in PUBLISHED.items():
            if distance >= values["bin_m"][0]:
                top.axvline(distance, color="tab:green", linewidth=1.0, label=f"{work}, {distance:g} m")
        top.set(ylabel="success [%]", ylim=(0.0, 103.0), title=run.title)
        top.legend(loc="lower left")
        error = [np.nan if value is None else value for value in values["bin_mean_error_of_successes_m"]]
        bottom.plot(values["bin_m"], error, marker="o")
        bottom.set(xlabel="commanded distance [m]", ylabel="mean error of successes [m]", ylim=(0.0, None))


def show(values: dict[str, Any]) -> None:
    """Print each bin, published distances beside ours, and what ours are."""
    bins = Table("distance [m]", "success [%]", "without a second hop", "without a step", "falls [%]", "misses [%]",
                 "base at touchdown [m]")  # fmt: skip
    for i in range(len(values["bin_m"])):
        bins.add_row(*row_of(values, i))
    works = Table("work", "jump [m]")
    for work, distance in PUBLISHED.items():
        works.add_row(work, f"{distance:g}")
    for kind, words in WORDS.items():
        distance = values[f"largest_reliable{kind}_m"]
        name = f"here, simulated, {100 * RELIABLE:g} % success, {words}"
        works.add_row(name, "none" if distance is None else f"{distance:.1f}")
    Console().print(bins, works)
    print(verdict(values))


def main(args: Args) -> dict:
    """Let the distance grow and return the figures."""
    run = EvaluationRun.of("max_jump", args)
    env, headings = run.env(args.jumps), random_headings(args.jumps, args.seed)
    bins: dict[float, Landings] = {}
    for number in range(round((args.last - args.first) / BIN) + 1):
        middle = round(args.first + number * BIN, 6)
        asked = Landings(goals(args, middle), termination_names(env.task), headings)
        bins[middle] = run.follow(env, asked, film=f"jump_{middle:.1f}_m")
        print(progress(distance_metrics({middle: bins[middle]}, IN_RANGE)), flush=True)
        if bins[middle].success.mean() < GIVEN_UP:
            break
    values = distance_metrics(bins, IN_RANGE) | trained_range(env.task) | {"direction_deg": args.direction}
    plot(values, run)
    show(values)
    return run.report(values, PAPER)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
