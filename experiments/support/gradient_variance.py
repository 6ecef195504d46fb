"""How noisy a policy's gradient is over windows of different lengths, through the physics and by the score function."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from jumper_warp.diff.differentiable_env import DifferentiableEnv
from jumper_warp.trajectory.gauss_newton import Network, Tape, world_rows


@dataclass(frozen=True)
class Spread:
    """Of one estimator's gradients of the worlds, each (weights,)."""

    deviation: float
    """Root of the sum over weights of the variance between worlds."""
    signal: float
    """Length of the mean over worlds, the part that noise alone would give taken off; 0 if noise explains it."""
    non_finite: float
    """Share of worlds whose gradient is not finite."""

    @property
    def worlds_needed(self) -> float:
        """Number of worlds whose mean has noise as long as the signal."""
        return (self.deviation / self.signal) ** 2 if self.signal > 0.0 else float("inf")


def spread_of(rows: torch.Tensor) -> Spread:
    """Return the spread of gradients (worlds, weights)."""
    finite = rows.isfinite().all(1)
    kept = rows[finite].double()
    variance = float(kept.var(0).sum())
    signal = float(kept.mean(0).square().sum()) - variance / len(kept)
    return Spread(variance**0.5, max(signal, 0.0) ** 0.5, 1.0 - float(finite.double().mean()))


def gradients(env: DifferentiableEnv, network: Network, horizon: int, std: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return each world's gradient (worlds, weights) of the reward of a window: by physics, and by the score function.

    The window begins where the environment is; a world's counts until its episode ends. std: of the actions' noise [1].
    The score function's advantage is what is left of the window's reward, less its mean over the worlds.
    """
    env.begin_window()
    tape, scores, scored, rewards = Tape(), [], Tape(), []
    alive = torch.ones(env.num_envs, device=env.device)
    for _ in range(horizon):
        obs, _ = env.observe()
        mean = network.act(obs, tape=tape)
        action = mean + std * torch.randn_like(mean)
        again = network.act(obs.detach(), tape=scored)
        scores.append(-0.5 * alive * ((action.detach() - again) / std).square().sum(1))
        rewards.append(alive * env.step_with_gradient(action))
        alive = alive * (1.0 - env.done)
    by_physics = world_rows(torch.stack(rewards).sum(), tape)
    left = torch.stack(rewards).detach().flip(0).cumsum(0).flip(0)
    advantage = left - left.mean(1, keepdim=True)
    return by_physics, world_rows((torch.stack(scores) * advantage).sum(), scored)
