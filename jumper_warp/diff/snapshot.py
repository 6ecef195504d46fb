"""Snapshot of an environment for gradients: its robots, their parameters and their state."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch

from jumper_warp.utils.newton_types import Model


class Snapshot(NamedTuple):
    """State and parameters of an environment's robots.

    Tensors are float32 on its device and read-only; its next step may change them.
    """

    tasks: tuple[Any, ...]
    """`jumper_warp.tasks.cfg.TaskCfg` of each skill, without randomisation that the environment leaves out."""
    solver: str
    """Name of the solver's class."""
    blocks: bool
    """Whether the worlds have moving blocks."""
    model: Model
    dt: float
    """[s] Physics step."""
    substeps: int
    """Physics steps in a policy step."""
    default_angle: torch.Tensor
    """(12,) [rad] Motor angles of a zero action."""
    com: torch.Tensor
    """(num_worlds, 3) [m] Centre of mass of the base link, in its frame."""
    parameters: dict[str, torch.Tensor]
    """Motor constants, `table` and `latency` by the names, with the units and shapes of `Rollout.parameters`."""
    q: torch.Tensor
    """(19, num_worlds) [m], xyzw, [rad], as in `jumper_warp.diff.rollout.Trajectory`."""
    qd: torch.Tensor
    """(18, num_worlds) [m/s], [rad/s]"""
    initial_target: torch.Tensor
    """(12, num_worlds) [rad] Filtered targets of the last policy step."""
    impulse: torch.Tensor
    """(4, num_worlds, 3) [N s] Contact impulses in the last physics step, world axes."""
    action: torch.Tensor
    """(12, num_worlds) Of the last policy step, within ±1."""
    torque: torch.Tensor
    """(12, num_worlds) [N m] Of the last physics step."""
    wrench: torch.Tensor
    """(6, num_worlds) [N], [N m] On the base at its com, world axes."""


def compact_columns(joint_values: torch.Tensor, base: int) -> torch.Tensor:
    """Return base and motor values, (base + 12, num_worlds), of Newton's coordinates or rates (num_worlds, ...)."""
    legs = joint_values[:, base : base + 20].unflatten(1, (4, 5))
    motors = torch.cat([legs[..., :2], legs[..., 3:4]], -1).flatten(1)
    return torch.cat([joint_values[:, :base], motors], 1).T
