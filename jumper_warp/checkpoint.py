"""Checkpoints that are written whole, carry a checksum, and are read without executing anything."""

from __future__ import annotations

import hashlib
import io
import json
import os
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

MANIFEST = "manifest.json"
"""Beside the checkpoints: SHA-256, iteration and score of each."""
REQUIRED = ("iteration", "ppo", "env", "rng", "config")
"""What every checkpoint holds."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be used, said in one line."""


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that whoever looks finds either the old content or the new, also after a power cut.

    Raises:
        OSError: The disk is full or the folder cannot be written; `filename` is the path.
    """
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        error.filename = str(path)
        raise
    finally:
        part.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def save_checkpoint(folder: Path, state: dict[str, Any], score: float | None = None, keep: int = 3) -> Path:
    """Save tensors, numbers and strings as `iteration_XXXXXX.pt`, and return its path.

    Args:
        folder: Made if need be.
        state: Has at least the keys of REQUIRED.
        score: The higher, the better; the best checkpoint is never removed.
        keep: How many of the newest stay, at least 1.

    Raises:
        OSError: The disk is full or the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    torch.save(state, buffer)
    data = buffer.getvalue()
    path = folder / f"iteration_{state['iteration']:06d}.pt"
    write_whole(path, data)
    manifest = _read_manifest(folder, missing_ok=True)
    manifest[path.name] = {
        "sha256": hashlib.sha256(data).hexdigest(),
        "iteration": state["iteration"],
        "score": score,
    }
    newest = sorted(manifest, key=lambda name: manifest[name]["iteration"])[-keep:]
    best = _best(manifest)
    old = [name for name in manifest if name not in newest and name != best]
    for name in old:
        del manifest[name]
    write_whole(folder / MANIFEST, json.dumps(manifest, indent=1).encode())
    for name in old:
        (folder / name).unlink(missing_ok=True)
    return path


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Return what was saved, on the CPU.

    Raises:
        CheckpointError: The file is missing, has no checksum, differs from it, or is no checkpoint.
    """
    entry = _read_manifest(path.parent).get(path.name)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such checkpoint")
    if entry is None:
        raise CheckpointError(f"{path}: has no checksum in {MANIFEST}")
    data = path.read_bytes()
    if hashlib.sha256(data).hexdigest() != entry["sha256"]:
        raise CheckpointError(f"{path}: differs from its checksum in {MANIFEST}")
    try:
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, ValueError, KeyError, UnpicklingError) as error:
        raise CheckpointError(f"{path}: not readable as tensors: {str(error).splitlines()[0]}") from error
    missing = [key for key in REQUIRED if not isinstance(state, dict) or key not in state]
    if missing:
        raise CheckpointError(f"{path}: lacks {', '.join(missing)}")
    return state


def latest_checkpoint(folder: Path) -> tuple[Path, dict[str, Any], list[str]]:
    """Return path and content of the newest usable checkpoint, and why each newer one was passed over.

    Raises:
        CheckpointError: None is usable.
    """
    manifest = _read_manifest(folder)
    refusals: list[str] = []
    for name in sorted(manifest, key=lambda name: manifest[name]["iteration"], reverse=True):
        try:
            return folder / name, load_checkpoint(folder / name), refusals
        except CheckpointError as error:
            refusals.append(str(error))
    raise CheckpointError("; ".join([f"{folder}: no usable checkpoint", *refusals]))


def best_checkpoint(folder: Path) -> Path:
    """Return the path of the checkpoint with the highest score, or of the newest if none has one.

    Raises:
        CheckpointError: There is none.
    """
    manifest = _read_manifest(folder)
    if not manifest:
        raise CheckpointError(f"{folder}: no checkpoint")
    return folder / (_best(manifest) or max(manifest, key=lambda name: manifest[name]["iteration"]))


def _best(manifest: dict[str, dict[str, Any]]) -> str | None:
    scored = [name for name, entry in manifest.items() if entry["score"] is not None]
    return max(scored, key=lambda name: manifest[name]["score"], default=None)


def _read_manifest(folder: Path, missing_ok: bool = False) -> dict[str, dict[str, Any]]:
    path = folder / MANIFEST
    if missing_ok and not path.exists():
        return {}
    try:
        manifest = json.loads(path.read_text())
        complete = all({"sha256", "iteration", "score"} <= entry.keys() for entry in manifest.values())
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror}") from error
    except (ValueError, AttributeError) as error:
        raise CheckpointError(f"{path}: not readable") from error
    if not complete:
        raise CheckpointError(f"{path}: not readable")
    return manifest
