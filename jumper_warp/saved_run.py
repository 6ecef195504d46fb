"""Reading back what a policy or a training run was made with: its task, its environment, its weights.

Configurations are data: numbers, names and structure are taken from the file, functions only from the project's tasks.
"""

from __future__ import annotations

import dataclasses
import json
import math
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_type_hints

import warp as wp

from jumper_warp.checkpoint import (
    DAMAGE,
    CheckpointError,
    best_checkpoint,
    latest_checkpoint,
    load_checkpoint,
    one_line,
)
from jumper_warp.networks import EPS, NORMALISED_LIMIT, RAW_LIMIT
from jumper_warp.policy import Policy, load_policy
from jumper_warp.policy_interface import PolicyError, interface_of_task
from jumper_warp.tasks import make_task
from jumper_warp.tasks.task import Rule, TaskCfg, Term
from kernels import rewards, terminations

if TYPE_CHECKING:
    from jumper_warp.env import JumpEnv

CHECKPOINTS = "checkpoints"
METRICS = "metrics.jsonl"


@dataclass(frozen=True)
class Conditions:
    """What a policy is tried in."""

    solver: Literal["jumper", "mujoco"] = "jumper"
    """Physics: the dedicated solver, or Newton's SolverMuJoCo."""
    randomize: bool = False
    """Draw masses, friction, motors, latency and pushes as in training."""
    noise: bool = False
    """Add the training's observation noise."""
    seed: int = 0
    """Of randomisation and noise."""
    device: str | None = None
    """Warp device (default: a GPU if there is one)."""


def is_run(source: str | Path) -> bool:
    """Return whether this is a training run's folder or a checkpoint."""
    source = Path(source)
    return source.suffix == ".pt" or (source / CHECKPOINTS).is_dir()


def open_policy(source: str | Path, *, newest: bool = False) -> Policy:
    """Return a policy by name or folder, or that of a run's best (or newest) checkpoint or of a checkpoint.

    Raises:
        PolicyError: There is none, or it cannot be used.
        CheckpointError: The checkpoint cannot be used.
    """
    if not is_run(source):
        return load_policy(source)
    source = Path(source)
    if source.suffix == ".pt":
        return _policy_of_checkpoint(source, load_checkpoint(source))
    folder = source / CHECKPOINTS
    if newest:
        path, state, _ = latest_checkpoint(folder)
        return _policy_of_checkpoint(path, state)
    path = best_checkpoint(folder)
    return _policy_of_checkpoint(path, load_checkpoint(path))


def _policy_of_checkpoint(path: Path, state: dict[str, Any]) -> Policy:
    """Return the actor of a checkpoint with the interface that its configuration describes."""
    try:
        config = json.loads(state["config"])
        env, ppo = config["env"], config["train"]["ppo"]
        model = state["ppo"]["model"]
        names = [key for key in model if key.startswith("actor.") and key.endswith(".weight")]
        names.sort(key=lambda key: int(key.split(".")[1]))
        layers = [(model[name], model[name.removesuffix("weight") + "bias"]) for name in names]
        mean = model["obs_moments.mean"].float()
        std = (model["obs_moments.var"] + EPS).sqrt().float()
        times = {"policy_dt": env["policy_dt_s"], "physics_dt": env["physics_dt_s"]}
        shape = {"hidden": tuple(ppo["hidden"]), "activation": ppo["activation"]}
        commit = config.get("commit") or {"hash": None, "dirty": None}
        config |= {"commit": commit["hash"], "dirty": commit["dirty"], "iteration": state["iteration"]}
    except DAMAGE as error:
        raise _no_training(path, error) from error
    try:
        interface = interface_of_task(restored_task(config), **times, **shape)
        interface = dataclasses.replace(interface, observation_limit=RAW_LIMIT, normalised_limit=NORMALISED_LIMIT)
        return Policy(layers, mean, std, interface, config)
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error
    except DAMAGE as error:
        raise _no_training(path, error) from error


def _no_training(path: Path, error: Exception) -> CheckpointError:
    return CheckpointError(f"{path}: not of a training of this project ({type(error).__name__}: {one_line(error)})")


def learning_curve(source: Path) -> bytes | None:
    """Return the logged figures of a run or of a checkpoint's run, one JSON object a line; None if there are none."""
    run = source.parents[1] if source.suffix == ".pt" else source
    path = run / METRICS
    return path.read_bytes() if path.is_file() else None


def env_of_policy(
    policy: Policy,
    num_envs: int,
    conditions: Conditions,
    *,
    change: Callable[[TaskCfg], TaskCfg] | None = None,
    **scene: Any,
) -> JumpEnv:
    """Return the environment that a policy was trained in, with other conditions.

    Args:
        policy: Its configuration tells the task.
        num_envs: Number of worlds.
        conditions: Physics, randomisation and noise.
        change: Returns the task that is wanted instead.
        scene: More settings of `JumpEnv`, such as its ground.

    Raises:
        PolicyError: This version of the project cannot rebuild it, or its observation is not the policy's.
    """
    from jumper_warp.env import JumpEnv

    task = restored_task(policy.config)
    if task.observation_names != policy.interface.observation_names:
        raise PolicyError("the policy's observation is not the one that this version of its task gives")
    return JumpEnv(
        task if change is None else change(task),
        num_envs,
        seed=conditions.seed,
        device=conditions.device,
        solver=conditions.solver,
        randomize=conditions.randomize,
        noise=conditions.noise,
        auto_reset=False,
        **scene,
    )


