"""Compilation of tensor functions by torch.compile, and what happens where it cannot be had."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import torch

BACKEND = "inductor"
"""Of torch.compile."""


class Compiler:
    """Compiles functions if asked to; where that fails, says so once and runs them as they are.

    A function is compiled, or read from Inductor's cache on disk, at its first call; the shapes of its tensors and its
    other arguments stay the same from then on.
    """

    def __init__(self, enabled: bool) -> None:
        """enabled: whether to compile at all."""
        self.enabled = enabled

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that computes the same."""
        if not self.enabled:
            return function
        compiled: Callable[..., Any] | None = None

        def call(*args: Any) -> Any:
            nonlocal compiled
            if compiled is not None:
                return compiled(*args)
            if not self.enabled:
                return function(*args)
            try:
                tried = torch.compile(function, fullgraph=True, dynamic=False, backend=BACKEND, options=_options())
                result = tried(*args)
            except Exception as error:  # whatever a compiler, or none, does
                self.enabled = False
                print(f"not compiled, training is slower: {_reason(error)}", file=sys.stderr)
                return function(*args)
            compiled = tried
            return result

        return call


def _options() -> dict[str, str | int | bool | Callable[..., Any]] | None:
    """Return options of Inductor: it may not choose by time between kernels that add up in another order."""
    if BACKEND != "inductor":
        return None
    from torch._inductor import config

    return {"deterministic": True} if hasattr(config, "deterministic") else {}


def _reason(error: Exception) -> str:
    inner = getattr(error, "inner_exception", error)  # of a backend's failure
    lines = [line.strip() for line in str(inner).splitlines() if line.strip()]
    return f"{type(inner).__name__}: {lines[0] if lines else ''}"[:300]
