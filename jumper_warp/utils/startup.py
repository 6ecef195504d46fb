"""Start and end of a command: open standard streams, few garbage collections, Newton's unused parts not imported."""

from __future__ import annotations

import atexit
import gc
import io
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from threading import RLock, current_thread, main_thread
from types import ModuleType
from typing import Any

DEFERRED = frozenset(f"newton.{name}" for name in ("actuators", "controllers", "ik", "selection", "sensors", "viewer"))
"""Modules that `import newton` imports and few commands need; `newton.viewer` imports the Rerun SDK."""
UNINTERRUPTED = "trimesh"  # Module that catches all exceptions of its imports, also KeyboardInterrupt
COLLECTION_THRESHOLD = 50_000
"""Surplus of allocated objects that starts a garbage collection after the first one."""
FIRST_COLLECTION_THRESHOLD = 1_200_000
"""Surplus of allocated objects that starts the first garbage collection. Imports allocate a million that stay."""


class DeferredModule(ModuleType):
    """Imported module whose code runs when a name is first read that the import system has not set.

    Unlike with `importlib.util.LazyLoader`, `__file__` and other names of the import system do not execute it:
    `inspect` and PyTorch read those of all modules.
    """

    _lock, _running = RLock(), False

    def __getattr__(self, name: str) -> Any:
        """Run the module's code, and return its attribute. Raises AttributeError: the module has no such name."""
        with DeferredModule._lock:
            if type(self) is DeferredModule and not self._running:
                self._running = True
                loader = self.__spec__.loader if self.__spec__ else None
                assert isinstance(loader, DeferredLoader)
                try:
                    loader.loader.exec_module(self)
                    module: Any = self
                    module.__class__ = ModuleType
                finally:
                    del self._running
        return ModuleType.__getattribute__(self, name)


class DeferredLoader(Loader):
    """Loader that turns a module into a `DeferredModule` instead of executing it by its own loader."""

    def __init__(self, loader: Loader) -> None:
        """Store the module's own loader, which runs at the first use of the module."""
        self.loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Return the module object that the module's own loader creates, None for a usual module."""
        return self.loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Make the module a `DeferredModule` instead of running its code; names such as `__file__` are set already."""
        module.__class__ = DeferredModule


class DeferredFinder(MetaPathFinder):
    """Import finder that defers the code of `DEFERRED` to its first use, and Ctrl-C to the end of `UNINTERRUPTED`."""

    def find_spec(self, fullname: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the specification of a deferred module, None for any other module."""
        spec = PathFinder.find_spec(fullname, path, target) if fullname in {*DEFERRED, UNINTERRUPTED} else None
        if spec is not None and spec.loader is not None and fullname in DEFERRED:
            spec.loader = DeferredLoader(spec.loader)
        elif spec is not None and spec.loader is not None:
            spec.loader.exec_module = partial(_uninterrupted, spec.loader.exec_module)
        return spec


def _uninterrupted(execute: Callable[[ModuleType], None], module: ModuleType) -> None:
    """Run a module's code; Ctrl-C is handled at its end."""
    if current_thread() is not main_thread():
        execute(module)
        return
    requests = []
    handler = signal.signal(signal.SIGINT, lambda number, _: requests.append(number))
    try:
        execute(module)
    finally:
        signal.signal(signal.SIGINT, handler)
    for number in requests:
        signal.raise_signal(number)


class LossyFile(io.FileIO):
    """Open file that discards what it cannot write, such as to a full device or a closed pipe."""

    def write(self, data: Any) -> int:
        """Write bytes; return the number of those that are written or discarded."""
        with suppress(OSError):
            return super().write(data)
        return len(data)


def open_standard_streams() -> None:
    """Open standard streams that are closed, as by `>&-`, on the null device; let standard error discard messages.

    Otherwise the next opened file gets the number of such a stream, and the output of libraries. A message that cannot
    be written, as with `2>/dev/full`, changes neither the result of a command nor its exit code, as with most Unix
    tools.
    """
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # gets the lowest free number, this one
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))
    if sys.stderr is sys.__stderr__:  # no capture, such as pytest's
        buffer = io.BufferedWriter(LossyFile(sys.stderr.fileno(), "w", closefd=False))
        settings = {"encoding": sys.stderr.encoding, "errors": sys.stderr.errors}
        sys.stderr = io.TextIOWrapper(buffer, **settings, line_buffering=True)


def prepare_imports() -> None:
    """Defer imports of Newton's unused parts and collect garbage less often, for the rest of this process.

    The process also ends without a garbage collection, which would take seconds. Call it in a process of a command,
    before its imports.
    """
    if any(isinstance(finder, DeferredFinder) for finder in sys.meta_path):
        return
    sys.meta_path.insert(0, DeferredFinder())
    gc.set_threshold(FIRST_COLLECTION_THRESHOLD)
    gc.callbacks.append(_after_first_collection)
    atexit.register(gc.freeze)


def _after_first_collection(phase: str, info: dict[str, int]) -> None:
    """Collect garbage more often after the first collection, since the imports are over; arguments: of gc.callbacks."""
    gc.set_threshold(COLLECTION_THRESHOLD)
    gc.callbacks.remove(_after_first_collection)
