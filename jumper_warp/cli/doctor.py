"""`jumper doctor`: check the installation, and step an environment on each device."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from platform import platform
from types import ModuleType
from typing import Any

from jumper_warp.cli.main import FAULT, parse

TASK = "vertical-jump"  # Task of the environment that is stepped
WORLDS = {"cpu": 64, "cuda": 1024}  # Worlds of the environment by type of device
SECONDS = 0.5  # [s] Time for which an environment is stepped
DEPENDENCIES = ("rerun-sdk", "pin", "onnx", "scipy", "matplotlib", "tyro")  # beside those of `runtime.PACKAGES`
OPTIONAL = ("onnxruntime", "cma", "gymnasium", "stable-baselines3", "usd-core", "newton-usd-schemas", "pyglet",
            "imageio-ffmpeg", "wandb")  # fmt: skip
VARIABLES = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "CUDA_VISIBLE_DEVICES", "WARP_CACHE_PATH",
             "TORCHINDUCTOR_CACHE_DIR", "PYTHONPATH")  # fmt: skip
"""Environment variables that change threads, devices, caches or the imported package."""


@dataclass(frozen=True)
class DoctorCfg:
    """Check the installation: versions, devices, threads, caches, OpenGL and the working folder.

    Also steps an environment on each device. The exit code is 1 if a device fails. Add the output to a bug report.
    """

    json: bool = False  # Print JSON
    task: str = ""
    """Instead run each of your own terms of this task alone, in a process of its own that ends at an index outside an
    array, and name the terms that fail."""


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Print the state of the installation; exits with code 1 if a device fails. modules: unused."""
    cfg = parse(DoctorCfg, "doctor", args)
    if cfg.task:
        check_task(cfg.task)
        return
    import warp as wp

    from jumper_warp.utils.runtime import init_warp, source_versions

    init_warp()
    versions = source_versions()
    content = {
        "commit": versions["commit"], "dirty": versions["dirty"], "system": platform(), "package": package_folder(),
        "versions": versions["versions"] | {name: version_of(name) for name in DEPENDENCIES},
        "optional": {name: version_of(name) for name in OPTIONAL},
        "threads": threads(), "environment": {name: os.environ[name] for name in VARIABLES if name in os.environ},
        "folders": {name: describe_folder(path) for name, path in folders().items()},
        "opengl": opengl(), "devices": [check_device(device) for device in wp.get_devices()],
    }  # fmt: skip
    print(json.dumps(content, indent=2) if cfg.json else "\n".join(lines_of(content)))
    if any(device["error"] for device in content["devices"]):
        sys.stdout.flush()
        raise SystemExit(FAULT)


def check_task(name: str) -> None:
    """Run each of the user's terms of a task alone, and print the results; exits with code 1 if one fails."""
    from jumper_warp.envs.term_check import check_terms
    from jumper_warp.registry import make_task

    failed = False
    for term, failure in check_terms(make_task(name)):
        print(f"{term}: {failure or 'ok'}", flush=True)
        failed = failed or bool(failure)
    if failed:
        raise SystemExit(FAULT)


def package_folder() -> str:
    """Return the folder of the imported package."""
    return str(Path(__file__).resolve().parents[1])


def version_of(package: str) -> str | None:
    """Return the version of an installed package; None: it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def threads() -> dict[str, int]:
    """Return the number of CPU cores, and the default numbers of threads of simulations and of torch."""
    import torch

    from jumper_warp.utils.threads import available_threads

    return {"cores": os.cpu_count() or 1, "simulation": available_threads(), "torch": torch.get_num_threads()}


def folders() -> dict[str, Path]:
    """Return the working folder, and the kernel caches of Warp and of Triton, by name."""
    import warp as wp

    triton = Path(os.environ.get("TRITON_CACHE_DIR", Path.home() / ".triton" / "cache"))
    return {"working": Path.cwd(), "kernels": Path(str(wp.config.kernel_cache_dir)), "Triton": triton}


def describe_folder(path: Path) -> dict[str, Any]:
    """Return a folder's path, whether files can be written, free space [byte], and for a cache its size [byte]."""
    exists = path.is_dir()
    existing = next(parent for parent in (path, *path.parents) if parent.is_dir())
    try:
        with tempfile.TemporaryFile(dir=existing):
            writable = True
    except OSError:
        writable = False
    size = sum(file_sizes(path)) if exists and path != Path.cwd() else None
    free = shutil.disk_usage(existing).free
    return {"path": str(path), "exists": exists, "writable": writable, "free_bytes": free, "size_bytes": size}


