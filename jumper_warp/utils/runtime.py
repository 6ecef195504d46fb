"""Device, package versions and commit of a run."""

import functools
import subprocess
from importlib import metadata
from pathlib import Path
from platform import python_version
from typing import Any, NamedTuple

import warp as wp
from rich.console import Console

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.threads import checked_threads, set_threads

PACKAGES = ("jumper-warp", "warp-lang", "newton", "mujoco", "mujoco-warp", "torch", "numpy", "rsl-rl-lib")
"""Distributions whose version can change a result."""


class Commit(NamedTuple):
    """Commit and state of a source tree."""

    hash: str  # full hash of the checked-out commit
    dirty: bool  # whether there are modified or untracked files


class DeviceInfo(NamedTuple):
    """Properties of a Warp device."""

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
    parts = [f"device {info.alias} ({info.name})"]
    if info.driver is None:
        parts.append(f"threads {checked_threads(None)}")
        parts.append("no CUDA device in use: large batches will be slow")
    else:
        parts += [f"driver for CUDA {info.driver}", f"mempool {'on' if info.mempool else 'OFF'}"]
    parts.append(f"graph capture {'on' if info.graphs else 'OFF: each kernel is launched on its own'}")
    style = "green" if info.driver is not None and info.graphs else "yellow"
    console = console or Console(stderr=True)
    console.print(", ".join(parts), style=style, markup=False, highlight=False, soft_wrap=True)
    return info


def configure_device(device: str | None, threads: int | None = None) -> DeviceInfo:
    """Set the number of threads, silence Warp's module messages, and print and return the device's properties.

    device: a Warp device (default: the current one). threads: CPU threads of simulations, as in `set_threads`.
    Raises InputError: there is no such device, or the number of threads is invalid.
    """
    set_threads(threads)
    wp.config.log_level = wp.LOG_WARNING
    try:
        return report_device(device)
    except (ValueError, RuntimeError) as error:
        raise InputError(f"no device {device!r:.60}") from error


def git_commit(folder: Path | None = None) -> Commit | None:
    """Return the commit of the source tree in `folder` (default: this package's folder, cached at the first call).

    None without git, outside a git tree, in a tree without commits, and if the enclosing tree does not track the
    folder, as for a package installed inside another project.
    """
    if folder is None:
        return _package_commit()
    commit = _git(folder, "rev-parse", "--verify", "HEAD") if _git(folder, "ls-files") else None
    return Commit(commit.strip(), bool(_git(folder, "status", "--porcelain", "--", ":/"))) if commit else None


@functools.cache
def _package_commit() -> Commit | None:
    """Return the commit of this package's source tree, cached at the first call."""
    return git_commit(Path(__file__).parent)


def _git(folder: Path, *arguments: str) -> str | None:
    """Return git's standard output for the tree in `folder`, or None if it fails or is not installed."""
    try:
        result = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout if result.returncode == 0 else None


def source_versions() -> dict[str, Any]:
    """Return the dict of `commit` (hash or None), `dirty` (bool or None) and `versions` for this package."""
    commit = git_commit()
    return {"commit": commit and commit.hash, "dirty": commit and commit.dirty, "versions": versions()}


def versions() -> dict[str, str | None]:
    """Return the version of Python and of each of `PACKAGES`; None for one that is not installed."""
    by_package: dict[str, str | None] = {"python": python_version()}
    for package in PACKAGES:
        try:
            by_package[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            by_package[package] = None
    return by_package
