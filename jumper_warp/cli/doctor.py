"""`jumper doctor`: check the installation, and step an environment on each device."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from platform import platform
from types import ModuleType
from typing import Any

from jumper_warp.cli.flags import parse
from jumper_warp.cli.main import FAULT

TASK = "vertical-jump"  # Task of the environment that is stepped
WORLDS = 64  # Worlds of the environment
PACKAGES = (
    "rerun-sdk", "pin", "onnx", "scipy", "matplotlib", "tyro", "onnxruntime", "gymnasium", "stable-baselines3",
    "usd-core", "newton-usd-schemas", "pyglet", "imageio-ffmpeg", "wandb",
)  # fmt: skip
"""Packages whose versions are printed, beside those of `jumper_warp.utils.runtime.PACKAGES`."""


@dataclass(frozen=True)
class DoctorCfg:
    """Check the installation: versions, and one environment step on each device.

    The exit code is 1 if a device fails. Add the output to a bug report.
    """

    task: str = ""
    """Instead run each of your own terms of this task alone, in a process of its own that ends at an index outside an
    array, and name the terms that fail."""


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Print versions, and the result of a step on each device; exits with code 1 if one fails. modules: unused."""
    cfg = parse(DoctorCfg, "doctor", args)
    if cfg.task:
        check_task(cfg.task)
        return
    import warp as wp

    from jumper_warp.utils.runtime import init_warp, source_versions, versions

    init_warp()
    source = source_versions()
    commit = f"{source['commit'] or 'unknown'}{', changed' if source['dirty'] else ''}"
    rows = {"commit": commit, "package": str(Path(__file__).resolve().parents[1]), "system": platform()}
    rows |= source["versions"] | versions(PACKAGES)
    for name, text in rows.items():
        print(f"{name:<20}{text or '-'}")
    failed = False
    for device in wp.get_devices():
        try:
            text = check_device(device)
        except Exception as error:  # every fault of a device is a result
            failed = True
            text = f"FAILED: {type(error).__name__}: {' '.join(str(error).split()):.200}"
        print(f"{device!s:<20}{text}", flush=True)
    if failed:
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


def check_device(device: Any) -> str:
    """Build and step an environment on a Warp device; return the device's name, and the time of both [s], as text.

    Raises RuntimeError: an observation is not finite. Other errors are those of the environment.
    """
    import torch

    from jumper_warp.envs.env import Env
    from jumper_warp.registry import make_task
    from jumper_warp.utils.runtime import device_info

    info = device_info(device)
    start = time.perf_counter()
    env = Env(make_task(TASK), WORLDS, device=info.alias)
    env.reset()
    env.step(torch.zeros(WORLDS, env.num_actions, device=env.device))
    if not bool(env.obs.isfinite().all()):
        raise RuntimeError("observations are not finite")
    driver = f", driver for CUDA {info.driver}" if info.driver else ""
    return f"{info.name}{driver}: built and stepped {WORLDS} worlds in {time.perf_counter() - start:.1f} s"
