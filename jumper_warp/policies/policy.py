"""Trained policies: actor networks with their observation normalisers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import ModuleType
from typing import Any

import torch
from torch import nn

from jumper_warp.policies.spec import PolicyError, PolicyInterface
from jumper_warp.recipe import Recipe
from jumper_warp.rl.mirror import Weights
from jumper_warp.rl.networks import ACTIVATIONS, linear_layers
from jumper_warp.tasks.saving import TaskError
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.normalise import normalise

MAX_OUTPUT = 1.0e38  # Bound of layer outputs, below the largest float32


class _Linear(nn.Linear):
    """Linear layer without initial weights: `nn.utils.skip_init` avoids them too, but imports SymPy."""

    def reset_parameters(self) -> None:
        """Skip the initialisation of weights, and leave the random streams unchanged."""


class Policy(nn.Module):
    """Actor network with its observation normaliser; `act` maps raw observations to actions. Inherits `to(device)`."""

    mean: torch.Tensor  # (num_obs,) mean of raw observations
    std: torch.Tensor  # (num_obs,) standard deviation that observations are divided by

    def __init__(
        self, layers: Weights, mean: torch.Tensor, std: torch.Tensor, interface: PolicyInterface,
        config: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        """Create a policy from copies of the tensors, as float32.

        layers: weight (out, in) and bias (out,) of each layer. mean, std: (num_obs,) of raw observations. interface:
        layout of observation and action, and network sizes. config: JSON configuration of environment and training.
        Raises PolicyError: a tensor does not have the interface's shape, is not finite, or is so large that an action
        could overflow; or std is not positive.
        """
        super().__init__()
        self.interface = interface
        self.config = dict(config or {})
        tensors = {"normaliser.mean": mean, "normaliser.std": std}
        for i, (weight, bias) in enumerate(layers):
            tensors |= {f"actor.{i}.weight": weight, f"actor.{i}.bias": bias}
        tensors = {name: tensor.detach().float().cpu().clone() for name, tensor in tensors.items()}
        check_tensors(tensors, interface)
        self.register_buffer("mean", tensors["normaliser.mean"])
        self.register_buffer("std", tensors["normaliser.std"])
        self.actor = nn.Sequential()
        for i in range(len(layers)):
            weight = tensors[f"actor.{i}.weight"]
            linear = _Linear(weight.shape[1], weight.shape[0], device="cpu")
            linear.weight.data, linear.bias.data = weight, tensors[f"actor.{i}.bias"]
            self.actor.append(linear)
            if i < len(layers) - 1:
                self.actor.append(ACTIVATIONS[interface.activation]())
        self.requires_grad_(False)

    def recipe(self, modules: Iterable[ModuleType] = ()) -> Recipe:
        """Return the recipe of the policy's training, from its configuration; see `Recipe.from_json`.

        modules: the user's, in which functions from outside the project are looked up.
        Raises PolicyError: the configuration has no recipe of this version, or its observation is another one.
        """
        try:
            recipe = Recipe.from_json(self.config, modules, complete=False)
        except TaskError as error:
            raise PolicyError(str(error)) from error
        if recipe.task.observation_names != self.interface.observation_names:
            raise PolicyError("the policy's observation differs from that of its task in this version")
        return recipe

    @property
    def layers(self) -> Weights:
        """Weight (out, in) and bias (out,) of each layer of the actor network."""
        return linear_layers(self.actor)

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return all tensors on the CPU, by name: normaliser.mean, normaliser.std, actor.N.weight, actor.N.bias."""
        tensors = {"normaliser.mean": self.mean, "normaliser.std": self.std}
        for i, (weight, bias) in enumerate(self.layers):
            tensors |= {f"actor.{i}.weight": weight, f"actor.{i}.bias": bias}
        return {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}

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


def check_tensors(tensors: Mapping[str, torch.Tensor], interface: PolicyInterface) -> None:
    """Raise PolicyError unless names (see `Policy.tensors`), shapes and values of tensors fit an interface."""
    sizes = interface.sizes
    expected = {"normaliser.mean": (sizes[0],), "normaliser.std": (sizes[0],)}
    for i in range(len(sizes) - 1):
        expected |= {f"actor.{i}.weight": (sizes[i + 1], sizes[i]), f"actor.{i}.bias": (sizes[i + 1],)}
    different = sorted(set(expected) ^ set(tensors))
    if different:
        raise PolicyError(f"configured layers are {sizes}; missing or unknown: {', '.join(different):.200}")
    for name, shape in expected.items():
        tensor = tensors[name]
        if tuple(tensor.shape) != shape:
            raise PolicyError(f"{name} must have the configured shape {shape}, got {tuple(tensor.shape)}")
        if not tensor.isfinite().all():
            raise PolicyError(f"{name} is not finite")
    if not (tensors["normaliser.std"] > 0.0).all():
        raise PolicyError("normaliser.std must be positive")
    _check_overflow(tensors, interface)


def _check_overflow(tensors: Mapping[str, torch.Tensor], interface: PolicyInterface) -> None:
    """Raise PolicyError if a layer's output could overflow float32 for some observation, by interval bounds."""
    bound = torch.full((interface.sizes[0],), interface.normalised_limit, dtype=torch.float64)
    for i in range(len(interface.sizes) - 1):
        bound = tensors[f"actor.{i}.weight"].double().abs() @ bound + tensors[f"actor.{i}.bias"].double().abs()
        if not bound.max() < MAX_OUTPUT:
            raise PolicyError(f"the weights of layer {i} are so large that its outputs may overflow")
        # an activation's output is at most its input, or 1
        bound = torch.ones_like(bound) if interface.activation == "tanh" else bound.clamp(min=1.0)
