"""Device, package versions and git commit of a run, for its output."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Iterable
from contextlib import ExitStack
from importlib import metadata
from pathlib import Path
from platform import python_version
from typing import TYPE_CHECKING, NamedTuple

import warp as wp

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json
from jumper_warp.utils.startup import open_standard_streams
from jumper_warp.utils.threads import checked_threads, set_threads
from jumper_warp.utils.version import __version__

if TYPE_CHECKING:
    import torch

PACKAGES = ("warp-lang", "newton", "mujoco", "mujoco-warp", "torch", "numpy", "rsl-rl-lib")
"""Installed distributions whose version can change a result."""


class Commit(NamedTuple):
    """Git commit of a source tree, and whether the tree has changes."""

    hash: str  # full hash of the checked-out commit
    dirty: bool  # whether there are modified or untracked files


class DeviceInfo(NamedTuple):
    """Names, CUDA version and graph capabilities of a Warp device."""

    alias: str  # warp's name of the device, for example `cpu` or `cuda:0`
    name: str  # product name of the processor
    driver: str | None  # CUDA version that the driver supports; None on a CPU
    mempool: bool  # whether device memory comes from a stream-ordered pool, which captured graphs need to allocate
    graphs: bool  # whether a step that allocates memory can be captured as a graph


def device_info(device: wp.DeviceLike = None) -> DeviceInfo:
    """Return the properties of a Warp device (default: the current one)."""
    resolved = wp.get_device(device)
    if not resolved.is_cuda:
        return DeviceInfo(resolved.alias, resolved.name, driver=None, mempool=False, graphs=True)
    driver = ".".join(map(str, wp.get_cuda_driver_version() or ()))
    mempool = wp.is_mempool_enabled(resolved)
    return DeviceInfo(resolved.alias, resolved.name, driver=driver, mempool=mempool, graphs=mempool)


def configure_device(device: str | None, threads: int | None = None) -> DeviceInfo:
    """Choose the Warp device and the number of CPU threads of a command, start it, and print the device once.

    Returns the device's properties. device: a Warp device (default: the current
    one). threads: CPU threads of simulations, as in `set_threads`. Raises InputError: there is no such device, or the
    number of threads is invalid.
    """
    set_threads(threads)
    init_warp()
    try:
        info = _report_once(device, checked_threads(None))
        _ = wp.get_device(device).context  # creates the device's context
        return info
    except (ValueError, RuntimeError) as error:
        known = ", ".join(each.alias for each in wp.get_devices())
        raise InputError(f"no device {device!r:.60}; available: {known}") from error


@functools.cache
def _report_once(device: str | None, threads: int) -> DeviceInfo:
    """Print a line about a device at the first call with these arguments, and return the device's properties.

    The cache keeps a script with several environments from repeating the line.
    """
    info = device_info(device)
    if info.driver is None:
        line = f"device: {info.alias} ({threads} thread{'s' if threads > 1 else ''})"
        line += "" if wp.is_cuda_available() else "; no CUDA GPU found"
    else:
        line = f"device: {info.alias} ({info.name}), driver for CUDA {info.driver}"
    line += "" if info.graphs else "; graph capture is off without a memory pool: each kernel is launched on its own"
    print(line, file=sys.stderr)
    return info


@functools.cache
def init_warp() -> None:
    """Initialise Warp at the first call, without messages about each module; a log level that the user has set is kept.

    Raises InputError: the kernel cache cannot be made.
    """
    open_standard_streams()
    if wp.config.log_level == wp.LOG_INFO:  # Warp's default
        wp.config.log_level = wp.LOG_WARNING
    try:
        wp.init()
    except OSError as error:
        folder = f"kernel cache {wp.config.kernel_cache_dir} cannot be written"
        raise InputError(f"{folder} ({error.strerror}): set WARP_CACHE_PATH to a writable folder") from error


@functools.cache
def git_commit() -> Commit | None:
    """Return the git commit of this package's source tree, looked up only once.

    None without git, outside a git tree, in a tree without commits, and if the enclosing tree does not track the
    package, as for one installed inside another project.
    """
    folder = Path(__file__).parent
    commit = _git(folder, "rev-parse", "--verify", "HEAD") if _git(folder, "ls-files") else None
    return Commit(commit.strip(), bool(_git(folder, "status", "--porcelain", "--", ":/"))) if commit else None


def _git(folder: Path, *arguments: str) -> str | None:
    """Return git's standard output for the tree in `folder`, or None if it fails or is not installed."""
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]  # the user's git may run at the same time
    try:
        result = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=30, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout if result.returncode == 0 else None


def source_versions() -> Json:
    """Return this package's git commit and whether files have changed (None without git), and versions of packages."""
    commit = git_commit()
    return {"commit": commit and commit.hash, "dirty": commit and commit.dirty, "versions": versions()}


def versions(packages: Iterable[str] = PACKAGES) -> dict[str, str | None]:
    """Return the versions of Python, this package and other `packages`; None for one that is not installed."""
    by_package: dict[str, str | None] = {"python": python_version(), "jumper-warp": __version__}
    for package in packages:
        try:
            by_package[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            by_package[package] = None
    return by_package


class DeviceStream:
    """Context in which PyTorch and Warp enqueue work on a GPU stream of its own; on a CPU it does nothing."""

    def __init__(self, device: torch.device) -> None:
        """Create a stream on a device of PyTorch."""
        init_warp()
        self._stream = wp.Stream(wp.get_device(str(device))) if device.type == "cuda" else None
        self._entered = ExitStack()

    def __enter__(self) -> None:
        """Make the stream the current one of PyTorch and of Warp."""
        if self._stream is not None:
            import torch

            self._entered.enter_context(wp.ScopedStream(self._stream, sync_enter=False))
            self._entered.enter_context(torch.cuda.stream(wp.stream_to_torch(self._stream)))

    def __exit__(self, *_: object) -> None:
        """Make the previous streams the current ones."""
        self._entered.close()
