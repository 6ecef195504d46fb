"""Flags and report shared by scripts."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import tyro

from jumper_warp.cli.main import run_command
from jumper_warp.cli.renamed_flags import use_new_names
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import configure_device

Args = TypeVar("Args")


@dataclass(frozen=True)
class DeviceArgs:
    """Flags of a script that computes on one device."""

    out: Path | None = None  # Folder for metrics.json, plots and recordings (default: outputs/<script>/<time>)
    device: str | None = None  # Warp device


@dataclass(frozen=True)
class ThreadArgs(DeviceArgs):
    """Flags of a script whose worlds may share CPU threads."""

    threads: int | None = None  # CPU threads that share the worlds (default: all cores); they change no result


def run_script(main: Callable[[Args], Any], kind: type[Args]) -> None:
    """Call `main` with the flags of a script, of type `kind`; print InputError and OSError as one line, exit code 2."""
    run_command(lambda: main(parse_flags(kind)))


def parse_flags(kind: type[Args]) -> Args:
    """Return the flags of a script, an object of `kind`, from the command line.

    Raises InputError: a flag is given by both its former and its present name.
    """
    return tyro.cli(kind, args=use_new_names(sys.argv[1:], kind))


def prepare(name: str, args: DeviceArgs, threads: int | None = None) -> Path:
    """Select device and CPU threads, print them, create and return the output folder; name: of the script."""
    configure_device(args.device, threads)
    return output_dir(name, args.out)


def report(folder: Path, values: dict[str, Any]) -> dict[str, Any]:
    """Write metrics by name to `metrics.json` in a folder, print them and the folder, and return them."""
    write_metrics(folder, values)
    for name, value in values.items():
        items = value if isinstance(value, list | tuple) else [value]
        print(f"{name:40} {', '.join(map(number_text, items))}")
    print(f"metrics, plots and recordings in {folder}")
    return values


def number_text(value: Any) -> str:
    """Return a value as text; floats below 1000 have four significant digits, others all digits but no decimals."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 1.0e3 else f"{value:.4g}"
