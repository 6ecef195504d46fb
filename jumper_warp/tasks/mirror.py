"""Mirror maps of a task's observations and actions, as permutations and signs.

A symmetric policy needs them: the robot is symmetric about its x-z plane and, except for the width of its stance, about
its y-z plane. A term's mirror image is given by columns counted from 1, negative where the sign changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jumper_warp.kernels.mdp.mirror import FRONT_BACK_MOTORS, MOTORS
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError


class Mirror(NamedTuple):
    """Mirror map: a permutation and signs; the mirror image of a vector x is `signs * x[order]`."""

    order: np.ndarray  # (columns,) int, source column of each column
    signs: np.ndarray  # (columns,) float32, 1 or -1


def mirror_image(task: TaskCfg, what: str, plane: str = "left-right") -> Mirror:
    """Return the mirror map of a task's "observation" or of an "action"; plane: "left-right" or "front-back".

    Raises InputError: another text, or the mirror image of a term is not known.
    """
    motors = {"left-right": MOTORS, "front-back": FRONT_BACK_MOTORS}
    if what not in ("observation", "action") or plane not in motors:
        raise InputError(f"expected observation or action, left-right or front-back; got {what!r:.40}, {plane!r:.40}")
    return mirror_of(task, "actor", plane) if what == "observation" else _mirror(motors[plane])


def mirror_of(task: TaskCfg, group: str, plane: str = "left-right") -> Mirror:
    """Return the mirror map of a task's observation; group: "actor" or "critic"; plane: as in `mirror_image`.

    Each frame of a term's history is mirrored on its own: columns of the term become columns of the observation.
    Raises InputError: the mirror image of a term is not known.
    """
    columns: list[int] = []
    for term in getattr(task.observations, group):
        image = term.mirror if plane == "left-right" else getattr(term.func, "front_back", None)
        if image is None:
            hint = "mirror=" if plane == "left-right" else "front_back= of mdp.mirror.set_mirror"
            raise InputError(f"{task.name} {group}: the {plane} image of {term.name} is not known; pass it as {hint}")
        for _ in range(term.options["history"]):
            first = len(columns)
            columns += [column + (first if column > 0 else -first) for column in image]
    return _mirror(columns)


def _mirror(columns: Sequence[int]) -> Mirror:
    """Return the mirror map of a signed permutation, as in `jumper_warp.kernels.mdp.mirror`."""
    signed = np.array(columns, dtype=int)
    return Mirror(np.abs(signed) - 1, np.sign(signed).astype(np.float32))
