"""Training of the arms of a comparison or a sweep, which continues after an interruption."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from jumper_warp.compare.arms import OF_A_SEED, Member, differences
from jumper_warp.recipe import Recipe
from jumper_warp.rl.metrics_file import last_metrics
from jumper_warp.rl.run_folder import flat_settings
from jumper_warp.rl.run_names import CHECKPOINTS, FROZEN, MANIFEST, newest, seed_folders, title
from jumper_warp.rl.runner import Observer
from jumper_warp.training import train
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.sources import source_checksums


def train_arm(recipe: Recipe, observers: Sequence[Observer] = ()) -> Path:
    """Train the seeds of a recipe and return the run's folder; a run of the same `run_name` is continued.

    observers: see `jumper_warp.training.train`. Raises InputError: that run has other settings, or a user's file
    of the task has changed.
    """
    cfg = recipe.train
    runs = (run for run in (cfg.log_root / cfg.task).glob("*/") if title(run) == (cfg.run_name or "").replace(" ", "-"))
    run = newest(run for run in runs if any(run.glob(f"*/{CHECKPOINTS}/{MANIFEST}")))
    if run is None:
        return train(recipe, observers=observers).folder
    seeds = seed_folders(run)
    if set(seeds) != set(cfg.seeds):
        trained = ", ".join(map(str, seeds))
        raise InputError(f"{run} was trained with seeds {trained}: remove it, or choose another log root")
    folders = [folder for folder in seeds.values() if not (folder / FROZEN).exists()]
    if not folders:
        raise InputError(f"{run}: the training of every seed has failed, see {FROZEN} there: remove it")
    saved, config = Member(folders[0]), recipe.to_json()
    requested = {name: value for name, value in flat_settings(config).items() if name not in OF_A_SEED}
    requested |= source_checksums(config["env"])
    saved = saved.settings | saved.config.get("sources", {})
    if changed := differences([requested, {name: saved.get(name) for name in requested}]):
        raise InputError(f"{run} was trained with another {next(iter(changed))}: remove it, or choose another log root")
    if all(last_metrics(folder).get("iteration", 0) >= cfg.max_iterations for folder in folders):
        return run
    resumed = dataclasses.replace(recipe, train=dataclasses.replace(cfg, resume=str(run)))
    return train(resumed, observers=observers).folder
