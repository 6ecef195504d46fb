"""Left-right mirror maps of a task's observations and actions, as permutations and signs.

A mirror-symmetric policy needs them: the robot is symmetric about its x-z plane. A term's mirror image is given by
columns counted from 1, negative where the sign changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jumper_warp.kernels.mdp.mirror import MOTORS
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError


class Mirror(NamedTuple):
    """Left-right mirror map: a permutation and signs; the mirror image of a vector x is `signs * x[order]`."""

    order: np.ndarray  # (columns,) int, source column of each column
    signs: np.ndarray  # (columns,) float32, 1 or -1


def mirror_of(task: TaskCfg, group: str) -> Mirror:
    """Return the left-right mirror map of a task's observation; group: "actor" or "critic".

    Each frame of a term's history is mirrored on its own: columns of the term become columns of the observation.
    Raises InputError: the mirror image of a term is not known.
    """
    columns: list[int] = []
    for term in getattr(task.observations, group):
        if term.mirror is None:
            raise InputError(f"{task.name} {group}: the mirror image of {term.name} is not known; pass it as mirror=")
        for _ in range(term.options["history"]):
            first = len(columns)
            columns += [column + (first if column > 0 else -first) for column in term.mirror]
    return _mirror(columns)


def mirror_of_action() -> Mirror:
    """Return the left-right mirror map of an action (12,), in motor order."""
    return _mirror(MOTORS)


def _mirror(columns: Sequence[int]) -> Mirror:
    """Return the mirror map of a signed permutation, as in `jumper_warp.kernels.mdp.mirror`."""
    signed = np.array(columns, dtype=int)
    return Mirror(np.abs(signed) - 1, np.sign(signed).astype(np.float32))
