"""The latency that was simulated, which is whole physics steps, and how it is told."""

from __future__ import annotations

from typing import Any

import numpy as np


def latency_metrics(steps: np.ndarray, physics_dt: float, asked: float | None = None) -> dict[str, Any]:
    """Return the latency from action to motor as it was simulated.

    steps: [physics steps] of all worlds; physics_dt [s]; asked [ms]: what was asked for, if anything.
    `latency_ms` is the mean, `latency` all of it in words.
    """
    told: dict[str, Any] = {} if asked is None else {"latency_asked_ms": asked}
    mean = 1000.0 * physics_dt * float(np.mean(steps))
    return told | {"latency_ms": mean, "latency": latency_text(steps, physics_dt)}


def latency_text(steps: np.ndarray, physics_dt: float) -> str:
    """Return a latency in milliseconds and in physics steps, or the range and the mean of several."""
    least, most = int(np.min(steps)), int(np.max(steps))
    low, high, mean = (f"{1000.0 * physics_dt * float(value):.3g}" for value in (least, most, np.mean(steps)))
    if least == most:
        return f"{low} ms ({least} physics step{'' if least == 1 else 's'})"
    return f"{low} to {high} ms ({least} to {most} physics steps), mean {mean} ms"
