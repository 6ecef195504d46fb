"""The suite that finds the farthest jump: bins of growing distance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from jumper_warp.evaluation.log import largest, mean, within
from jumper_warp.evaluation.places import PlaceLog, landing_metrics, trained_range
from jumper_warp.evaluation.plots import drawn
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.evaluation.sweeps import Suite, check

BIN, IN_RANGE = 0.1, (1.0, 1.4)
"""[m] Width of a bin; the upper part of what the paper reaches always."""
GIVEN_UP = 0.5
"""[1] Success below which no farther bin is tried."""
LIMIT = 9.0
"""[m] Of all bins."""

RELIABLE = 0.95
"""[1] Success of a distance that counts."""
KINDS = {"": "success_rate", "_without_hop": "single_jump_success_rate", "_without_step": "step_free_success_rate"}
"""Ends of the names of reliable distances, and the rate that each takes."""
EACH = (
    *KINDS.values(),
    "mean_error_m",
    "mean_error_of_successes_m",
    "mean_error_at_touchdown_m",
    "mean_error_0_3_s_after_touchdown_m",
    "fall_rate",
    "miss_rate",
    "still_landing_rate",
    "max_landing_tilt_deg",
)
"""Metrics with an entry a bin."""
PUBLISHED = {
    "Barkour (Caluwaerts et al. 2023)": 0.5,
    "Margolis et al. 2021": 0.66,
    "Liu et al. 2023": 0.8,
    "Cheng et al. 2024": 0.8,
    "Atanassov et al. 2024": 0.9,
    "Jumper, the paper's robot": 1.25,
}
"""[m] The paper's table of jump distances."""


@dataclass(frozen=True)
class Farthest(Suite):
    """Jumps whose distance grows from 1 m by bins of 0.1 m, until fewer than half of a bin succeed.

    Goals of a bin lie in one direction, within 0.05 m of its middle. A far goal may be reached by steps or a second hop
    after the landing, so three distances are reported, each the largest middle of a bin up to which at least 95 % of
    the jumps succeed: at all; without a second hop, in which all paws are off the ground again for more than 0.05 s;
    without a step, in which any paw that had come down is off it again for 0.05 s. `base_at_touchdown` is the distance
    of the base from its start at touchdown, the mean of a bin's successes. Published distances were jumped by robots;
    the paper's 1.25 m compares with `hop_free_distance_m`.
    """

    jumps: int = 100
    first: float = 1.0
    """[m] Middle of the first bin."""
    last: float = 2.5
    """[m] No bin beyond."""
    direction: float = 0.0
    """[deg] Of the goals from the robot: 0 ahead, 90 to the left, 180 back."""

    name: ClassVar = "max"
    paper: ClassVar = {"hop_free_distance_m": 1.25}

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        good, limits = 0.1 <= self.first <= self.last <= LIMIT, f"0.1 <= first <= last <= {LIMIT:g} m"
        check(good, f"need {limits}, got {self.first} and {self.last}")
        check(-180.0 <= self.direction <= 180.0, f"direction must be in -180..180 deg, got {self.direction}")

    def places(self, middle: float) -> np.ndarray:
        """Return the goals of the bin around a distance [m], (jumps, 1, 2) [m]."""
        distance = middle + BIN * (np.linspace(0.0, 1.0, self.jumps) - 0.5 if self.jumps > 1 else np.zeros(1))
        angle = math.radians(self.direction)
        return distance[:, None, None] * np.array([math.cos(angle), math.sin(angle)])

    def measure(self, run: EvaluationRun) -> dict[str, Any]:
        """Follow jumps of growing distance, draw their success, and return the metrics."""
        env, bins = run.env(self.jumps), {}
        for number in range(round((self.last - self.first) / BIN) + 1):
            middle = round(self.first + number * BIN, 6)
            bins[middle] = self.jump(run, self.places(middle), env, film=f"jump_{middle:.1f}_m")
            success = bins[middle].success.mean()
            print(f"{middle:.1f} m: {success:.1%} success", flush=True)
            if success < GIVEN_UP:
                break
        values = distance_metrics(bins) | trained_range(env.task) | {"direction_deg": self.direction}
        draw_distances(run, values)
        return values


def draw_distances(run: EvaluationRun, values: dict[str, Any]) -> None:
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


def distance_metrics(bins: dict[float, PlaceLog]) -> dict[str, Any]:
    """Return the metrics over all bins (middle [m] to jumps), and lists with an entry a bin."""
    each = [landing_metrics(landings) for landings in bins.values()]
    lists = {name: [values[name] for values in each] for name in EACH}
    flown = [base_at_touchdown(landings) for landings in bins.values()]
    landed = [landings.landing[landings.success][:, 0] for landings in bins.values()]
    inside = [landings.success[within(landings.places[..., 0], IN_RANGE)] for landings in bins.values()]
    values: dict[str, Any] = {
        "jumps": sum(values["jumps"] for values in each),
        "mean_error_m": mean(lists["mean_error_m"]),
        "success_rate_in_range": mean(np.concatenate(inside)),
        **{rate: mean(lists[rate]) for rate in (*KINDS.values(), "fall_rate", "miss_rate", "still_landing_rate")},
        "max_landing_tilt_deg": max((tilt for tilt in lists["max_landing_tilt_deg"] if tilt is not None), default=None),
    }
    for kind, rate in KINDS.items():
        bad = next((i for i, share in enumerate(lists[rate]) if share < RELIABLE), len(bins))
        values[f"largest_reliable{kind}_m"] = list(bins)[bad - 1] if bad else None
        values[f"base_at_touchdown{kind}_m"] = flown[bad - 1] if bad else None
    values["hop_free_distance_m"] = values["largest_reliable_without_hop_m"]
    values["farthest_success_m"] = largest(np.concatenate(landed))
    values |= {"bin_m": list(bins), "bin_base_at_touchdown_m": flown}
    return values | {f"bin_{name}": column for name, column in lists.items()}


def base_at_touchdown(landings: PlaceLog) -> float | None:
    """Return the mean distance [m] of the base from its start when the first paw comes down, over the successes."""
    return mean(np.linalg.norm(landings.touchdown[landings.success], axis=-1))
