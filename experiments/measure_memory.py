"""Measure how much memory each world of a training takes, and write metrics.

    python experiments/measure_memory.py --solver mujoco

`building` is the main memory while the environment is built, `standing` the size of its arrays on the device. Both are
slopes between two numbers of worlds, each measured in a separate process. `jumper_warp.cli.training_memory` uses the
results as constants.
"""

from __future__ import annotations

import gc
import json
import resource
import subprocess
import sys
from dataclasses import dataclass

import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task
from jumper_warp.sim.simulation import SolverName
from jumper_warp.utils.output import output_dir
from jumper_warp.utils.runtime import configure_device
from support.scripts import OutputArgs, report, run_script


@dataclass(frozen=True)
class Args(OutputArgs):
    """Flags of the measurement of a training's memory."""

    solver: SolverName = "jumper"  # Physics solver
    task: str = "vertical-jump"  # Name of the task
    envs: tuple[int, ...] = (256, 2048)  # Numbers of worlds; a single one is measured in this process


def array_bytes() -> int:
    """Return the total size [byte] of all live Warp arrays that own their memory."""
    gc.collect()
    arrays = [obj for obj in gc.get_objects() if type(obj) is wp.array and obj.ptr and obj.deleter is not None]
    return sum({array.ptr: array.capacity for array in arrays}.values())


def measure(args: Args) -> dict[str, float]:
    """Build an environment of `args.envs[0]` worlds on the CPU, and return its memory [byte].

    `building`: peak main memory of the process; `standing`: size of all arrays, which are the same on a GPU.
    """
    env = Env(make_task(args.task), args.envs[0], device="cpu", solver=args.solver)
    env.reset()
    return {"building": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, "standing": array_bytes()}


def main(args: Args) -> dict[str, float]:
    """Measure the memory of each world of a training [byte], and return it as metrics.

    Keys: `building_` and `standing_bytes_per_world`; for a single number of worlds, those of `measure`.
    """
    configure_device("cpu")
    if len(args.envs) == 1:
        values = measure(args)
        print(json.dumps(values))
        return values
    few, many = min(args.envs), max(args.envs)
    common = [sys.executable, __file__, "--solver", args.solver, "--task", args.task, "--envs"]
    runs = [subprocess.run([*common, str(n)], capture_output=True, text=True, check=True) for n in (few, many)]
    less, more = (json.loads(run.stdout.splitlines()[-1]) for run in runs)
    values = {f"{name}_bytes_per_world": (more[name] - less[name]) / (many - few) for name in less}
    saved, folder = {**values, "solver": args.solver, "task": args.task}, output_dir("measure_memory", args.out)
    return report(args, folder, saved, f"Memory per world of {args.task} on {args.solver}", values)


if __name__ == "__main__":
    run_script(main, Args)
