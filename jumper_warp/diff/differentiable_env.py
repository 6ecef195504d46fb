"""Environment whose observations and rewards have derivatives w.r.t. actions, over windows of policy steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from jumper_warp.diff.closed_loop import ClosedLoop, LoopState, with_gradient_of
from jumper_warp.diff.smooth_rewards import SMOOTH, make_context, smooth_reward
from jumper_warp.utils.errors import InputError

WORLD_NORM = 100.0  # default of `DifferentiableEnv.world_norm`


class DifferentiableEnv:
    """Environment whose observations and rewards PyTorch can differentiate w.r.t. the actions.

    See `jumper_warp.envs.vec_env.DifferentiableVecEnv`. All other attributes are those of the wrapped environment.
    """

    def __init__(self, env: Any, world_norm: float = WORLD_NORM) -> None:
        """Wrap an environment (`jumper_warp.envs.env.Env`) whose rewards become differentiable.

        world_norm: norm to which the gradient w.r.t. each part of `LoopState` is clipped, by world and policy step.
        Raises InputError: as `ClosedLoop`, or no reward has a derivative.
        """
        self.env, self.loop, self.world_norm = env, ClosedLoop(env), world_norm
        if not any(term.func.key in SMOOTH for term in self.loop.task.rewards):
            raise InputError(f"{self.loop.task.name}: no reward has a derivative")
        self._state: LoopState
        self._final: LoopState

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the wrapped environment that this class does not define."""
        return getattr(self.env, name)

    def begin_window(self) -> None:
        """Start a window of policy steps: detach the current state, so that no derivatives reach earlier steps."""
        self._state = self.loop.state()

    def observe(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the observations of actor and critic, with derivatives w.r.t. the window's earlier actions.

        `obs`, `critic_obs` (num_envs, columns).
        """
        return self._observe_both(self._state, self.env.obs, self.env.critic_obs)

    def observe_final(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the observations of actor and critic after the last step, before resets, with derivatives.

        `final_obs` and `final_critic_obs`, derivatives as `observe`.
        """
        return self._observe_both(self._final, self.env.final_obs, self.env.final_critic_obs)

    def _observe_both(
        self, state: LoopState, obs: torch.Tensor, critic_obs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the observations of actor and critic with their derivatives w.r.t. `state`.

        Values are those of obs and critic_obs.
        """
        critic = self.loop.observe(state, critic_obs, "critic")
        return with_gradient_of(obs, self.loop.observe(state, obs)), with_gradient_of(critic_obs, critic)

    def step_with_gradient(self, action: torch.Tensor) -> torch.Tensor:
        """Step the environment, and return the reward (num_envs,) with derivatives of the reward terms in `SMOOTH`.

        action: (num_envs, 12), clamped to ±1. The last reward of an episode has no derivative. Call `begin_window`
        first, and no `step` within a window.
        """
        env, old = self.env, self._state
        state, final = self.loop.step(old, action)
        final = self._final = LoopState(*(self._clip_gradient(part) for part in final))
        smooth = smooth_reward(self.loop.task, make_context(self.loop, final, old, env.task_arrays()))
        smooth = torch.where((env.done == 0.0) & smooth.isfinite(), smooth, 0.0)
        self._state = LoopState(*(self._clip_gradient(part) for part in state))
        return with_gradient_of(env.reward.clone(), smooth)

    def _clip_gradient(self, part: torch.Tensor) -> torch.Tensor:
        """Return a copy of one array of the state whose gradient is clipped in the reverse pass."""
        if not part.requires_grad:
            return part
        part = part * 1.0  # a new tensor, whose gradient sums all uses
        part.register_hook(clip_norm(self.world_norm))
        return part


def clip_norm(max_norm: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return a gradient hook that limits the gradient's norm in each world and zeroes non-finite gradients.

    Gradients: (rows, num_worlds).
    """

    def clip(grad: torch.Tensor) -> torch.Tensor:
        grad = torch.where(grad.isfinite().all(0, keepdim=True), grad, 0.0)
        length = grad.norm(dim=0, keepdim=True)
        return grad * (max_norm / length.clamp(min=1.0e-30)).clamp(max=1.0)

    return clip
