"""Going on with a training: which checkpoint, and the random numbers where they were left."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from jumper_warp.checkpoint import CheckpointError, latest_checkpoint, load_checkpoint

if TYPE_CHECKING:
    from jumper_warp.train import TrainCfg

CHECKPOINTS = "checkpoints"
"""Folder of a run that holds its checkpoints."""


def find_checkpoint(cfg: TrainCfg) -> tuple[Path, dict[str, Any], list[str]]:
    """Return path and content of the checkpoint to resume, and why newer ones were passed over.

    Raises:
        CheckpointError: There is none that can be used.
    """
    if cfg.resume == "latest":
        runs = cfg.log_root / cfg.task
        folders = sorted(path.parent for path in runs.glob(f"*/{CHECKPOINTS}/manifest.json"))
        if not folders:
            raise CheckpointError(f"{runs}: no run to resume")
        return latest_checkpoint(folders[-1])
    path = Path(cfg.resume or "")
    if path.suffix == ".pt":
        return path, load_checkpoint(path), []
    return latest_checkpoint(path if path.name == CHECKPOINTS else path / CHECKPOINTS)


def random_state() -> dict[str, torch.Tensor]:
    """Return the states of torch's generators."""
    state = {"cpu": torch.get_rng_state()}
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state()
    return state


def set_random_state(state: dict[str, torch.Tensor]) -> None:
    """Take up what `random_state` gave; a GPU's only where there is one."""
    torch.set_rng_state(state["cpu"])
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"])
