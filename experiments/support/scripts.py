"""Flags of scripts, their output folder, and the summary that they end with."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from jumper_warp.cli.flags import parse
from jumper_warp.cli.main import check_words, run_command
from jumper_warp.utils.files import Json
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import configure_device
from jumper_warp.utils.startup import prepare_imports
from jumper_warp.utils.summary import PrintFlags, print_summary
from support.timing import process_age

Args = TypeVar("Args")


@dataclass(frozen=True)
class OutputArgs(PrintFlags):
    """Flags that every experiment script has."""

    out: Path | None = None  # Folder for metrics.json, plots and recordings (default: outputs/<script>/<time>)


@dataclass(frozen=True)
class DeviceArgs(OutputArgs):
    """Flags of an experiment script that computes on one device."""

    device: str | None = None  # Warp device, such as cpu or cuda:0 (default: a GPU if there is one)


@dataclass(frozen=True)
class ThreadArgs(DeviceArgs):
    """Flags of an experiment script that can use several CPU threads."""

    threads: int | None = None  # CPU threads that share the worlds (default: all cores); they change no result


def run_script(main: Callable[[Args], Any], kind: type[Args]) -> None:
    """Call `main` with the flags of a script, of type `kind`; print InputError and OSError as one line, exit code 2."""
    prepare_imports()
    run_command(lambda: main(parse_flags(kind)))


def parse_flags(kind: type[Args]) -> Args:
    """Return the flags of a script, an object of `kind`, from the command line; `--help` prints the script's docstring.

    Raises InputError: there is no such flag, or a value is invalid.
    """
    # lines of a paragraph or of an item of a list become one, which the help wraps at the terminal's width
    about = re.sub(r"(?<!\n)\n {0,3}(?![\s-]|\d+\. )", " ", sys.modules["__main__"].__doc__ or "").strip()
    name = Path(sys.argv[0]).name
    check_words(sys.argv[1:])
    return parse(kind, name, sys.argv[1:], description=about, program=f"python experiments/{name}")


def prepare(name: str, args: DeviceArgs, threads: int | None = None) -> Path:
    """Select device and CPU threads, print them, create and return the output folder; name: of the script."""
    configure_device(args.device, threads)
    return output_dir(name, args.out)


def announce(text: str) -> None:
    """Print what a script does or has done, with the time since its start, on standard error."""
    print(f"{process_age():4.0f} s  {text}", file=sys.stderr, flush=True)


def report(
    args: PrintFlags,
    folder: Path,
    values: Json,
    done: str,
    keys: Iterable[str],
    paper: Mapping[str, float] | None = None,
) -> Json:
    """Write metrics by name to `metrics.json` in a folder, print a summary, and return the metrics.

    done: what was done, the first line; keys: of the metrics in the summary, missing ones are skipped; paper: published
    values by key.
    """
    print_summary(write_metrics(folder, values), done, keys, paper=paper, flags=args, seconds=process_age())
    return values
