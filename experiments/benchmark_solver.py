"""Measure how fast SolverJumper and SolverMuJoCo simulate the same robots, and write metrics.

    python experiments/benchmark_solver.py --envs 4096 --out outputs/benchmark

Speeds are policy steps per second of all environments together. A policy step is 8 physics steps of 1/480 s, motors
included. Both solvers replay a captured graph, of the simulation with standing and jumping robots, and of whole
environments in which the project's policy `vertical_jump` jumps. The outcome is checked before the timing: the robots
must stand, or reach their apex. `--threads 1 2` compares numbers of CPU threads, for physics and for whole
environments; all other metrics are measured with the last number.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import warp as wp

from jumper_warp.sim.simulation import SolverName
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir
from jumper_warp.utils.runtime import configure_device
from support.scripts import DeviceArgs, report, run_script
from support.speed import time_policy, time_solver, time_threads


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the benchmark of the physics solvers."""

    envs: list[int] = field(default_factory=lambda: [64])  # Numbers of environments, one run for each
    solvers: list[SolverName] = field(default_factory=lambda: ["jumper", "mujoco"])
    repeats: int = 5  # Number of timed repetitions; the median is reported
    steps: int = 100  # Number of policy steps in a repetition of the standing test
    iterations: int = 6  # Largest number of SolverMuJoCo's iterations in a physics step
    ls_iterations: int = 6  # Largest number of line searches in each of these iterations
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"  # SolverMuJoCo's friction cone
    refine: int = 1  # Factor on the number of SolverMuJoCo's physics steps
    policy: bool = True  # Whether to time environments too, with the default settings of SolverMuJoCo
    threads: list[int] | None = None  # Numbers of CPU threads to compare (default: all cores, nothing is compared)


def main(args: Args) -> dict:
    """Time the simulation of robots by both solvers, write and return the metrics.

    Raises InputError: threads compared on a GPU.
    """
    values: dict = {"device": configure_device(args.device, args.threads[-1] if args.threads else None).name}
    if args.threads and wp.get_device(args.device).is_cuda:
        raise InputError("threads are compared on a CPU; add --device cpu")
    folder = output_dir("benchmark_solver", args.out)
    sizes = args.steps, args.repeats, args.device, args.refine
    mujoco = {"iterations": args.iterations, "ls_iterations": args.ls_iterations, "cone": args.cone}
    for envs in args.envs:
        times = {solver: time_solver(solver, envs, *sizes, **mujoco) for solver in args.solvers}
        metrics = {f"{solver}_{name}": value for solver in times for name, value in times[solver].items()}
        for solver in args.solvers if args.policy else ():
            metrics[f"{solver}_steps_per_s_policy"] = envs / time_policy(envs, args.repeats, args.device, solver)
        phases = ("standing", "jump", "policy")[: 2 + args.policy]
        for phase in phases if len(times) == 2 else ():
            rates = (metrics[f"{solver}_steps_per_s_{phase}"] for solver in ("jumper", "mujoco"))
            metrics[f"ratio_{phase}"] = next(rates) / next(rates)
        if args.threads and len(args.threads) > 1:
            metrics |= time_threads(envs, args.threads, args.steps, args.repeats)
        prefix = "" if len(args.envs) == 1 else f"envs_{envs}_"
        values |= {f"{prefix}{name}": value for name, value in metrics.items()}
    values |= {"envs": args.envs, "refine": args.refine} | mujoco
    names = [f"{s}_steps_per_s_{phase}" for phase in ("standing", "jump", "policy") for s in args.solvers]
    ratios = ("ratio_standing", "ratio_jump", "ratio_policy")
    keys = [key for key in values if key.endswith((*names, *ratios, "thread_speedup"))]
    return report(args, folder, values, f"Policy steps per second, {values['device']}", keys)


if __name__ == "__main__":
    run_script(main, Args)
