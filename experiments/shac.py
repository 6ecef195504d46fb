"""SHAC against PPO on the nominal vertical jump, and how noisy gradients through contact are.

    python experiments/shac.py --envs 4096 --seconds 120 --out outputs/shac          # on a GPU
    python experiments/shac.py --envs 128 --seconds 300 --hidden 64 64 --history 1 --seeds 0     # on a CPU

First the spread of the policy's gradient between worlds is measured against the length of the window, through the
physics and by the score function that PPO uses: of a policy with new weights and of the trained one. Then both are
trained. Every few seconds, off the clock, a policy makes the same jumps to heights of 0.5 to 1.1 m from standing; told
are the time and the steps to 50, 90 and 95 % of success.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.cli.main import run_command
from jumper_warp.diff.differentiable_env import DifferentiableEnv
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.plots import drawn
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.runs import open_policy
from jumper_warp.registry import make_task, trainer_settings
from jumper_warp.rl.cfg import ShacCfg
from jumper_warp.rl.networks import ActorCritic
from jumper_warp.rl.ppo import Ppo
from jumper_warp.rl.shac import Shac
from jumper_warp.tasks.observations import with_history
from jumper_warp.trajectory.gauss_newton import Network
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import announce
from support.gradient_variance import gradients, spread_of
from support.learning import Curve, learning_curve, make_judge

TASK = "vertical-jump"
RATES = (0.5, 0.9, 0.95)
NOISE = 0.2
"""[1] Standard deviation of the actions in windows."""
ESTIMATORS = ("physics", "score")


@dataclass(frozen=True)
class Args:
    """Flags."""

    seconds: float = 120.0
    """[s] Time of each training, its evaluations not counted; 0: none."""
    every: float = 5.0
    """[s] Training time between two evaluations."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of weights, noise and worlds."""
    trainers: tuple[Literal["ppo", "shac"], ...] = ("ppo", "shac")
    """Compared."""
    envs: int = 4096
    """Worlds of a training."""
    window: int = 16
    """Policy steps of SHAC's windows; PPO's are those of the task."""
    init_std: float = 0.3
    """Exploration noise at the start, of SHAC; PPO's is that of the task."""
    hidden: tuple[int, ...] = (256, 128, 128)
    """Widths of the hidden layers of both."""
    history: int | None = None
    """Policy steps that the policies of trainings see, as `jumper train --history` (default: as the task says)."""
    jumps: int = 200
    """Jumps of an evaluation."""
    horizons: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64)
    """Policy steps of the windows whose gradients are measured."""
    worlds: int = 256
    """Worlds of that."""
    out: Path | None = None
    """Folder for metrics.json and plots (default: outputs/shac/<time>)."""
    device: str | None = None
    """Warp device."""

    def __post_init__(self) -> None:
        """Raises InputError: a setting is out of range."""
        if not self.seeds or not self.trainers or min((self.every, *self.horizons, self.worlds - 1)) <= 0:
            raise InputError("need seeds, trainers, at least 2 worlds, and positive times and horizons")


def make_env(args: Args, num_envs: int, seed: int = 0, *, history: int | None = None) -> Env:
    """Return the nominal task; history: policy steps that the policy sees."""
    task = with_history(make_task(TASK), history)
    return Env(task, num_envs, seed=seed, device=args.device, randomize=False, noise=False)


def policies() -> dict[str, Policy]:
    """Return a policy with new weights that sees as the trained one does, and that one."""
    trained = open_policy("vertical_jump")
    face = trained.interface
    torch.manual_seed(0)
    new = ActorCritic(face.sizes[0], face.sizes[-1], face.hidden, face.activation)
    return {"new": Policy.from_actor(new.actor, trained.mean, trained.std, face), "trained": trained}


