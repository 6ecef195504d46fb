"""Normalisation of a policy's observations."""

from __future__ import annotations

import torch


def normalise(obs: torch.Tensor, mean: torch.Tensor, std: torch.Tensor, limit: float) -> torch.Tensor:
    """Return observations (..., n) as standard deviations from the mean, clamped to ± limit; mean, std: (n,)."""
    return ((obs - mean) / std).clamp(-limit, limit)
