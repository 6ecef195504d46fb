"""Named variants of the trainer's settings."""

from __future__ import annotations

import dataclasses

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json

DEFAULT = "default"  # Name of the unchanged settings
VARIANTS: dict[str, Json] = {
    DEFAULT: {},
    "eager": {"fused": False},
    "four_minibatches": {"minibatches": 4},
    "less_noise": {"init_std": 0.5},
    "small": {"hidden": (128, 64, 64), "final_desired_kl": 0.005},
}
"""Changed fields of `PpoCfg` by name of the variant."""


def variant(cfg: PpoCfg, name: str) -> PpoCfg:
    """Return a copy of the trainer's settings with the changes of a variant.

    Raises InputError: `name` is not in VARIANTS.
    """
    if name not in VARIANTS:
        raise InputError(f"variants are {', '.join(VARIANTS)}, got {name!r:.60}")
    return dataclasses.replace(cfg, **VARIANTS[name])
