"""Trained policies: actor networks with their observation normalisers; loading and saving.

`Policy.load` reads the project's policies, folders, checkpoints and runs; `save_policy` writes a folder. Sections: the
class; training runs; saving.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import nn

from jumper_warp.envs.vec_env import RAW_LIMIT
from jumper_warp.policies import catalog
from jumper_warp.policies.onnx import check_tensors, onnx_bytes, tensors_from_onnx
from jumper_warp.policies.spec import PolicyError, PolicyInterface, checksum_entry, make_interface
from jumper_warp.recipe import Recipe
from jumper_warp.rl import checkpoint as checkpoints
from jumper_warp.rl.checkpoint import DECODE_ERRORS, CheckpointError, one_line_message
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.mirror import Weights, expand_layers, symmetries_in
from jumper_warp.rl.networks import ACTIVATIONS, NORMALISED_LIMIT, VARIANCE_EPS, linear_layers
from jumper_warp.rl.run_names import CHECKPOINTS
from jumper_warp.tasks import saving
from jumper_warp.tasks.saving import TaskError
from jumper_warp.utils.checks import check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, directory_lock, json_bytes, parse_json, read_file, read_json, write_atomically
from jumper_warp.utils.normalise import normalise
from jumper_warp.utils.runtime import source_versions

FILE_SUFFIXES = (".pt", ".pth", ".onnx", ".safetensors")  # Suffixes that a policy's folder may not have
RSL_RL_EPS = 0.01  # rsl-rl adds this to the standard deviation of observations
RSL_RL_LIMIT = 1.0e6  # Bound of normalised observations, which rsl-rl does not clip
CURVE = (
    "iteration", "Perf/elapsed_s", "Train/mean_reward", "Train/mean_episode_length", "Metrics/success", "Metrics/score"
)  # fmt: skip
"""Columns of a saved learning curve."""
CURVE_ROWS = 60  # Maximum number of rows of a saved learning curve, evenly spaced


class _Linear(nn.Linear):
    """Linear layer without initial weights: `nn.utils.skip_init` avoids them too, but imports SymPy."""

    def reset_parameters(self) -> None:
        """Skip the initialisation of weights, and leave the random streams unchanged."""


class Policy(nn.Module):
    """Actor network with its observation normaliser; `act` maps raw observations to actions. Inherits `to(device)`."""

    mean: torch.Tensor  # (num_obs,) mean of raw observations
    std: torch.Tensor  # (num_obs,) standard deviation that observations are divided by

    def __init__(
        self,
        layers: Weights,
        mean: torch.Tensor,
        std: torch.Tensor,
        interface: PolicyInterface,
        config: Mapping[str, Any] | None = None,
    ) -> None:
        """Create a policy from copies of the tensors, as float32.

        layers: weight (out, in) and bias (out,) of each layer. mean, std: (num_obs,) of raw observations. interface:
        layout of observation and action, and network sizes. config: JSON configuration of environment and training.
        Raises PolicyError: a tensor does not have the interface's shape, is not finite, or is so large that an action
        could overflow; or std is not positive.
        """
        super().__init__()
        self.interface = interface
        self.source: str | Path = ""  # Name, folder, run or checkpoint from which the policy was loaded
        self.checkpoint: Path | None = None  # File of a training run from which the policy was loaded
        self.config = dict(config or {})
        tensors = {name: tensor.detach().float().cpu().clone() for name, tensor in _named(layers, mean, std).items()}
        check_tensors(tensors, interface)
        self.register_buffer("mean", tensors["normaliser.mean"])
        self.register_buffer("std", tensors["normaliser.std"])
        self.actor = nn.Sequential()
        for i in range(len(layers)):
            weight = tensors[f"actor.{i}.weight"]
            linear = _Linear(weight.shape[1], weight.shape[0], device="cpu")
            linear.weight.data = weight
            linear.bias.data = tensors[f"actor.{i}.bias"]
            self.actor.append(linear)
            if i < len(layers) - 1:
                self.actor.append(ACTIVATIONS[interface.activation]())
        self.requires_grad_(False)

    @classmethod
    def load(cls, source: str | Path, *, newest: bool = False) -> Policy:
        """Load a policy; source: name or folder of a policy, path of a checkpoint, or folder of a training run.

        A task's log folder, `logs/TASK`, stands for its newest run with a checkpoint.
        newest: whether to use the newest checkpoint of a run, not the best; of rsl-rl's runs it is always the newest.
        rsl-rl's checkpoints `model_N.pt` need a `config.json` beside them, see `RslRlVecEnv.write_config`.
        Raises PolicyError or CheckpointError: there is no such policy, or it cannot be used.
        """
        source, config, weights = catalog.open_source(source)
        policy = _policy_of_folder(source, config, weights) if config else _policy_of_run(Path(source), newest)
        policy.source = source
        return policy

    def recipe(self, modules: Iterable[ModuleType] = ()) -> Recipe:
        """Return the recipe of the policy's training, from its configuration; see `Recipe.from_json`.

        modules: the user's, in which functions from outside the project are looked up.
        Raises TaskError: the configuration has no recipe of this version; PolicyError: its observation is another one.
        """
        recipe = Recipe.from_json(self.config, modules, complete=False)
        if recipe.task.observation_names != self.interface.observation_names:
            raise PolicyError("the policy's observation differs from that of its task in this version")
        return recipe

    @property
    def layers(self) -> Weights:
        """Weight (out, in) and bias (out,) of each layer of the actor network."""
        return linear_layers(self.actor)

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return all tensors on the CPU, by name: normaliser.mean, normaliser.std, actor.N.weight, actor.N.bias."""
        named = _named(self.layers, self.mean, self.std)
        return {name: tensor.detach().cpu().contiguous() for name, tensor in named.items()}

    @torch.no_grad()
    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the mean action clipped to ±1, (..., num_actions) float32, for raw observations.

        Entries of an observation that are not finite count as 0. There is no host synchronisation.
        obs: (..., num_obs) tensor on the policy's device, of any numeric type.
        Raises InputError, a ValueError: obs is not a tensor, or its last axis does not have num_obs entries.
        """
        if not isinstance(obs, torch.Tensor):
            raise InputError(f"the observation must be a torch tensor, got {type(obs).__name__}: use torch.as_tensor")
        if not obs.dim() or obs.shape[-1] != len(self.mean):
            got = obs.shape[-1] if obs.dim() else "a scalar"
            raise InputError(f"the observation must have {len(self.mean)} columns, got {got}")
        limit = self.interface.observation_limit
        finite = torch.nan_to_num(obs, nan=0.0, posinf=0.0, neginf=0.0).clamp(-limit, limit).to(self.mean.dtype)
        limit = self.interface.normalised_limit
        return self.actor(normalise(finite, self.mean, self.std, limit)).clamp(-1.0, 1.0)


def load_policy(name: str | Path, device: str | torch.device = "cpu") -> Policy:
    """Load a policy by name, folder or checkpoint to a device, and return it; name and errors: as `Policy.load`.

    Raises InputError: there is no such device.
    """
    policy = Policy.load(name)
    try:
        return policy.to(torch.device(device))
    except (RuntimeError, TypeError, AssertionError) as error:  # AssertionError: torch has no CUDA
        raise InputError(f"no device {device!r:.60} ({one_line_message(error):.100})") from error


def _named(layers: Weights, mean: torch.Tensor, std: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the tensors of a policy by the names of `Policy.tensors`."""
    tensors = {"normaliser.mean": mean, "normaliser.std": std}
    for i, (weight, bias) in enumerate(layers):
        tensors |= {f"actor.{i}.weight": weight, f"actor.{i}.bias": bias}
    return tensors