def file_sizes(folder: Path) -> Iterator[int]:
    """Yield the sizes of all files in a folder and its subfolders [byte]."""
    for root, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):  # deleted meanwhile
                yield os.lstat(os.path.join(root, name)).st_size


def opengl() -> dict[str, str | None]:
    """Return the `name` of the OpenGL implementation that renders images, or the `error` if there is none."""
    from jumper_warp.viz.renderer import opengl_name

    try:
        return {"name": opengl_name(), "error": None}
    except (ImportError, RuntimeError, OSError) as error:
        return {"name": None, "error": one_line(error)}


def check_device(device: Any) -> dict[str, Any]:
    """Return a Warp device's properties, and the build time and step rate of an environment on it, or the error."""
    result: dict[str, Any] = {"alias": str(device), "name": None, "error": None}
    worlds = WORLDS["cuda" if device.is_cuda else "cpu"]
    try:
        from jumper_warp.utils.runtime import device_info

        result |= device_info(device)._asdict()
        if device.is_cuda:
            result |= {"memory_bytes": device.total_memory, "free_memory_bytes": device.free_memory}
        result |= {"worlds": worlds, **time_steps(str(device), worlds)}
    except Exception as error:  # every fault of a device is a result
        result["error"] = one_line(error)
    return result


def time_steps(device: str, worlds: int) -> dict[str, float]:
    """Build an environment and step it; return the time of the build [s] and the rate of policy steps [1/s].

    Raises RuntimeError: an observation is not finite. Other errors are those of the environment.
    """
    import torch
    import warp as wp

    from jumper_warp.envs.env import Env
    from jumper_warp.registry import make_task

    start = time.perf_counter()
    env = Env(make_task(TASK), worlds, device=device)
    env.reset()
    action = torch.zeros(worlds, 12, device=env.device)
    env.step(action)
    wp.synchronize_device(device)
    built, steps = time.perf_counter(), 0
    while time.perf_counter() < built + SECONDS:
        env.step(action)
        wp.synchronize_device(device)
        steps += 1
    seconds = time.perf_counter() - built
    if not bool(env.obs.isfinite().all()):
        raise RuntimeError("observations are not finite")
    return {"build_s": built - start, "steps_per_second": steps * worlds / seconds}


def one_line(error: Exception) -> str:
    """Return type and message of an exception on one line of at most 200 characters."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:200]


def lines_of(content: dict[str, Any]) -> list[str]:
    """Return the state of the installation as lines of text."""
    commit = f"{content['commit'][:12]}{', changed' if content['dirty'] else ''}" if content["commit"] else "unknown"
    rows = {"commit": commit, "package": content["package"], "system": content["system"]}
    rows |= {name: version or "MISSING" for name, version in content["versions"].items()}
    rows["optional"] = ", ".join(f"{name} {version or '-'}" for name, version in content["optional"].items())
    rows["threads"] = ", ".join(f"{name} {count}" for name, count in content["threads"].items())
    rows["environment"] = ", ".join(f"{name}={value}" for name, value in content["environment"].items()) or "-"
    for name, folder in content["folders"].items():
        size = "" if folder["size_bytes"] is None else f", {folder['size_bytes'] / 1e6:,.0f} MB"
        state = "writable" if folder["writable"] else "NOT WRITABLE"
        rows[f"{name} folder"] = f"{folder['path']}{size}, {state}, {folder['free_bytes'] / 1e9:,.1f} GB free"
    rows["OpenGL"] = content["opengl"]["name"] or f"none: {content['opengl']['error']}"
    for device in content["devices"]:
        rows[device["alias"]] = device_text(device)
    width = max(map(len, rows)) + 2
    return [f"{name:<{width}}{text}" for name, text in rows.items()]


def device_text(device: dict[str, Any]) -> str:
    """Return the result of a device's check as text."""
    if device["error"]:
        return f"FAILED: {device['error']}"
    gpu = ""
    if device["driver"]:
        memory = f"{device['free_memory_bytes'] / 1e9:.1f} of {device['memory_bytes'] / 1e9:.1f} GB free"
        gpu = f", driver for CUDA {device['driver']}, {memory}" + ("" if device["graphs"] else ", no graph capture")
    rate = f"{device['worlds']} worlds at {device['steps_per_second']:,.0f} steps/s, built in {device['build_s']:.1f} s"
    return f"{device['name']}{gpu}: {rate}"
