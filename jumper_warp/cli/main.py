"""The command `jumper`: train, play, evaluate and so on. `jumper COMMAND --help` shows the flags.

A command imports only what it needs, so that help and usage errors print at once.
"""

from __future__ import annotations

import errno
import importlib
import io
import itertools
import os
import shutil
import signal
import sys
import traceback
from collections.abc import Callable, Collection, Sequence

from jumper_warp.utils.errors import InputError, is_out_of_memory, suggestion
from jumper_warp.utils.startup import open_standard_streams, prepare_imports
from jumper_warp.utils.version import __version__

FAULT = 1  # Exit code for a fault of the program or the machine
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # Full disk, exhausted quota, too large file
LEAST_COLUMNS = 20  # Smallest width of a terminal for which the output is laid out
USAGE_ERROR = 2  # Exit code for input that cannot be used
INCONSISTENT = 3  # Exit code of `jumper sysid` for a fit that is not consistent with the data
INTERRUPTED = 130  # Exit code after Ctrl-C
COMMANDS = {
    "train": "Train a policy: jumper train TASK.",
    "watch": "Show a training that runs or has ended: jumper watch RUN.",
    "finetune": "Reduce a jumping policy's errors by gradients through the physics.",
    "play": "Record a policy for the Rerun viewer.",
    "drive": "Drive a robot from the browser.",
    "evaluate": "Measure a policy over many trials.",
    "compare": "Compare trainings of several seeds: jumper compare A B.",
    "try": "Train a changed task and its base briefly: jumper try FILE.py.",
    "sweep": "Optimise settings of a training: jumper sweep FILE.toml.",
    "rescore": "Evaluate changed rewards on a recorded motion.",
    "export": "Save a policy, a bundle for the robot, or the robot for other simulators.",
    "deploy": "Run policies on the robot: jumper deploy BUNDLE --bus BUS.",
    "bus-sim": "Simulate the robot's motors and sensors on its CAN buses.",
    "sysid": "Identify the robot's parameters from recorded motions.",
    "robot": "Write, check or show a robot of your own: jumper robot new FOLDER.",
    "list": "List the tasks and the project's policies.",
    "info": "Describe a task or a policy: jumper info NAME.",
    "doctor": "Check the installation: versions, and a step on each device.",
}
"""Help text by command; each command is a module of `jumper_warp.cli` with run(args, modules), see MODULES."""
MODULES = {"bus-sim": "bus_sim", "try": "try_task"}  # Module of `jumper_warp.cli` by command, where their names differ
RED, RESET = "\033[31m", "\033[0m"  # Colour of the program's name before an error
TASK_MODULE = "--task-module"
TASK_MODULE_HELP = f"""\
Every command takes {TASK_MODULE} FILE_OR_MODULE, any number of times: a
FILE.py or an installed module that registers tasks of your own."""
EXIT_CODES = "Exit codes: 0 done, 1 fault, 2 invalid input, 3 inconsistent fit, 130 Ctrl-C."


class UsageError(InputError):
    """Raised for an invalid command line. The message is one line."""


def usage() -> str:
    """Return the help text that lists all commands."""
    lines = ["usage: jumper COMMAND [arguments]", ""]
    lines += [f"  {name:<12}{about}" for name, about in COMMANDS.items()]
    lines += ["", "jumper COMMAND --help shows the arguments of one; jumper --version the version."]
    return "\n".join([*lines, TASK_MODULE_HELP, EXIT_CODES])


def main(argv: Sequence[str] | None = None) -> None:
    """Run a `jumper` command; exits with code 2 and one line on standard error if its input is invalid.

    argv: the arguments after `jumper` (default: those of the process).
    """
    args = list(sys.argv[1:] if argv is None else argv)
    if not args:
        print(usage(), file=sys.stderr)
        raise SystemExit(USAGE_ERROR)
    if shutil.get_terminal_size().columns < LEAST_COLUMNS:
        os.environ["COLUMNS"] = str(LEAST_COLUMNS)  # rich breaks lines forever in a terminal of five columns
    prepare_imports()
    run_command(lambda: dispatch(args))


