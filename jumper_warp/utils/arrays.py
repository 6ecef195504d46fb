"""Check of arrays of numbers, atomic writing of NumPy archives (.npz), and reading of those of limited size."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import MAX_BYTES, ErrorType, read_file, write_atomically


def real_array(values: Any, name: str, dtype: Any = np.float32) -> np.ndarray:
    """Return a number, list, array or torch tensor as an array of a floating-point `dtype`; name: for messages.

    Raises InputError: it is not rectangular, masked, or holds other than integers and floating-point numbers.
    """
    if hasattr(values, "detach"):
        values = values.detach().cpu()
    try:
        if np.ma.is_masked(values):
            raise TypeError("some values are masked")
        array = np.asarray(values)
        if array.dtype.kind not in "fiu":
            raise TypeError(f"values of type {array.dtype}")
        return array.astype(dtype, copy=False)
    except (ValueError, TypeError) as error:
        raise InputError(f"{name} must be an array of numbers, got {type(values).__name__}: {error}") from error


def read_npz(path: Path, purpose: str, error: ErrorType = InputError) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file by name; pickled objects are refused, since loading one runs its code.

    purpose: content of the file, for messages. error: class of the error. Raises `error`: it is no regular file, larger
    than MAX_BYTES, also unpacked, damaged, or holds something else; the message has the path.
    """
    data = read_file(path, purpose, error=error)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > MAX_BYTES:
                raise error(f"{path}: larger than {MAX_BYTES >> 20} MiB unpacked ({purpose})")
            if archive.testzip() is not None or len({entry.filename for entry in entries}) < len(entries):
                raise error(f"{path}: damaged ({purpose})")
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except InputError:
        raise
    except Exception as problem:  # zip and header errors are of many kinds
        raise error(f"{path}: not an npz file of plain arrays ({type(problem).__name__})") from None


def write_npz(path: Path, **arrays: Any) -> None:
    """Write arrays by name to a compressed npz file, atomically. Raises OSError as `write_atomically`."""
    data = io.BytesIO()
    np.savez_compressed(data, **arrays)
    write_atomically(path, data.getvalue())
