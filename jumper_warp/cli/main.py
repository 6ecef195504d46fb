"""The command `jumper`: train, play, evaluate, export, list. `jumper COMMAND --help` shows the flags.

Only what a command needs is imported, so that help and mistakes answer at once.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import tyro

OWN = ("jumper_warp", "experiments", "__main__")
"""First names of modules whose word on their input is a refusal; an experiment that is run is `__main__`."""
USAGE_ERROR = 2
"""Exit code for input that cannot be used."""
INTERRUPTED = 130
"""Exit code after Ctrl-C."""


class UsageError(ValueError):
    """A command that cannot be understood. The message is one line."""


def train_command(args: Sequence[str]) -> None:
    """Train a policy: jumper train TASK."""
    from jumper_warp.cli.train import run_train

    run_train(args)


def play_command(args: Sequence[str]) -> None:
    """Record a policy's jumps for the Rerun viewer."""
    from jumper_warp.cli.play import PlayCfg, play
    from jumper_warp.policies.restore import open_policy

    cfg = parse(PlayCfg, "play", args)
    open_policy(cfg.policy)  # what is wrong with it is said before anything else
    announce(cfg.conditions.device)
    play(cfg)


def evaluate_command(args: Sequence[str]) -> None:
    """Measure a policy over many jumps."""
    from jumper_warp.cli.evaluate import EvaluateCfg, evaluate
    from jumper_warp.policies.restore import open_policy

    cfg = parse(EvaluateCfg, "evaluate", args)
    open_policy(cfg.policy)  # what is wrong with it is said before anything else
    announce(cfg.conditions.device)
    evaluate(cfg)


def export_command(args: Sequence[str]) -> None:
    """Make a policy's folder of a training run, or one ONNX file of a policy."""
    from jumper_warp.cli.export import ExportCfg, export

    export(parse(ExportCfg, "export", args))


def list_command(args: Sequence[str]) -> None:
    """Show the tasks and the project's policies."""
    parse(ListCfg, "list", args)
    from rich.console import Console

    from jumper_warp.policies.folder import list_policies
    from jumper_warp.registry import ALIASES, TASKS

    console = Console()
    for name in TASKS:
        aliases = ", ".join(alias for alias, task in ALIASES.items() if task == name)
        console.print(f"task    {name}" + (f" ({aliases})" if aliases else ""), highlight=False)
    for name in list_policies():
        console.print(f"policy  {name}", highlight=False)


@dataclass(frozen=True)
class ListCfg:
    """Show the tasks and the project's policies."""


COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {
    "train": train_command,
    "play": play_command,
    "evaluate": evaluate_command,
    "export": export_command,
    "list": list_command,
}


def announce(device: str | None) -> None:
    """Print a line on the device that is going to be used, and silence Warp's notes on its modules.

    Raises:
        UsageError: There is no such device.
    """
    import warp as wp

    from jumper_warp.utils.runtime import report_device

    wp.config.log_level = wp.LOG_WARNING
    try:
        report_device(device)
    except (ValueError, RuntimeError) as error:
        raise UsageError(f"no device {device!r:.60}") from error


def parse(kind: type, command: str, args: Sequence[str]) -> Any:
    """Return a command's settings from its arguments; exits with USAGE_ERROR if they are not understood."""
    return tyro.cli(kind, prog=f"jumper {command}", args=list(args))


def usage() -> str:
    """Return the overview of all commands."""
    lines = ["usage: jumper COMMAND [arguments]", ""]
    lines += [f"  {name:<10}{command.__doc__}" for name, command in COMMANDS.items()]
    return "\n".join([*lines, "", "jumper COMMAND --help shows the arguments of one."])


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command; exits with 2 and one line on standard error if its input cannot be used."""
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        print(usage())
        raise SystemExit(0 if args else USAGE_ERROR)
    run_command(lambda: dispatch(args))


def dispatch(args: Sequence[str]) -> None:
    """Run the command that comes first. Raises UsageError if there is none of that name."""
    if args[0] not in COMMANDS:
        raise UsageError(f"no command {args[0]!r}; there are {', '.join(COMMANDS)}")
    COMMANDS[args[0]](args[1:])


def run_command(command: Callable[[], object]) -> None:
    """Call a command or an experiment; exits with 2 and one line on standard error if its input cannot be used."""
    try:
        command()
    except KeyboardInterrupt:
        raise SystemExit(INTERRUPTED) from None
    except (ValueError, OSError) as error:
        if not is_refusal(error):
            raise
        print(f"jumper: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(USAGE_ERROR) from None


def is_refusal(error: Exception) -> bool:
    """Return whether an error is this project's word on its input, and not a fault inside some library."""
    if isinstance(error, OSError):
        return error.filename is not None
    frames = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
    return bool(frames) and frames[-1].split(".")[0] in OWN