def _policy_of_folder(source: str | Path, config: Json, weights: bytes) -> Policy:
    """Return the policy of a folder's configuration and ONNX file. Raises PolicyError: they do not fit each other.

    source: name or folder, for messages.
    """
    try:
        spec = PolicyInterface.from_json(config.get("interface"))
        tensors = tensors_from_onnx(weights, spec, config)
    except PolicyError as error:
        raise PolicyError(f"{source}: {error}") from error
    layers = [(tensors[f"actor.{i}.weight"], tensors[f"actor.{i}.bias"]) for i in range(len(spec.sizes) - 1)]
    return Policy(layers, tensors["normaliser.mean"], tensors["normaliser.std"], spec, config)


# ---------------------------------------------------------------------- training runs


def _policy_of_run(source: Path, newest: bool) -> Policy:
    """Load the policy of a checkpoint or of a run's folder; arguments and errors: see `Policy.load`."""
    foreign = {
        int(match[1]): path for path in source.glob("model_*.pt") if (match := catalog.RSL_RL.fullmatch(path.name))
    }
    path = foreign[max(foreign)] if foreign else source
    read = _policy_of_checkpoint
    if catalog.RSL_RL.fullmatch(path.name):
        file = path.with_name(catalog.CONFIG)
        if not file.exists():
            raise CheckpointError(f"{path}: needs {catalog.CONFIG} beside it, see RslRlVecEnv.write_config")
        config = read_json(file, "settings of a run", error=CheckpointError)
        state = {"config": config, "saved": checkpoints.load_foreign_checkpoint(path)}
        read = _policy_of_rsl_rl
    elif path.suffix != ".pt" and newest:
        path, state, skipped, _ = checkpoints.latest_checkpoint(path / CHECKPOINTS)
        for reason in skipped:
            print(f"skipped: {reason}", file=sys.stderr)
    else:
        path = path if path.suffix == ".pt" else checkpoints.best_checkpoint(path / CHECKPOINTS)
        state = checkpoints.load_checkpoint(path)
    try:
        policy = read(state)
        policy.checkpoint = path
        return policy
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from error
    except TaskError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except DECODE_ERRORS as error:
        reason = f"{type(error).__name__}: {one_line_message(error)}"
        raise CheckpointError(f"{path}: not a training checkpoint of this project ({reason})") from error


