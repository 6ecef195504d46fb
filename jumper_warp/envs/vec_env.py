"""The side of an environment that training sees, and how observations are kept within bounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import torch

RAW_LIMIT = 100.0
"""Raw observations are clamped to plus and minus this, so that one absurd world cannot spoil the statistics."""


class VecEnv(Protocol):
    """What PPO asks of an environment of many worlds that begin new episodes by themselves.

    The tensors are on `device` and keep their place: `reset`, `step` and `load_state_dict` write them anew.
    """

    num_envs: int
    """Worlds, each with an episode of its own."""
    num_obs: int
    num_critic_obs: int
    num_actions: int
    device: torch.device
    """Where all tensors are, the action too."""
    obs: torch.Tensor
    """(num_envs, num_obs) float32, what the actor sees, of the new episode where one has just begun."""
    critic_obs: torch.Tensor
    """(num_envs, num_critic_obs) float32, what the critic sees, of the new episode where one has just begun."""
    reward: torch.Tensor
    """(num_envs,) float32, of the last step."""
    done: torch.Tensor
    """(num_envs,) float32, 1 where the last step ended the episode, else 0."""
    timeout: torch.Tensor
    """(num_envs,) float32, 1 where it did so without failure, so that the value of the final state counts."""
    final_obs: torch.Tensor
    """(num_envs, num_obs) float32, the last observation of the old episode, where one has ended."""
    final_critic_obs: torch.Tensor
    """(num_envs, num_critic_obs) float32, likewise."""

    def reset(self) -> Any:
        """Begin a new episode in all worlds; `obs` and `critic_obs` are those of its beginning.

        What it returns is not read.
        """

    def step(self, action: torch.Tensor) -> Any:
        """Advance by a policy period, and begin a new episode where one has ended; what it returns is not read.

        action: (num_envs, num_actions), only read. No work waits for the host, so that a graph can hold many steps.
        """

    def metrics(self) -> dict[str, float]:
        """Return what to log of the episodes that ended since the last call, by name (waits for the device)."""
        ...

    def config(self) -> dict[str, Any]:
        """Return all settings that define the environment, ready for JSON."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next step depends on, tensors only; later steps do not change them."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave; the next step, without a `reset`, is the one that would have followed.

        Raises ValueError: the state does not fit this environment.
        """


@runtime_checkable
class MirroredVecEnv(Protocol):
    """What PPO asks besides of an environment whose policy is to be symmetric."""

    def mirror(self, what: str) -> tuple[Sequence[int], Sequence[float]]:
        """Return order and signs of the mirror image `signs * x[order]` of x, an "observation" or an "action".

        Raises ValueError: there is none.
        """
        ...


class DifferentiableVecEnv(VecEnv, Protocol):
    """What SHAC asks of an environment: steps whose observations and rewards carry derivatives by the actions before.

    Its values are those of `obs`, `critic_obs`, `final_obs`, `final_critic_obs` and `reward`. What it returns is new in
    every call.
    """

    def begin_window(self) -> None:
        """Forget what the present depends on."""

    def observe(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return `obs` and `critic_obs` with derivatives; a world whose episode has just begun has none."""
        ...

    def observe_final(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return `final_obs` and `final_critic_obs` of the last step with derivatives."""
        ...

    def step_with_gradient(self, action: torch.Tensor) -> torch.Tensor:
        """Advance as `step`; return the reward (num_envs,) with derivatives as far as it has any."""
        ...


def sanitise(obs: torch.Tensor, out: torch.Tensor | None = None) -> torch.Tensor:
    """Return a copy of observations, in `out` if given: non-finite entries 0, the rest clamped to ±RAW_LIMIT."""
    return torch.nan_to_num(obs, nan=0.0, posinf=0.0, neginf=0.0, out=out).clamp_(-RAW_LIMIT, RAW_LIMIT)
