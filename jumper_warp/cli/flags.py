"""Parsing of flags, which tyro generates from a dataclass of settings; their list, help pages and limits."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import inspect
import io
import itertools
import math
import re
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import tyro

from jumper_warp.utils.checks import MOST_WORLDS
from jumper_warp.utils.errors import InputError, suggestion
from jumper_warp.utils.files import Json

LARGEST = 2.0**31  # Largest absolute value of a number in a flag
MOST_TRIALS = 100_000  # Largest number of jumps, walks or robots, which needs some 10 GB
DURATIONS = ("resampling-time-range", "interval-range-s", "steps", "idle-steps")
"""Flags of a task that may be infinite, for never; the task checks them."""
FLAG_LIMITS = {"num-envs": MOST_WORLDS, "num-steps": LARGEST, "trials": MOST_TRIALS, "states": MOST_TRIALS,
               "repeats": 10_000, "seconds": 3600.0}  # fmt: skip
"""Largest value of a number in a flag by the last part of its name."""
HELP, HELP_ALL = ("-h", "--help"), "--help-all"


class Flag(NamedTuple):
    """A flag, or a positional argument, of a command."""

    name: str  # without leading dashes, nested ones dotted, as `ppo.init-std`; of a positional in upper case
    kind: Any  # type of its value
    default: Any  # dataclasses.MISSING: it must be given
    about: str  # what it sets, as its dataclass says; may be empty
    marks: tuple[Any, ...] = ()  # metadata of the annotation, such as tyro.conf.Positional
    group_about: str = ""  # what the group of a nested flag sets

    @property
    def positional(self) -> bool:
        """Whether the argument is positional: its value is given without the name."""
        return tyro.conf.Positional in self.marks

    @property
    def has_negative(self) -> bool:
        """Whether the flag has an opposite, with `no-` before the last part of its name."""
        return self.kind is bool and tyro.conf.FlagCreatePairsOff not in self.marks

    @property
    def options(self) -> list[str]:
        """Spellings of the flag on the command line, with leading dashes: itself and, for a switch, its opposite."""
        negative = [re.sub(r"([^.]+)$", r"no-\1", self.name)] if self.has_negative else []
        return [] if self.positional else [f"--{name}" for name in (self.name, *negative)]

    @property
    def first_sentence(self) -> str:
        """First sentence of the flag's description, without its full stop."""
        return self.about.split(". ")[0].rstrip(".")


TASK_MODULE_FLAG = Flag("task-module", Path | None, None, "File or installed module with tasks of your own; repeatable")


def list_flags(cfg: Any, prefix: str = "", group_about: str = "", *, described: bool = True) -> list[Flag]:
    """Return the flags of a settings dataclass, or of an instance with the defaults, in the order of its fields.

    prefix: of all names, with its dot. group_about: of those that are not nested further. described: whether the flags
    have descriptions, whose reading from the sources takes long.
    """
    kind = cfg if isinstance(cfg, type) else type(cfg)
    flags = []
    hints = get_type_hints(kind, include_extras=True)
    docs = field_docs(kind) if described else {}
    for spec in dataclasses.fields(cfg):
        hint, *marks = get_args(hint) if get_origin(hint := hints[spec.name]) is Annotated else (hint,)
        if tyro.conf.Suppress in marks:
            continue
        settings = {key: getattr(mark, key) for mark in marks for key in ("name", "help") if hasattr(mark, key)}
        name = settings.get("name")
        name = spec.name.replace("_", "-") if name is None else name
        default = spec.default_factory() if callable(spec.default_factory) else spec.default
        default = default if isinstance(cfg, type) else getattr(cfg, spec.name)
        nested = hint if default is dataclasses.MISSING else default
        about = settings.get("help") or docs.get(spec.name, "")
        if dataclasses.is_dataclass(nested):
            inner, group = (f"{prefix}{name}.", about) if name else (prefix, group_about)
            flags += list_flags(nested, inner, group, described=described)
            continue
        name = name.upper() if tyro.conf.Positional in marks else prefix + name
        marks = tuple(mark for mark in marks if not hasattr(mark, "name"))
        flags.append(Flag(name, hint, default, about, marks, group_about))
    return flags


@functools.cache
def field_docs(kind: type) -> dict[str, str]:
    """Return the descriptions of a dataclass's fields by name: a docstring below a field, else a comment after it.

    Empty where there is no source.
    """
    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        try:
            source = textwrap.dedent(inspect.getsource(base))
            tree: Any = ast.parse(source)
        except (OSError, TypeError, SyntaxError):
            continue
        lines = source.splitlines()
        for field, text in itertools.pairwise([*tree.body[0].body, None]):
            if not isinstance(field, ast.AnnAssign):
                continue
            comment = lines[(field.end_lineno or 1) - 1].encode()[field.end_col_offset :].decode()
            about = comment.partition("#")[2]
            if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                about = str(text.value.value)
            name = ast.unparse(field.target)
            docs[name] = " ".join(about.split()) or docs.get(name, "")
    return docs


def wants_help(args: Sequence[str]) -> bool:
    """Return whether command-line arguments ask for help."""
    return any(arg in (*HELP, HELP_ALL) for arg in args)


