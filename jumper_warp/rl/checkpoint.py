"""Checkpoint files: atomic writes, SHA-256 checksums, loading without executing code, choice of one to resume."""

from __future__ import annotations

import hashlib
import io
import json
import math
import statistics
from pathlib import Path
from typing import Any, NamedTuple

import torch

from jumper_warp.rl.cfg import LATEST, LATEST_OR_NEW, TrainCfg
from jumper_warp.rl.run_names import CHECKPOINTS, FROZEN, MANIFEST, SEED, newest, seed_folders
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, existing_file, read_file, read_json, write_atomically

PURPOSE = "checkpoint of a training"
MAX_BYTES = 8 * 2**30  # Size of the largest checkpoint that is read
DECODE_ERRORS = (LookupError, TypeError, ValueError, AttributeError, RuntimeError, ArithmeticError)
"""Exceptions raised on reading a part of a checkpoint that is missing or of another type."""


class CheckpointError(InputError):
    """Error: a training checkpoint cannot be used. The message is one line."""


class Checkpoint(NamedTuple):
    """Loaded training checkpoint: its path and contents, and the reasons why newer ones cannot be used."""

    path: Path
    state: Json  # contents, see `save_checkpoint`
    skipped: list[str]  # reasons why newer checkpoints cannot be used, one line each
    newest: str  # file name of the newest checkpoint in the folder when this one was loaded

    @property
    def seed(self) -> int | None:
        """Seed of the checkpoint, of a run of several seeds; None: of a single training."""
        name = self.path.parents[1].name
        return int(name.removeprefix(SEED)) if name.startswith(SEED) else None


def on_cpu(state: Json) -> Json:
    """Return a copy of nested dicts with copies of their tensors on the CPU."""
    return {
        name: on_cpu(value) if isinstance(value, dict) else value.to("cpu", copy=True) for name, value in state.items()
    }


def save_checkpoint(folder: Path, state: Json, score: float | None = None, max_checkpoints: int = 3) -> Path:
    """Save a training's state as the file `iteration_XXXXXX.pt`, remove old checkpoints, and return the new path.

    folder: created if missing. state: tensors, numbers and strings, with the keys iteration, ppo, env, rng and config.
    score: higher is better, NaN counts as None; the best checkpoint is never removed. max_checkpoints: number of newest
    checkpoints to keep, at least 1. Checkpoints of later iterations are removed: the training was resumed before them.
    Raises OSError: the disk is full or the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    torch.save(state, buffer)
    data = buffer.getvalue()
    path = folder / f"iteration_{state['iteration']:06d}.pt"
    manifest = _read_manifest(folder, missing_ok=True)
    digest = hashlib.sha256(data).hexdigest()
    if path.name in manifest:  # if the process is killed, the old or the new file is valid
        manifest[path.name]["updating"] = digest
        write_atomically(folder / MANIFEST, json.dumps(manifest, indent=1).encode())
    write_atomically(path, data)
    manifest.pop(path.name, None)  # the order of entries is the order of saving
    manifest[path.name] = {"sha256": digest, "iteration": state["iteration"], "score": score}
    branch = {name: entry for name, entry in manifest.items() if entry.get("iteration", 0) <= state["iteration"]}
    kept = [*list(branch)[-max_checkpoints:], _best(branch)]
    removed = [name for name in manifest if name not in kept]
    for name in removed:
        del manifest[name]
    write_atomically(folder / MANIFEST, json.dumps(manifest, indent=1).encode())
    for name in removed:
        (folder / name).unlink(missing_ok=True)
    return path


def load_checkpoint(path: Path) -> Json:
    """Return the training state in a checkpoint file of this package, with all tensors on the CPU.

    Raises CheckpointError: the file is missing, damaged, without checksum, or no checkpoint.
    """
    path = existing_file(path, PURPOSE, MAX_BYTES, CheckpointError)
    entry = _read_manifest(path.parent).get(path.name)
    if entry is None:
        raise CheckpointError(f"{path}: has no checksum in {MANIFEST}")
    data = read_file(path, PURPOSE, MAX_BYTES, CheckpointError)
    if hashlib.sha256(data).hexdigest() not in (entry["sha256"], entry.get("updating")):
        raise CheckpointError(f"{path}: differs from its checksum in {MANIFEST}")
    return _decoded(path, data)


def load_foreign_checkpoint(path: Path) -> Any:
    """Return the tensors, numbers and text in a checkpoint file of another program, such as rsl-rl, on the CPU.

    Raises CheckpointError: the file cannot be read, or holds something else.
    """
    return _decoded(path, read_file(path, PURPOSE, MAX_BYTES, CheckpointError))


def _decoded(path: Path, data: bytes) -> Any:
    """Decode a checkpoint file's bytes; return its tensors, numbers and text, on the CPU. Raises CheckpointError."""
    try:
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged pickle raises anything
        raise CheckpointError(f"{path}: not readable as tensors: {one_line_message(error)}") from error


