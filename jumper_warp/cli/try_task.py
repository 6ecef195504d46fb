"""`jumper try FILE.py`: train a changed task and its base briefly, and print reward terms and metrics side by side."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import tyro

from jumper_warp.cli.flags import parse
from jumper_warp.rl.cfg import TrainCfg

SECONDS = 10.0  # [s] Training time of each of the two trainings on a GPU
SHARE = 8  # Divisor of a preset's iterations on a CPU
NUM_ENVS = 512  # Worlds of each seed on a CPU
DEFAULT = "--no-randomize --no-noise --history 1 --ppo.hidden 128 64 64 --max-iterations 200"
"""Flags of a training on a CPU of a task without a preset."""


@dataclass(frozen=True)
class TryCfg:
    """Train a changed task and its base briefly, and print their reward terms and metrics side by side.

    On a CPU: an eighth of the preset laptop's iterations; on a GPU 10 s of training each. That is too short to show
    which task is better: `jumper compare` does.
    """

    task: tyro.conf.Positional[str]  # Changed task: a FILE.py that registers one task, FILE.py:TASK, or a name
    base: str = ""  # Task to compare with (default: the most similar one of the project)
    seeds: tuple[int, ...] = (1, 2, 3, 4)  # Seeds, trained side by side
    max_iterations: int | None = None  # Iterations of each training (default: see above)
    num_envs: int | None = None  # Worlds of each seed (default: 512 on a CPU, the task's on a GPU)
    device: str | None = None  # PyTorch device (default: a GPU if there is one)
    out: Path | None = None  # Folder for runs and picture (default: outputs/try/<time>)


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper try` with the given arguments; modules: loaded by --task-module. Raises InputError: no such task."""
    cfg: TryCfg = parse(TryCfg, "try", args)
    from jumper_warp.cli.train import parse_train
    from jumper_warp.compare.comparison import compare
    from jumper_warp.compare.report import plot, print_side_by_side
    from jumper_warp.compare.tasks import base_of, task_of
    from jumper_warp.compare.training import train_arm
    from jumper_warp.registry import TASKS, find_task
    from jumper_warp.rl.cfg import PpoCfg
    from jumper_warp.utils.output import output_dir
    from jumper_warp.utils.runtime import configure_device

    task = task_of(cfg.task)
    base, entry = find_task(cfg.base or base_of(task))
    cpu = configure_device(cfg.device).driver is None
    folder = output_dir("try", cfg.out)
    flags = [*short_flags(entry.presets.get("laptop", DEFAULT), cfg, cpu), "--log-root", str(folder)]
    recipe = parse_train([base, *flags, "--run-name", "base"])[0]
    changed = parse_train([task.name, *flags, "--run-name", "change"])[0]
    if TASKS[task.name].ppo == PpoCfg():  # the file names no settings of PPO: those of the base apply
        train = dataclasses.replace(changed.train, ppo=recipe.train.ppo, best_metric=recipe.train.best_metric)
        changed = dataclasses.replace(changed, train=train)
    runs = [f"{each.train.run_name}={train_arm(each)}" for each in (recipe, changed)]
    comparison = compare(*runs, evaluate=False, title=f"{task.name} (change) and {base} (base), short trainings")
    plot(comparison, folder / "try.png", verdict=False)
    print_side_by_side(comparison)
    print(folder / "try.png")


def short_flags(preset: str, cfg: TryCfg, cpu: bool) -> list[str]:
    """Return the flags of `jumper train` for a short training; preset: flags of a long one on a CPU."""
    seeds = ["--seeds", *map(str, cfg.seeds), "--log-interval", "1", "--no-tensorboard"]
    seeds += [] if cfg.device is None else ["--device", cfg.device]
    iterations = [] if cfg.max_iterations is None else ["--max-iterations", str(cfg.max_iterations)]
    worlds = [] if cfg.num_envs is None else ["--num-envs", str(cfg.num_envs)]
    if not cpu:
        return [*seeds, *(iterations or ["--max-seconds", str(SECONDS)]), *worlds]
    words = shlex.split(preset)
    if "--max-iterations" not in words:
        words += ["--max-iterations", str(TrainCfg.max_iterations)]
    place = words.index("--max-iterations")
    short = ["--max-iterations", str(int(words[place + 1]) // SHARE)]
    worlds = worlds or ["--num-envs", str(NUM_ENVS)]
    return [*words[:place], *words[place + 2 :], *(iterations or short), *worlds, *seeds]
