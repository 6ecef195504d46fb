"""Flags and report shared by scripts."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import tyro

from jumper_warp.cli.renamed_flags import use_new_names
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import configure_device

Args = TypeVar("Args")


@dataclass(frozen=True)
class DeviceArgs:
    """Flags of a script that computes on one device."""

    out: Path | None = None
    """Folder for metrics.json, plots and recordings (default: outputs/<script>/<time>)."""
    device: str | None = None
    """Warp device."""


@dataclass(frozen=True)
class ThreadArgs(DeviceArgs):
    """Flags of a script whose worlds may share CPU threads."""

    threads: int | None = None
    """CPU threads that share the worlds (default: all cores); they change no result."""


def parse_flags(kind: type[Args]) -> Args:
    """Return a script's flags from the command line. Raises InputError: a flag is given by its old and new name."""
    return tyro.cli(kind, args=use_new_names(sys.argv[1:], kind))


def prepare(name: str, args: DeviceArgs, threads: int | None = None) -> Path:
    """Select device and threads, print them, and return the output folder of a script."""
    configure_device(args.device, threads)
    return output_dir(name, args.out)


def report(folder: Path, values: Mapping[str, Any]) -> None:
    """Write metrics to `metrics.json` in a folder, and print them and the folder."""
    write_metrics(folder, values)
    for name, value in values.items():
        items = value if isinstance(value, list | tuple) else [value]
        print(f"{name:40} {', '.join(map(number_text, items))}")
    print(f"metrics, plots and recordings in {folder}")


def number_text(value: Any) -> str:
    """Return a value as text; floats have four significant digits, or all before the decimal point."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 1.0e3 else f"{value:.4g}"
