"""Measure how long an iteration of several seeds side by side takes, compared with one seed, and write metrics.

    python experiments/benchmark_seeds.py --seeds 1 8 16 --num-envs 1024 --out outputs/benchmark_seeds

Each seed has an environment and a learner of its own, on a GPU on its own stream, as in `jumper train --seeds`. The
policies learn for `--warm-up` iterations before the timing, so that they jump. Times exclude start and compilation.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass

import torch
import warp as wp

from jumper_warp import Recipe
from jumper_warp.rl.fused import make_ppo
from jumper_warp.rl.learner import Learner
from jumper_warp.utils.output import output_dir
from jumper_warp.utils.runtime import DeviceStream, configure_device
from support.scripts import ThreadArgs, report, run_script
from support.speed import device_memory

PARTS = ("collect", "update")  # Methods of a learner that make an iteration


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the benchmark of several seeds."""

    task: str = "vertical-jump"
    seeds: tuple[int, ...] = (1, 8, 16)  # Numbers of seeds; ratios are to the first
    num_envs: int = 1024  # Number of worlds of each seed
    warm_up: int = 100  # Iterations before the timing
    iterations: int = 20  # Iterations in a repetition
    repeats: int = 5  # Number of repetitions; the median is reported


def start(args: Args, seed: int) -> tuple[DeviceStream, Learner]:
    """Return the stream and the learner of one seed, ready for its first iteration."""
    recipe = Recipe.of(args.task)
    device = torch.device(wp.device_to_torch(wp.get_device(args.device)))
    stream = DeviceStream(device)
    with stream:
        env = recipe.make_env(args.num_envs, seed, device)
        torch.manual_seed(seed)
        learner = make_ppo(env, recipe.train.ppo)
        env.compile()
        learner.compile()
        env.reset()
    return stream, learner


def run_parts(members: list[tuple[DeviceStream, Learner]], names: tuple[str, ...]) -> float:
    """Run parts of an iteration of all seeds, and return the time until the device has finished [s]."""
    begin = time.perf_counter()
    for stream, learner in members:
        with stream:
            for name in names:
                getattr(learner, name)()
    wp.synchronize()
    return time.perf_counter() - begin


def time_seeds(args: Args, count: int) -> dict[str, float]:
    """Return the median times of an iteration of `count` seeds and of its parts [s], and the memory in use [GiB]."""
    members = [start(args, seed) for seed in range(1, count + 1)]
    for _ in range(args.warm_up):
        run_parts(members, PARTS)
    blocks = [[run_parts(members, PARTS) for _ in range(args.iterations)] for _ in range(args.repeats)]
    values = {f"iteration_{count}_s": statistics.median(statistics.fmean(block) for block in blocks)}
    parts = [[run_parts(members, (name,)) for name in PARTS] for _ in range(args.iterations)]
    values |= {f"{name}_{count}_s": statistics.median(times) for name, times in zip(PARTS, zip(*parts), strict=True)}
    if memory := device_memory(wp.get_device(args.device)):
        values[f"memory_{count}_gib"] = memory / 2**30
    for _, learner in members:
        learner.close()
    return values


def main(args: Args) -> dict:
    """Time the numbers of seeds in the flags, write and return the metrics."""
    info = configure_device(args.device, args.threads)
    folder = output_dir("benchmark_seeds", args.out)
    values: dict = {"device": info.name, "num_envs": args.num_envs}
    for count in args.seeds:
        values |= time_seeds(args, count)
        values[f"ratio_{count}"] = values[f"iteration_{count}_s"] / values[f"iteration_{args.seeds[0]}_s"]
    keys = [f"{name}_{count}{unit}" for count in args.seeds for name, unit in (("iteration", "_s"), ("ratio", ""))]
    return report(args, folder, values, f"Seeds of {args.num_envs:,} environments, {info.name}", keys)


if __name__ == "__main__":
    run_script(main, Args)
