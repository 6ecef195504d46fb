"""Compare trainings by SHAC and by PPO and the noise of their gradients, and write metrics and plots.

    python experiments/shac.py --num-envs 4096 --seconds 120 --out outputs/shac          # on a GPU
    python experiments/shac.py --num-envs 128 --seconds 300 --hidden 64 64 --history 1 --seeds 0     # on a CPU

The task is the nominal vertical jump. First the variance of the policy gradient between worlds is measured for windows
of several lengths, through the physics (SHAC) and by the score function (PPO), for random and for trained weights. Then
both train. Every few seconds of training time the policy is evaluated on jumps to heights of 0.5 to 1.1 m. The metrics
are time and steps to success rates.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import torch

from jumper_warp.diff.differentiable_env import DifferentiableEnv
from jumper_warp.envs.env import Env
from jumper_warp.envs.vec_env import DifferentiableVecEnv
from jumper_warp.registry import make_task, trainer_settings
from jumper_warp.rl.cfg import ShacCfg
from jumper_warp.rl.ppo import Ppo
from jumper_warp.rl.shac import Shac
from jumper_warp.tasks.observations import with_history
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import write_metrics
from support.gradient_variance import measure_stats, plot_variances, variance_metrics
from support.learning import LearningCurve, curve_metrics, make_eval_env, plot_curves, train_and_evaluate
from support.scripts import DeviceArgs, announce, prepare, report, run_script, tracked

TASK = "vertical-jump"


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the comparison of SHAC and PPO."""

    seconds: float = 120.0  # [s] Time of each training, its evaluations not counted; 0: none
    eval_interval: float = 5.0  # [s] Training time between two evaluations
    seeds: tuple[int, ...] = (0, 1, 2)  # Seeds of weights, noise and worlds
    trainers: tuple[Literal["ppo", "shac"], ...] = ("ppo", "shac")  # Trainers to compare
    num_envs: int = 4096  # Number of environments of a training
    window: int = 16  # Policy steps of SHAC's windows; PPO's are those of the task
    init_std: float = 0.3  # Exploration noise at the start, of SHAC; PPO's is that of the task
    hidden: tuple[int, ...] = (256, 128, 128)  # Widths of the hidden layers of both
    history: int | None = None
    """Number of policy steps in the observation, as `jumper train --history` (default: the task's)."""
    num_jumps: int = 200  # Number of jumps of an evaluation
    horizons: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64)  # Policy steps of the windows whose gradients are measured
    num_gradient_envs: int = 256  # Number of environments whose gradients are measured

    def __post_init__(self) -> None:
        positive = min((self.eval_interval, *self.horizons, self.num_gradient_envs - 1)) > 0
        if not self.seeds or not self.trainers or not positive:
            raise InputError("need seeds, trainers, at least 2 worlds, and positive times and horizons")


def make_env(args: Args, num_envs: int, seed: int = 0, *, history: int | None = None) -> Env:
    """Return an environment of TASK without randomisation and noise.

    history: number of policy steps that an observation covers, None: the task's.
    """
    task = with_history(make_task(TASK), history)
    return Env(task, num_envs, seed=seed, device=args.device, randomize=False, noise=False)


def train(args: Args, algorithm: str, seed: int) -> LearningCurve:
    """Train with an algorithm, "ppo" or "shac", and a seed, and return the learning curve."""
    torch.manual_seed(seed)
    env, settings = make_env(args, args.num_envs, seed, history=args.history), trainer_settings(TASK)
    eval_env = make_eval_env(env.tasks[0], args.num_jumps, args.device)
    settings = replace(settings, hidden=args.hidden)
    if algorithm == "shac":
        differentiable = cast(DifferentiableVecEnv, DifferentiableEnv(env))
        settings = replace(settings, num_steps=args.window, init_std=args.init_std)
        trainer = Shac(differentiable, settings, ShacCfg())
        return train_and_evaluate(differentiable, trainer, eval_env, args.seconds, args.eval_interval)
    return train_and_evaluate(env, Ppo(env, settings), eval_env, args.seconds, args.eval_interval)


def compare(args: Args, folder: Path) -> dict[str, Any]:
    """Train with SHAC and PPO for every seed, plot the learning curves into `folder`, return the metrics."""
    values, curves = {}, {trainer: [] for trainer in args.trainers}
    for trainer, seed in tracked([*itertools.product(args.trainers, args.seeds)], "trainings"):
        curves[trainer].append(train(args, trainer, seed))
        values |= curve_metrics(curves[trainer][-1], f"{trainer}_{seed}")
        write_metrics(folder, values)
        announce(f"{trainer}, seed {seed}: {values[f'success_{trainer}_{seed}']:.1%} success")
    plot_curves(curves, folder / "curves.png")
    return values


def main(args: Args) -> dict[str, Any]:
    """Measure the noise of policy gradients, train with SHAC and PPO, plot both, and return the metrics."""
    folder = prepare("shac", args)
    values: dict[str, Any] = {"envs": args.num_envs, "window": args.window, "worlds": args.num_gradient_envs}
    stats = measure_stats(lambda: make_env(args, args.num_gradient_envs), args.horizons)
    plot_variances(stats, args.horizons, folder / "variance.png")
    values |= {"horizons": list(args.horizons)} | variance_metrics(stats)
    values |= compare(args, folder) if args.seconds > 0.0 else {}
    keys = [key for key in values if key.startswith(("success_", "seconds_to_95_percent_"))]
    return report(args, folder, values, f"SHAC and PPO on {TASK}, {args.num_envs:,} environments", keys)


if __name__ == "__main__":
    run_script(main, Args)
