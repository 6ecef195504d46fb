"""Help pages of commands, in columns, from the list of their flags."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jumper_warp.cli.flags import Flag
from jumper_warp.utils.errors import InputError, suggestion

HELP, HELP_ALL = ("-h", "--help"), "--help-all"
BRIEF = "Defaults are in parentheses.\n"
MAX_LINES = 60  # A longer page of --help has the first paragraph, and the first sentence about each flag, only
INDENT = 30  # Column of the descriptions
MAX_WIDTH = 100  # Columns of a page on a wider terminal
Short = Mapping[str, Sequence[str]]
"""Names of the flags that people set, by heading, for the page of --help of a command with many flags."""


def wants_help(args: Sequence[str]) -> bool:
    """Return whether command-line arguments ask for help."""
    return any(arg in (*HELP, HELP_ALL) for arg in args)


def help_page(program: str, about: str, flags: Sequence[Flag], args: Sequence[str], short: Short | None = None) -> str:
    """Return the help page that `--help`, `--help-all` or `--help GROUP` among the arguments requests.

    program: command line without flags. about: what it does. short: flags of --help (default: all).
    Raises InputError: there is no such group.
    """
    words = " ".join(flag.name for flag in flags if flag.positional)
    usage = f"usage: {program} {words + ' ' if words else ''}[flags]\n\n"
    full = f"{usage}{wrap(about)}\n\n{sections(flags)}"
    if HELP_ALL in args:
        return full
    following = args[next(i for i, arg in enumerate(args) if arg in HELP) + 1 :][:1]
    if following and not following[0].startswith("-"):
        return sections(group_of(following[0], flags))
    if short is None and full.count("\n") <= MAX_LINES:
        return full
    rows = sections(flags, brief=True) if short is None else short_sections(flags, short)
    about, _, _ = about.partition("\n\n")
    return f"{usage}{wrap(about)}\n{BRIEF}\n{rows}\n{more(flags)}"


def group_of(name: str, flags: Sequence[Flag]) -> list[Flag]:
    """Return the flags of a group, such as ppo or env.rewards, or the flag of this name.

    Raises InputError: there is neither.
    """
    name = name.lstrip("-").replace("_", "-")
    chosen = [flag for flag in flags if f"{flag.name}.".startswith(f"{name}.")]
    if chosen:
        return chosen
    groups = {".".join(parts[:i]) for flag in flags for parts in [flag.name.split(".")] for i in range(1, len(parts))}
    near = suggestion(name, groups) or f"; there are {', '.join(sorted(top_groups(flags))) or 'none'}"
    raise InputError(f"no group of flags {name!r:.60}{near}")


def top_groups(flags: Iterable[Flag]) -> dict[str, int]:
    """Count the flags of each top-level group: the first part of dotted names, in `env` the first two parts."""
    groups: dict[str, int] = {}
    for flag in flags:
        parts = flag.name.split(".")
        depth = min(len(parts) - 1, 2 if parts[0] == "env" else 1)
        if depth:
            group = ".".join(parts[:depth])
            groups[group] = groups.get(group, 0) + 1
    return groups


def more(flags: Sequence[Flag]) -> str:
    """Return the lines at the end of a help page that name the pages with further flags."""
    lines = [f"--help-all prints all {len(flags)} flags in full."]
    if groups := ", ".join(f"{group} ({count})" for group, count in top_groups(flags).items()):
        lines[:0] = ["More flags, by group; --help GROUP prints one:", wrap(groups, indent=2)]
    return "\n".join(lines) + "\n"


def short_sections(flags: Sequence[Flag], short: Short) -> str:
    """Return a short help text: chosen flags below headings, each with its description's first sentence."""
    by_name = {flag.name: flag for flag in flags}
    return "\n".join(
        f"{heading}:\n" + "".join(row(by_name[name], brief=True) for name in names) for heading, names in short.items()
    )


def sections(flags: Sequence[Flag], *, brief: bool = False) -> str:
    """Return the help text of all flags, below the names of their groups; flags of no group come first."""
    groups: dict[str, list[Flag]] = {"": []}
    for flag in flags:
        groups.setdefault(flag.name.rpartition(".")[0], []).append(flag)
    pages = []
    for group, members in groups.items():
        title = wrap(f"{group}: {members[0].group_about}".rstrip(": ")) + "\n" if group else ""
        pages += [title + "".join(row(flag, brief=brief) for flag in members)] if members else []
    return "\n".join(pages)


def row(flag: Flag, *, brief: bool = False) -> str:
    """Return the help text of one flag: name and value on the left, description and default on the right.

    brief: with the first sentence of the description only.
    """
    name = flag.name if flag.positional else f"--{flag.name}"
    if flag.has_negative:
        start, dot, last = flag.name.rpartition(".")
        name = f"--{start}{dot}[no-]{last}"
    left = f"  {name} {'' if flag.positional else flag.metavar}".rstrip()
    about = flag.first_sentence if brief else flag.about
    default = "" if "(default" in about else default_text(flag.default)
    default = f"({'' if brief else 'default: '}{default})" if default else ""
    return columns(left, f"{about.rstrip('.')} {default}".strip()) if about else f"{left} {default}\n"


def columns(left: str, right: str) -> str:
    """Format help text in two columns, ending in a new line; a long left column has a line of its own."""
    lines = wrap(right, indent=INDENT).splitlines() or [""]
    if len(left) < INDENT:
        lines[0] = left.ljust(INDENT) + lines[0].lstrip()
    else:
        lines.insert(0, left)
    return "".join(f"{line.rstrip()}\n" for line in lines)


def wrap(text: str, indent: int = 0) -> str:
    """Return text wrapped at the terminal's width; line breaks stay."""
    width, margin = min(shutil.get_terminal_size().columns, MAX_WIDTH), " " * indent
    return "\n".join(
        textwrap.fill(line, width, initial_indent=margin, subsequent_indent=margin, break_on_hyphens=False)
        for line in text.splitlines()
    )


def default_text(default: Any) -> str:
    """Return a flag's default value as text; empty for None, and for a value that no flag can give."""
    if isinstance(default, bool):
        return "on" if default else "off"
    if isinstance(default, tuple):
        return " ".join(map(default_text, default))
    return (
        f"{default:g}" if isinstance(default, float) else str(default) if isinstance(default, str | int | Path) else ""
    )