def restored_task(config: dict[str, Any]) -> TaskCfg:
    """Return the task of a saved configuration, from its entry `env` (`JumpEnv.config`).

    Settings that the file lacks have the defaults of their class: what they did before they existed. Reward terms that
    the project does not have are left out, as a policy does not need them; anything else unknown is refused.

    Raises:
        PolicyError: The configuration is not of a task of the project.
    """
    try:
        saved = dict(config["env"]["task"])
        default = make_task(saved["name"])
        saved["terms"] = [term for term in saved["terms"] if _on(rewards, term["func"])]
    except (KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"no task in the configuration ({type(error).__name__}: {error})") from error
    try:
        return _restored(default, saved, "task")
    except PolicyError:
        raise
    except (ValueError, TypeError) as error:
        raise PolicyError(f"task in the configuration: {error}") from error


def _restored(default: Any, saved: Any, where: str) -> Any:
    """Return a value of the default's structure with the saved numbers and names."""
    if isinstance(default, wp.Function):
        if saved != default.key:
            raise PolicyError(f"{where}: this version has {default.key}, the configuration {saved!r:.60}")
        return default
    if dataclasses.is_dataclass(default):
        return _restored_fields(default, saved, where)
    if isinstance(default, tuple):
        return _restored_tuple(default, saved, where)
    kinds = (float, int) if isinstance(default, float) else type(default)
    if isinstance(saved, bool) != isinstance(default, bool) or not isinstance(saved, kinds):
        raise PolicyError(f"{where}: expected {type(default).__name__}, got {saved!r:.60}")
    if isinstance(default, float) and not math.isfinite(saved):
        raise PolicyError(f"{where}: must be finite, got {saved}")
    return type(default)(saved)


def _restored_fields(default: Any, saved: Any, where: str) -> Any:
    if not isinstance(saved, dict):
        raise PolicyError(f"{where}: expected settings by name, got {saved!r:.60}")
    names = [spec.name for spec in dataclasses.fields(default)]
    unknown = sorted(set(saved) - set(names))
    if unknown:
        raise PolicyError(f"{where}: unknown setting {unknown[0]!r:.60}")
    hints = get_type_hints(type(default))
    changes = {}
    for spec in dataclasses.fields(default):
        if spec.name not in saved and spec.default_factory is not dataclasses.MISSING:
            changes[spec.name] = spec.default_factory()
        elif spec.name not in saved and spec.default is not dataclasses.MISSING:
            changes[spec.name] = spec.default
    for name, value in saved.items():
        if value is None and types.NoneType in get_args(hints[name]):
            changes[name] = None
        else:
            changes[name] = _restored(getattr(default, name), value, f"{where}.{name}")
    return dataclasses.replace(default, **changes)


def _restored_tuple(default: tuple, saved: Any, where: str) -> tuple:
    """Return a tuple of rows (of as many as were saved), or of numbers or names."""
    if not isinstance(saved, list):
        raise PolicyError(f"{where}: expected a list, got {saved!r:.60}")
    if default and dataclasses.is_dataclass(default[0]):
        return tuple(
            _restored(_row(default, row, f"{where}[{i}]"), row, f"{where}[{i}]") for i, row in enumerate(saved)
        )
    if where.endswith((".params", ".hidden")):
        kind = 0 if where.endswith(".hidden") else 0.0
        return tuple(_restored(kind, value, where) for value in saved)
    if len(saved) != len(default):
        raise PolicyError(f"{where}: expected {len(default)} entries, got {len(saved)}")
    return tuple(_restored(d, value, f"{where}[{i}]") for i, (d, value) in enumerate(zip(default, saved, strict=True)))


def _on(shelf: types.ModuleType, name: Any) -> wp.Function | None:
    """Return the Warp function of a name that a module defines."""
    func = getattr(shelf, name, None) if isinstance(name, str) else None
    return func if isinstance(func, wp.Function) and func.func.__module__ == shelf.__name__ else None


def _row(rows: tuple, saved: Any, where: str) -> Any:
    """Return the default row that a saved row builds on: the one with the same function, if rows have functions.

    A function that the task does not use is looked up among the project's rewards or terminations.
    """
    if not hasattr(rows[0], "func"):
        return rows[0]
    key = saved.get("func") if isinstance(saved, dict) else None
    for row in rows:
        if row.func.key == key:
            return row
    if isinstance(rows[0], Term) and _on(rewards, key):
        return Term(_on(rewards, key), 0.0)
    if isinstance(rows[0], Rule) and _on(terminations, key):
        return Rule(_on(terminations, key))
    raise PolicyError(f"{where}: this version has no {key!r:.60}")
