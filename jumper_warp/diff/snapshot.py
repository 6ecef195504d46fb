"""Snapshot of an environment's robots: state and parameters from which gradients are computed."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch

from jumper_warp.utils.copying import Uncopied
from jumper_warp.utils.newton_types import Model


class Snapshot(NamedTuple):
    """State and parameters of an environment's robots, from which gradients are computed.

    Tensors are float32 on the environment's device and read-only; the next step may change them.
    """

    __reduce__ = Uncopied.__reduce__

    tasks: tuple[Any, ...]
    """`jumper_warp.tasks.cfg.TaskCfg` of each skill, without the randomisation that the environment does not apply."""
    solver: str  # name of the solver's class
    blocks: bool  # whether the worlds have moving blocks
    model: Model
    dt: float  # [s] Physics step
    substeps: int  # physics steps in a policy step
    default_angle: torch.Tensor  # (12,) [rad] Motor angles of a zero action
    com: torch.Tensor  # (num_worlds, 3) [m] Centre of mass of the base link, in its frame
    parameters: dict[str, torch.Tensor]
    """Motor constants, `table` and `latency` by the names, with the units and shapes of `Rollout.parameters`."""
    q: torch.Tensor
    """(19, num_worlds) Base origin [m], xyzw, motor angles [rad], as in `jumper_warp.diff.rollout.Trajectory`."""
    qd: torch.Tensor  # (18, num_worlds) Velocity of the base's COM [m/s], angular velocity and motor rates [rad/s]
    initial_target: torch.Tensor  # (steps, 12, num_worlds) [rad] Filtered targets of the last policy steps
    impulse: torch.Tensor  # (4, num_worlds, 3) [N s] Contact impulses in the last physics step, world axes
    action: torch.Tensor  # (12, num_worlds) Actions of the last policy step, within ±1
    torque: torch.Tensor  # (12, num_worlds) [N m] Motor torques in the last physics step
    wrench: torch.Tensor  # (6, num_worlds) Force [N] and moment [N m] on the base at its com, world axes


def compact_columns(joint_values: torch.Tensor, base: int) -> torch.Tensor:
    """Return the values of the base and the 12 motors from Newton's joint coordinates or rates.

    joint_values: (num_worlds, columns). Returned: (base + 12, num_worlds). base: number of base columns, 7 coordinates
    or 6 rates; five joints of each leg follow: lateral, outer, outer knee, inner, inner knee. Knees have no motors.
    """
    legs = joint_values[:, base : base + 20].unflatten(1, (4, 5))
    motors = torch.cat([legs[..., :2], legs[..., 3:4]], -1).flatten(1)
    return torch.cat([joint_values[:, :base], motors], 1).T
