"""Beginning a training with the actor of a policy instead of random weights."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.mirror import Symmetry, Weights, contract_expanded_layers, nearest_expanded_layers
from jumper_warp.rl.networks import EPS, ActorCritic, linear_layers
from jumper_warp.utils.errors import InputError

PRIOR_ITERATIONS = 100
"""The policy's statistics of observations weigh as much as the samples of so many iterations: the mean and variance of
what the robot sees now replace them slowly, so that the actor need not follow a jump of its inputs."""

NEARLY = 0.05
"""Of the norm of each layer's weights, that fine-tuning may have taken from the form of a mirror-symmetric actor."""


class ActorInit(NamedTuple):
    """What an `ActorCritic` begins with."""

    layers: Weights
    """Of the actor."""
    mean: torch.Tensor
    """(num_obs,) of the raw observations."""
    std: torch.Tensor
    """(num_obs,) what observations are divided by."""
    change: str = ""
    """What had to be done to a policy that is not mirror-symmetric for a training that is."""


def make_actor_init(
    layers: Weights, mean: torch.Tensor, std: torch.Tensor, activation: str, cfg: PpoCfg,
    symmetry: Symmetry | None = None,
) -> ActorInit:  # fmt: skip
    """Return what a training with these settings begins with to act as a policy does.

    A policy g that is not mirror-symmetric begins a training with symmetry actor as (g(x) + N g(M x)) / 2, in the
    notation of `jumper_warp.rl.mirror`; one that was, but for small changes of its weights, as the nearest that is.

    layers: of the policy as a plain network, with activation between; mean, std: (num_obs,) what it subtracts from raw
    observations and divides them by; symmetry: the mirror images, if the training is with symmetry actor.

    Raises InputError: the settings make other hidden layers or another activation, or a deviation is smaller than what
    is added to variances.
    """
    if activation != cfg.activation:
        raise InputError(
            f"start_from: the policy has activation {activation}, these settings make {cfg.activation}: "
            f"give --ppo.activation {activation}"
        )
    has = [len(bias) for _, bias in layers[:-1]]
    half = None if symmetry is None else _half(layers, mean, std, symmetry)
    wanted = [len(bias) for _, bias in (half or layers)[:-1]]
    if wanted != list(cfg.hidden):
        made = [width if half is None else 2 * width for width in cfg.hidden]
        raise InputError(
            f"start_from: the policy has hidden layers {_words(has)}, these settings make {_words(made)}: "
            f"give --ppo.hidden {_words(wanted, ' ')}"
        )
    if not (std.double().square() > 0.999 * EPS).all():
        raise InputError(f"start_from: the policy divides an observation by {std.min():.3g}, least is {EPS**0.5:.3g}")
    if half is not None and symmetry is not None:
        return ActorInit(half, mean, std, "" if _is_symmetric(layers, symmetry) else "made mirror-symmetric")
    if symmetry is None:
        return ActorInit(layers, mean, std)
    return _averaged(layers, mean, std, symmetry)


@torch.no_grad()
def apply_actor_init(start: ActorInit, model: ActorCritic, samples: int) -> None:
    """Put the weights and the statistics of observations into a model, in place; its noise and its critic stay.

    samples: of all worlds in an iteration. Raises InputError: the model's observation, action or layers are of other
    sizes; nothing is changed.
    """
    own = linear_layers(model.actor)
    has, made = ([tuple(weight.shape) for weight, _ in layers] for layers in (start.layers, own))
    if has != made:
        raise InputError(f"start_from: the policy's weights are of shapes {_words(has)}, the training's {_words(made)}")
    for (weight, bias), (new_weight, new_bias) in zip(own, start.layers, strict=True):
        weight.copy_(new_weight)
        bias.copy_(new_bias)
    moments = model.obs_moments
    moments.mean.copy_(start.mean)
    moments.var.copy_((start.std.double().square() - EPS).clamp(min=0.0))
    moments.count.fill_(PRIOR_ITERATIONS * samples)


def _half(layers: Weights, mean: torch.Tensor, std: torch.Tensor, symmetry: Symmetry) -> Weights | None:
    """Return the layers of f, see `contract_expanded_layers`, or None: they or the statistics are not nearly symmetric."""
    widths = [len(bias) for _, bias in layers[:-1]]
    symmetric = torch.allclose(symmetry.obs.of(mean), mean, atol=1e-5) and torch.allclose(std[symmetry.obs.order], std)
    if not symmetric or not widths or any(width % 2 for width in widths):
        return None
    nearest = nearest_expanded_layers(layers, symmetry)
    pairs = zip(layers, nearest, strict=True)
    near = all((one - other).norm() <= NEARLY * one.norm() for (one, _), (other, _) in pairs)
    return contract_expanded_layers(nearest, symmetry) if near else None


def _is_symmetric(layers: Weights, symmetry: Symmetry) -> bool:
    try:
        contract_expanded_layers(layers, symmetry)
    except InputError:
        return False
    return True


def _averaged(layers: Weights, mean: torch.Tensor, std: torch.Tensor, symmetry: Symmetry) -> ActorInit:
    """Return g as the network f of a symmetric actor, and the statistics of its samples and their images."""
    middle, var = symmetry.obs.moments(mean.double(), std.double().square())
    scaled = rescale_inputs(layers, mean, std, middle, var.sqrt())
    own = [(weight.to(mean.dtype), bias.to(mean.dtype)) for weight, bias in scaled]
    change = "its answers averaged with their mirror images"
    return ActorInit(own, middle.to(mean.dtype), var.sqrt().to(std.dtype), change)


def rescale_inputs(
    layers: Weights, mean: torch.Tensor, std: torch.Tensor, other_mean: torch.Tensor, other_std: torch.Tensor
) -> Weights:
    """Return the layers, float64, for observations scaled by other statistics (num_obs,) than by mean and std.

    The first makes up for the change: W (x - mean) / std stays the same for all x within the limits.
    """
    (weight, bias), *others = ((weight.double(), bias.double()) for weight, bias in layers)
    mean, std = mean.double(), std.double()
    first = weight * (other_std.double() / std), bias + weight @ ((other_mean.double() - mean) / std)
    return [first, *others]


def _words(values: Iterable[object], between: str = ", ") -> str:
    return between.join(map(str, values))
