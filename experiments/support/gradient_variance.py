"""Noise of policy gradients over windows of different lengths, through the physics and by the score function."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from jumper_warp.diff.differentiable_env import DifferentiableEnv
from jumper_warp.envs.env import Env
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.runs import open_policy
from jumper_warp.rl.networks import ActorCritic, linear_layers
from jumper_warp.trajectory.gauss_newton import Network, Tape, per_world_gradients
from jumper_warp.viz.plots import figure

NOISE = 0.2  # [1] Standard deviation of the actions in windows
ESTIMATORS = ("physics", "score")  # Gradients through the physics, and by the score function
METRICS = {"deviation": "std", "signal": "signal", "worlds_needed": "worlds_needed", "non_finite": "non_finite"}
"""Field of `GradientStats` by name of the metric."""


@dataclass(frozen=True)
class GradientStats:
    """Statistics over worlds of one estimator's policy gradients, (weights,) each."""

    std: float  # Square root of the sum over weights of the variance between worlds
    signal: float  # Norm of the mean over worlds, without the part expected from noise alone; 0 if noise explains it
    non_finite: float  # Fraction of worlds whose gradient is not finite

    @property
    def worlds_needed(self) -> float:
        """Number of worlds whose mean gradient has as much noise as signal; infinite without signal."""
        return (self.std / self.signal) ** 2 if self.signal > 0.0 else float("inf")


StatsByPolicy = dict[str, dict[str, list[GradientStats]]]  # Statistics by policy and estimator, one per horizon


def gradient_stats(rows: torch.Tensor) -> GradientStats:
    """Compute the statistics of policy gradients (worlds, weights) over the worlds with finite gradient."""
    finite = rows.isfinite().all(1)
    valid = rows[finite].double()
    variance = float(valid.var(0).sum())
    signal = float(valid.mean(0).square().sum()) - variance / len(valid)
    return GradientStats(variance**0.5, max(signal, 0.0) ** 0.5, 1.0 - float(finite.double().mean()))


def gradients(env: DifferentiableEnv, network: Network, horizon: int, std: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute each world's policy gradient (worlds, weights), through the physics and by the score function.

    It is the gradient of the sum of rewards in a window with respect to the network's weights. The window of `horizon`
    policy steps starts at the present state; rewards of a world count until its episode ends. std: of action noise [1].
    The advantage of the score function is the remaining reward minus its mean over worlds.
    """
    env.begin_window()
    tape, score_tape, scores, rewards = Tape(), Tape(), [], []
    alive = torch.ones(env.num_envs, device=env.device)
    for _ in range(horizon):
        obs, _ = env.observe()
        mean = network.act(obs, tape=tape)
        action = mean + std * torch.randn_like(mean)
        score_mean = network.act(obs.detach(), tape=score_tape)
        scores.append(-0.5 * alive * ((action.detach() - score_mean) / std).square().sum(1))
        rewards.append(alive * env.step_with_gradient(action))
        alive = alive * (1.0 - env.done)
    by_physics = per_world_gradients(torch.stack(rewards).sum(), tape)
    to_go = torch.stack(rewards).detach().flip(0).cumsum(0).flip(0)
    advantage = to_go - to_go.mean(1, keepdim=True)
    return by_physics, per_world_gradients((torch.stack(scores) * advantage).sum(), score_tape)


def policies() -> dict[str, Policy]:
    """Return the two policies to measure: `trained`, as shipped, and `new`, with random weights.

    Both have the same interface.
    """
    trained = open_policy("vertical_jump")
    interface = trained.interface
    torch.manual_seed(0)
    new = ActorCritic(interface.sizes[0], interface.sizes[-1], interface.hidden, interface.activation)
    return {"new": Policy(linear_layers(new.actor), trained.mean, trained.std, interface), "trained": trained}


def stats_over_horizons(
    policy: Policy, env: DifferentiableEnv, horizons: tuple[int, ...]
) -> dict[str, list[GradientStats]]:
    """Measure a policy's gradients: return their statistics by estimator, one per horizon [policy steps]."""
    network, stats = Network(policy, device=env.device), []
    for horizon in horizons:
        torch.manual_seed(1)
        env.reset(seed=1)
        stats.append([gradient_stats(rows) for rows in gradients(env, network, horizon, NOISE)])
    return dict(zip(ESTIMATORS, map(list, zip(*stats, strict=True)), strict=True))


def measure_stats(make_env: Callable[[], Env], horizons: tuple[int, ...]) -> StatsByPolicy:
    """Measure the gradients of the trained and the new policy: return statistics by policy and estimator, per horizon.

    Horizons are in policy steps.
    """
    return {
        name: stats_over_horizons(policy, DifferentiableEnv(make_env(), world_norm=math.inf), horizons)
        for name, policy in policies().items()
    }


def variance_metrics(stats: StatsByPolicy) -> dict[str, Any]:
    """Return the statistics of policy gradients as metrics `<metric>_<estimator>_<policy>`.

    Each is the list over horizons of one of METRICS; None where not finite.
    """
    values = {}
    for policy, by_estimator in stats.items():
        for estimator, of_horizons in by_estimator.items():
            for key, field in METRICS.items():
                series = [getattr(one_horizon, field) for one_horizon in of_horizons]
                values[f"{key}_{estimator}_{policy}"] = [x if math.isfinite(x) else None for x in series]
    return values


def plot_variances(stats: StatsByPolicy, horizons: tuple[int, ...], path: Path) -> None:
    """Plot the gradients' standard deviation over the horizon, and the number of worlds at which noise equals signal.

    A color per policy, a line style per estimator.
    """
    with figure(path, 1, 2, figsize=(11, 5), title="Noise of policy gradients") as axes:
        for i, (policy, by_estimator) in enumerate(stats.items()):
            for name, of_horizons in by_estimator.items():
                style = {"color": f"C{i}", "linestyle": "-" if name == "physics" else "--", "marker": "o"}
                axes[0].plot(horizons, [s.std for s in of_horizons], label=f"{policy}, {name}", **style)
                axes[1].plot(horizons, [s.worlds_needed for s in of_horizons], **style)
        axes[0].set(ylabel="deviation between worlds")
        axes[1].set(ylabel="worlds until noise is as long as the signal")
        for axis in axes:
            axis.set(xscale="log", yscale="log", xlabel="policy steps of the window")
            axis.set_xticks(horizons, map(str, horizons))
            axis.set_xticks([], minor=True)
