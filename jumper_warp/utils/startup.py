"""Faster start of a command's process: fewer garbage collections, and imports of Newton's unused parts deferred."""

from __future__ import annotations

import gc
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from types import ModuleType
from typing import Any

DEFERRED = frozenset(f"newton.{name}" for name in ("actuators", "controllers", "ik", "selection", "sensors", "viewer"))
"""Modules that `import newton` imports and no command needs; the first one imports the Rerun SDK."""
COLLECTION_THRESHOLD = 50_000
"""Surplus of allocated objects that starts a garbage collection. Imports allocate millions of objects that stay."""


class DeferredFinder(MetaPathFinder):
    """Finder of the modules in `DEFERRED`, which are loaded at the first access to one of their attributes."""

    def find_spec(self, fullname: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the specification of a deferred module, None for any other module."""
        spec = PathFinder.find_spec(fullname, path, target) if fullname in DEFERRED else None
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
        return spec


def prepare_imports() -> None:
    """Defer imports of Newton's unused parts and collect garbage less often, for the rest of this process.

    Call it in a process of a command, before its imports.
    """
    gc.set_threshold(COLLECTION_THRESHOLD)
    if not any(isinstance(finder, DeferredFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, DeferredFinder())
