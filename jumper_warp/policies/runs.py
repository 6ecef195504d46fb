"""Loading of policies by name, folder, run or checkpoint, and the learning curve of a run."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from jumper_warp.envs.vec_env import RAW_LIMIT
from jumper_warp.policies.catalog import newest_run
from jumper_warp.policies.folder import read_policy
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError, make_interface
from jumper_warp.rl import checkpoint as checkpoints
from jumper_warp.rl.checkpoint import DECODE_ERRORS, CheckpointError, load_foreign_checkpoint, one_line_message
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.mirror import Symmetry, Weights, expand_layers, mirror_map
from jumper_warp.rl.networks import NORMALISED_LIMIT, VARIANCE_EPS
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.rl.run_folder import CONFIG
from jumper_warp.tasks.saving import TaskError, check_version
from jumper_warp.utils.files import parse_json, read_file, read_json

CURVE = (
    "iteration", "Perf/elapsed_s", "Train/mean_reward", "Train/mean_episode_length", "Metrics/success", "Metrics/score",
)  # fmt: skip
"""Columns of a saved learning curve."""
RSL_RL = re.compile(r"model_(\d+)\.pt")  # Names of rsl-rl's checkpoints, with the iteration
RSL_RL_EPS = 0.01  # rsl-rl adds this to the standard deviation of observations
RSL_RL_LIMIT = 1.0e6  # Bound of normalised observations, which rsl-rl does not clip
CURVE_ROWS = 60  # Maximum number of rows of a saved learning curve, evenly spaced


def is_run(source: str | Path) -> bool:
    """Return whether `source` is a training run's folder or a checkpoint."""
    source = Path(source)
    return source.suffix == ".pt" or (source / CHECKPOINTS).is_dir() or bool(_rsl_rl_checkpoints(source))


def run_folder(source: Path) -> Path:
    """Return the folder of the training run that a checkpoint (.pt) belongs to; any other path unchanged."""
    if source.suffix != ".pt":
        return source
    return source.parent if RSL_RL.fullmatch(source.name) else source.parents[1]


