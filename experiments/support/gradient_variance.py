"""How noisy a policy's gradient is over windows of different lengths, through the physics and by the score function."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from jumper_warp.diff.differentiable_env import DifferentiableEnv
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.plots import figure
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.runs import open_policy
from jumper_warp.rl.networks import ActorCritic, weights_of
from jumper_warp.trajectory.gauss_newton import Network, Tape, per_world_gradients

NOISE = 0.2
"""[1] Standard deviation of the actions in windows."""
ESTIMATORS = ("physics", "score")


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
    by_physics = per_world_gradients(torch.stack(rewards).sum(), tape)
    left = torch.stack(rewards).detach().flip(0).cumsum(0).flip(0)
    advantage = left - left.mean(1, keepdim=True)
    return by_physics, per_world_gradients((torch.stack(scores) * advantage).sum(), scored)


def policies() -> dict[str, Policy]:
    """Return the trained policy, and one with new weights and the same interface."""
    trained = open_policy("vertical_jump")
    face = trained.interface
    torch.manual_seed(0)
    new = ActorCritic(face.sizes[0], face.sizes[-1], face.hidden, face.activation)
    return {"new": Policy(weights_of(new.actor), trained.mean, trained.std, face), "trained": trained}


def spreads_of(policy: Policy, env: DifferentiableEnv, horizons: tuple[int, ...]) -> dict[str, list[Spread]]:
    """Return the spreads of a policy's gradients over windows of these policy steps, by estimator."""
    network, found = Network(policy, device=env.device), []
    for horizon in horizons:
        torch.manual_seed(1)
        env.reset(seed=1)
        found.append([spread_of(rows) for rows in gradients(env, network, horizon, NOISE)])
    return dict(zip(ESTIMATORS, map(list, zip(*found, strict=True)), strict=True))


def variances(make_env: Callable[[], Env], horizons: tuple[int, ...], path: Path) -> dict[str, Any]:
    """Measure spreads over horizons, draw them, and return them."""
    values: dict[str, Any] = {"horizons": list(horizons)}
    table = Table("policy", "steps", *(f"{name}: {what}" for name in ESTIMATORS for what in ("deviation", "worlds")))
    with figure(path, 1, 2, figsize=(11, 4.5)) as axes:
        for i, (who, policy) in enumerate(policies().items()):
            found = spreads_of(policy, DifferentiableEnv(make_env(), world_norm=math.inf), horizons)
            for horizon, *pair in zip(horizons, *found.values(), strict=True):
                cells = [f"{x:.3g}" for spread in pair for x in (spread.deviation, spread.worlds_needed)]
                table.add_row(who, str(horizon), *cells)
            for name, spreads in found.items():
                for what in ("deviation", "signal", "worlds_needed", "non_finite"):
                    series = [getattr(spread, what) for spread in spreads]
                    values[f"{what}_{name}_{who}"] = [x if math.isfinite(x) else None for x in series]
                style = {"color": f"C{i}", "linestyle": "-" if name == "physics" else "--", "marker": "o"}
                axes[0].plot(horizons, [s.deviation for s in spreads], label=f"{who}, {name}", **style)
                axes[1].plot(horizons, [s.worlds_needed for s in spreads], **style)
        axes[0].set(ylabel="deviation between worlds")
        axes[1].set(ylabel="worlds until noise is as long as the signal")
        for axis in axes:
            axis.set(xscale="log", yscale="log", xlabel="policy steps of the window")
            axis.grid(alpha=0.3)
        axes[0].legend()
    Console().print(table)
    return values
