"""Wall time of work on a device, and comparison with the same script of another checkout."""

from __future__ import annotations

import dataclasses
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
from jumper_warp.utils.output import read_values

RATE = "steps_per_s"  # Part of the names of metrics that are compared with a baseline


def wall_time(function: Callable[[], Any], device: wp.DeviceLike = None, calls: int = 1) -> float:
    """Return the mean wall time [s] of `calls` calls; waits for the device before the first and after the last."""
    wp.synchronize_device(device)
    start = time.perf_counter()
    for _ in range(calls):
        function()
    wp.synchronize_device(device)
    return (time.perf_counter() - start) / calls


def median_time(function: Callable[[], Any], device: wp.DeviceLike = None, calls: int = 1, repeats: int = 5) -> float:
    """Return the median of `wall_time` [s] over repetitions of `calls` calls each."""
    return float(np.median([wall_time(function, device, calls) for _ in range(repeats)]))


def process_age() -> float:
    """Return the time since the start of this process [s]; Linux only."""
    ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])  # start time, field 22
    return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")


def device_memory(device: wp.Device) -> int:
    """Return the memory in use on a GPU [byte], 0 on a CPU."""
    return device.total_memory - device.free_memory if device.is_cuda else 0


def baseline_ratios(checkout: Path | None, script: str, args: Any, metrics: Mapping[str, Any]) -> dict[str, float]:
    """Run the same benchmark script of another checkout, and return this run's speeds relative to it.

    Keys: `<metric>_over_baseline` for all metrics with RATE.
    checkout: root of the other checkout, None: no comparison; script: path within; args: dataclass with the flags of
    this run; metrics: of this run. Raises InputError: there is no such script, or it fails.
    """
    if checkout is None:
        return {}
    if not (checkout / script).is_file():
        raise InputError(f"no {script} in {checkout}")
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, script, *changed_flags(args), "--out", folder]
        paths = [str(checkout.resolve()), *filter(None, [os.environ.get("PYTHONPATH")])]
        env = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
        done = subprocess.run(command, cwd=checkout, env=env, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"{script} of {checkout} fails: {done.stderr.strip().splitlines()[-1:]}")
        base = read_values(Path(folder))
    rates = [name for name, value in metrics.items() if RATE in name and isinstance(value, float) and base.get(name)]
    return {f"{name}_over_baseline": metrics[name] / base[name] for name in rates}


def changed_flags(args: Any) -> list[str]:
    """Return the fields of a dataclass as command-line flags, without `out`, `baseline` and values at their default.

    Without defaults, another checkout may lack the newest flags.
    """
    flags: list[str] = []
    for spec in dataclasses.fields(args):
        value = getattr(args, spec.name)
        name = spec.name.replace("_", "-")
        make = spec.default_factory
        default = spec.default if make is dataclasses.MISSING else make()
        if spec.name in ("out", "baseline") or value == default:
            continue
        if isinstance(value, bool):
            flags.append(f"--{name}" if value else f"--no-{name}")
        else:
            flags += [f"--{name}", *map(str, value if isinstance(value, tuple | list) else [value])]
    return flags
