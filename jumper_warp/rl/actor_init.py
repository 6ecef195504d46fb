"""Initial weights and observation statistics of an actor, taken from a trained policy."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.mirror import Symmetries, Weights, contract_layers
from jumper_warp.rl.networks import VARIANCE_EPS, ActorCritic, linear_layers
from jumper_warp.utils.errors import InputError

PRIOR_ITERATIONS = 100
"""Weight of the policy's observation statistics [iterations of samples]; large, so that they change slowly."""

SYMMETRY_TOLERANCE = 0.05
"""Largest distance from a mirror-symmetric actor, relative to the norm of a layer's weights, that is projected."""


class ActorInit(NamedTuple):
    """Initial weights and observation statistics (mean, standard deviation) of an actor, from a trained policy."""

    layers: Weights  # weight (out, in) and bias (out,) of each layer
    mean: torch.Tensor  # (num_obs,) mean of raw observations
    std: torch.Tensor  # (num_obs,) standard deviation that observations are divided by
    change: str = ""  # how the policy was made mirror-symmetric, for the log; empty if it was not changed


def make_actor_init(
    layers: Weights, mean: torch.Tensor, std: torch.Tensor, activation: str, cfg: PpoCfg,
    symmetries: Symmetries = (),
) -> ActorInit:  # fmt: skip
    """Return initial weights and observation statistics, from a trained policy, of an actor with settings `cfg`.

    Without `symmetries` the actor equals the policy. With them, a policy that is nearly symmetric is projected to the
    nearest symmetric one; any other becomes the mean over all images, as in `jumper_warp.rl.mirror`.
    layers, activation: the policy as a plain network; mean, std: (num_obs,) its observation statistics; symmetries: the
    task's mirror maps for cfg.symmetry.
    Raises InputError: hidden layers or activation differ from the settings, or std is below sqrt(VARIANCE_EPS).
    """
    if activation != cfg.activation:
        raise InputError(
            f"init_policy: the policy has activation {activation}, the settings {cfg.activation}: "
            f"pass --ppo.activation {activation}"
        )
    policy_widths = [len(bias) for _, bias in layers[:-1]]
    policy = (layers, mean, std, symmetries)
    contracted = _contracted_layers(*policy, SYMMETRY_TOLERANCE) if symmetries else None
    required = [len(bias) for _, bias in (contracted or layers)[:-1]]
    if required != list(cfg.hidden):
        settings_widths = [width if contracted is None else 2 ** len(symmetries) * width for width in cfg.hidden]
        raise InputError(
            f"init_policy: the policy has hidden layers {_joined(policy_widths)}, the settings "
            f"{_joined(settings_widths)}: pass --ppo.hidden {_joined(required, ' ')}"
        )
    least = VARIANCE_EPS**0.5
    if not (std.double().square() > 0.999 * VARIANCE_EPS).all():
        raise InputError(f"init_policy: an observation's std must be at least {least:.3g}, got {std.min():.3g}")
    if contracted is not None:
        return ActorInit(contracted, mean, std, "" if _contracted_layers(*policy) else "made mirror-symmetric")
    if not symmetries:
        return ActorInit(layers, mean, std)
    return _averaged(layers, mean, std, symmetries)


@torch.no_grad()
def apply_actor_init(actor_init: ActorInit, model: ActorCritic, samples: int) -> None:
    """Copy initial weights and observation statistics into a model's actor; noise and critic are unchanged.

    samples: num_steps · num_envs of an iteration. Raises InputError: layers have other shapes; nothing is changed.
    """
    layers = linear_layers(model.actor)
    policy_shapes, shapes = ([tuple(weight.shape) for weight, _ in each] for each in (actor_init.layers, layers))
    if policy_shapes != shapes:
        raise InputError(
            f"init_policy: the policy's weights are of shapes {_joined(policy_shapes)}, "
            f"the training's {_joined(shapes)}"
        )
    for (weight, bias), (new_weight, new_bias) in zip(layers, actor_init.layers, strict=True):
        weight.copy_(new_weight)
        bias.copy_(new_bias)
    moments = model.obs_moments
    moments.mean.copy_(actor_init.mean)
    moments.var.copy_((actor_init.std.double().square() - VARIANCE_EPS).clamp(min=0.0))
    moments.count.fill_(PRIOR_ITERATIONS * samples)


def _contracted_layers(
    layers: Weights, mean: torch.Tensor, std: torch.Tensor, symmetries: Symmetries, tolerance: float = 1.0e-6
) -> Weights | None:
    """Return the layers, of smaller widths, of the symmetric actor that is nearest to a policy's network.

    Returns None if the layers are not nearly mirror-symmetric, or the observation statistics are not symmetric.
    tolerance: as in `contract_layers`.
    """
    widths = [len(bias) for _, bias in layers[:-1]]
    symmetric = all(
        torch.allclose(each.obs.apply(mean), mean, atol=1e-5) and torch.allclose(std[each.obs.order], std)
        for each in symmetries
    )
    if not symmetric or not widths or any(width % 2 ** len(symmetries) for width in widths):
        return None
    return contract_layers(layers, symmetries, tolerance)


def _averaged(layers: Weights, mean: torch.Tensor, std: torch.Tensor, symmetries: Symmetries) -> ActorInit:
    """Make a policy mirror-symmetric: average its actions with the mirror images for mirrored observations.

    Its network becomes that of the symmetric actor, its layers rescaled to mirror-symmetric observation statistics.
    """
    new_mean, new_var = mean.double(), std.double().square()
    for each in symmetries:
        new_mean, new_var = each.obs.symmetrise_moments(new_mean, new_var)
    rescaled = rescale_inputs(layers, mean, std, new_mean, new_var.sqrt())
    new_layers = [(weight.to(mean.dtype), bias.to(mean.dtype)) for weight, bias in rescaled]
    change = "its actions averaged with their mirror images"
    return ActorInit(new_layers, new_mean.to(mean.dtype), new_var.sqrt().to(std.dtype), change)


def rescale_inputs(
    layers: Weights, mean: torch.Tensor, std: torch.Tensor, new_mean: torch.Tensor, new_std: torch.Tensor
) -> Weights:
    """Return a network's layers (float64) adapted to another normalisation of its inputs, with unchanged outputs.

    mean, std: with which observations were normalised; new_mean, new_std: with which they will be.
    All statistics are (num_obs,). Only the first layer changes: W (x - mean) / std + b stays the same for all x.
    """
    (weight, bias), *others = ((weight.double(), bias.double()) for weight, bias in layers)
    mean, std = mean.double(), std.double()
    first = weight * (new_std.double() / std), bias + weight @ ((new_mean.double() - mean) / std)
    return [first, *others]


def _joined(values: Iterable[object], separator: str = ", ") -> str:
    """Return values as text with a separator between them."""
    return separator.join(map(str, values))
