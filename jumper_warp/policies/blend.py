"""The mean of two policies' weights.

Where one policy was trained on from the other, or both from a third, the networks in between act as policies too, and
what one does better and the other worse can be weighed (Wortsman et al. 2022, Robust fine-tuning of zero-shot models).
"""

from __future__ import annotations

import torch

from jumper_warp.policies.policy import Layers, Policy
from jumper_warp.policies.spec import PolicyError


def blend(policy: Policy, other: Policy, share: float) -> Policy:
    """Return (1 - share) policy + share other, weight by weight, with the normaliser and the configuration of policy.

    The other's first layer is written for that normaliser before: W (x - mean) / std stays the same for all x within
    the limits.

    Args:
        policy: What the blend is with share 0.
        other: What it is with share 1, within the limits of normalised observations.
        share: From 0 to 1.

    Raises:
        PolicyError: They do not read and drive the same by networks of the same form, or the share is out of range.
    """
    if not 0.0 <= share <= 1.0:
        raise PolicyError(f"the share of a blend must be from 0 to 1, got {share}")
    if policy.interface != other.interface:
        raise PolicyError("policies of a blend must read and drive the same by networks of the same form")
    mean, std = policy.mean.double(), policy.std.double()
    pairs = zip(_double(policy.layers), _written_for(other, mean, std), strict=True)
    layers = [((1.0 - share) * w + share * v, (1.0 - share) * b + share * c) for (w, b), (v, c) in pairs]
    return Policy(layers, policy.mean, policy.std, policy.interface, policy.config)


def _double(layers: Layers) -> list[tuple[torch.Tensor, torch.Tensor]]:
    return [(weight.double(), bias.double()) for weight, bias in layers]


def _written_for(policy: Policy, mean: torch.Tensor, std: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Return the layers of a policy for observations that another normaliser (num_obs,) made."""
    (weight, bias), *others = _double(policy.layers)
    own_mean, own_std = policy.mean.double(), policy.std.double()
    return [(weight * (std / own_std), bias + weight @ ((mean - own_mean) / own_std)), *others]