def variances(args: Args, path: Path) -> dict[str, Any]:
    """Measure spreads over horizons, draw them, and return them."""
    values: dict[str, Any] = {"horizons": list(args.horizons)}
    table = Table("policy", "steps", *(f"{name}: {what}" for name in ESTIMATORS for what in ("deviation", "worlds")))
    with drawn(path, 1, 2, figsize=(11, 4.5)) as axes:
        for i, (who, policy) in enumerate(policies().items()):
            env = DifferentiableEnv(make_env(args, args.worlds), world_norm=math.inf)
            network, found = Network(policy, device=env.device), []
            for horizon in args.horizons:
                torch.manual_seed(1)
                env.reset(seed=1)
                found.append([spread_of(rows) for rows in gradients(env, network, horizon, NOISE)])
                told = [f"{x:.3g}" for spread in found[-1] for x in (spread.deviation, spread.worlds_needed)]
                table.add_row(who, str(horizon), *told)
            for name, spreads in zip(ESTIMATORS, zip(*found, strict=True), strict=True):
                for what in ("deviation", "signal", "worlds_needed", "non_finite"):
                    series = [getattr(spread, what) for spread in spreads]
                    values[f"{what}_{name}_{who}"] = [x if math.isfinite(x) else None for x in series]
                style = {"color": f"C{i}", "linestyle": "-" if name == "physics" else "--", "marker": "o"}
                axes[0].plot(args.horizons, [s.deviation for s in spreads], label=f"{who}, {name}", **style)
                axes[1].plot(args.horizons, [s.worlds_needed for s in spreads], **style)
        axes[0].set(ylabel="deviation between worlds")
        axes[1].set(ylabel="worlds until noise is as long as the signal")
        for axis in axes:
            axis.set(xscale="log", yscale="log", xlabel="policy steps of the window")
            axis.grid(alpha=0.3)
        axes[0].legend()
    Console().print(table)
    return values


def train(args: Args, trainer: str, seed: int) -> Curve:
    """Train once and return the curve."""
    torch.manual_seed(seed)
    env, settings = make_env(args, args.envs, seed, history=args.history), trainer_settings(TASK)
    judge = make_judge(env.tasks[0], args.jumps, args.device)
    settings = replace(settings, hidden=args.hidden)
    if trainer == "shac":
        env = DifferentiableEnv(env)
        settings = replace(settings, num_steps=args.window, init_std=args.init_std)
        return learning_curve(env, Shac(env, settings, ShacCfg()), judge, args.seconds, args.every)
    return learning_curve(env, Ppo(env, settings), judge, args.seconds, args.every)


def compare(args: Args, folder: Path) -> dict[str, Any]:
    """Train with every trainer and seed, draw the curves, and return the figures."""
    values: dict[str, Any] = {}
    table = Table("trainer", "seed", "success", *(f"to {100 * rate:g} %" for rate in RATES), "steps a second")
    with drawn(folder / "curves.png", 1, 2, figsize=(11, 4.5), sharey=True) as axes:
        for i, trainer in enumerate(args.trainers):
            for seed in args.seeds:
                curve, cells = train(args, trainer, seed), []
                for rate in RATES:
                    seconds = curve.seconds_to(rate)
                    steps = None if seconds is None else curve.steps[curve.seconds.index(seconds)]
                    name = f"{100 * rate:g}_percent_{trainer}_{seed}"
                    values |= {f"seconds_to_{name}": seconds, f"steps_to_{name}": steps}
                    cells.append("never" if seconds is None else f"{seconds:.0f} s, {steps / 1e6:.2f} M")
                pace = curve.steps[-1] / curve.seconds[-1]
                values |= {f"success_{trainer}_{seed}": curve.success[-1], f"steps_per_s_{trainer}_{seed}": pace}
                values |= {f"curve_{name}_{trainer}_{seed}": getattr(curve, name)
                           for name in ("seconds", "steps", "success")}  # fmt: skip
                table.add_row(trainer, str(seed), f"{100 * curve.success[-1]:.1f} %", *cells, f"{pace:,.0f}")
                for axis, x in zip(axes, (curve.seconds, np.array(curve.steps) / 1e6), strict=True):
                    axis.plot(x, curve.success, color=f"C{i}", label=trainer if seed == args.seeds[0] else None)
                write_metrics(folder, values)
        axes[0].set(xlabel="training time [s]", ylabel="success [1]")
        axes[1].set(xlabel="steps [million]")
        axes[0].legend()
    Console().print(table)
    return values


def main(args: Args) -> dict[str, Any]:
    """Measure, train, draw, and return the figures."""
    announce(args.device)
    folder = output_dir("shac", args.out)
    values = {"envs": args.envs, "window": args.window, "worlds": args.worlds}
    values |= variances(args, folder / "variance.png")
    values |= compare(args, folder) if args.seconds > 0.0 else {}
    write_metrics(folder, values)
    print(f"figures and plots in {folder}")
    return values


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