def dispatch(args: Sequence[str]) -> None:
    """Run the command named by the first argument; errors in files of tasks become InputError.

    Raises UsageError: there is no such command. Other exceptions are the command's.
    """
    name = args[0]
    if name in ("-h", "--help"):
        print(usage())
        return
    if name in ("-V", "--version"):
        print(f"jumper {__version__}")
        return
    if name not in COMMANDS:
        near = suggestion(name, COMMANDS) or f"; there are {', '.join(COMMANDS)}"
        raise UsageError(f"no command {name!r:.60}{near}")
    check_words(args)
    rest, files = split_task_modules(args[1:])
    modules = []
    try:
        if files:
            from jumper_warp.registry import load_task_module

            modules += (load_task_module(file) for file in files)
        importlib.import_module(f"jumper_warp.cli.{MODULES.get(name, name)}").run(rest, modules)
    except Exception as error:
        from jumper_warp.registry import LOADED

        paths = [*LOADED, *(getattr(module, "__file__", None) for module in modules)]
        folders = {os.path.dirname(os.path.abspath(path)) for path in paths if path}
        if message := user_file_error(folders, error):
            raise InputError(message) from error
        raise


def check_words(args: Sequence[str]) -> None:
    """Raise UsageError if an argument is empty, such as an unset variable of a shell, or the value after `--flag=`.

    Also if one is not UTF-8, which JSON, the format of saved command lines, cannot hold.
    """
    for before, arg in itertools.pairwise(["jumper", *args]):
        if arg.encode(errors="replace").decode() != arg:
            raise UsageError(f"{arg!a:.60} is not UTF-8")
        flag, equals, value = arg.partition("=")
        if not arg or (flag.startswith("--") and equals and not value):
            raise UsageError(f"empty value of {flag}" if arg else f"empty value after {before}")


def user_file_error(folders: Collection[str], error: Exception) -> str | None:
    """Return a message with file and line of an exception raised in a file of `folders` (absolute paths), else None.

    A mistake in the user's own file is invalid input, which one line explains; the project's faults keep the traceback.
    An error that Warp raises for a function in the file, as for missing annotations, counts as the file's.
    """
    frames = [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    if type(error).__module__.startswith("warp."):
        while frames and os.path.dirname(frames[-1][0]) not in folders:
            frames.pop()
    if isinstance(error, InputError) or not frames or os.path.dirname(frames[-1][0]) not in folders:
        return None
    return f"{os.path.basename(frames[-1][0])}:{frames[-1][1]}: {type(error).__name__}: {error}"


def split_task_modules(args: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the arguments without `--task-module NAME`, and all NAMEs. Raises UsageError: a value is missing."""
    rest = []
    names = []
    remaining = iter(args)
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


def run_command(command: Callable[[], object]) -> None:
    """Call a command or an experiment; exits with code 2 and one line on standard error if its input is invalid.

    InputError, and OSError about a file or a full disk, are printed as one line; so is exhausted memory, with code 1; a
    closed output pipe ends the command quietly with code 0; any other exception propagates. Characters that the
    encoding of standard output lacks are printed as escapes.
    """
    open_standard_streams()
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        try:
            command()
        except SystemExit as end:  # after help
            if not end.code:
                sys.stdout.flush()
            raise
        sys.stdout.flush()
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # another Ctrl-C ends the process at once, without a traceback
        raise SystemExit(INTERRUPTED) from None
    except BrokenPipeError:  # the reader closed the pipe, as `head` does
        discard_output()
    except InputError as error:
        print_error(str(error))
        raise SystemExit(USAGE_ERROR) from None
    except OSError as error:
        no_folder = "temporary directory" in str(error)  # of Python's tempfile, which names those that it tried
        if error.filename is None and error.errno not in (*FULL, errno.ENOENT) and not no_folder:
            raise
        if error.filename is None and error.errno in FULL:
            discard_output()
        nameless = "working directory" if error.errno == errno.ENOENT else "standard output or an open file"
        place = error.filename or ("TMPDIR" if no_folder else nameless)
        print_error(f"{place}: {error.strerror}")
        raise SystemExit(USAGE_ERROR) from None
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        reason = next(iter(str(error).splitlines()), "")
        reason = f"{reason:.200}" if "out of memory" in reason else f"out of memory: {reason:.200}".rstrip(": ")
        notes = reversed(getattr(error, "__notes__", ["use fewer worlds"]))
        print_error("; ".join([reason, *notes]))
        raise SystemExit(FAULT) from None


def discard_output() -> None:
    """Redirect standard output to the null device, also what is buffered: Python would fail to write it at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_error(message: str) -> None:
    """Print a message with the program's name on standard error, coloured on a terminal."""
    colour = sys.stderr.isatty() and "NO_COLOR" not in os.environ
    print(f"{RED if colour else ''}jumper:{RESET if colour else ''} {message}", file=sys.stderr)


if __name__ == "__main__":
    main()
