"""How soon the vertical jump is learnt, nominal: success over wall time and over steps, for seeds and trainer variants.

    python experiments/learning_curves.py --seconds 60 --seeds 0 1 2 --variants default compiled_bfloat16
    python experiments/learning_curves.py --device cpu --envs 2048 --history 1 --variants small --heights 0.5 0.9 \
        --seconds 450 --every 30                                        # two cores of a CPU

Each training is a process of its own, from nothing, one after the other. Every few seconds, off the clock, its policy
makes the same jumps to heights of 0.5 to 1.1 m from standing. Two times are told to 95 % of success, and to all jumps:
of training alone, which begins when all kernels and functions are compiled, and from the start of the process. Variants
are those of `support.variants`; what a second process finds in the caches on disk it does not compile
again.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import tyro
import warp as wp
from rich.console import Console
from rich.table import Table

from jumper_warp.cli.main import run_command
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.plots import drawn
from jumper_warp.registry import make_task, trainer_settings
from jumper_warp.rl.ppo import Ppo
from jumper_warp.tasks.observations import with_history
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import announce
from support.learning import TESTED, Curve, learning_curve, make_judge, success, warm_up
from support.variants import DEFAULT, variant

TASK = "vertical-jump"
GOOD = 0.95
"""Success rate whose time is reported."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    seconds: float = 60.0
    """[s] Time of each training, its evaluations not counted."""
    every: float = 2.0
    """[s] Training time between two evaluations."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of weights, noise and worlds."""
    variants: tuple[str, ...] = (DEFAULT,)
    """Of the trainer."""
    envs: int = 8192
    """Number of environments."""
    jumps: int = 200
    """Jumps of an evaluation."""
    heights: tuple[float, float] = TESTED
    """[m] Lowest and highest of them."""
    history: int | None = None
    """Policy steps that the policy sees, as `jumper train --history` (default: as the task says)."""
    randomize: bool = False
    """Train with randomisation and noise."""
    out: Path | None = None
    """Folder for metrics.json, plot and table (default: outputs/learning_curves/<time>)."""
    device: str | None = None
    """Warp device."""
    one: Path | None = field(default=None)
    """Train the first variant with the first seed in this process, and write its curve to this file."""

    def __post_init__(self) -> None:
        """Check the values."""
        for name in self.variants:
            variant(trainer_settings(TASK), name)
        if not self.variants or not self.seeds or min(self.seeds) < 0:
            raise InputError("at least one variant and one seed of 0 or more are needed")
        if self.seconds <= 0.0 or self.every <= 0.0:
            raise InputError(f"seconds and every must be positive, got {self.seconds} and {self.every}")


def process_age() -> float:
    """Return the seconds since this process was started, by the system's clock."""
    ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")


def train_one(args: Args) -> dict:
    """Train once, and return curve and the seconds from the start of the process until training began."""
    wp.config.log_level = wp.LOG_WARNING
    task = with_history(make_task(TASK), args.history)
    torch.manual_seed(args.seeds[0])
    env = Env(task, args.envs, seed=args.seeds[0], device=args.device, randomize=args.randomize, noise=args.randomize)
    ppo = Ppo(env, variant(trainer_settings(TASK), args.variants[0]))
    warm_up(env, ppo)
    ready = process_age()
    judge = make_judge(task, args.jumps, args.device)
    success(ppo, judge)
    curve = learning_curve(env, ppo, judge, args.seconds, args.every, args.heights)
    return {"ready": ready, "seconds": curve.seconds, "steps": curve.steps, "success": curve.success}


def in_process(args: Args, name: str, seed: int, path: Path) -> dict:
    """Train a variant with a seed in a process of its own, and return what `train_one` found."""
    flags = ["--seconds", args.seconds, "--every", args.every, "--envs", args.envs, "--jumps", args.jumps]
    flags += ["--seeds", seed, "--variants", name, "--one", path, "--heights", *args.heights]
    flags += [] if args.history is None else ["--history", args.history]
    flags += ["--randomize" if args.randomize else "--no-randomize"]
    flags += ["--device", args.device] if args.device else []
    done = subprocess.run([sys.executable, __file__, *map(str, flags)], check=False)
    if done.returncode:
        raise InputError(f"training {name} with seed {seed} failed")
    return json.loads(path.read_text())


def plot(found: dict[tuple[str, int], dict], path: Path) -> None:
    """Draw success over training time and over steps, one line a training, one colour a variant."""
    colours = {name: f"C{i}" for i, name in enumerate(dict.fromkeys(name for name, _ in found))}
    with drawn(path, 1, 2, figsize=(11, 4.5), sharey=True) as axes:
        for (name, seed), each in found.items():
            label = name.replace("_", " ") if seed == next(s for n, s in found if n == name) else None
            for axis, x in zip(axes, (each["seconds"], np.divide(each["steps"], 1.0e6)), strict=True):
                axis.plot([0.0, *x], [0.0, *(100.0 * s for s in each["success"])], color=colours[name], label=label)
        axes[0].set(xlabel="training time [s]", ylabel="success [%]", ylim=(0.0, 102.0))
        axes[1].set(xlabel="steps [million]")
        for axis in axes:
            axis.grid(alpha=0.3)
        axes[0].legend(loc="lower right")


def main(args: Args) -> dict:
    """Train every variant with every seed and return the figures."""
    if args.one is not None:
        values = train_one(args)
        args.one.write_text(json.dumps(values))
        return values
    announce(args.device)
    folder = output_dir("learning_curves", args.out)
    columns = ("to 95 %: trained [s]", "from start [s]", "million steps", "to 100 %: trained [s]")
    table = Table("variant", "seed", "success", "ready [s]", *columns)
    values: dict = {"seconds": args.seconds, "envs": args.envs, "randomize": args.randomize, "seeds": list(args.seeds)}
    values |= {"heights_m": list(args.heights), "history": args.history}
    found: dict[tuple[str, int], dict] = {}
    for name in args.variants:
        for seed in args.seeds:
            each = found[name, seed] = in_process(args, name, seed, folder / f"curve_{name}_{seed}.json")
            curve = Curve(each["seconds"], each["success"])
            trained, every_one = curve.seconds_to(GOOD), curve.seconds_to(1.0)
            steps = None if trained is None else each["steps"][each["seconds"].index(trained)]
            total = None if trained is None else trained + each["ready"]
            values |= {
                f"success_{name}_{seed}": each["success"][-1],
                f"ready_s_{name}_{seed}": each["ready"],
                f"trained_to_95_percent_s_{name}_{seed}": trained,
                f"from_start_to_95_percent_s_{name}_{seed}": total,
                f"steps_to_95_percent_{name}_{seed}": steps,
                f"trained_to_100_percent_s_{name}_{seed}": every_one,
                **{f"curve_{key}_{name}_{seed}": each[key] for key in ("seconds", "steps", "success")},
            }
            told = [trained, total, steps and steps / 1e6, every_one]
            cells = ["never" if x is None else f"{x:.1f}" for x in told]
            table.add_row(name, str(seed), f"{100 * each['success'][-1]:.1f} %", f"{each['ready']:.1f}", *cells)
            write_metrics(folder, values)
            plot(found, folder / "learning_curves.png")
    Console().print(table)
    with (folder / "learning_curves.txt").open("w") as file:
        Console(file=file, width=120).print(table)
    print(f"figures, plot and table in {folder}")
    return values


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Args)))