def parse(
    kind: Any,
    command: str,
    args: Sequence[str],
    *,
    description: str | None = None,
    default: Any = None,
    short: Sequence[str] | None = None,
    program: str | None = None,
) -> Any:
    """Return a command's settings parsed from its arguments; prints help and exits with 0 if they ask for it.

    kind: dataclass of the settings. description: text for the help (default: kind's docstring). default: instance of
    `kind`. short: names of the flags of --help (default: all). program: command line of a script in place of
    `jumper COMMAND`, without --task-module.
    Raises InputError: a setting is out of range. Exits with 2 and tyro's message: there is no such flag, or a value is
    missing or of another type.
    """
    settings: Json = {"prog": program or f"jumper {command}"}
    about = description or inspect.getdoc(kind) or ""
    if wants_help(args):
        flags = list_flags(kind if default is None else default) + ([] if program else [TASK_MODULE_FLAG])
        print_help(settings["prog"], about, flags, args, short)
    settings |= {} if default is None else {"default": default}
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            parsed = tyro.cli(kind, args=args, **settings)
    except SystemExit as end:
        error: BaseException | None = end
        while error is not None and not isinstance(error, InputError):
            error = error.__context__
        if error is not None:  # raised by a dataclass of settings; tyro has printed it in a box
            raise error from None
        print(printed.getvalue(), end="", file=sys.stderr)
        raise
    print(printed.getvalue(), end="", file=sys.stderr)
    check_numbers(parsed)
    return parsed


def print_help(
    program: str, about: str, flags: Sequence[Flag], args: Sequence[str], short: Sequence[str] | None = None
) -> None:
    """Print the help page that `--help`, `--help GROUP` or `--help-all` among the arguments requests; exits with 0.

    A task has hundreds of flags: tyro prints a dataclass that is made of only the requested ones.
    program: command line without flags. about: what it does. short: names of the flags of --help (default: all), each
    with the first sentence of its description. Raises InputError: there is no such group.
    """
    groups = dict.fromkeys(re.findall(r"^(env\.[^.\n]+|[^.\n]+)\.", "\n".join(flag.name for flag in flags), re.M))
    following = [group for arg, group in itertools.pairwise([*args, "-"]) if arg in HELP]
    if HELP_ALL not in args and not following[0].startswith("-"):
        name = following[0].replace("_", "-")
        flags = [flag for flag in flags if f"{flag.name}.".startswith(f"{name}.")]
        if not flags:
            near = suggestion(name, groups) or f"; there are {', '.join(groups) or 'none'}"
            raise InputError(f"no group of flags {name!r:.60}{near}")
    elif HELP_ALL not in args:
        by_name = {flag.name: flag for flag in flags}
        flags = [flag._replace(about=flag.first_sentence) for flag in map(by_name.__getitem__, short or by_name)]
        about, _, _ = about.partition("\n\n")
        about += f"\n--help GROUP prints a group of flags: {', '.join(groups)}." if groups else ""
        about += "\n--help-all prints all flags in full."
    kind = dataclasses.make_dataclass("Flags", [help_field(flag) for flag in flags], kw_only=True)
    tyro.cli(kind, prog=program, description=about, args=["--help"], config=(tyro.conf.DisallowNone,))


def help_field(flag: Flag) -> tuple[str, Any, Any]:
    """Return a field of a dataclass, as for `dataclasses.make_dataclass`, whose help in tyro describes a flag.

    tyro appends the default to the text, unless the default is empty or the text states it.
    """
    hint = "" if flag.default in (None, dataclasses.MISSING) or "(default" in flag.about else None
    metavar = flag.name if flag.positional else None
    settings = tyro.conf.arg(name=flag.name, metavar=metavar, help=flag.about, help_behavior_hint=hint)
    name = "flag_" + re.sub(r"\W", "_", flag.name)  # `from` is a keyword of Python
    required = flag.default is dataclasses.MISSING
    field = dataclasses.field() if required else dataclasses.field(default_factory=lambda: flag.default)
    return name, Annotated[(flag.kind, settings, *flag.marks)], field


def check_numbers(settings: Any) -> None:
    """Raise InputError for a number in parsed flags that is too large or not finite.

    Otherwise such a number would fail later, as an overflow or exhausted memory without the name of its flag.
    settings: dataclass of the flags; limits: `FLAG_LIMITS` by name, LARGEST for others, none for durations of a task.
    """
    for flag in list_flags(settings, described=False):
        name = flag.name.split(".")[-1]
        limit = FLAG_LIMITS.get(name, MOST_TRIALS if name.startswith("num-") else LARGEST)
        if flag.name.startswith("env.") and name in DURATIONS:
            continue
        for number in flag.default if isinstance(flag.default, tuple) else (flag.default,):
            if isinstance(number, float) and not math.isfinite(number):
                raise InputError(f"--{flag.name} must be a finite number, got {number}")
            if isinstance(number, int | float) and abs(number) > limit:
                bound = f"at most {limit:.10g}" if number > 0 else f"at least {-limit:.10g}"
                raise InputError(f"--{flag.name} must be {bound}, got {number!s:.40}")


def option_of(arg: str) -> str:
    """Return the name of the flag in an argument, as `--ppo.init-std` in `--ppo.init_std=1`; empty for a value."""
    match = re.match(r"(--[A-Za-z][\w.-]*)(=|$)", arg)
    return match[1].replace("_", "-") if match else ""


def switch_of(option: str) -> str:
    """Return the positive form of a command-line flag: `--noise` for `--no-noise`, any other flag unchanged."""
    return re.sub(r"(--|\.)no-([^.]+)$", r"\1\2", option)


def values_of(option: str, args: Sequence[str]) -> list[str]:
    """Return the values after the last appearance of a flag (with dashes) in unparsed arguments."""
    values: list[str] = []
    for i, arg in enumerate(args):
        if option_of(arg) == option:
            values = [arg.partition("=")[2]] if "=" in arg else []
            values += itertools.takewhile(lambda following: not option_of(following), args[i + 1 :])
    return values
