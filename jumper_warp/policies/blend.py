"""The mean of two policies' weights.

Where one policy was trained on from the other, or both from a third, the networks in between act as policies too, and
what one does better and the other worse can be weighed (Wortsman et al. 2022, Robust fine-tuning of zero-shot models).
"""

from __future__ import annotations

from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.rl.actor_init import rescale_inputs


def blend(policy: Policy, other: Policy, share: float) -> Policy:
    """Return (1 - share) policy + share other, weight by weight, with the normaliser and the configuration of policy.

    The other's first layer is written for that normaliser before. The configuration tells the share, and commit and
    iteration of the other, as `blended`.

    policy: what the blend is with share 0. other: what it is with share 1, within the limits of normalised
    observations. share: from 0 to 1.
    Raises PolicyError: they do not read and drive the same by networks of the same form, or the share is out of range.
    """
    if not 0.0 <= share <= 1.0:
        raise PolicyError(f"the share of a blend must be from 0 to 1, got {share}")
    if policy.interface != other.interface:
        raise PolicyError("policies of a blend must read and drive the same by networks of the same form")
    its = rescale_inputs(other.layers, other.mean, other.std, policy.mean, policy.std)
    pairs = zip(policy.layers, its, strict=True)
    layers = [
        ((1.0 - share) * w.double() + share * v, (1.0 - share) * b.double() + share * c) for (w, b), (v, c) in pairs
    ]
    of = {"share": share, **{key: other.config[key] for key in ("commit", "iteration") if key in other.config}}
    return Policy(layers, policy.mean, policy.std, policy.interface, policy.config | {"blended": of})
