"""Learning curves: success of a policy at jumps over its training time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
import torch
import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.fused import make_ppo
from jumper_warp.rl.learner import Learner
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.files import Json
from jumper_warp.viz.plots import figure
from support.timing import process_age

RATES = (0.5, 0.8, 0.9, 0.95, 1.0)  # [1] Success rates for which the time to reach them is reported
EVALUATIONS = 40  # Number of evaluations of a training with a given number of iterations
TEST_RANGES = {"height": (0.5, 1.1), "place": (0.3, 1.5)}
"""Default ranges [m] of the heights, or distances ahead, of evaluated jumps by `Evaluation.kind`."""


@dataclass
class LearningCurve:
    """Learning curve: success of one training over its time; lists have one entry per evaluation."""

    seconds: list[float] = field(default_factory=list)  # [s] Training time so far
    success: list[float] = field(default_factory=list)  # [1] Success rate
    steps: list[int] = field(default_factory=list)  # Policy steps of all worlds together so far
    iterations: int = 0  # Number of iterations of the training
    ready: float = 0.0  # [s] Time from the start of the process to the start of the training; 0 if not measured

    def reached(self, rate: float) -> int | None:
        """Return the index of the first evaluation with at least this success rate, or None."""
        return next((i for i, success in enumerate(self.success) if success >= rate), None)


def run_jumps(act: Callable[[torch.Tensor], torch.Tensor], env: Env, goals: np.ndarray) -> JumpLog:
    """Run one jump per world to a commanded goal, and return the finished log.

    act: as for `run_evaluation`; goals [m]: as for `JumpLog`.
    """
    jumps = JumpLog(goals, env.task.termination_names)
    run_evaluation(act, env, jumps)
    return jumps


def places_ahead(limits: tuple[float, float], count: int) -> np.ndarray:
    """Return evenly spaced goals straight ahead [m], (count, 1, 2); limits [m]: nearest and farthest distance."""
    return np.stack([np.linspace(*limits, count), np.zeros(count)], axis=1)[:, None]


def success_rate(trainer: Learner, eval_env: Env, limits: tuple[float, float] | None = None) -> float:
    """Return the success rate [1] of jumps to evenly spaced heights, or places ahead, one per world of `eval_env`.

    limits [m]: lowest and highest height or distance; None: those of TEST_RANGES.
    """
    kind = eval_env.task.evaluation.kind
    count = eval_env.num_envs
    limits = limits or TEST_RANGES[kind]
    goals = places_ahead(limits, count) if kind == "place" else np.linspace(*limits, count)
    return float(run_jumps(trainer.model.act, eval_env, goals).success.mean())


def warm_up(env: VecEnv, trainer: Learner) -> None:
    """Compile the environment's kernels and the trainer's functions, then reset all episodes."""
    env.reset()
    env.step(torch.zeros(env.num_envs, env.num_actions, device=env.device))
    trainer.compile()
    env.reset()
    env.metrics()


def train_and_evaluate(
    env: VecEnv,
    trainer: Learner,
    eval_env: Env,
    length: float,
    every: float,
    limits: tuple[float, float] | None = None,
    by_iterations: bool = False,
) -> LearningCurve:
    """Train for a time or a number of iterations, evaluate at intervals, and return the learning curve.

    Schedules follow `length`, as in `jumper train --max-seconds` or `--max-iterations`. Compilation (`warm_up`)
    and evaluations do not count as training time.
    env: environment of the training, not yet reset; eval_env: one world per evaluated jump; length: of the training,
    and every: between two evaluations, [s] or number of iterations; limits [m]: see `success_rate`.
    """
    warm_up(env, trainer)
    curve = LearningCurve()
    trained = 0.0
    spent = 0.0
    device = wp.device_from_torch(env.device)
    while spent < length:
        wp.synchronize_device(device)
        start = time.perf_counter()
        before = trained
        until = min(spent + every, length)
        while spent < until:
            trainer.set_progress(spent / length)
            trainer.iterate()
            curve.iterations += 1
            wp.synchronize_device(device)
            trained = before + time.perf_counter() - start
            spent = float(curve.iterations) if by_iterations else trained
        curve.seconds.append(trained)
        curve.steps.append(curve.iterations * trainer.batch_size)
        curve.success.append(success_rate(trainer, eval_env, limits))
    return curve


def train_and_time(task: TaskCfg, cfg: PpoCfg, args: Any, seed: int) -> LearningCurve:
    """Train with PPO and return the learning curve, with the time from process start to training start.

    args: `Args` of `experiments/learning_curves.py`; seed: of weights, noise and worlds.
    """
    torch.manual_seed(seed)
    env = Env(task, args.num_envs, seed=seed, device=args.device, randomize=args.randomize, noise=args.randomize)
    trainer = make_ppo(env, cfg)
    warm_up(env, trainer)
    ready = process_age()
    nominal = task.without_margins()
    eval_env = Env(nominal, args.num_jumps, device=args.device, randomize=False, noise=False, auto_reset=False)
    success_rate(trainer, eval_env)
    length, every = args.seconds, args.eval_interval
    if args.iterations:
        length = args.iterations
        every = max(1, args.iterations // EVALUATIONS)
    curve = train_and_evaluate(env, trainer, eval_env, length, every, args.goal_range, bool(args.iterations))
    curve.ready = ready
    return curve


def curve_metrics(curve: LearningCurve, name: str) -> Json:
    """Return final success, and time and steps to reach each of RATES, of one training's learning curve.

    Keys: `<metric>_<name>`.
    """
    values: Json = {f"success_{name}": curve.success[-1]}
    values |= {f"steps_per_s_{name}": curve.steps[-1] / curve.seconds[-1]}
    values |= {f"curve_{series}_{name}": getattr(curve, series) for series in ("seconds", "steps", "success")}
    for rate in RATES:
        i = curve.reached(rate)
        key = f"{100 * rate:g}_percent_{name}"
        values[f"seconds_to_{key}"] = None if i is None else curve.seconds[i]
        values[f"steps_to_{key}"] = None if i is None else curve.steps[i]
    return values


def compare(first: Sequence[LearningCurve], second: Sequence[LearningCurve], rate: float = 0.95) -> dict[str, float]:
    """Return p-values of the hypotheses that two trainers are equally fast and successful, with Holm's correction.

    The correction for two tests doubles the smaller p-value; the larger one is at least as large as this.
    Two-sided rank tests (Mann-Whitney) of the steps to a success rate, infinite if it is not reached, and of the final
    success. Keys: `p_steps_to_95_percent`, `p_final_success`.
    """
    steps = []
    final = []
    for curves in (first, second):
        indices = [curve.reached(rate) for curve in curves]
        steps.append([math.inf if i is None else curve.steps[i] for i, curve in zip(indices, curves, strict=True)])
        final.append([curve.success[-1] for curve in curves])
    p = [float(scipy.stats.mannwhitneyu(*pair).pvalue) for pair in (steps, final)]
    smallest = min(1.0, 2.0 * min(p))
    names = (f"p_steps_to_{100 * rate:g}_percent", "p_final_success")
    return {name: smallest if value == min(p) else max(smallest, value) for name, value in zip(names, p, strict=True)}


def plot_curves(curves: Mapping[str, Sequence[LearningCurve]], path: Path) -> None:
    """Plot success over training time and over steps into a file; curves: by name of the trainer, a color each."""
    with figure(path, 1, 2, figsize=(11, 5), sharey=True, title="Success over training") as axes:
        for i, (name, runs) in enumerate(curves.items()):
            for number, curve in enumerate(runs):
                for axis, x in zip(axes, (curve.seconds, np.array(curve.steps) / 1e6), strict=True):
                    axis.plot(x, curve.success, color=f"C{i}", label=None if number else name)
        axes[0].set(xlabel="training time [s]", ylabel="success [1]")
        axes[1].set(xlabel="steps [million]")
