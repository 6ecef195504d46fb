"""Policies by name, folder or training run: the actor of a checkpoint, and the learning curve of its run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jumper_warp.envs.vec_env import RAW_LIMIT
from jumper_warp.policies.folder import load_policy
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError, make_interface
from jumper_warp.rl.checkpoint import (
    DECODE_ERRORS,
    CheckpointError,
    best_checkpoint,
    latest_checkpoint,
    load_checkpoint,
    one_line_message,
)
from jumper_warp.rl.mirror import Symmetry, expand_symmetric_layers, mirror_map
from jumper_warp.rl.networks import NORMALISED_LIMIT, VARIANCE_EPS
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.tasks.saving import TaskError, check_version

if TYPE_CHECKING:
    import torch

METRICS = "metrics.jsonl"
CURVE = (
    "iteration", "Perf/elapsed_s", "Train/mean_return", "Train/mean_length", "Metrics/success", "Metrics/score",
)  # fmt: skip
"""Columns of a learning curve that a policy's folder keeps."""
CURVE_ROWS = 60
"""Most rows of it, evenly spaced."""


def is_run(source: str | Path) -> bool:
    """Return whether this is a training run's folder or a checkpoint."""
    source = Path(source)
    return source.suffix == ".pt" or (source / CHECKPOINTS).is_dir()


def open_policy(source: str | Path, *, newest: bool = False) -> Policy:
    """Return a policy by name or folder, or that of a run's best (or newest) checkpoint or of a checkpoint.

    Raises PolicyError or CheckpointError: there is none, or it cannot be used.
    """
    if not is_run(source):
        return load_policy(source)
    path = Path(source)
    if path.suffix != ".pt" and newest:
        newest_checkpoint = latest_checkpoint(path / CHECKPOINTS)
        return _policy_of_checkpoint(newest_checkpoint.path, newest_checkpoint.state)
    path = path if path.suffix == ".pt" else best_checkpoint(path / CHECKPOINTS)
    return _policy_of_checkpoint(path, load_checkpoint(path))


def _policy_of_checkpoint(path: Path, state: dict[str, Any]) -> Policy:
    """Return the actor of a checkpoint with the interface that its configuration describes."""
    try:
        config = json.loads(state["config"])
        env, ppo = config["env"], config["train"]["ppo"]
        check_version(env["task"])
        model = state["ppo"]["model"]
        names = [key for key in model if key.startswith("actor.") and key.endswith(".weight")]
        names.sort(key=lambda key: int(key.split(".")[1]))
        layers = [(model[name], model[name.removesuffix("weight") + "bias"]) for name in names]
        mean = model["obs_moments.mean"].float()
        std = (model["obs_moments.var"] + VARIANCE_EPS).sqrt().float()
        times = {"policy_dt": env["policy_dt_s"], "physics_dt": env["physics_dt_s"]}
        shape = {"hidden": tuple(ppo["hidden"]), "activation": ppo["activation"]}
        if symmetry := _symmetry(model):
            layers, shape["hidden"] = (
                expand_symmetric_layers(layers, symmetry),
                tuple(2 * width for width in ppo["hidden"]),
            )
        commit = config.get("commit") or {"hash": None, "dirty": None}
        config |= {"commit": commit["hash"], "dirty": commit["dirty"], "iteration": state["iteration"]}
        described = {**env["interface"], "observation_limit": RAW_LIMIT, "normalised_limit": NORMALISED_LIMIT}
        return Policy(layers, mean, std, make_interface(described, **times, **shape), config)
    except TaskError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error
    except DECODE_ERRORS as error:
        said = f"not of a training of this project ({type(error).__name__}: {one_line_message(error)})"
        raise CheckpointError(f"{path}: {said}") from error


def _symmetry(model: dict[str, torch.Tensor]) -> Symmetry | None:
    """Return the symmetry of a checkpoint's actor, if it has one by its form."""
    if not any(name.startswith("mirror_") for name in model):
        return None
    parts = ((model[f"mirror_{name}_order"], model[f"mirror_{name}_signs"], name) for name in Symmetry._fields)
    return Symmetry(*(mirror_map(*part) for part in parts))


def learning_curve(source: Path) -> bytes | None:
    """Return the metrics of a run or of a checkpoint's run, one JSON object a line; None if there are none.

    They are those of CURVE, in at most CURVE_ROWS lines, the first and the last among them.
    """
    run = source.parents[1] if source.suffix == ".pt" else source
    path = run / METRICS
    return thinned_curve(path.read_bytes()) if path.is_file() else None


def thinned_curve(logged: bytes) -> bytes:
    """Return what a policy's folder keeps of logged metrics; a line that is not whole is left out."""
    rows = [row for line in logged.splitlines() if (row := _row(line))]
    last = len(rows) - 1
    kept = rows if last < CURVE_ROWS else [rows[round(i * last / (CURVE_ROWS - 1))] for i in range(CURVE_ROWS)]
    return "".join(f"{json.dumps(row)}\n" for row in kept).encode()


def _row(line: bytes) -> dict[str, Any]:
    try:
        row = json.loads(line)
        return {name: row[name] for name in CURVE if name in row}
    except (ValueError, TypeError):
        return {}
