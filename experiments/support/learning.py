"""Success of a policy for jumps to heights over the time of its training."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import run_jumps
from jumper_warp.evaluation.plots import drawn
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.ppo import Ppo
from jumper_warp.rl.shac import Shac
from jumper_warp.tasks.cfg import TaskCfg
from support.timing import process_age

TESTED = (0.5, 1.1)
"""[m] Heights of the test's jumps, unless others are asked for."""


@dataclass
class Curve:
    """Success of one variant over its training time."""

    seconds: list[float] = field(default_factory=list)
    success: list[float] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    """Policy steps of all worlds together, so far."""
    iterations: int = 0
    ready: float = 0.0
    """[s] From the start of the process until training began."""

    def seconds_to(self, rate: float) -> float | None:
        """Return the first training time [s] at which an evaluation had at least this success rate, if any."""
        return next((t for t, success in zip(self.seconds, self.success, strict=True) if success >= rate), None)


def make_judge(task: TaskCfg, jumps: int, device: str | None) -> Env:
    """Return where policies of a task are tested: nominal, without noise, and links may come near one another."""
    return Env(task.without_margins(), jumps, device=device, randomize=False, noise=False, auto_reset=False)


def success(ppo: Ppo | Shac, judge: Env, heights: tuple[float, float] = TESTED) -> float:
    """Return the share of jumps to heights [m] from the first to the second that succeed, one a world."""
    return float(run_jumps(ppo.model.act, judge, np.linspace(*heights, judge.num_envs)).success.mean())


def warm_up(env: Env, ppo: Ppo | Shac) -> None:
    """Compile the environment's kernels and the trainer's functions, and begin all episodes anew."""
    env.reset()
    env.step(torch.zeros(env.num_envs, env.num_actions, device=env.device))
    ppo.prepare()
    env.reset()
    env.metrics()


def learning_curve(
    env: Env, ppo: Ppo | Shac, judge: Env, seconds: float, every: float, heights: tuple[float, float] = TESTED
) -> Curve:
    """Train for a time [s] as `jumper train --max-seconds` does, and return the curve; the test is off the clock.

    What is compiled is compiled before, see `warm_up`.

    env: of the training, not yet reset; judge: one world a jump; every [s]: training time between two evaluations;
    heights [m]: of the test's jumps.
    """
    warm_up(env, ppo)
    curve, trained = Curve(), 0.0
    while trained < seconds:
        wp.synchronize_device(env.wp_device)
        start = time.perf_counter()
        until = min(trained + every, seconds)
        while (spent := trained + time.perf_counter() - start) < until:
            ppo.set_progress(spent / seconds)
            ppo.iterate()
            curve.iterations += 1
            wp.synchronize_device(env.wp_device)
        trained += time.perf_counter() - start
        curve.seconds.append(trained)
        curve.steps.append(curve.iterations * ppo.batch_size)
        curve.success.append(success(ppo, judge, heights))
    return curve


def timed_training(task: TaskCfg, cfg: PpoCfg, args: Any, seed: int) -> Curve:
    """Train in a fresh process, and return the curve with the time until the training was ready.

    args: envs, device, randomize, jumps, seconds, every and heights, as `experiments/learning_curves.py` has them.
    """
    torch.manual_seed(seed)
    env = Env(task, args.envs, seed=seed, device=args.device, randomize=args.randomize, noise=args.randomize)
    ppo = Ppo(env, cfg)
    warm_up(env, ppo)
    ready, judge = process_age(), make_judge(task, args.jumps, args.device)
    success(ppo, judge)
    curve = learning_curve(env, ppo, judge, args.seconds, args.every, args.heights)
    curve.ready = ready
    return curve


def curve_metrics(curve: Curve, name: str, good: float) -> dict[str, Any]:
    """Return the metrics of a curve, their names ending in its own; good: success rate whose time is reported."""
    reached, every_one, rate = curve.seconds_to(good), curve.seconds_to(1.0), f"{100.0 * good:g}_percent"
    return {
        f"success_{name}": curve.success[-1],
        f"ready_s_{name}": curve.ready,
        f"trained_to_{rate}_s_{name}": reached,
        f"from_start_to_{rate}_s_{name}": None if reached is None else reached + curve.ready,
        f"steps_to_{rate}_{name}": None if reached is None else curve.steps[curve.seconds.index(reached)],
        f"trained_to_100_percent_s_{name}": every_one,
        **{f"curve_{key}_{name}": getattr(curve, key) for key in ("seconds", "steps", "success")},
    }


def plot_curves(curves: dict[tuple[str, int], Curve], path: Path) -> None:
    """Draw success over training time and over steps, one line a training (name, seed), one colour a name."""
    colours = {name: f"C{i}" for i, name in enumerate(dict.fromkeys(name for name, _ in curves))}
    with drawn(path, 1, 2, figsize=(11, 4.5), sharey=True) as axes:
        for (name, seed), curve in curves.items():
            label = name.replace("_", " ") if seed == next(s for n, s in curves if n == name) else None
            for axis, x in zip(axes, (curve.seconds, np.divide(curve.steps, 1.0e6)), strict=True):
                axis.plot([0.0, *x], [0.0, *(100.0 * s for s in curve.success)], color=colours[name], label=label)
        axes[0].set(xlabel="training time [s]", ylabel="success [%]", ylim=(0.0, 102.0))
        axes[1].set(xlabel="steps [million]")
        for axis in axes:
            axis.grid(alpha=0.3)
        axes[0].legend(loc="lower right")