def _rsl_rl_checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints in a log folder of rsl-rl, by iteration."""
    found = {int(match[1]): path for path in folder.glob("model_*.pt") if (match := RSL_RL.fullmatch(path.name))}
    return [found[iteration] for iteration in sorted(found)]


def load_policy(name: str | Path, device: str | torch.device = "cpu") -> Policy:
    """Load a policy by name, folder or checkpoint to a device, and return it; name and errors: as `open_policy`."""
    return open_policy(name).to(device)


def open_policy(source: str | Path, *, newest: bool = False) -> Policy:
    """Load a policy; source: name or folder of a policy, path of a checkpoint, or folder of a training run.

    A task's log folder, `logs/TASK`, stands for its newest run with a checkpoint.
    newest: whether to use the newest checkpoint of a run, not the best; of rsl-rl's runs it is always the newest.
    rsl-rl's checkpoints `model_N.pt` need a `config.json` beside them, see `RslRlVecEnv.write_config`.
    Raises PolicyError or CheckpointError: there is no such policy, or it cannot be used.
    """
    source = newest_run(source)
    if not is_run(source):
        return read_policy(source)
    path = Path(source)
    if path.suffix != ".pt" and (theirs := _rsl_rl_checkpoints(path)):
        path = theirs[-1]
    if RSL_RL.fullmatch(path.name):
        return _policy_of_rsl_rl(path)
    if path.suffix != ".pt" and newest:
        checkpoint = checkpoints.latest_checkpoint(path / CHECKPOINTS)
        return _policy_of_checkpoint(checkpoint.path, partial(CheckpointContents.from_dict, checkpoint.state))
    path = path if path.suffix == ".pt" else checkpoints.best_checkpoint(path / CHECKPOINTS)
    return _policy_of_checkpoint(path, partial(CheckpointContents.from_dict, checkpoints.load_checkpoint(path)))


@dataclass(frozen=True)
class CheckpointContents:
    """Policy data in a training checkpoint: configuration, interface, weights and observation statistics."""

    config: dict[str, Any]  # configuration of the policy: of the run, with commit, dirty and iteration
    interface: dict[str, Any]  # result of `jumper_warp.tasks.interface.interface`: observation, joints, filter
    policy_dt: float  # [s]
    physics_dt: float  # [s]
    activation: str  # elu, relu or tanh
    hidden: tuple[int, ...]  # widths of the hidden layers of `layers`
    layers: Weights  # weight (out, in) and bias (out,) of each layer of the actor as a plain network
    mean: torch.Tensor  # (num_obs,) mean of raw observations
    std: torch.Tensor  # (num_obs,) standard deviation that observations are divided by
    limit: float = NORMALISED_LIMIT  # normalised observations are clamped to ± this

    @classmethod
    def from_rsl_rl(cls, state: Any, config: Any) -> CheckpointContents:
        """Read the policy data in a loaded checkpoint of rsl-rl.

        config: `env`, as `Env.config`, and perhaps `train`.
        Raises TaskError: the task has another version. CheckpointError: a part is missing or of another type.
        """
        try:
            env, actor = config["env"], state["actor_state_dict"]
            check_version(env["task"])
            layers = _actor_layers(actor, "mlp.")
            mean, std = torch.zeros(layers[0][0].shape[1]), torch.ones(layers[0][0].shape[1])
            if "obs_normalizer._mean" in actor:
                mean = _tensor(actor, "obs_normalizer._mean")[0]
                std = _tensor(actor, "obs_normalizer._std")[0] + RSL_RL_EPS
            activation = config.get("train", {}).get("ppo", {}).get("activation", "elu")
            return cls(
                _with_source(config, int(state["iter"])), dict(env["interface"]), env["policy_dt_s"],
                env["physics_dt_s"], activation, tuple(len(bias) for _, bias in layers[:-1]),
                layers, mean, std, RSL_RL_LIMIT,
            )  # fmt: skip
        except TaskError:
            raise
        except DECODE_ERRORS as error:
            reason = f"{type(error).__name__}: {one_line_message(error)}"
            raise CheckpointError(f"not of rsl-rl 5 on an environment of this project ({reason})") from error

    @classmethod
    def from_dict(cls, state: dict[str, Any]) -> CheckpointContents:
        """Read the policy data in a loaded checkpoint of this package.

        Raises TaskError: its task has another version. CheckpointError: a part is missing or of another type.
        """
        try:
            config = parse_json(state["config"], "config")
            env, ppo = config["env"], config["train"]["ppo"]
            check_version(env["task"])
            model = state["ppo"]["model"]
            layers, hidden = _actor_layers(model), tuple(ppo["hidden"])
            if symmetry := _symmetry(model):
                layers, hidden = expand_layers(layers, symmetry), tuple(2 * width for width in hidden)
            mean, var = _tensor(model, "obs_moments.mean"), _tensor(model, "obs_moments.var")
            return cls(
                _with_source(config, state["iteration"]), dict(env["interface"]), env["policy_dt_s"],
                env["physics_dt_s"], ppo["activation"], hidden, layers, mean.float(),
                (var + VARIANCE_EPS).sqrt().float(),
            )  # fmt: skip
        except TaskError:
            raise
        except DECODE_ERRORS as error:
            reason = f"{type(error).__name__}: {one_line_message(error)}"
            raise CheckpointError(f"not a training checkpoint of this project ({reason})") from error

    def policy(self) -> Policy:
        """Build the policy from the checkpoint's data.

        Raises PolicyError: interface, layers and statistics contradict each other.
        """
        description = {**self.interface, "observation_limit": RAW_LIMIT, "normalised_limit": self.limit}
        network = {"hidden": self.hidden, "activation": self.activation}
        interface = make_interface(description, policy_dt=self.policy_dt, physics_dt=self.physics_dt, **network)
        return Policy(self.layers, self.mean, self.std, interface, self.config)


def _with_source(config: dict[str, Any], iteration: int) -> dict[str, Any]:
    """Return a run's configuration with code version (`commit`, `dirty`) and `iteration` as a policy saves them."""
    commit = config.get("commit") or {"hash": None, "dirty": None}
    return {**config, "commit": commit["hash"], "dirty": commit["dirty"], "iteration": iteration}


