"""The side of an environment that training sees."""

from __future__ import annotations

from typing import Any, Protocol

import torch


class VecTask(Protocol):
    """What PPO asks of an environment of many worlds.

    All tensors keep their place; `reset` and `step` write them anew.
    """

    num_envs: int
    num_obs: int
    num_critic_obs: int
    num_actions: int
    device: torch.device
    obs: torch.Tensor
    """(num_envs, num_obs), what the actor sees, of the new episode where one has just begun."""
    critic_obs: torch.Tensor
    """(num_envs, num_critic_obs), what the critic sees, of the new episode where one has just begun."""
    reward: torch.Tensor
    """(num_envs,)"""
    done: torch.Tensor
    """(num_envs,), 1 where the step ended the episode."""
    timeout: torch.Tensor
    """(num_envs,), 1 where it did so for a reason that says nothing against the state, so that its value counts."""
    final_obs: torch.Tensor
    """(num_envs, num_obs), the last observation of the old episode, where one has ended."""
    final_critic_obs: torch.Tensor
    """(num_envs, num_critic_obs), likewise."""

    def reset(self) -> None:
        """Begin a new episode in all worlds."""

    def step(self, action: torch.Tensor) -> None:
        """Advance by a policy period; action (num_envs, num_actions) is read only, and no work waits for the host."""

    def metrics(self) -> dict[str, float]:
        """Return what to log of the episodes since the last call; waits for the device."""

    def config(self) -> dict[str, Any]:
        """Return all settings, ready for JSON."""

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next step depends on, tensors only."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave; `reset` does not follow."""
