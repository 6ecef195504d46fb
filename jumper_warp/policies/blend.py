"""Weight averaging of two policies (Wortsman et al. 2022, Robust fine-tuning of zero-shot models).

If one policy was fine-tuned from the other, or both from a third, the interpolated networks are usable policies too.
They trade off the strengths of both.
"""

from __future__ import annotations

import torch

from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.rl.actor_init import rescale_inputs


def blend(policy: Policy, other: Policy, fraction: float) -> Policy:
    """Average the weights of two policies: (1 - fraction) * policy + fraction * other, with the normaliser of `policy`.

    First the first layer of `other` is rescaled to that normaliser. The configuration is a copy of `policy.config`
    with the entry `blended`: the keys share (the fraction), and commit and iteration of `other`.
    fraction: 0 gives `policy`; 1 acts like `other` wherever neither policy clips its normalised observation.
    Raises PolicyError: the interfaces differ, or the fraction is not in [0, 1].
    """
    if not 0.0 <= fraction <= 1.0:
        raise PolicyError(f"the fraction of a blend must be from 0 to 1, got {fraction}")
    if policy.interface != other.interface:
        raise PolicyError("policies of a blend must have the same interface: observation, action and network sizes")
    other_layers = rescale_inputs(other.layers, other.mean, other.std, policy.mean, policy.std)

    def interpolate(tensor: torch.Tensor, other_tensor: torch.Tensor) -> torch.Tensor:
        """Return the weighted mean of two tensors of one shape, float64."""
        return (1.0 - fraction) * tensor.double() + fraction * other_tensor

    pairs = zip(policy.layers, other_layers, strict=True)
    layers = [(interpolate(w, other_w), interpolate(b, other_b)) for (w, b), (other_w, other_b) in pairs]
    origin = {key: other.config[key] for key in ("commit", "iteration") if key in other.config}
    config = policy.config | {"blended": {"share": fraction, **origin}}
    return Policy(layers, policy.mean, policy.std, policy.interface, config)
