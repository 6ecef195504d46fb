"""Wall time of work on a device, and the same script of another checkout beside it."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from jumper_warp.utils.errors import InputError

RATE = "steps_per_s"
"""Part of the names of figures that are compared."""


def wall_time(body: Callable[[], Any], device: wp.DeviceLike = None, calls: int = 1) -> float:
    """Return the seconds of a call; waits for the device before and after all of them."""
    wp.synchronize_device(device)
    start = time.perf_counter()
    for _ in range(calls):
        body()
    wp.synchronize_device(device)
    return (time.perf_counter() - start) / calls


def median_time(body: Callable[[], Any], device: wp.DeviceLike = None, calls: int = 1, repeats: int = 5) -> float:
    """Return the seconds of a call as `wall_time`, the median of some repetitions."""
    return float(np.median([wall_time(body, device, calls) for _ in range(repeats)]))


def process_age() -> float:
    """Return the seconds since this process was started, by the system's clock."""
    ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")


def device_memory(device: wp.Device) -> int:
    """Return bytes in use on a GPU, 0 on a CPU."""
    return device.total_memory - device.free_memory if device.is_cuda else 0


def over_baseline(checkout: Path | None, script: str, args: Any, figures: Mapping[str, Any]) -> dict[str, float]:
    """Run the same script of another checkout on this machine, and return the ratios of all rates, ours over its own.

    Args:
        checkout: Its root; None: nothing is run or returned.
        script: Path of the script within.
        args: A dataclass, the flags of this run; `out`, `baseline` and what is as by default are left out, so that
            another checkout need not know the newest flags.
        figures: Of this run.

    Raises:
        InputError: There is no such script, or it fails.
    """
    if checkout is None:
        return {}
    if not (checkout / script).is_file():
        raise InputError(f"no {script} in {checkout}")
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, script, *flags_of(args), "--out", folder]
        found = [str(checkout.resolve()), *filter(None, [os.environ.get("PYTHONPATH")])]
        env = os.environ | {"PYTHONPATH": os.pathsep.join(found)}
        done = subprocess.run(command, cwd=checkout, env=env, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"{script} of {checkout} fails: {done.stderr.strip().splitlines()[-1:]}")
        base = json.loads((Path(folder) / "metrics.json").read_text())
    rates = [name for name, value in figures.items() if RATE in name and isinstance(value, float) and base.get(name)]
    return {f"{name}_over_baseline": figures[name] / base[name] for name in rates}


def flags_of(args: Any) -> list[str]:
    """Return a dataclass as flags of the command line, without `out`, `baseline` and what is as by default."""
    flags: list[str] = []
    for spec in dataclasses.fields(args):
        value, name = getattr(args, spec.name), spec.name.replace("_", "-")
        make = spec.default_factory
        default = spec.default if make is dataclasses.MISSING else make()
        if spec.name in ("out", "baseline") or value == default:
            continue
        if isinstance(value, bool):
            flags.append(f"--{name}" if value else f"--no-{name}")
        else:
            flags += [f"--{name}", *map(str, value if isinstance(value, tuple | list) else [value])]
    return flags