def _policy_of_rsl_rl(state: Json) -> Policy:
    """Return the policy in a checkpoint of rsl-rl 5, `saved`, with the `config` (`env`, perhaps `train`) beside it.

    Its normaliser adds RSL_RL_EPS to the standard deviation; without one, observations stay raw.
    """
    config = state["config"]
    saved = state["saved"]
    actor = saved["actor_state_dict"]
    layers = _actor_layers(actor, "mlp.")
    mean = torch.zeros(layers[0][0].shape[1])
    std = torch.ones_like(mean)
    if "obs_normalizer._mean" in actor:
        mean = actor["obs_normalizer._mean"][0]
        std = actor["obs_normalizer._std"][0] + RSL_RL_EPS
    activation = config.get("train", {}).get("ppo", {}).get("activation", "elu")
    return _policy_of_weights(config, int(saved["iter"]), layers, mean, std, activation, RSL_RL_LIMIT)


def _policy_of_checkpoint(state: Json) -> Policy:
    """Return the policy in a checkpoint of this package; a mirror-symmetric actor becomes a plain network.

    state: `config`, the run's settings as JSON text; `iteration`; `ppo`, whose `model` is the state_dict of networks
    and running moments. Only a symmetric actor has the buffers `mirror_<name>_order` and `mirror_<name>_signs`; name:
    obs or action. Raises PolicyError and TaskError as `_policy_of_weights`. Raises one of DECODE_ERRORS: an entry is
    missing or of another type; `_policy_of_run` converts it to a CheckpointError.
    """
    config = parse_json(state["config"], "config")
    model = state["ppo"]["model"]
    layers = _actor_layers(model, "actor.")
    layers = expand_layers(layers, symmetries_in(model))
    mean = model["obs_moments.mean"].float()
    std = (model["obs_moments.var"] + VARIANCE_EPS).sqrt().float()
    activation = config["train"]["ppo"]["activation"]
    return _policy_of_weights(config, state["iteration"], layers, mean, std, activation, NORMALISED_LIMIT)


def _policy_of_weights(
    config: Json, iteration: int, layers: Weights, mean: torch.Tensor, std: torch.Tensor, activation: str, limit: float
) -> Policy:
    """Return the policy of a training, with the code version of its run and the iteration in the configuration.

    limit: normalised observations are clamped to ± this. Raises TaskError: its task has another version; PolicyError:
    interface, layers and statistics contradict each other.
    """
    env = config["env"]
    saving.check_version(env["task"])
    commit = config.get("commit") or {"hash": None, "dirty": None}
    spec = make_interface(
        {**env["interface"], "observation_limit": RAW_LIMIT, "normalised_limit": limit},
        policy_dt=env["policy_dt_s"],
        physics_dt=env["physics_dt_s"],
        hidden=tuple(len(bias) for _, bias in layers[:-1]),
        activation=activation,
    )
    source = {"commit": commit["hash"], "dirty": commit["dirty"], "iteration": iteration}
    return Policy(layers, mean, std, spec, {**config, **source})


