"""Normalisation of a policy's observations."""

from __future__ import annotations

import torch


def normalise(obs: torch.Tensor, mean: torch.Tensor, std: torch.Tensor, limit: float) -> torch.Tensor:
    """Return (obs - mean) / std, clamped to ± limit, of shape (..., n); obs: (..., n); mean, std: (n,)."""
    return ((obs - mean) / std).clamp(-limit, limit)
