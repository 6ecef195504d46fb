"""Several recorded motions side by side, with the rewards that one task pays for each of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from jumper_warp.compare.rescore import TOTAL, reward_terms
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.viz.pairs import side_by_side
from jumper_warp.viz.recording import Recording


def compare_motions(recordings: Mapping[str, Recording], task: TaskCfg) -> Recording:
    """Return the first robot of each recording by label, side by side, with a task's reward terms as series.

    A plot has one term of all motions: first the total, as its sum so far, then the terms whose sums differ most.
    Raises InputError: a recording has no complete states.
    """
    together = side_by_side(recordings)
    frames = len(together.times)
    rewards = {}
    for label, recording in recordings.items():
        terms = {name: values[:, 0].astype(float) for name, values in reward_terms(recording, task).items()}
        rewards[label] = {name: np.pad(values, (0, frames - len(values))) for name, values in terms.items()}
    sums = {name: [terms[name].sum() for terms in rewards.values()] for name in next(iter(rewards.values()))}
    series = {}
    for name in sorted(sums, key=lambda name: (name != TOTAL, -np.ptp(sums[name]))):
        words = "sum of all rewards so far" if name == TOTAL else name.replace("_", " ")
        for label, terms in rewards.items():
            values = np.cumsum(terms[name]) if name == TOTAL else terms[name]
            series[f"reward, {words}/{name}, {label} [1]"] = values
    height = {name: values for name, values in together.series.items() if name.startswith("height/")}
    return replace(together, series=height | series | together.series)
