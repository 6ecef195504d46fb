"""Command lines of a Markdown page: checked by the real parsers, or run."""

import contextlib
import dataclasses
import glob
import importlib
import io
import itertools
import os
import runpy
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import jumper_warp.cli.play  # its open_run is patched
import jumper_warp.cli.train  # noqa: F401
from jumper_warp.cli.main import COMMANDS, main
from jumper_warp.policies.catalog import find_policy
from jumper_warp.policies.policy import Policy
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.utils.errors import InputError

ROOT = Path(__file__).parents[2]
OUTPUTS = ("out", "page", "video", "log_root", "write_tables", "readme")  # fields whose paths need not exist
POLICIES = ("policy", "policies", "landing_policy", "init_policy", "source", "sources", "walk", "jump_up", "jump_to")
OPENED = ("evaluate", "play", "finetune", "export", "info")  # commands whose first argument is a policy
VIEWERS = ("rerun", "tensorboard", "xdg-open")  # never run
OPERATORS = "();<>|&"


class CommandError(Exception):
    """A command line that cannot be parsed, or a file that it reads is missing."""


class Parsed(BaseException):
    """Raised in place of running a command; its argument is the settings that were parsed."""


def command_lines(source, first_line):
    """Return (line number, list of words) of each command in a fence; operators such as | separate commands."""
    commands, text, start = [], "", first_line
    for number, line in enumerate(source.splitlines(), first_line):
        start = number if not text else start
        text += line
        if text.endswith("\\"):
            text = text[:-1] + " "
            continue
        lexer = shlex.shlex(text, posix=True, punctuation_chars=OPERATORS)
        lexer.whitespace_split = True
        words = []
        for word in [*lexer, ";"]:
            if word.strip(OPERATORS):
                words.append(word)
            elif words:
                commands.append((start, words))
                words = []
        text = ""
    return commands


def parsed(call, after="tyro.cli"):
    """Return the settings that a command line is parsed into; `call` starts it, and ends once `after` has returned.

    after: function that returns the settings. Returns None if help was printed. Raises CommandError.
    """
    module, _, name = after.rpartition(".")
    original, errors = getattr(importlib.import_module(module), name), io.StringIO()

    def stop(*args, **settings):  # parse the arguments, and raise instead of running the command
        raise Parsed(original(*args, **settings))

    with patch(after, stop), contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        try:
            call()
            raise CommandError("parses no flags")
        except Parsed as done:
            settings = done.args[0]
        except SystemExit as error:
            if error.code:
                raise CommandError(errors.getvalue().strip() or f"exit code {error.code}") from None
            settings = None
    if " is now --" in errors.getvalue():
        raise CommandError(errors.getvalue().strip())
    return settings


