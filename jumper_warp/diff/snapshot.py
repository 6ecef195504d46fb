"""The view of an environment that gradients need: its robots, their parameters and their state."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch

from jumper_warp.utils.newton_types import Model


class Snapshot(NamedTuple):
    """Robots of an environment; tensors, float32 on its device, are read only and may change with its next step."""

    tasks: tuple[Any, ...]
    """`jumper_warp.tasks.cfg.TaskCfg` of each skill, draws that the environment leaves out removed."""
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
    before: torch.Tensor
    """(12, num_worlds) [rad] Filtered targets of the step before."""
    impulse: torch.Tensor
    """(4, num_worlds, 3) [N s] On the paws in the last physics step, world axes."""
    action: torch.Tensor
    """(12, num_worlds) Of the step before, within ±1."""
    torque: torch.Tensor
    """(12, num_worlds) [N m] Of the last physics step."""
    wrench: torch.Tensor
    """(6, num_worlds) [N], [N m] On the base at its com, world axes."""


def compact_columns(joint_values: torch.Tensor, base: int) -> torch.Tensor:
    """Return (base + 12, num_worlds): `base` values and the motors' of Newton's coordinates or rates of each world."""
    legs = joint_values[:, base : base + 20].unflatten(1, (4, 5))
    motors = torch.cat([legs[..., :2], legs[..., 3:4]], -1).flatten(1)
    return torch.cat([joint_values[:, :base], motors], 1).T
