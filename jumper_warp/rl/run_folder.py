"""Folder of a training run: creation, configuration, dumps of non-finite values, replacement if files are deleted."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.distributed import Rank, all_reduce_max
from jumper_warp.rl.run_names import run_name
from jumper_warp.utils.dumps import DUMPS, NonFiniteValue, write_dump
from jumper_warp.utils.files import Json, write_atomically
from jumper_warp.utils.runtime import git_commit, versions
from jumper_warp.utils.sources import source_checksums

INTERRUPTED = 130  # Exit code of a training that a signal stopped
CONFIG = "config.json"  # File in a run's folder with all settings, versions and the commit
SOURCES = "sources"  # Folder in a run's folder that holds copies of the user's files


class TrainResult(NamedTuple):
    """Result of a training: the folder of the run, its length and last metrics."""

    folder: Path  # the run's folder
    iteration: int  # number of iterations, over all resumes
    seconds: float  # wall-clock time of this process's iterations [s], including the first
    metrics: dict[str, float]  # last logged metrics; of several seeds their means
    seeds: dict[int, TrainResult]  # results of the seeds of this process by seed; empty: one training


def new_folder(cfg: TrainCfg, rank: Rank) -> Path:
    """Create the folder of a new training run, see `run_name`, on rank 0, and return its path on all ranks."""
    (microseconds,) = all_reduce_max([time.time_ns() // 1000 if rank.index == 0 else 0])
    folder = cfg.log_root / cfg.task / run_name(microseconds, cfg.run_name)
    if rank.index == 0:
        folder.mkdir(parents=True)
    return folder


def full_config(cfg: TrainCfg, env: VecEnv, rank: Rank) -> Json:
    """Return the configuration of a training run as JSON data: settings, environment, versions, commit, user files."""
    settings = json.loads(json.dumps(dataclasses.asdict(cfg), default=str))
    commit, env_config = git_commit(), env.config()
    return {
        "train": settings,
        "env": env_config,
        "processes": rank.size,
        "device": str(rank.device),
        "versions": versions(),
        "commit": commit and commit._asdict(),
        "sources": source_checksums(env_config),
    }


def write_config(folder: Path, config: Json) -> None:
    """Write the configuration of a training run, and the user's files, to the run's folder, which exists.

    Raises OSError.
    """
    write_atomically(folder / CONFIG, json.dumps(config, indent=1).encode())
    for module in config["sources"]:
        source = Path(str(sys.modules[module].__file__))
        (folder / SOURCES).mkdir(exist_ok=True)
        write_atomically(folder / SOURCES / f"{module}.py", source.read_bytes())


def report_non_finite(
    env: VecEnv, folder: Path, config: Json, iteration: int, print_line: Callable[[str], None], rank: int = 0
) -> list[NonFiniteValue]:
    """For each task term that is non-finite for the first time, print a line and save a dump file; return their values.

    config: of the run; rank: index of this process. A dump that cannot be written is reported in the line.
    """
    found: list[NonFiniteValue] = getattr(env, "non_finite", list)()  # optional for a `VecEnv`
    for value in found:
        prefix = f"rank_{rank}_" if rank else ""
        name = re.sub(r"[^\w.-]", "_", value.term)
        path = folder / DUMPS / f"{prefix}{name}.npz"
        try:
            write_dump(path, value, iteration=iteration, task=config["train"]["task"], config=config)
            print_line(f"{value}; jumper play --dump {path}")
        except OSError as error:
            print_line(f"{value}; {path}: {error.strerror}")
    return found
