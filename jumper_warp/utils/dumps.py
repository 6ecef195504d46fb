"""Dump files: the first non-finite value of a task's term, such as a reward, and the state of its world."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_atomically

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
    data = io.BytesIO()
    arrays: dict[str, Any] = {"header": np.array(json.dumps(header, allow_nan=False)), **found.arrays}
    np.savez_compressed(data, **arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, data.getvalue())


def load_dump(path: Path) -> tuple[NonFiniteValue, dict[str, Any]]:
    """Read a non-finite value and the header from a file that `write_dump` has written.

    Raises InputError: the file is missing, damaged, of another kind or of another version.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files if name != "header"}
            header = json.loads(str(archive["header"]))
        if header["format"] != FORMAT or header["version"] != VERSION:
            raise InputError(f"{path}: expected a {FORMAT} of version {VERSION}")
        fits = arrays["joint_q"].shape == (43,) and arrays["joint_qd"].shape == (38,)
        fits &= all(arrays[name].shape == (len(header["names"][name]),) for name in ("rewards", "observations"))
        if not fits or arrays["action"].shape != (12,):
            raise InputError(f"{path}: arrays of another shape than those of a {FORMAT}")
        place = (float(header["value"]), int(header["world"]), int(header["step"]))
        return NonFiniteValue(str(header["term"]), *place, arrays, header["names"]), header
    except InputError:
        raise
    except (OSError, EOFError, LookupError, TypeError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: cannot be read as a dump ({type(error).__name__}: {error})") from error
