"""Normalisation of a policy's observations."""

from __future__ import annotations

import torch


def normalise(obs: torch.Tensor, mean: torch.Tensor, std: torch.Tensor, limit: float) -> torch.Tensor:
    """Normalise observations (..., n) by mean and standard deviation (n,), and clamp them to ± limit.

    The clamp keeps a rare outlier, as of an observation with a small deviation, from dominating the network.
    """
    return ((obs - mean) / std).clamp(-limit, limit)
