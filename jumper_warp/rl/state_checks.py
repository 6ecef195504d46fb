"""Refusals of a saved state of PPO, each in one line that names the part."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.state_checks import check_parts, check_tensor, check_values


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
        if name.startswith("mirror_") and not torch.equal(found, like.to(found.device)):
            raise InputError(f"{where} is of another observation or action")
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
