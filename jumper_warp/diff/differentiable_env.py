"""An environment whose observations and rewards carry derivatives by the actions before."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from jumper_warp.diff.closed_loop import ClosedLoop, LoopState, anchored
from jumper_warp.diff.smooth_rewards import SMOOTH, make_moment, smooth_reward
from jumper_warp.utils.errors import InputError

WORLD_NORM = 100.0
"""Longest gradient that a world's state passes on from a policy step to the one before."""


class DifferentiableEnv:
    """An environment with all that it has, and gradients: see `jumper_warp.envs.vec_env.DifferentiableVecEnv`."""

    def __init__(self, env: Any, world_norm: float = WORLD_NORM) -> None:
        """Wrap a `jumper_warp.envs.env.Env`.

        world_norm: longest gradient by a world's positions, and by its velocities, that is passed on.
        Raises InputError: as `ClosedLoop`, or no reward has a derivative.
        """
        self.env, self.loop, self.world_norm = env, ClosedLoop(env), world_norm
        if not any(term.func.key in SMOOTH for term in self.loop.task.rewards):
            raise InputError(f"{self.loop.task.name}: no reward has a derivative")
        self._state: LoopState
        self._final: LoopState

    def __getattr__(self, name: str) -> Any:
        """Return what the environment has of that name."""
        return getattr(self.env, name)

    def begin_window(self) -> None:
        """Forget what the present depends on."""
        self._state = self.loop.state()

    def observe(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return `obs` and `critic_obs` with their derivatives."""
        return self._anchored(self._state, self.env.obs, self.env.critic_obs)

    def observe_final(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return `final_obs` and `final_critic_obs` of the last step with their derivatives."""
        return self._anchored(self._final, self.env.final_obs, self.env.final_critic_obs)

    def _anchored(
        self, state: LoopState, obs: torch.Tensor, critic_obs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return observations of both networks with their derivatives by a state."""
        observe = self.loop.observe
        return anchored(obs, observe(state, obs)), anchored(critic_obs, observe(state, critic_obs, "critic"))

    def step_with_gradient(self, action: torch.Tensor) -> torch.Tensor:
        """Make a policy step; return the reward (num_envs,) with the derivatives of its smooth terms.

        The last reward of an episode has none. A window must have begun, and no other step been made since.
        """
        env, old = self.env, self._state
        state, made = self.loop.step(old, action)
        made = self._final = LoopState(*(self._kept(part) for part in made))
        smooth = smooth_reward(self.loop.task, make_moment(self.loop, made, old, env.task_arrays()))
        smooth = torch.where((env.done == 0.0) & smooth.isfinite(), smooth, 0.0)
        self._state = LoopState(*(self._kept(part) for part in state))
        return anchored(env.reward.clone(), smooth)

    def _kept(self, part: torch.Tensor) -> torch.Tensor:
        """Let a part of the state pass on finite gradients, of bounded length for each world."""
        if not part.requires_grad:
            return part
        part = part * 1.0  # a tensor of its own, whose gradient is the sum of all
        part.register_hook(limited(self.world_norm))
        return part


def limited(longest: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return what shortens the gradient of each world, the last axis, to a length, and a non-finite one to 0."""

    def limit(grad: torch.Tensor) -> torch.Tensor:
        grad = torch.where(grad.isfinite().all(0, keepdim=True), grad, 0.0)
        length = grad.norm(dim=0, keepdim=True)
        return grad * (longest / length.clamp(min=1.0e-30)).clamp(max=1.0)

    return limit