class Commands:
    """The commands of one page, in its working folder, the current one."""

    def __init__(self):
        self.made = {}  # what earlier commands make: task (or None) by path
        self.task = None  # of the last training

    def check(self, words):
        """Parse a command line without running it. Raises CommandError."""
        while "=" in words[0] and len(words) > 1:  # a variable
            words = words[1:]
        name, words = Path(words[0]).name, words[1:]
        if "jumper_warp" in words and words[words.index("jumper_warp") - 1] == "-m":
            name, words = "jumper", words[words.index("jumper_warp") + 1 :]
        scripts = [i for i, word in enumerate(words) if word.endswith(".py")]
        if name == "jumper":
            self.check_jumper(words)
        elif name in ("python", "python3", "torchrun") and scripts and "-m" not in words[: scripts[0]]:
            self.check_script(words[scripts[0]], words[scripts[0] + 1 :])
        elif name == "make":
            self.made["outputs"] = None

    def check_jumper(self, args):
        """Parse `jumper ARGS`. Raises CommandError."""
        if args and args[0] in ("--help", "--version"):
            return
        if not args or args[0] not in COMMANDS:
            raise CommandError(f"jumper has no command {' '.join(args[:1])!r}")
        self.made["outputs"] = None
        if args[0] == "train":
            for flag in {"--resume", "--robot"}.intersection(args):  # files that training reads at once
                at = args.index(flag)
                value = "".join(args[at + 1 : at + 2])
                if not Path(value).exists() and (value == "latest" or self.is_made(value)):
                    args = args[:at] + args[at + 2 :]
            result = parsed(lambda: main(args), "jumper_warp.cli.train.parse_train")
            if result is not None:
                self.made["logs"] = self.task = result[0].task
                self.check_values(result[0].train)
            return
        if args[0] == "info" and "--task-module" in args:  # of a user's task
            self.require(Path(args[args.index("--task-module") + 1]))
            return
        task = None
        if args[0] == "play" and len(args) > 2 and "-" not in (args[1][0], args[2][0]):  # several motions
            flags = itertools.dropwhile(lambda arg: arg[0] != "-", args[1:])
            args = ["play", args[1].rpartition("=")[2], *flags]
        with contextlib.ExitStack() as stack:
            of_policy = args[1:] and args[1][0] != "-" and args[1] != "robot" and "--agent" not in args
            if args[0] in OPENED and of_policy:
                task = self.task_of(args[1])
                for module in ("evaluate", "play") if task else ():
                    stack.enter_context(
                        patch(f"jumper_warp.cli.{module}.open_run", lambda *_: SimpleNamespace(task=task))
                    )
                if task and args[0] not in ("evaluate", "play"):
                    args = [args[0], "vertical_jump", *args[2:]]
            settings = parsed(lambda: main(args))
        self.check_values(settings)
        default = f"{args[1]}_finetuned" if args[0] == "finetune" else None
        if path := getattr(settings, "out", None) or default:
            policy = args[0] in ("finetune", "export") and args[1] != "robot"
            if policy and not task:  # that of a user's module is the last training's
                task = self.task if "--task-module" in args else Policy.load(args[1]).recipe().task
            self.made[str(path)] = task

    def check_script(self, script, args):
        """Parse the flags of a script in experiments/; other scripts only have to exist. Raises CommandError."""
        self.require(Path(script))
        self.made["outputs"] = None
        if Path(script).parts[:1] == ("experiments",):
            with patch.object(sys, "argv", [script, *args]):
                settings = parsed(lambda: runpy.run_path(script, run_name="__main__"))
            self.check_values(settings)
            if getattr(settings, "out", None):
                self.made[str(settings.out)] = None

    def check_values(self, settings):
        """Raise CommandError if a file or policy in parsed settings does not exist and no earlier command makes it."""
        for field in dataclasses.fields(settings) if dataclasses.is_dataclass(settings) else ():
            value = getattr(settings, field.name)
            if not isinstance(value, RobotOverlay):  # its file is checked
                self.check_values(value)
            for item in value if isinstance(value, tuple) else (value,):
                if isinstance(item, Path) and field.name not in OUTPUTS:
                    self.require(item)
                elif isinstance(item, str) and item and value != field.default and field.name in (*POLICIES, "blend"):
                    self.task_of(item)

    def is_made(self, path):
        """Return whether an earlier command makes a path; a placeholder such as FOLDER or $run is a training's."""
        text = str(path) or "."
        placeholder = (text.isupper() or text[0] == "$") and self.task is not None
        return placeholder or any(text == made or text.startswith(f"{made}/") for made in self.made)

    def require(self, path):
        """Raise CommandError if a path neither exists nor is made by an earlier command."""
        if not path.exists() and not self.is_made(path):
            raise CommandError(f"{path}: no such file, and no earlier command on this page makes it")

    def task_of(self, source):
        """Return the task of a policy that an earlier command makes, None of one that exists. Raises CommandError."""
        if not Path(source).exists() and self.is_made(source):
            owner = max((made for made in self.made if source.startswith(made)), key=len, default="logs")
            return self.made.get(owner) or self.task
        if not source.endswith(".pt"):
            try:
                find_policy(source)
            except InputError as error:
                raise CommandError(str(error)) from None
        return None

    def run(self, words, train_flags=()):
        """Check and run a command, `jumper` and Python scripts in this process. Raises CommandError."""
        name = Path(words[0]).name
        words = [found for word in words for found in (sorted(glob.glob(word)) if "*" in word else [word])]
        self.check(words)
        train = ["train"] == words[1:2]
        words = [*words, *train_flags] if name == "jumper" and train else words
        if name == "jumper":
            run_here(lambda: main(words[1:]))
        elif name in ("python", "python3") and words[1:] and words[1].endswith(".py"):
            with patch.object(sys, "argv", words[1:]):
                run_here(lambda: runpy.run_path(words[1], run_name="__main__"))
        elif name not in VIEWERS:
            paths = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
            done = subprocess.run(words, env=os.environ | paths, capture_output=True, text=True, check=False)
            if done.returncode:
                raise CommandError(f"exit code {done.returncode}: {done.stderr.strip()}")


def run_here(call):
    """Call a command; raise CommandError with what it printed on standard error if its exit code is not 0."""
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors):
        try:
            call()
        except SystemExit as error:
            if error.code:
                raise CommandError(errors.getvalue().strip() or f"exit code {error.code}") from None
