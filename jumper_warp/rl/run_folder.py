"""Folder of a training run: creation, configuration and its changes on resuming, dumps of non-finite values."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import SESSION, TrainCfg
from jumper_warp.rl.distributed import Rank, all_reduce_max
from jumper_warp.rl.run_names import run_name
from jumper_warp.utils.dumps import DUMPS, NonFiniteValue, write_dump
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, write_atomically
from jumper_warp.utils.runtime import git_commit, versions
from jumper_warp.utils.sources import source_checksums

INTERRUPTED = 130  # Exit code of a training that a signal stopped
CONFIG = "config.json"  # File in a run's folder with all settings, versions and the commit
SOURCES = "sources"  # Folder in a run's folder that holds copies of the user's files
FIXED = (
    "best-metric", "run-name", "ppo.init-std", "ppo.normalise-value", "env.motors.lateral.peak",
    "env.motors.transversal.peak", "robot.values.latency", "robot.values.motor-friction", "robot.values.paw-friction",
)  # fmt: skip
"""Settings that only the start of a training reads; scores of saved checkpoints are of its `best_metric`."""
RANGES = ("env.randomization.", "robot.randomization.")  # Begins of the names of ranges of robot parameters
REDRAWN = ("env.randomization.push", "env.randomization.resample-at", "env.randomization.type")
"""Begins of the names in RANGES that apply during a training in any case."""
DERIVED = ("interface", "num_envs", "seed")  # Entries of an environment's configuration that follow from other settings


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


def changed_settings(saved: Json, config: Json) -> dict[str, str]:
    """Return the settings that differ between two configurations of a run, as text `old -> new` by name."""
    old, new = flat_settings(saved), flat_settings(config)
    changed = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    return {name: f"{old.get(name)!s:.80} -> {new.get(name)!s:.80}" for name in changed}


def check_changes(changed: Iterable[str], config: Json) -> None:
    """Raise InputError if a changed setting is read at the start of a training only, and so would have no effect.

    Such settings are FIXED and, of robots that are nominal or sampled at startup, ranges and startup events.
    """
    env, fixed = config["env"], set(FIXED)
    task = env.get("task", {})
    if not env.get("randomize") or task.get("randomization", {}).get("resample_at") == "startup":
        fixed |= {name for name in changed if name.startswith(RANGES) and not name.startswith(REDRAWN)}
    startup = tuple(f"env.events.{event['name']}." for event in task.get("events", ()) if event["mode"] == "startup")
    fixed |= {name for name in changed if name.startswith(startup)}
    if names := [name for name in changed if name in fixed]:
        raise InputError(f"{', '.join(names)} cannot change after the start of a training")


def flat_settings(config: Json) -> Json:
    """Return the settings in a run's configuration as a flat dict by flag name, without leading dashes."""
    train = {name: value for name, value in config["train"].items() if name not in (*SESSION, "task")}
    env = {name: value for name, value in config["env"].items() if name not in (*DERIVED, "task")}
    task = dict(config["env"].get("task", {}))
    reset = dict(task.get("reset", {}))
    settings = reset.pop("settings", None) or {}  # their flags omit this level
    task["reset"] = reset | settings
    return _flat(train) | _flat(env) | _flat(task, "env")


def _flat(value: Any, name: str = "") -> Json:
    """Flatten nested dicts: return their leaves by dotted name, such as `ppo.num-steps`.

    Entries of lists are named by their key `name`.
    """
    if isinstance(value, list) and any(isinstance(part, dict) for part in value):
        value = {part.get("name", str(i)): part for i, part in enumerate(value)}
    if not isinstance(value, dict):
        return {name: value}
    parts = [_flat(part, f"{name}.{key}".strip(".").replace("_", "-")) for key, part in value.items()]
    return {key: leaf for part in parts for key, leaf in part.items()}


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
