"""What a result was made with: device, driver, package versions and commit."""

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
"""Distributions whose version can change a figure."""


class Commit(NamedTuple):
    """State of the source tree."""

    hash: str
    """Full hash of the checked-out commit."""
    dirty: bool
    """Whether tracked files differ from that commit or untracked files lie beside them."""


class DeviceInfo(NamedTuple):
    """What Warp computes on."""

    alias: str
    """Warp's name of the device, for example `cpu` or `cuda:0`."""
    name: str
    """The maker's name of the processor."""
    driver: str | None
    """CUDA version that the driver supports; None on a CPU."""
    mempool: bool
    """Whether device memory comes from a stream-ordered pool, which captured graphs need to allocate."""
    graphs: bool
    """Whether a step that allocates memory can be captured as a graph."""


def device_info(device: wp.DeviceLike = None) -> DeviceInfo:
    """Return the facts about a Warp device; None is the current one."""
    found = wp.get_device(device)
    if not found.is_cuda:
        return DeviceInfo(found.alias, found.name, driver=None, mempool=False, graphs=True)
    driver = ".".join(map(str, wp.get_cuda_driver_version() or ()))
    pooled = wp.is_mempool_enabled(found)
    return DeviceInfo(found.alias, found.name, driver=driver, mempool=pooled, graphs=pooled)


def report_device(device: wp.DeviceLike = None, console: Console | None = None) -> DeviceInfo:
    """Print one line on the device to standard error, and return the same facts."""
    info = device_info(device)
    parts = [f"device {info.alias} ({info.name})"]
    if info.driver is None:
        parts.append(f"threads {checked_threads(None)}")
        parts.append("no CUDA device in use: large batches will be slow")
    else:
        parts += [f"driver for CUDA {info.driver}", f"mempool {'on' if info.mempool else 'OFF'}"]
    parts.append(f"graph capture {'on' if info.graphs else 'OFF: each kernel is launched on its own'}")
    good = info.driver is not None and info.graphs
    console = console or Console(stderr=True)
    console.print(", ".join(parts), style="green" if good else "yellow", markup=False, highlight=False, soft_wrap=True)
    return info


def configure_device(device: str | None, threads: int | None = None) -> DeviceInfo:
    """Print a line on the device that is going to be used, and silence Warp's notes on its modules.

    threads: of a CPU, for all simulations that are made from now on, as in `set_threads`.

    Raises InputError: there is no such device, or no such number of threads.
    """
    set_threads(threads)
    wp.config.log_level = wp.LOG_WARNING
    try:
        return report_device(device)
    except (ValueError, RuntimeError) as error:
        raise InputError(f"no device {device!r:.60}") from error


def git_commit(folder: Path | None = None) -> Commit | None:
    """Return the commit of the source tree in `folder` (default: this package's, as it was when first asked for).

    None without git, outside a git tree, in a tree without commits, and where the enclosing tree does not track
    the folder, as for a package installed inside another project.
    """
    if folder is None:
        return _own_commit()
    commit = _git(folder, "rev-parse", "--verify", "HEAD") if _git(folder, "ls-files") else None
    return Commit(commit.strip(), bool(_git(folder, "status", "--porcelain", "--", ":/"))) if commit else None


@functools.cache
def _own_commit() -> Commit | None:
    """Return the commit of this package's source tree; what has been imported from it stays the same."""
    return git_commit(Path(__file__).parent)


def _git(folder: Path, *arguments: str) -> str | None:
    """Return what git prints for the tree in `folder`, or None if it fails or is not installed."""
    try:
        answer = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout if answer.returncode == 0 else None


def source_versions() -> dict[str, Any]:
    """Return the commit of this package's source tree, whether it is dirty, and `versions`."""
    commit = git_commit()
    return {"commit": commit and commit.hash, "dirty": commit and commit.dirty, "versions": versions()}


def versions() -> dict[str, str | None]:
    """Return the version of Python and of each of `PACKAGES`; None for one that is not installed."""
    found: dict[str, str | None] = {"python": python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found
