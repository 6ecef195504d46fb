"""Dump files: the first non-finite value of a task's term, such as a reward, and the state of its world."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jumper_warp.utils.arrays import read_npz, write_npz
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, parse_json

FORMAT, VERSION = "jumper-warp dump", 1
DUMPS = "non_finite"  # Folder in a run's folder that holds its dumps


class NonFiniteValue(NamedTuple):
    """First non-finite value of a term, such as a reward, and its world's state after that step, before a reset."""

    term: str  # such as `rewards.jump_height`; `terminations.diverged` for the state and the action
    value: float  # NaN or infinite
    world: int
    step: int  # policy steps of the world since the start of the run
    arrays: dict[str, np.ndarray]
    """joint_q (43,) [m], [1], [rad] and joint_qd (38,) [m/s], [rad/s] as in Newton; action (12,) [1]; rewards (n,) and
    observations (n,), values of all terms; state.<field> of the task's state."""
    names: dict[str, list[str]]  # names of the entries of rewards and observations

    def __str__(self) -> str:
        """Return the term, value, world and step as text."""
        return f"{self.term} is not finite ({self.value:g}) in world {self.world} at step {self.step}"


def write_dump(path: Path, found: NonFiniteValue, **header: Any) -> None:
    """Write a non-finite value and the state of its world to a NumPy archive; header: further JSON data.

    Raises OSError: the file cannot be written.
    """
    header |= {"format": FORMAT, "version": VERSION, "term": found.term, "value": str(found.value)}
    header |= {"world": found.world, "step": found.step, "names": found.names}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_npz(path, header=np.array(json.dumps(header, allow_nan=False)), **found.arrays)


def load_dump(path: Path) -> tuple[NonFiniteValue, Json]:
    """Read a non-finite value and the header from a file that `write_dump` has written in a training.

    Raises InputError: the file is missing, damaged, larger than 256 MiB unpacked, of another kind or version, or an
    array has another type or shape, or a name or count is malformed.
    """
    arrays = read_npz(path, "dump of a training")
    try:
        header = parse_json(str(arrays.pop("header")), "header")
        if (header["format"], header["version"]) != (FORMAT, VERSION):
            raise InputError(f"expected a {FORMAT} of version {VERSION}")
        numbers = float(header["value"]), header["world"], header["step"]
        found = NonFiniteValue(header["term"], *numbers, arrays, header["names"])
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a dump ({type(error).__name__}: {error!s:.200})") from error
    return found, header
