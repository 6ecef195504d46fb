"""Command-line flags for the settings of any task that are numbers or choices.

    --env.rewards.jump-height.weight 30 --env.observations.actor.lin-vel.noise 0.1 --env.reset.tilt 3

They are derived from the task. The flag of a term's number is its dotted name (`jumper_warp.tasks.terms`), without the
term's name in a section with one term, as `--env.curriculum.tolerance`; other settings have the name of their field.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

import tyro
import warp as wp

from jumper_warp.cli.flags import field_docs, parse
from jumper_warp.tasks.cfg import Command, Reset, TaskCfg
from jumper_warp.tasks.evaluation import Evaluation
from jumper_warp.tasks.terms import Term
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json

NO_SOURCE = __package__
"""Module name of the dataclasses made here: tyro parses its source, which is fast since the file is empty."""


class Setting(NamedTuple):
    """Type, default and help text of a flag, or of a group of flags, for a task's settings."""

    kind: Any  # type of the setting, for tyro
    value: Any  # default; of a group, an instance of its dataclass
    about: str | None = None  # help text


def parse_with_task(
    default: Any, task: TaskCfg, command: str, args: Sequence[str], short: Sequence[str]
) -> tuple[Any, TaskCfg]:
    """Parse a command's settings and a task's, and return the settings, and the task changed by its flags `--env`.

    default: the command's settings, a dataclass, with their defaults. tyro needs one dataclass of all flags: that of
    `default` is extended by a field with the task's. short: see `parse`, which also lists errors and exits.
    """
    flags = flags_of(task)
    settings = type(default)
    kind = dataclasses.make_dataclass(
        settings.__name__, [("env", type(flags), flags)], bases=(settings,), frozen=True,
        namespace={"__module__": settings.__module__},
    )  # fmt: skip
    about = f"Train a policy on {task.name}."
    parsed = parse(kind, command, args, description=about, default=kind(**vars(default)), short=short)
    return parsed, with_flags(task, parsed.env)


def flags_of(task: TaskCfg) -> Any:
    """Return a task's settings as an instance of a nested dataclass for tyro; inverted by `with_flags`.

    Raises InputError: two flags have one name.
    """
    flags = _flag(task, TaskCfg, task.name)
    return flags and flags.value


def flag_name(name: str) -> str:
    """Return the name of a setting in the spelling of flags: lower case, with dashes."""
    return re.sub(r"[^0-9A-Za-z]+", "-", name).strip("-").lower()


def _flag(value: Any, hint: Any, where: str) -> Setting | None:
    """Return the flag or group of flags for a part of a task, None if it has none; where: its path, for messages.

    Fields of a dataclass that hold functions or names have none. Its docstring and those of its fields become the help.
    """
    if isinstance(value, Term):
        return _flag_of_term(value, where)
    if isinstance(value, Reset):
        return _flag(value.settings, Any, where)
    if isinstance(value, Command | Evaluation):
        return None
    if not (parts := _parts(value)):
        return Setting(hint, value) if _is_number(value, hint) else None
    kind = None if isinstance(value, tuple) else type(value)
    hints = get_type_hints(kind) if kind else {}
    docs = field_docs(kind) if kind else {}
    flags = {}
    for name, part in parts.items():
        if (flag := _flag(part, hints.get(name, Any), f"{where} {name}")) is not None:
            flags[name] = flag._replace(about=docs.get(name, flag.about))
    return _group(_first_paragraph(kind and kind.__doc__), flags, where) if flags else None


def _flag_of_term(term: Term, where: str) -> Setting | None:
    """Return the flags of a task term's numerical settings and integer options."""
    settings = {**term.settings, **term.options}
    numbers = term.numbers | {key: option for key, option in term.options.items() if type(option) is int}
    kinds = {int: int, tuple: tuple[float, float]}
    flags = {key: Setting(kinds.get(type(settings.get(key)), float), value) for key, value in numbers.items()}
    return _group(_first_paragraph(inspect.getdoc(term.func.func)), flags, where) if flags else None


def _group(about: str | None, flags: dict[str, Setting], where: str) -> Setting:
    """Combine flags into one group, an instance of a frozen dataclass. Raises InputError: two flags have one name."""
    names = [flag_name(name) for name in flags]
    if len(set(names)) < len(names) or "" in names:
        raise InputError(f"{where}: the names of {', '.join(flags)} make the same flags")
    fields = [
        (
            f"setting_{i}",
            Annotated[flag.kind, tyro.conf.arg(name=name, help=flag.about)],
            dataclasses.field(metadata={"flag": name}),
        )
        for i, (name, flag) in enumerate(zip(names, flags.values(), strict=True))
    ]
    kind = dataclasses.make_dataclass("Settings", fields, frozen=True, namespace={"__module__": NO_SOURCE})
    kind.__doc__ = about
    return Setting(kind, kind(*(flag.value for flag in flags.values())), about)


def with_flags(value: Any, flags: Any) -> Any:
    """Return a copy of a task, or a part of it, with the values in flags (result of `flags_of`, modified by tyro).

    Raises InputError as `TaskCfg`.
    """
    if isinstance(value, Reset):
        return dataclasses.replace(value, settings=with_flags(value.settings, flags))
    if not (parts := _parts(value)):
        return flags
    values = {spec.metadata["flag"]: getattr(flags, spec.name) for spec in dataclasses.fields(flags)}
    new = {name: with_flags(part, values[flag_name(name)]) for name, part in parts.items() if flag_name(name) in values}
    if isinstance(value, Term):
        return value.replace(**{key: number for key, number in new.items() if number != parts[key]})
    return tuple((parts | new).values()) if isinstance(value, tuple) else dataclasses.replace(value, **new)


def _parts(value: Any) -> Json:
    """Return the named parts of a term, dataclass or tuple of either, by name or index; empty for any other value.

    Both directions, `flags_of` and `with_flags`, walk through a task by these names.
    """
    if isinstance(value, Term):
        return {**value.numbers, **value.options}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {spec.name: getattr(value, spec.name) for spec in dataclasses.fields(value)}
    if not isinstance(value, tuple) or not all(isinstance(v, Term) or dataclasses.is_dataclass(v) for v in value):
        return {}
    return {part.name if isinstance(part, Term) else str(i): part for i, part in enumerate(value)}


def _is_number(value: Any, hint: Any) -> bool:
    """Return whether a setting can have a flag: it holds numbers or a choice, or is optional; no function or name.

    hint: annotation of the field, which distinguishes a choice (Literal) from a name, and what may replace None.
    """
    if isinstance(value, str):
        return hint is not str
    if isinstance(value, tuple):
        return bool(value) and all(_is_number(v, Any) for v in value)
    if value is None:
        return hint is not Any and wp.Function not in get_args(hint)
    return isinstance(value, bool | int | float)


def _first_paragraph(doc: str | None) -> str | None:
    """Return the first paragraph of a docstring in one line; None if it is empty."""
    return " ".join(inspect.cleandoc(doc or "").split("\n\n")[0].split()) or None
