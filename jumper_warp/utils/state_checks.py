"""Refusals of a saved state, each in one line that names the part."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch

from jumper_warp.utils.errors import InputError


def check_parts(found: Any, names: Iterable[Any], where: str) -> None:
    """Raises ValueError: `found` is no dictionary with exactly these keys."""
    if not isinstance(found, dict):
        raise InputError(f"{where} must be a dictionary, got {type(found).__name__}")
    names = set(names)
    lacking, besides = sorted(map(str, names - found.keys())), sorted(map(str, found.keys() - names))
    if lacking or besides:
        raise InputError(f"{where} lacks {_named(lacking)}, has {_named(besides)} besides")


def _named(names: list[str]) -> str:
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return shown or "nothing"


def check_tensor(found: Any, like: torch.Tensor, where: str, dtypes: Iterable[torch.dtype] = ()) -> None:
    """Raises ValueError: `found` is no dense tensor of the shape and type of `like`, or of one of `dtypes` instead."""
    if not isinstance(found, torch.Tensor) or found.layout != torch.strided:
        raise InputError(f"{where} must be a tensor, got {type(found).__name__}")
    if found.shape != like.shape:
        raise InputError(f"{where} has shape {tuple(found.shape)}, expected {tuple(like.shape)}")
    if found.dtype not in (like.dtype, *dtypes):
        raise InputError(f"{where} has type {found.dtype}, expected {like.dtype}")


def check_values(found: torch.Tensor, where: str, least: float = -math.inf) -> None:
    """Raises ValueError: a number of a tensor is not finite or below `least`."""
    if not bool(found.isfinite().all()):
        raise InputError(f"{where} is not finite")
    if not bool((found >= least).all()):
        raise InputError(f"{where} must not be below {least:g}, got {found.min().item():g}")
