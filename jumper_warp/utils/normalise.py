"""The input of a policy's network."""

from __future__ import annotations

import torch


def normalise(obs: torch.Tensor, mean: torch.Tensor, std: torch.Tensor, limit: float) -> torch.Tensor:
    """Return observations (..., n) in standard deviations from the mean, within plus and minus a limit."""
    return ((obs - mean) / std).clamp(-limit, limit)
