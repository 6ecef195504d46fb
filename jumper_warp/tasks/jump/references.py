"""Optimised jumps that episodes begin along: JSON files of assets/motions, written by the trajectory experiment."""

from __future__ import annotations

import functools
import json
import re
from dataclasses import dataclass

import numpy as np

from jumper_warp.utils.assets import ASSETS
from jumper_warp.utils.errors import InputError

ROWS, COLUMNS = 16, ("x_m", "z_m", "pitch_rad", "forward_m_s", "up_m_s", "pitch_rate_rad_s")
"""Moments from the deepest squat until a paw lifts, evenly spaced, and what is known of the base at each."""
FOLDER = ASSETS / "motions"
NAME = re.compile(r"[a-z0-9_]{1,40}")
LARGEST = 20.0
"""[SI] No entry is beyond."""


@dataclass(frozen=True)
class Reference:
    """A jump while all paws push off; lengths relative to the middle of the paws, along the jump."""

    rows: np.ndarray
    """(ROWS, 6) As in `COLUMNS`; the velocity is that of the base's centre of mass, pitch nose down."""
    distance: float
    """[m] Where the base lands, ahead."""
    apex: float
    """[m] Of the base."""


@functools.cache
def load_reference(name: str) -> Reference:
    """Return a motion by its name. Raises InputError: there is none, or its file is not one."""
    if not NAME.fullmatch(name) or not (path := FOLDER / f"{name}.json").is_file():
        known = ", ".join(sorted(file.stem for file in FOLDER.glob("*.json"))) or "none"
        raise InputError(f"no reference motion {name!r:.60}; there are {known}")
    try:
        content = json.loads(path.read_text())
        rows = np.array(content["rows"], dtype=float)
        distance, apex = float(content["distance_m"]), float(content["apex_m"])
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: not a reference motion: {error!s:.100}") from error
    sound = rows.shape == (ROWS, len(COLUMNS)) and np.all(np.abs([*rows.ravel(), distance, apex]) <= LARGEST)
    if content.get("columns") != list(COLUMNS) or not sound or apex <= 0.0:
        raise InputError(f"{path}: a reference motion has {ROWS} finite rows of {', '.join(COLUMNS)}")
    return Reference(rows, distance, apex)