def _policy_of_rsl_rl(path: Path) -> Policy:
    """Load the policy in a checkpoint file of rsl-rl. Raises PolicyError or CheckpointError, with its path."""
    file = path.parent / CONFIG
    if not file.exists():
        raise CheckpointError(f"{path}: needs {CONFIG} beside it, see RslRlVecEnv.write_config")
    config = read_json(file, "settings of a run", error=CheckpointError)
    return _policy_of_checkpoint(path, partial(CheckpointContents.from_rsl_rl, load_foreign_checkpoint(path), config))


def _policy_of_checkpoint(path: Path, read: Callable[[], CheckpointContents]) -> Policy:
    """Build the policy from a checkpoint's contents. Raises PolicyError or CheckpointError, with its path."""
    try:
        return read().policy()
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error
    except (TaskError, CheckpointError) as error:
        raise CheckpointError(f"{path}: {error}") from error


def _tensor(model: dict[str, Any], name: str) -> torch.Tensor:
    """Return a dense tensor of a model's state_dict by name. Raises LookupError or TypeError: there is none."""
    tensor = model[name]
    if not isinstance(tensor, torch.Tensor) or tensor.layout != torch.strided:
        raise TypeError(f"{name} must be a dense tensor, got {type(tensor).__name__}")
    return tensor


def _actor_layers(model: dict[str, Any], prefix: str = "actor.") -> Weights:
    """Return weight (out, in) and bias (out,) of the actor's layers, first to last, from a model's state_dict."""
    names = [key for key in model if key.startswith(prefix) and key.endswith(".weight")]
    names.sort(key=lambda key: int(key.split(".")[1]))
    return [(_tensor(model, name), _tensor(model, name.removesuffix("weight") + "bias")) for name in names]


def _symmetry(model: dict[str, torch.Tensor]) -> Symmetry | None:
    """Return the left-right mirror maps of a symmetric actor from a model's state_dict; None for a plain network."""
    if not any(name.startswith("mirror_") for name in model):
        return None
    parts = ((model[f"mirror_{name}_order"], model[f"mirror_{name}_signs"], name) for name in Symmetry._fields)
    return Symmetry(*(mirror_map(*part) for part in parts))


def learning_curve(source: Path) -> bytes | None:
    """Return the thinned learning curve of a run, or of a checkpoint's run; None without a metrics file."""
    path = run_folder(source) / METRICS_FILE
    return thinned_curve(read_file(path, "metrics of a run")) if path.is_file() else None


def thinned_curve(metrics: bytes) -> bytes:
    """Reduce a metrics file to a short learning curve: columns CURVE, at most CURVE_ROWS lines of JSON.

    The lines are evenly spaced. The first and the last line are included, malformed lines are omitted.
    """
    rows = [row for line in metrics.splitlines() if (row := _curve_row(line))]
    last = len(rows) - 1
    kept = rows if last < CURVE_ROWS else [rows[round(i * last / (CURVE_ROWS - 1))] for i in range(CURVE_ROWS)]
    return "".join(f"{json.dumps(row)}\n" for row in kept).encode()


def _curve_row(line: bytes) -> dict[str, Any]:
    """Return the learning curve's values (keys CURVE) in one line of metrics; empty for a malformed line."""
    try:
        row = parse_json(line, "metrics")
        return {name: row[name] for name in CURVE if name in row}
    except (ValueError, TypeError):
        return {}