def _actor_layers(model: Json, prefix: str) -> Weights:
    """Return weight (out, in) and bias (out,) of the actor's layers, first to last, from a model's state_dict."""
    names = [key for key in model if key.startswith(prefix) and key.endswith(".weight")]
    names.sort(key=lambda key: int(key.split(".")[1]))
    return [(model[name], model[name.removesuffix("weight") + "bias"]) for name in names]


def learning_curve(source: Path) -> bytes | None:
    """Return the thinned learning curve of a run, or of a checkpoint's run; None without a metrics file."""
    path = catalog.run_folder(source) / METRICS_FILE
    return thinned_curve(read_file(path, "metrics of a run")) if path.is_file() else None


def thinned_curve(metrics: bytes) -> bytes:
    """Reduce a metrics file to a short learning curve: columns CURVE, at most CURVE_ROWS lines of JSON.

    The lines are evenly spaced. The first and the last line are included, malformed lines are omitted.
    """
    rows = []
    for line in metrics.splitlines():
        with suppress(InputError, TypeError):
            row = parse_json(line, METRICS_FILE)
            rows.append({name: row[name] for name in CURVE if name in row})
    last = len(rows) - 1
    kept = rows if last < CURVE_ROWS else [rows[round(i * last / (CURVE_ROWS - 1))] for i in range(CURVE_ROWS)]
    return "".join(f"{json.dumps(row)}\n" for row in kept).encode()


# ---------------------------------------------------------------------- saving


def save_policy(
    folder: Path, policy: Policy, *, files: Mapping[str, bytes] | None = None, overwrite: bool = False
) -> Path:
    """Write a policy to a folder atomically, and return the folder's path.

    Commit and versions are added to the configuration if it has none. files: content of additional files by name.
    overwrite: whether to replace an existing policy with all its files.
    Raises PolicyError: the folder exists and overwrite is not set, or it is not a policy's.
    """
    check_type("policy", policy, Policy)
    folder = checked_folder(folder, overwrite)
    config = {**source_versions(), **policy.config}
    config |= {"schema_version": catalog.SCHEMA_VERSION, "interface": policy.interface.to_json()}
    content = {
        **(files or {}),
        catalog.CONFIG: json_bytes(config),
        catalog.ONNX: onnx_bytes(policy.tensors(), policy.interface, config),
        catalog.README: default_readme(policy.interface).encode(),
    }
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as aside:
        new = Path(aside, "new")
        old = Path(aside, "old")
        new.mkdir()
        catalog.write_files(new, content, {})
        with directory_lock(folder.parent):
            try:
                if folder.exists():
                    os.replace(folder, old)
                os.replace(new, folder)
            except BaseException:
                if not folder.exists() and old.exists():
                    os.rename(old, folder)
                raise
    return folder


def checked_folder(folder: Path, overwrite: bool) -> Path:
    """Return a path for a policy's folder, after checking that a policy can be written there.

    Raises PolicyError: it has no name or the suffix of a file; it exists and overwrite is not set, or is no policy's.
    """
    folder = Path(folder)
    if folder.name in ("", ".."):
        raise PolicyError(f"a policy's folder needs a name, got {folder}")
    if folder.suffix.lower() in FILE_SUFFIXES:
        raise PolicyError(f"a policy is saved as a folder, whose name cannot end in {folder.suffix}: got {folder}")
    if folder.exists() and not (overwrite and (folder / catalog.MANIFEST).is_file()):
        reason = " and is not a policy's folder" if overwrite else "; overwrite replaces it"
        raise PolicyError(f"{folder} exists{reason}")
    return folder


def default_readme(spec: PolicyInterface) -> str:
    """Return the text of README.md for a policy's folder: sizes, rate, files and commands."""
    return (
        f"# Policy for {spec.task}\n\n"
        f"Reads {spec.sizes[0]} numbers, drives {spec.sizes[-1]} motors at {1.0 / spec.policy_dt:.0f} Hz.\n"
        f"`{catalog.ONNX}` holds the network with its normaliser, `{catalog.CONFIG}` everything that made it.\n\n"
        "    jumper play FOLDER\n"
        "    jumper evaluate FOLDER\n"
    )


def export_onnx(policy: Policy, path: Path) -> Path:
    """Write a policy as one ONNX file with its checksum, atomically, and return its path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    data = onnx_bytes(policy.tensors(), policy.interface, policy.config)
    write_atomically(path, data + checksum_entry(data))
    return path
