"""How far a policy jumps: metrics over bins of growing distance, and how they are told."""

from __future__ import annotations

from typing import Any

import numpy as np

from jumper_warp.evaluation.landings import Landings
from jumper_warp.evaluation.log import largest, mean, within
from jumper_warp.evaluation.places import landing_metrics

RELIABLE = 0.95
"""[1] Success of a distance that counts."""
KINDS = {"": "success_rate", "_without_hop": "single_jump_success_rate", "_without_step": "step_free_success_rate"}
"""What a reliable distance is told of: the end of its name, and the rate that it takes."""
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


def distance_metrics(bins: dict[float, Landings], in_range: tuple[float, float]) -> dict[str, Any]:
    """Return the metrics over all bins (middle [m] to jumps), and lists with an entry a bin; in_range [m]."""
    each = [landing_metrics(landings) for landings in bins.values()]
    lists = {name: [values[name] for values in each] for name in EACH}
    flown = [base_at_touchdown(landings) for landings in bins.values()]
    landed = [landings.landing[landings.success][:, 0] for landings in bins.values()]
    inside = [landings.success[within(landings.goals[..., 0], in_range)] for landings in bins.values()]
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


def base_at_touchdown(landings: Landings) -> float | None:
    """Return the mean distance [m] of the base from its start when the first paw comes down, over the successes."""
    return mean(np.linalg.norm(landings.touchdown[landings.success], axis=-1))


def row_of(values: dict[str, Any], i: int) -> list[str]:
    """Return a bin's distance, success, success without a hop and a step, falls, misses, base at touchdown, as text."""
    flown = values["bin_base_at_touchdown_m"][i]
    shares = [f"{100.0 * values[f'bin_{rate}'][i]:.1f}" for rate in (*KINDS.values(), "fall_rate", "miss_rate")]
    return [f"{values['bin_m'][i]:.1f}", *shares, "" if flown is None else f"{flown:.2f}"]


def progress(values: dict[str, Any]) -> str:
    """Return a line on a single bin."""
    distance, success, single, free, falls, misses, flown = row_of(values, 0)
    hops = f"{single} % without a second hop, {free} % without a step"
    lost = f"{falls} % falls, {misses} % misses"
    return f"{distance} m: {success} % success, {hops}, {lost}, base at touchdown {flown or '-'} m"


def verdict(values: dict[str, Any]) -> str:
    """Return what the largest reliable distance is, in a line."""
    line = "Where the base is a second after touchdown counts: a landing may go on with steps or a second hop."
    distance, flown = values["largest_reliable_m"], values["base_at_touchdown_m"]
    if distance is None:
        return line
    return f"{line} Of {distance:.1f} m the base itself flew to {flown:.2f} m from its start, where the paws came down."
