"""Protocols of the environments that PPO trains on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch

RAW_LIMIT = 100.0
"""Largest absolute value of an observation: `Env` clamps to it, so that no world can spoil the statistics."""


@runtime_checkable
class VecEnv(Protocol):
    """Environment for PPO: many worlds whose ended episodes are reset in `step`.

    The tensors are on `device`; `reset`, `step` and `load_state_dict` overwrite them in place. Observations are finite
    and within ±RAW_LIMIT.
    """

    num_envs: int
    """Number of worlds."""
    num_obs: int
    num_critic_obs: int
    num_actions: int
    device: torch.device
    """Device of all tensors, the action included."""
    obs: torch.Tensor
    """Observation of the actor, (num_envs, num_obs) float32; of the new episode where one has ended."""
    critic_obs: torch.Tensor
    """Observation of the critic, (num_envs, num_critic_obs) float32; of the new episode where one has ended."""
    reward: torch.Tensor
    """Reward of the last step, (num_envs,) float32."""
    done: torch.Tensor
    """Whether the last step ended the episode, (num_envs,) float32, 1 or 0."""
    timeout: torch.Tensor
    """Whether an episode ended without failure and its last value is bootstrapped, (num_envs,) float32, 1 or 0."""
    final_obs: torch.Tensor
    """Observation of the actor before resets, (num_envs, num_obs) float32."""
    final_critic_obs: torch.Tensor
    """Observation of the critic before resets, (num_envs, num_critic_obs) float32."""

    def reset(self) -> Any:
        """Begin a new episode in all worlds, and write its first `obs` and `critic_obs`; the return value is unused."""

    def step(self, action: torch.Tensor) -> Any:
        """Advance one policy step, and reset ended episodes; the return value is unused.

        action: (num_envs, num_actions), not modified. Must not wait for the host, so that a graph can hold many steps.
        """

    def metrics(self) -> dict[str, float]:
        """Return the training metrics since the last call, by name (waits for the device)."""
        ...

    def config(self) -> dict[str, Any]:
        """Return all settings that define the environment as JSON data."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state that the next step depends on, as tensors that later steps do not change."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned; later steps without a `reset` repeat those after the saving.

        Raises ValueError: the state does not fit this environment.
        """


@runtime_checkable
class MirroredVecEnv(Protocol):
    """Environment with mirror images, which PPO needs to train a symmetric policy."""

    def mirror(self, what: str, plane: str, /) -> tuple[Sequence[int], Sequence[float]]:
        """Return (order, signs) of the mirror image `signs * x[order]` of an "observation" or an "action" x.

        plane: "left-right" or "front-back".

        Raises ValueError: no mirror image is defined.
        """
        ...
