"""Refusals of a saved state, each in one line that names the part."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import torch


def check_parts(found: Any, names: Iterable[Any], where: str) -> None:
    """Raises ValueError: `found` is no dictionary with exactly these keys."""
    if not isinstance(found, dict):
        raise ValueError(f"{where} must be a dictionary, got {type(found).__name__}")
    names = set(names)
    lacking, besides = sorted(map(str, names - found.keys())), sorted(map(str, found.keys() - names))
    if lacking or besides:
        raise ValueError(f"{where} lacks {_named(lacking)}, has {_named(besides)} besides")


def _named(names: list[str]) -> str:
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return shown or "nothing"


def check_tensor(found: Any, like: torch.Tensor, where: str, dtypes: Iterable[torch.dtype] = ()) -> None:
    """Raises ValueError: `found` is no dense tensor of the shape and type of `like`, or of one of `dtypes` instead."""
    if not isinstance(found, torch.Tensor) or found.layout != torch.strided:
        raise ValueError(f"{where} must be a tensor, got {type(found).__name__}")
    if found.shape != like.shape:
        raise ValueError(f"{where} has shape {tuple(found.shape)}, expected {tuple(like.shape)}")
    if found.dtype not in (like.dtype, *dtypes):
        raise ValueError(f"{where} has type {found.dtype}, expected {like.dtype}")


def check_values(found: torch.Tensor, where: str, least: float = -math.inf) -> None:
    """Raises ValueError: a number of a tensor is not finite or below `least`."""
    if not bool(found.isfinite().all()):
        raise ValueError(f"{where} is not finite")
    if not bool((found >= least).all()):
        raise ValueError(f"{where} must not be below {least:g}, got {found.min().item():g}")


def check_ppo(
    state: Any,
    model: dict[str, torch.Tensor],
    params: Sequence[torch.Tensor],
    lr: torch.Tensor,
    episode: torch.Tensor,
) -> None:
    """Check what `Ppo.state_dict` gave against the present one's weights, parameters of Adam, step size and episodes.

    Raises ValueError: a part is missing, unknown, of another shape or type, not finite, or a variance is negative.
    """
    check_parts(state, ("model", "optimiser", "lr", "episode"), "ppo")
    check_parts(state["model"], model, "ppo.model")
    for name, like in model.items():
        found, where = state["model"][name], f"ppo.model.{name}"
        check_tensor(found, like, where)
        check_values(found, where, 0.0 if name.endswith((".var", ".count")) else -math.inf)
    check_parts(state["optimiser"], range(len(params)), "ppo.optimiser")
    for index, param in enumerate(params):
        found, where = state["optimiser"][index], f"ppo.optimiser.{index}"
        check_parts(found, ("step", "exp_avg", "exp_avg_sq"), where)
        for name, like, least in (("step", lr, 0.0), ("exp_avg", param, -math.inf), ("exp_avg_sq", param, 0.0)):
            check_tensor(found[name], like, f"{where}.{name}")
            check_values(found[name], f"{where}.{name}", least)
    check_tensor(state["lr"], lr, "ppo.lr")
    check_values(state["lr"], "ppo.lr", 0.0)
    check_tensor(state["episode"], episode, "ppo.episode", (torch.float32,))  # of earlier versions
    check_values(state["episode"], "ppo.episode")
