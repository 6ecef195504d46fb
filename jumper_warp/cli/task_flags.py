"""A task's settings as flags of the command line, whatever the task; functions are left as the task has them.

    --env.rewards.jump-height.weight 30 --env.policy.lin-vel.noise 0.1 --env.reset.standing 0.5 --env.contact-force 0.2

They are derived from the task itself: numbers of terms by the term's name, everything else by the field's.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import re
import textwrap
from typing import Annotated, Any, NamedTuple, get_type_hints

import tyro

from jumper_warp.tasks.cfg import Reset, TaskCfg
from jumper_warp.tasks.terms import Term
from jumper_warp.utils.errors import InputError

NO_SOURCE = __package__
"""Module of the classes made here. Tyro looks for their source there: in an empty file, so that it takes no seconds."""


class Flag(NamedTuple):
    """A setting, or a group of them."""

    kind: Any
    """Its type, for tyro."""
    value: Any
    about: str | None = None


def flags_of(task: TaskCfg) -> Any:
    """Return a task's settings as a dataclass that tyro makes flags of. Raises InputError: two flags are the same."""
    hints, docs = get_type_hints(TaskCfg), field_docs(TaskCfg)
    found = {}
    for spec in dataclasses.fields(task):
        flag = _flag(getattr(task, spec.name), hints[spec.name], f"{task.name} {spec.name}")
        if flag is not None:
            found[spec.name] = flag._replace(about=flag.about or docs.get(spec.name))
    return _group("Settings of the task.", found, task.name).value


def with_flags(task: TaskCfg, flags: Any) -> TaskCfg:
    """Return the task with the settings of `flags_of`, changed or not. Raises ValueError as `TaskCfg` does."""
    given = _members(flags)
    changes = {
        spec.name: _changed(getattr(task, spec.name), given[flag_name(spec.name)])
        for spec in dataclasses.fields(task)
        if flag_name(spec.name) in given
    }
    return dataclasses.replace(task, **changes)


def flag_name(name: str) -> str:
    """Return a name of the task as a flag has it."""
    return re.sub(r"[^0-9A-Za-z]+", "-", name).strip("-").lower()


def field_docs(kind: type) -> dict[str, str]:
    """Return what the strings below the fields of a dataclass tell, by field."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0].body
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
    }


def _flag(value: Any, hint: Any, where: str) -> Flag | None:
    """Return the flag or flags of a part of a task; None if it has none."""
    if isinstance(value, Term):
        return _flag_of_term(value, where)
    if isinstance(value, Reset):
        return None if value.settings is None else _flag(value.settings, type(value.settings), where)
    if isinstance(value, tuple) and value and all(isinstance(term, Term) for term in value):
        terms = {term.name: _flag_of_term(term, f"{where} {term.name}") for term in value}
        return _group(None, {name: flag for name, flag in terms.items() if flag is not None}, where)
    if (isinstance(value, str | tuple) and not value) or isinstance(value, str) or not _is_data(value):
        return None
    if isinstance(value, tuple) and dataclasses.is_dataclass(value[0]):
        return Flag(tuple[tuple(type(v) for v in value)], value)
    return Flag(type(value) if dataclasses.is_dataclass(value) else hint, value)


def _flag_of_term(term: Term, where: str) -> Flag | None:
    """Return the flags of a term's numbers, and of the options that are whole numbers."""
    settings = term.settings | term.options
    numbers = term.numbers | {key: option for key, option in term.options.items() if type(option) is int}
    flags = {key: Flag(int if type(settings.get(key)) is int else float, value) for key, value in numbers.items()}
    about = (inspect.getdoc(term.func.func) or "").split("\n\n")[0]
    return _group(" ".join(about.split()) or None, flags, where) if flags else None


def _group(about: str | None, flags: dict[str, Flag], where: str) -> Flag:
    """Return settings as one frozen dataclass, whose members have the names of flags."""
    names = [flag_name(name) for name in flags]
    if len(set(names)) < len(names) or "" in names:
        raise InputError(f"{where}: the names of {', '.join(flags)} make the same flags")
    fields = [
        (f"setting_{i}", Annotated[flag.kind, tyro.conf.arg(name=name, help=flag.about)],
         dataclasses.field(metadata={"flag": name}))
        for i, (name, flag) in enumerate(zip(names, flags.values(), strict=True))
    ]  # fmt: skip
    kind = dataclasses.make_dataclass("Settings", fields, frozen=True, namespace={"__module__": NO_SOURCE})
    kind.__doc__ = about
    return Flag(kind, kind(*(flag.value for flag in flags.values())), about)


def _members(group: Any) -> dict[str, Any]:
    """Return the settings of a group by their flags."""
    return {spec.metadata["flag"]: getattr(group, spec.name) for spec in dataclasses.fields(group)}


def _changed(value: Any, flags: Any) -> Any:
    """Return a part of a task with the values of its flags."""
    if isinstance(value, Term):
        given = _members(flags)
        known = value.numbers | value.options
        new = {key: given[flag_name(key)] for key in known if flag_name(key) in given}
        return value.replace(**{key: number for key, number in new.items() if number != known[key]})
    if isinstance(value, Reset):
        return dataclasses.replace(value, settings=flags)
    if isinstance(value, tuple) and value and all(isinstance(term, Term) for term in value):
        given = _members(flags)
        return tuple(_changed(term, given[name]) if (name := flag_name(term.name)) in given else term for term in value)
    return flags


def _is_data(value: Any) -> bool:
    """Return whether a setting is numbers, names and nothing, and not a function of the task."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return all(_is_data(getattr(value, spec.name)) for spec in dataclasses.fields(value))
    if isinstance(value, tuple):
        return all(_is_data(v) for v in value)
    return value is None or isinstance(value, bool | int | float | str)
