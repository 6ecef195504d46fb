"""Measure how soon a jump is learnt, for seeds and trainer variants, and write metrics and a plot.

    python experiments/learning_curves.py --seconds 60 --seeds 0 1 2 --variants default eager
    python experiments/learning_curves.py --device cpu --num-envs 2048 --history 1 --variants small \
        --goal-range 0.5 0.9 --seconds 450 --eval-interval 30                 # two cores of a CPU
    python experiments/learning_curves.py --iterations 570 --seeds 0 1 2 3 4 5 6 7 --variants default eager --workers 4

Trainings start from random weights, one after the other, each in a separate process. Every few seconds of training time
the policy is evaluated on jumps to heights of 0.5 to 1.1 m, or to places 0.3 to 1.5 m ahead. The metrics are the
training times to success rates up to 100 %, and the time from the start of the process to the start of the training,
when everything is compiled. A second process loads compiled kernels from the caches on disk. Variants are those of
`support.variants`. Two variants are compared by rank tests. With `--iterations` all trainings have the same number of
samples, and several can run at once.
"""

from __future__ import annotations

import itertools
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import warp as wp

from jumper_warp.registry import make_task, trainer_settings
from jumper_warp.tasks.observations import with_history
from jumper_warp.utils.files import Json
from jumper_warp.utils.output import write_metrics
from support.learning import TEST_RANGES, LearningCurve, compare, curve_metrics, plot_curves, train_and_time
from support.scripts import DeviceArgs, announce, prepare, report, run_script, tracked
from support.variants import DEFAULT, variant


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the measurement of learning curves."""

    task: str = "vertical-jump"  # Task of jumps to heights or to places
    seconds: float = 60.0  # [s] Time of each training, its evaluations not counted
    iterations: int = 0  # Number of iterations of each training instead of a time; 0: `seconds` counts
    workers: int = 1  # Number of trainings at once; more than one needs `iterations`
    eval_interval: float = 2.0  # [s] Training time between two evaluations
    seeds: tuple[int, ...] = (0, 1, 2)  # Seeds of weights, noise and worlds
    variants: tuple[str, ...] = (DEFAULT,)  # Variants of the trainer (`support.variants`)
    num_envs: int = 8192  # Number of environments
    num_jumps: int = 200  # Number of jumps of an evaluation
    goal_range: tuple[float, float] | None = None
    """[m] Lowest and highest commanded base height, or smallest and largest distance ahead (default: `TEST_RANGES`)."""
    history: int | None = None
    """Number of policy steps in the observation, as `jumper train --history` (default: the task's)."""
    randomize: bool = False  # Train with randomisation and noise


def train(args: Args, name: str, seed: int) -> LearningCurve:
    """Train the trainer's variant `name` with a seed, and return the learning curve."""
    wp.config.log_level = wp.LOG_WARNING
    task = with_history(make_task(args.task), args.history)
    cfg = variant(trainer_settings(args.task), name)
    return train_and_time(task, cfg, args, seed)


def train_in_process(args: Args, name: str, seed: int) -> LearningCurve:
    """Run `train` in a new process, which compiles or loads everything itself, and return the learning curve."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(train, args, name, seed).result()


def main(args: Args) -> Json:
    """Train every variant with every seed, write metrics and plot after each, and return the metrics."""
    folder = prepare("learning_curves", args)
    length = {"iterations": args.iterations} if args.iterations else {"seconds": args.seconds}
    values: Json = {"task": args.task, **length, "envs": args.num_envs, "randomize": args.randomize}
    limits = args.goal_range or TEST_RANGES[make_task(args.task).evaluation.kind]
    values |= {"seeds": list(args.seeds), "goals_m": list(limits), "history": args.history}
    curves: dict[str, list[LearningCurve]] = {name: [] for name in args.variants}
    runs = [*itertools.product(args.variants, args.seeds)]
    with ThreadPoolExecutor(args.workers) as pool:
        results = [pool.submit(train_in_process, args, *run) for run in runs]
        for (name, seed), result in tracked([*zip(runs, results, strict=True)], "trainings"):
            curve = result.result()
            curves[name].append(curve)
            values |= curve_metrics(curve, f"{name}_{seed}") | {f"ready_s_{name}_{seed}": curve.ready}
            announce(f"{name}, seed {seed}: {curve.success[-1]:.1%} success, {curve.seconds[-1]:.0f} s of training")
            write_metrics(folder, values)
            plot_curves(curves, folder / "learning_curves.png")
    if len(args.variants) == 2 and len(args.seeds) > 1:
        first, second = curves.values()
        values |= compare(first, second)
        write_metrics(folder, values)
    keys = [key for key in values if key.startswith(("success_", "seconds_to_95_percent_", "p_"))]
    return report(args, folder, values, f"Learning curves of {args.task}, {args.num_envs:,} environments", keys)


if __name__ == "__main__":
    run_script(main, Args)
