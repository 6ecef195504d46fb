"""The command `jumper`: train, finetune, play, evaluate, export, sysid, list. `jumper COMMAND --help` shows the flags.

A command imports only what it needs, so that help and usage errors print at once.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
import traceback
from collections.abc import Callable, Collection, Sequence
from typing import Any

from jumper_warp.utils.errors import InputError

USAGE_ERROR = 2  # Exit code for input that cannot be used
INTERRUPTED = 130  # Exit code after Ctrl-C
COMMANDS = {
    "train": "Train a policy: jumper train TASK.",
    "finetune": "Make a jumping policy miss by less, by gradients through the physics.",
    "play": "Record a policy for the Rerun viewer.",
    "evaluate": "Measure a policy over many trials.",
    "export": "Make a policy's folder of a training run, or one ONNX file of a policy; export robot: MJCF, URDF, USD.",
    "sysid": "Identify the robot's parameters from recorded motions.",
    "list": "Show the tasks and the project's policies.",
}
"""Help text by command; each command is a module of `jumper_warp.cli` with run(args, modules)."""
CODEGEN = re.compile(r'Error while parsing function "(\w+)" at (.+):\d+:')
"""Function and file in Warp's message about a kernel that does not compile; the last match has the error."""
TASK_MODULE = "--task-module"
TASK_MODULE_HELP = f"""\
Every command takes {TASK_MODULE} FILE_OR_MODULE, any number of times: a FILE.py or an installed module
that registers tasks of your own, and has the functions that saved ones name."""


class UsageError(InputError):
    """Invalid command line; the message is one line."""


def usage() -> str:
    """Return the help text that lists all commands."""
    lines = ["usage: jumper COMMAND [arguments]", ""]
    lines += [f"  {name:<10}{about}" for name, about in COMMANDS.items()]
    return "\n".join([*lines, "", TASK_MODULE_HELP, "", "jumper COMMAND --help shows the arguments of one."])


def main(argv: Sequence[str] | None = None) -> None:
    """Run a `jumper` command; exits with code 2 and one line on standard error if its input is invalid.

    argv: the arguments after `jumper` (default: those of the process).
    """
    args = list(sys.argv[1:] if argv is None else argv)
    if not args:
        print(usage(), file=sys.stderr)
        raise SystemExit(USAGE_ERROR)
    if args[0] in ("-h", "--help"):
        print(usage())
        raise SystemExit(0)
    run_command(lambda: dispatch(args))


def dispatch(args: Sequence[str]) -> None:
    """Run the command named by the first argument; errors in the user's files become InputError.

    Raises UsageError: there is no such command. Other exceptions are the command's.
    """
    name = args[0]
    if name not in COMMANDS:
        raise UsageError(f"no command {name!r:.60}; there are {', '.join(COMMANDS)}")
    rest, files = split_task_modules(args[1:])
    modules = []
    try:
        if files:
            from jumper_warp.registry import load_task_module

            modules += (load_task_module(file) for file in files)
        importlib.import_module(f"jumper_warp.cli.{name}").run(rest, modules)
    except Exception as error:
        user_files = {os.path.abspath(path) for path in (*files, *(module.__file__ for module in modules)) if path}
        if message := user_file_error(user_files, error):
            raise InputError(message) from error
        raise


def user_file_error(files: Collection[str], error: Exception) -> str | None:
    """Return a message with file and line of an exception raised in one of `files` (absolute paths), else None."""
    functions = CODEGEN.findall(str(error))
    if functions and os.path.abspath(functions[-1][1]) in files:
        name, path = functions[-1]
        return f"{os.path.basename(path)}, function {name}: {str(error).rsplit(';Error', 1)[-1].strip(' ,')}"
    frames = [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    if isinstance(error, InputError) or not frames or os.path.abspath(frames[-1][0]) not in files:
        return None
    return f"{os.path.basename(frames[-1][0])}:{frames[-1][1]}: {type(error).__name__}: {error}"


def split_task_modules(args: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the arguments without --task-module, and its values. Raises UsageError: a value is missing."""
    rest, names, remaining = [], [], iter(args)
    for arg in remaining:
        flag, equals, name = arg.partition("=")
        if flag.replace("_", "-") != TASK_MODULE:
            rest.append(arg)
            continue
        name = name if equals else next(remaining, "")
        if not name or name.startswith("-"):
            raise UsageError(f"{TASK_MODULE} needs a FILE.py or the name of a module")
        names.append(name)
    return rest, names


def parse(kind: Any, command: str, args: Sequence[str], **settings: Any) -> Any:
    """Return a command's settings parsed from its arguments; exits with USAGE_ERROR if they are invalid.

    kind: dataclass of the settings. settings: keyword arguments of `tyro.cli`; default description: kind's docstring.
    """
    import tyro

    from jumper_warp.cli.renamed_flags import use_new_names

    about = settings.pop("description", kind.__doc__)
    description = f"{about}\n\n{TASK_MODULE_HELP}"
    args = use_new_names(args, settings.get("default", kind))
    return tyro.cli(kind, prog=f"jumper {command}", description=description, args=args, **settings)


def run_command(command: Callable[[], object]) -> None:
    """Call a command or an experiment; exits with code 2 and one line on standard error if its input is invalid.

    InputError, and OSError about a file, are printed as one line; any other exception propagates.
    """
    try:
        command()
        sys.stdout.flush()
    except KeyboardInterrupt:
        raise SystemExit(INTERRUPTED) from None
    except BrokenPipeError:  # the reader closed the pipe, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (InputError, OSError) as error:
        if isinstance(error, OSError) and error.filename is None:
            raise
        print(f"jumper: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(USAGE_ERROR) from None
