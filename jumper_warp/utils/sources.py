"""Files of a user that a run depends on, by what they held."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

OWN = "jumper_warp."
"""Beginning of the names of the project's modules; the commit identifies their content."""


def source_checksums(saved: Any) -> dict[str, str]:
    """Return the SHA-256 of each file outside the project that has a function which `module:name` in `saved` names.

    By module; saved: nested dicts and lists, such as a task as JSON. Modules that are not loaded, or have no file that
    can be read, are left out.
    """
    sums = {}
    for module in sorted(set(_modules(saved))):
        file = getattr(sys.modules.get(module), "__file__", None)
        if file and not module.startswith(OWN) and Path(file).is_file():
            sums[module] = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return sums


def changed_sources(old: Any, new: dict[str, str]) -> list[str]:
    """Return a line on each module whose file is not what it was; old: as `source_checksums` gave it, or anything."""
    before = old if isinstance(old, dict) else {}
    return [
        f"{module} has changed since: its functions are those of now, settings those of the run"
        for module, held in new.items()
        if before.get(module, held) != held
    ]


def _modules(saved: Any) -> Iterator[str]:
    """Yield what comes before the colon of each string."""
    if isinstance(saved, str):
        module, colon, _ = saved.partition(":")
        if colon:
            yield module
    elif isinstance(saved, dict | list):
        for part in saved.values() if isinstance(saved, dict) else saved:
            yield from _modules(part)