def one_line_message(error: Exception) -> str:
    """Return an error's message as one line of at most 300 characters, or its type's name if the message is empty."""
    return " ".join(str(error).split())[:300] or type(error).__name__


def latest_checkpoint(folder: Path) -> Checkpoint:
    """Load and return the most recently saved usable checkpoint of a folder. Raises CheckpointError: there is none."""
    folder = Path(folder)
    manifest = _read_manifest(folder)
    skipped: list[str] = []
    for name in reversed(manifest):
        try:
            return Checkpoint(folder / name, load_checkpoint(folder / name), skipped, list(manifest)[-1])
        except CheckpointError as error:
            skipped.append(str(error))
    raise CheckpointError("; ".join([f"{folder}: no usable checkpoint", *skipped]))


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


def checkpoint_names(folder: Path) -> list[str]:
    """Return the file names of a folder's checkpoints, even if damaged, in the order of saving.

    Raises CheckpointError: there is none.
    """
    if not (manifest := _read_manifest(folder)):
        raise CheckpointError(f"{folder}: no checkpoint")
    return list(manifest)


def newest_name(folder: Path) -> str:
    """Return the file name of a folder's last saved checkpoint, even if damaged. Raises as `checkpoint_names`."""
    return checkpoint_names(folder)[-1]


def best_checkpoint(folder: Path) -> Path:
    """Return the path of a folder's checkpoint with the highest score; on a tie or without scores, the last saved one.

    Raises CheckpointError: there is none.
    """
    folder = Path(folder)
    return folder / (_best(_read_manifest(folder)) or newest_name(folder))


def seed_of(run: Path, seed: int | None) -> Path:
    """Return the folder of a seed of a run, by default of the median seed by the score of its best checkpoint.

    A seed without a score counts as the worst.
    Raises CheckpointError: there is no such seed with a checkpoint, or a manifest is unreadable.
    """
    folders = {name: path for name, path in seed_folders(run).items() if any((path / CHECKPOINTS).glob("*.pt"))}
    if seed is None and folders:
        manifests = {path: _read_manifest(path / CHECKPOINTS) for path in folders.values()}
        scores = {path: each.get(_best(each) or "", {"score": -math.inf})["score"] for path, each in manifests.items()}
        return next(path for path, score in scores.items() if score == statistics.median_low(scores.values()))
    if seed is None or seed not in folders:
        known = ", ".join(map(str, folders)) or "none"
        raise CheckpointError(f"{run}: no checkpoint of seed {seed}; seeds with checkpoints: {known}")
    return folders[seed]


def _best(manifest: dict[str, Json]) -> str | None:
    """Return the file name of a manifest's last checkpoint with the highest finite score; None without scores."""
    scores = {name: entry["score"] for name, entry in manifest.items() if entry["score"] is not None}
    scored = [name for name in reversed(scores) if math.isfinite(scores[name])]
    return max(scored, key=scores.__getitem__, default=None)


def _read_manifest(folder: Path, missing_ok: bool = False) -> dict[str, Json]:
    """Return the manifest of a folder of checkpoints: entries by file name, in the order of saving.

    Raises CheckpointError: it is unreadable.
    """
    path = folder / MANIFEST
    if missing_ok and not path.exists():
        return {}
    manifest = read_json(path, "checksums of checkpoints", error=CheckpointError, finite=False)  # scores may be NaN
    if not isinstance(manifest, dict) or not all(map(_is_entry, manifest.values())):
        raise CheckpointError(f"{path}: not readable")
    return manifest


def _is_entry(entry: Any) -> bool:
    """Return whether a value can be an entry of a manifest: an object with a checksum and a score."""
    return isinstance(entry, dict) and "sha256" in entry and isinstance(entry.get("score", ""), float | int | None)
