"""Loading of user files as modules, and checksums of those that a run depends on."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from jumper_warp.utils.errors import InputError

PLACE = re.compile(r"\S+\.py:\d+[:,]")  # File and line at the start of a message
PROJECT_PREFIX = "jumper_warp."  # Prefix of the project's modules, whose content the commit identifies


def module_from_file(name: str, path: str | Path) -> ModuleType:
    """Import a file as a module with the given name, and return it; after an exception the name is free again.

    As for a program, the file can import its neighbours while it runs.
    Raises ImportError: the file's name does not end in .py.
    """
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{Path(path).name}: the name of a module's file must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    folder = str(Path(path).resolve().parent)
    sys.path.insert(0, folder)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    finally:
        sys.path.remove(folder)
    return module


def with_neighbours(modules: Sequence[ModuleType]) -> list[ModuleType]:
    """Return a user's modules, and after them loaded modules from the same folders, which they may have imported.

    Folders of installed packages are left out.
    """
    files = {file: module for module in modules if (file := getattr(module, "__file__", None))}
    folders = {os.path.dirname(file) for file in files if os.path.basename(os.path.dirname(file)) != "site-packages"}
    near = []
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        path = name.replace(".", os.sep)
        if file not in files and any(file in (f"{f}/{path}.py", f"{f}/{path}/__init__.py") for f in folders):
            near.append(module)
    return [*modules, *near]


def own_fault(error: Exception, path: str) -> InputError:
    """Convert an exception to an InputError with the line at which it was raised in the user's file `path`."""
    message = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if frame.f_code.co_filename == path]
    if not lines or PLACE.match(message):
        return InputError(message)
    return InputError(f"{Path(path).name}:{lines[-1]}: {message}")


def source_checksums(saved: Any) -> dict[str, str]:
    """Return SHA-256 checksums of the user's modules that a saved task names, by module.

    `saved` refers to them as `module:name`; files of the project are left out. saved: nested dicts and lists, such as a
    task as JSON. Modules that are not loaded or have no file are left out.
    """
    checksums = {}
    for module in sorted(set(re.findall(r'"([\w.]+):', json.dumps(saved, ensure_ascii=False)))):
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
