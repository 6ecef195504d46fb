"""Checks of a saved state, such as a checkpoint; each raises InputError with a message that begins with `where`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch

from jumper_warp.utils.errors import InputError


def check_parts(value: Any, names: Iterable[Any], where: str) -> None:
    """Raise InputError unless `value` is a dictionary with exactly the keys `names`; where: its name in messages."""
    if not isinstance(value, dict):
        raise InputError(f"{where} must be a dictionary, got {type(value).__name__}")
    names = set(names)
    missing = sorted(map(str, names - value.keys()))
    unknown = sorted(map(str, value.keys() - names))
    if missing or unknown:
        raise InputError(f"{where}: missing entries: {_listed(missing)}; unexpected entries: {_listed(unknown)}")


def _listed(names: list[str]) -> str:
    """List names in an error message: the first three and the number of the others, or "none"."""
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return shown or "none"


def check_tensor(value: Any, like: torch.Tensor, where: str, dtypes: Iterable[torch.dtype] = ()) -> None:
    """Raise InputError unless `value` is a dense tensor with the shape of `like`, and its dtype or one of `dtypes`."""
    if not isinstance(value, torch.Tensor) or value.layout != torch.strided:
        raise InputError(f"{where} must be a tensor, got {type(value).__name__}")
    if value.shape != like.shape:
        raise InputError(f"{where} has shape {tuple(value.shape)}, expected {tuple(like.shape)}")
    if value.dtype not in (like.dtype, *dtypes):
        raise InputError(f"{where} has type {value.dtype}, expected {like.dtype}")


def check_values(value: torch.Tensor, where: str, minimum: float = -math.inf) -> None:
    """Raise InputError unless all entries of a tensor are finite and at least `minimum`."""
    if not bool(value.isfinite().all()):
        raise InputError(f"{where} is not finite")
    if not bool((value >= minimum).all()):
        raise InputError(f"{where} must not be below {minimum:g}, got {value.min().item():g}")
