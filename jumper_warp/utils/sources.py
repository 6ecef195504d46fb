"""Checksums of user files that a run depends on."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PROJECT_PREFIX = "jumper_warp."  # Prefix of the project's modules, whose content the commit identifies


def source_checksums(saved: Any) -> dict[str, str]:
    """Return SHA-256 checksums of the user's modules that a saved task names, by module.

    `saved` refers to them as `module:name`; files of the project are left out. saved: nested dicts and lists, such as a
    task as JSON. Modules that are not loaded or have no file are left out.
    """
    checksums = {}
    for module in sorted(set(_modules(saved))):
        file = getattr(sys.modules.get(module), "__file__", None)
        if file and not module.startswith(PROJECT_PREFIX) and Path(file).is_file():
            checksums[module] = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return checksums


def changed_sources(old: Any, new: dict[str, str]) -> list[str]:
    """Return a message for each user module whose file has changed since its checksum was saved.

    old, new: results of `source_checksums`; if `old` is not a dict, or lacks a module, nothing is reported for it.
    """
    saved = old if isinstance(old, dict) else {}
    return [
        f"{module} has changed since the run was saved: its current functions are used with the saved settings"
        for module, checksum in new.items()
        if saved.get(module, checksum) != checksum
    ]


def _modules(saved: Any) -> Iterator[str]:
    """Yield the modules that saved data names: the part before the colon of each string with a colon."""
    if isinstance(saved, str):
        module, colon, _ = saved.partition(":")
        if colon:
            yield module
    elif isinstance(saved, dict | list):
        for part in saved.values() if isinstance(saved, dict) else saved:
            yield from _modules(part)
