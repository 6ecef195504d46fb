"""Ways to run the trainer that are compared with each other, by name."""

from __future__ import annotations

import dataclasses
from itertools import product
from typing import Any

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.utils.errors import InputError

DEFAULT = "default"
"""Name of the trainer as it is."""
VARIANTS: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    **{
        f"{name}_{precision}": {"compile": mode, "precision": precision}
        for (mode, name), precision in product((("off", "eager"), ("on", "compiled")), ("float32", "bfloat16"))
    },
    "four_minibatches": {"minibatches": 4},
    "less_noise": {"init_std": 0.5},
    "less_noise_bfloat16": {"init_std": 0.5, "precision": "bfloat16"},
    "small": {"hidden": (128, 64, 64), "final_desired_kl": 0.005},
}
"""What each changes of `PpoCfg`."""


def variant(cfg: PpoCfg, name: str) -> PpoCfg:
    """Return settings changed as a variant says. Raises ValueError: there is no such variant."""
    if name not in VARIANTS:
        raise InputError(f"variants are {', '.join(VARIANTS)}, got {name!r:.60}")
    return dataclasses.replace(cfg, **VARIANTS[name])
