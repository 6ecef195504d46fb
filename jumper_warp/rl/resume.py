"""Resuming of a training from a checkpoint: changed settings, state of a process and of random generators."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import torch

from jumper_warp.rl.cfg import SESSION
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json

if TYPE_CHECKING:
    from jumper_warp.rl.distributed import Rank

FIXED = (
    "best-metric", "run-name", "ppo.init-std", "ppo.normalise-value", "env.motors.lateral.peak",
    "env.motors.transversal.peak", "robot.values.latency", "robot.values.motor-friction", "robot.values.paw-friction",
)  # fmt: skip
"""Settings that only the start of a training reads; scores of saved checkpoints are of its `best_metric`."""
RANGES = ("env.randomization.", "robot.randomization.")  # Begins of the names of ranges of robot parameters
REDRAWN = ("env.randomization.push", "env.randomization.resample-at", "env.randomization.type")
"""Begins of the names in RANGES that apply during a training in any case."""
DERIVED = ("interface", "num_envs", "seed")  # Entries of an environment's configuration that follow from other settings


def rank_state(state: Json, rank: Rank) -> Json:
    """Return the state that one process (rank) restores from a checkpoint, with the entries `env`, `rng` and `ppo`.

    Raises InputError: another number of processes saved the checkpoint.
    """
    ranks = [state, *state["others"]]
    if len(ranks) != rank.size:
        raise InputError(f"saved by {len(ranks)} processes, resumed by {rank.size}")
    return ranks[rank.index]


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

    States of another kind of device are not used.
    """
    torch.set_rng_state(state["cpu"])
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"])
    if (learner := state.get(f"learner_{generator.device.type}")) is not None:
        generator.set_state(learner)
