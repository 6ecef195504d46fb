"""Success of a policy for jumps to heights over the time of its training."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.evaluation.heights import run_jumps
from jumper_warp.evaluation.plots import drawn
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.ppo import Ppo
from jumper_warp.rl.shac import Shac
from jumper_warp.tasks.cfg import TaskCfg
from support.timing import process_age

RATES = (0.5, 0.8, 0.9, 0.95, 1.0)
"""[1] Success rates whose first times are reported."""
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
    """[s] From the start of the process until training began, where it was measured."""

    def seconds_to(self, rate: float) -> float | None:
        """Return the first training time [s] at which an evaluation had at least this success rate, if any."""
        return next((t for t, success in zip(self.seconds, self.success, strict=True) if success >= rate), None)


def make_judge(task: TaskCfg, jumps: int, device: str | None) -> Env:
    """Return where policies of a task are tested: nominal, without noise, and links may come near one another."""
    return Env(task.without_margins(), jumps, device=device, randomize=False, noise=False, auto_reset=False)


def success(ppo: Ppo | Shac, judge: Env, heights: tuple[float, float] = TESTED) -> float:
    """Return the share of jumps to heights [m] from the first to the second that succeed, one a world."""
    return float(run_jumps(ppo.model.act, judge, np.linspace(*heights, judge.num_envs)).success.mean())


def warm_up(env: VecEnv, ppo: Ppo | Shac) -> None:
    """Compile the environment's kernels and the trainer's functions, and begin all episodes anew."""
    env.reset()
    env.step(torch.zeros(env.num_envs, env.num_actions, device=env.device))
    ppo.prepare()
    env.reset()
    env.metrics()


def learning_curve(
    env: VecEnv, ppo: Ppo | Shac, judge: Env, seconds: float, every: float, heights: tuple[float, float] = TESTED
) -> Curve:
    """Train for a time [s] as `jumper train --max-seconds` does, and return the curve; the test is off the clock.

    What is compiled is compiled before, see `warm_up`.

    env: of the training, not yet reset; judge: one world a jump; every [s]: training time between two evaluations;
    heights [m]: of the test's jumps.
    """
    warm_up(env, ppo)
    curve, trained, device = Curve(), 0.0, wp.device_from_torch(env.device)
    while trained < seconds:
        wp.synchronize_device(device)
        start = time.perf_counter()
        until = min(trained + every, seconds)
        while (spent := trained + time.perf_counter() - start) < until:
            ppo.set_progress(spent / seconds)
            ppo.iterate()
            curve.iterations += 1
            wp.synchronize_device(device)
        trained += time.perf_counter() - start
        curve.seconds.append(trained)
        curve.steps.append(curve.iterations * ppo.batch_size)
        curve.success.append(success(ppo, judge, heights))
    return curve


def timed_training(task: TaskCfg, cfg: PpoCfg, args: Any, seed: int) -> Curve:
    """Train, and return the curve with the time from the start of this process until the training was ready.

    args: envs, device, randomize, jumps, seconds, every and heights, as `experiments/learning_curves.py` has them.
    """
    torch.manual_seed(seed)
    env = Env(task, args.num_envs, seed=seed, device=args.device, randomize=args.randomize, noise=args.randomize)
    ppo = Ppo(env, cfg)
    warm_up(env, ppo)
    ready, judge = process_age(), make_judge(task, args.num_jumps, args.device)
    success(ppo, judge)
    curve = learning_curve(env, ppo, judge, args.seconds, args.eval_interval, args.height_range)
    curve.ready = ready
    return curve


def curve_metrics(curve: Curve, name: str) -> dict[str, Any]:
    """Return the metrics of one training, and print when it reached each of RATES."""
    pace = curve.steps[-1] / curve.seconds[-1]
    values = {f"success_{name}": curve.success[-1], f"steps_per_s_{name}": pace}
    values |= {f"curve_{series}_{name}": getattr(curve, series) for series in ("seconds", "steps", "success")}
    for rate in RATES:
        seconds, key = curve.seconds_to(rate), f"{100 * rate:g}_percent_{name}"
        steps = None if seconds is None else curve.steps[curve.seconds.index(seconds)]
        values |= {f"seconds_to_{key}": seconds, f"steps_to_{key}": steps}
        print(f"{name}, {100 * rate:g} %: " + ("never" if steps is None else f"{seconds:.0f} s, {steps / 1e6:.2f} M"))
    print(f"{name}: {100 * curve.success[-1]:.1f} % at the end, {pace:,.0f} steps a second", flush=True)
    return values


def draw_curves(curves: Mapping[str, Sequence[Curve]], path: Path) -> None:
    """Draw success over time and steps, a color for each name."""
    with drawn(path, 1, 2, figsize=(11, 4.5), sharey=True) as axes:
        for i, (name, runs) in enumerate(curves.items()):
            for number, curve in enumerate(runs):
                for axis, x in zip(axes, (curve.seconds, np.array(curve.steps) / 1e6), strict=True):
                    axis.plot(x, curve.success, color=f"C{i}", label=None if number else name)
        axes[0].set(xlabel="training time [s]", ylabel="success [1]")
        axes[1].set(xlabel="steps [million]")
        axes[0].legend()
