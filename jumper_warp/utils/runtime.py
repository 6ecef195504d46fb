"""Device, package versions and git commit of a run, for its output."""

import functools
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from platform import python_version
from typing import Any, NamedTuple

import warp as wp
from rich.console import Console

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.progress import shown
from jumper_warp.utils.startup import open_standard_streams
from jumper_warp.utils.threads import checked_threads, set_threads
from jumper_warp.utils.version import __version__

NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"  # Part of Warp's notice
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


def report_device(device: wp.DeviceLike = None, console: Console | None = None) -> DeviceInfo:
    """Print one line about a device, and return its properties (default: current device, standard error)."""
    info = device_info(device)
    if info.driver is None:
        threads = checked_threads(None)
        line = f"device: {info.alias} ({threads} thread{'s' if threads > 1 else ''})"
        line += "" if wp.is_cuda_available() else "; no CUDA GPU found"
    else:
        line = f"device: {info.alias} ({info.name}), driver for CUDA {info.driver}"
    line += "" if info.graphs else "; graph capture is off without a memory pool: each kernel is launched on its own"
    console = console or Console(stderr=True)
    console.print(line, style=None if info.graphs else "yellow", markup=False, highlight=False, soft_wrap=True)
    return info


def configure_device(device: str | None, threads: int | None = None) -> DeviceInfo:
    """Choose the Warp device and the number of CPU threads of a command, and print the device once.

    Returns the device's properties. device: a Warp device (default: the current
    one). threads: CPU threads of simulations, as in `set_threads`. Raises InputError: there is no such device, or the
    number of threads is invalid.
    """
    set_threads(threads)
    init_warp()
    try:
        return _report_once(device, checked_threads(None))
    except (ValueError, RuntimeError) as error:
        known = ", ".join(each.alias for each in wp.get_devices())
        raise InputError(f"no device {device!r:.60}; available: {known}") from error


@functools.cache
def _report_once(device: str | None, threads: int) -> DeviceInfo:
    """Print a line about a device at the first call with these arguments, and return the device's properties."""
    return report_device(device)


@functools.cache
def init_warp() -> None:
    """Initialise Warp at the first call, without messages about each module and a missing CUDA driver.

    A log level that the user has set is kept. A terminal shows when kernels are compiled. Warp's native library prints
    the notice about the driver, so that the process's standard error is a file meanwhile.
    Raises InputError, also a later compilation: the kernel cache cannot be written.
    """
    open_standard_streams()
    if wp.config.log_level == wp.LOG_INFO:  # Warp's default
        wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    with tempfile.TemporaryFile() as printed:
        stderr = os.dup(2)
        os.dup2(printed.fileno(), 2)
        try:
            with _kernel_cache():
                wp.init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            printed.seek(0)
            lines = [line for line in printed.read().decode(errors="replace").splitlines() if NO_DRIVER not in line]
            print("".join(f"{line}\n" for line in lines), end="", file=sys.stderr)
    compiler = "_compile"  # method of Warp 1.19 that is called only for a module that is not in the cache
    setattr(wp.Module, compiler, shown("compiling kernels", _kernel_cache()(getattr(wp.Module, compiler))))


@contextmanager
def _kernel_cache() -> Iterator[None]:
    """Raise InputError in place of an OSError of Warp about its kernel cache, for a block or a decorated function."""
    try:
        yield
    except OSError as error:
        folder = f"kernel cache {wp.config.kernel_cache_dir} cannot be written"
        raise InputError(f"{folder} ({error.strerror}): set WARP_CACHE_PATH to a writable folder") from error


def git_commit(folder: Path | None = None) -> Commit | None:
    """Return the git commit of the source tree in `folder`, by default this package's, looked up only once.

    None without git, outside a git tree, in a tree without commits, and if the enclosing tree does not track the
    folder, as for a package installed inside another project.
    """
    if folder is None:
        return _package_commit()
    commit = _git(folder, "rev-parse", "--verify", "HEAD") if _git(folder, "ls-files") else None
    return Commit(commit.strip(), bool(_git(folder, "status", "--porcelain", "--", ":/"))) if commit else None


@functools.cache
def _package_commit() -> Commit | None:
    """Return the git commit of this package's source tree, cached at the first call."""
    return git_commit(Path(__file__).parent)


def _git(folder: Path, *arguments: str) -> str | None:
    """Return git's standard output for the tree in `folder`, or None if it fails or is not installed."""
    try:
        settings: dict[str, Any] = {"capture_output": True, "text": True, "errors": "replace", "timeout": 30}
        result = subprocess.run(["git", "-C", str(folder), *arguments], **settings)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout if result.returncode == 0 else None


def source_versions() -> dict[str, Any]:
    """Return this package's git commit and whether files have changed (None without git), and versions of packages."""
    commit = git_commit()
    return {"commit": commit and commit.hash, "dirty": commit and commit.dirty, "versions": versions()}


def versions() -> dict[str, str | None]:
    """Return the versions of Python, this package and each of `PACKAGES`; None for one that is not installed."""
    by_package: dict[str, str | None] = {"python": python_version(), "jumper-warp": __version__}
    for package in PACKAGES:
        try:
            by_package[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            by_package[package] = None
    return by_package
