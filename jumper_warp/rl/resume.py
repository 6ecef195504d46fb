"""Resuming of a training: choice of the checkpoint, changed settings, and state of random generators."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from jumper_warp.rl.cfg import LATEST, LATEST_OR_NEW, SESSION
from jumper_warp.rl.checkpoint import (
    DECODE_ERRORS,
    Checkpoint,
    CheckpointError,
    checkpoint_names,
    latest_checkpoint,
    load_checkpoint,
    newest_name,
)
from jumper_warp.rl.run_names import CHECKPOINTS, MANIFEST, SEED, newest, seed_folders
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.sources import changed_sources

if TYPE_CHECKING:
    from jumper_warp.rl.cfg import TrainCfg
    from jumper_warp.rl.distributed import Rank

FIXED = (
    "best-metric", "run-name", "ppo.init-std", "ppo.normalise-value", "env.motors.lateral.peak",
    "env.motors.transversal.peak", "robot.values.latency", "robot.values.motor-friction", "robot.values.paw-friction",
)  # fmt: skip
"""Settings that only the start of a training reads; scores of saved checkpoints are of its `best_metric`."""
RANGES = ("env.randomization.", "robot.randomization.")  # Begins of the names of ranges of robot parameters
REDRAWN = ("env.randomization.push", "env.randomization.resample-at", "env.randomization.type")
"""Begins of the names in RANGES that apply during a training in any case."""
FROZEN = "frozen.txt"  # File in the folder of a seed whose training ended early, with the reason
DERIVED = ("interface", "num_envs", "seed")  # Entries of an environment's configuration that follow from other settings


def find_checkpoints(cfg: TrainCfg) -> list[Checkpoint]:
    """Load and return the checkpoints that `TrainCfg.resume` selects: one, or one of each seed that was not frozen.

    Those of several seeds are of the same iteration. Empty: start a new run. Raises CheckpointError.
    """
    if not cfg.resume:
        return []
    path = Path(cfg.resume)
    if cfg.resume in (LATEST, LATEST_OR_NEW):
        runs = cfg.log_root / cfg.task
        found = runs.glob(f"*/{CHECKPOINTS}/{MANIFEST}"), runs.glob(f"*/{SEED}*/{CHECKPOINTS}/{MANIFEST}")
        run = newest([*(file.parents[1] for file in found[0]), *(file.parents[2] for file in found[1])])
        if run is None and cfg.resume == LATEST_OR_NEW:
            return []
        if run is None:
            raise CheckpointError(f"{runs}: no run to resume")
        path = run
    if folders := seed_folders(path):
        return _common_checkpoints(path, [folder for folder in folders.values() if not (folder / FROZEN).exists()])
    folder = path.parent if path.suffix == ".pt" else path if path.name == CHECKPOINTS else path / CHECKPOINTS
    if not (folder / MANIFEST).is_file():
        reason = "no run to resume" if path.exists() else "no such file or folder, no run to resume"
        raise CheckpointError(f"{path}: {reason}; pass a run's folder, one of its checkpoints, or latest")
    if path.suffix == ".pt":
        return [Checkpoint(path, load_checkpoint(path), [], newest_name(folder))]
    return [latest_checkpoint(folder)]


def _common_checkpoints(run: Path, folders: list[Path]) -> list[Checkpoint]:
    """Return the checkpoints of the last iteration that the folders of all seeds have. Raises CheckpointError."""
    names = [checkpoint_names(folder / CHECKPOINTS) for folder in folders]
    skipped: list[str] = []
    for name in sorted(set.intersection(*map(set, names)), reverse=True) if names else []:
        paths = [folder / CHECKPOINTS / name for folder in folders]
        try:
            states = [load_checkpoint(path) for path in paths]
        except CheckpointError as error:
            skipped.append(str(error))
            continue
        parts = zip(paths, states, names, strict=True)
        return [Checkpoint(path, state, skipped, saved[-1]) for path, state, saved in parts]
    raise CheckpointError("; ".join([f"{run}: its seeds have no usable checkpoint of the same iteration", *skipped]))


def check_unchanged(checkpoint: Checkpoint) -> None:
    """Raise CheckpointError if another process saved a checkpoint in the folder after `checkpoint` was loaded."""
    if newest_name(checkpoint.path.parent) != checkpoint.newest:
        raise CheckpointError(f"{checkpoint.path.parent}: another process has saved a checkpoint; resume again")


def rank_state(state: Json, rank: Rank) -> Json:
    """Return the state that one process (rank) restores from a checkpoint, with the entries `env`, `rng` and `ppo`.

    Raises InputError: another number of processes saved the checkpoint.
    """
    ranks = [state, *state["others"]]
    if len(ranks) != rank.size:
        raise InputError(f"saved by {len(ranks)} processes, resumed by {rank.size}")
    return ranks[rank.index]


def saved_init_policy(state: Json) -> str | None:
    """Return the policy from which a checkpoint's training started (setting `init_policy`); None: none or unknown."""
    try:
        settings = json.loads(state["config"])["train"]
        return str(settings["init_policy"]) if settings.get("init_policy") else None
    except DECODE_ERRORS:
        return None


def changed_settings(state: Json, config: Json) -> dict[str, str]:
    """Return the settings that differ between a checkpoint's configuration and `config`, as text `old -> new` by name.

    Empty if the checkpoint has no readable configuration.
    """
    try:
        old, new = flat_settings(json.loads(state["config"])), flat_settings(config)
    except DECODE_ERRORS:
        return {}
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


def changed_user_files(state: Json, config: Json) -> list[str]:
    """List the user files whose content changed after the checkpoint was saved, one line each."""
    try:
        return changed_sources(json.loads(state["config"])["sources"], config["sources"])
    except DECODE_ERRORS:
        return []


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


def random_state(generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Return the states of a learner's random generator and of torch's default ones, `cpu` and `cuda`.

    The learner's is `learner_cpu` or `learner_cuda`, by its device.
    """
    state = {"cpu": torch.get_rng_state(), f"learner_{generator.device.type}": generator.get_state()}
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state()
    return state


def set_random_state(state: dict[str, torch.Tensor], generator: torch.Generator) -> None:
    """Set a learner's random generator, and torch's default ones, to states from `random_state`.

    Checkpoints of earlier versions lack the learner's, which then was torch's default one of its device. States of
    another kind of device are not used.
    """
    kind = generator.device.type
    torch.set_rng_state(state["cpu"])
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"])
    if (learner := state.get(f"learner_{kind}", state.get(kind))) is not None:
        generator.set_state(learner)
