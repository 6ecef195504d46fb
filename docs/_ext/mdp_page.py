"""Page of the types and stock terms of `jumper_warp.mdp`, as MyST Markdown from docstrings and field comments."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import warp as wp

from jumper_warp import mdp
from jumper_warp.cli.flags import field_docs
from jumper_warp.kernels.actuation.command_filter import FilterParams, Limits
from jumper_warp.kernels.actuation.motors import MotorArrays
from jumper_warp.kernels.kinematics.geometry import LegGeometry
from jumper_warp.kernels.terrain.ground import Block
from jumper_warp.tasks.terms import REQUIRED, Term
from plain_text import to_markdown
from stock_terms import SPACES, helpers, stock_terms, task_terms, tasks_by_function

MDP = mdp.__name__
STRUCT = type(mdp.RobotView)  # type of what @wp.struct returns
INNER_STRUCTS = (Block, FilterParams, LegGeometry, Limits, MotorArrays)
"""Structs that are fields of public ones."""
UNIT = re.compile(r"(\[[^\]]+\](?:, \[[^\]]+\])*),? ?")
SHAPE = re.compile(r"(\([^()]*,[^()]*\))[,;]? ?")


class Entry(NamedTuple):
    """A documented object."""

    name: str  # full name in the reference, such as `jumper_warp.mdp.RobotView`
    text: str  # directive that describes it


def mdp_page() -> str:
    """Return the Markdown of the page: a table of all names, then their descriptions by kind."""
    public = {f"{MDP}.{name}": getattr(mdp, name) for name in mdp.__all__}
    functions = {name: value for name, value in public.items() if isinstance(value, wp.Function)}
    for space in SPACES:
        functions |= helpers(space)
    factories = {name: value for name, value in public.items() if inspect.isfunction(value)}
    structs = {name: value for name, value in public.items() if isinstance(value, STRUCT)}
    structs |= {f"{struct.cls.__module__}.{struct.key}": struct for struct in INNER_STRUCTS}
    classes = {name: value for name, value in public.items() if inspect.isclass(value)}
    used = tasks_by_function()
    kinds = {
        "Term classes": [term_class(name, kind) for name, kind in classes.items() if issubclass(kind, Term)],
        "Task classes": [task_class(name, kind) for name, kind in classes.items() if dataclasses.is_dataclass(kind)],
        "Structs": [struct_entry(name, struct) for name, struct in structs.items()],
        "Constants": [constant(name, value) for name, value in public.items() if isinstance(value, int)],
        "Functions": [function_entry(name, func) for name, func in functions.items()],
        "Motors and filters": [factory(name, value) for name, value in factories.items()],
    }
    for space in SPACES:
        kinds[f"Stock {space}"] = [
            function_entry(name, func, used.get(func)) for name, func in stock_terms(space).items()
        ]
    for space in SPACES:
        if terms := task_terms(space):
            title = f"{space.capitalize()} of the project's tasks"
            kinds[title] = [function_entry(name, func, used.get(func)) for name, func in terms.items()]
    for entries in kinds.values():
        entries.sort(key=lambda entry: entry.name.rpartition(".")[2].lower())
    parts = [f"## {kind}\n\n" + "\n\n".join(entry.text for entry in entries) for kind, entries in kinds.items()]
    return "\n\n".join([summary(kinds), *parts]) + "\n"


def summary(kinds: dict[str, list[Entry]]) -> str:
    """Return the table of all names by kind, each a link to its description."""
    rows = []
    for kind, entries in kinds.items():
        anchor = re.sub(r"[^a-z -]", "", kind.lower()).replace(" ", "-")
        rows.append((f"[{kind}](#{anchor})", ", ".join(f"{{py:obj}}`~{entry.name}`" for entry in entries)))
    return table(("Kind", "Names"), rows)


def described(kind: str, name: str, signature: str, *paragraphs: str) -> Entry:
    """Return an entry: a directive `py:<kind>` of a full name, a signature, and paragraphs of Markdown."""
    local = name.removeprefix(f"{MDP}.").removeprefix("jumper_warp.kernels.")
    body = "\n\n".join(paragraph for paragraph in paragraphs if paragraph)
    return Entry(
        name, f"````{{py:{kind}}} {local}{signature}\n:module: {name.removesuffix(f'.{local}')}\n\n{body}\n````"
    )


def parsed(thing: Any) -> Any:
    """Return the syntax tree of a class or function."""
    return ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]


def plain_type(annotation: ast.expr) -> str:
    """Return the name of an annotated type, without `wp.`: `array2d of vec3`."""
    return re.sub(r"(array\w*)\(dtype=(\w+)\)", r"\1 of \2", ast.unparse(annotation).replace("wp.", ""))


def split(pattern: re.Pattern[str], text: str) -> tuple[str, str]:
    """Return what a pattern finds at the start of a text, and the rest."""
    match = pattern.match(text)
    return (match[1], text[match.end() :]) if match else ("", text)


def function_entry(name: str, func: Any, tasks: Sequence[str] | None = None) -> Entry:
    """Return the entry of a Warp function; tasks: names of those that use it as a term."""
    tree = parsed(func.func)
    returns = f" -> {plain_type(tree.returns)}" if tree.returns else ""
    for arg in tree.args.args:
        arg.annotation = ast.Name(plain_type(arg.annotation)) if arg.annotation else None
    names = f"Used by {', '.join(f'`{task}`' for task in tasks)}." if tasks else ""
    about = to_markdown(inspect.getdoc(func.func) or "")
    return described("function", name, f"({ast.unparse(tree.args)}){returns}", about, names)


def factory(name: str, function: Any) -> Entry:
    """Return the entry of a Python function that returns settings of a task."""
    return described("function", name, str(inspect.signature(function)).replace("'", ""),
                     to_markdown(inspect.getdoc(function) or ""))  # fmt: skip


def struct_entry(name: str, struct: Any) -> Entry:
    """Return the entry of a Warp struct, with the table of its fields."""
    docs, rows = field_docs(struct.cls), []
    for field in parsed(struct.cls).body:
        if isinstance(field, ast.AnnAssign):
            name_of_field, kind = ast.unparse(field.target), plain_type(field.annotation)
            unit, about = split(UNIT, docs[name_of_field])
            shape, about = split(SHAPE, about) if kind.startswith("array") else ("", about)
            kind += f", `{shape}`" if shape else ""
            rows.append((f"`{name_of_field}`", kind, to_markdown(unit), to_markdown(about)))
    about = to_markdown(inspect.getdoc(struct.cls) or "")
    return described("class", name, "", about, table(("Field", "Type", "Unit", "Meaning"), rows))


def term_class(name: str, kind: type[Term]) -> Entry:
    """Return the entry of a class of terms, with the table of its keyword arguments."""
    arguments = parsed(kind.__init__).args
    arguments.args = arguments.args[1:]  # without self
    values = {"number": kind.settings, "option": kind.options}
    rows = [
        (f"`{key}`", place, "required" if value is REQUIRED else f"`{value!r}`")
        for place, defaults in values.items() for key, value in defaults.items()
    ]  # fmt: skip
    about = to_markdown(inspect.getdoc(kind) or "")
    keywords = table(("Keyword", "Kind", "Default"), rows) if rows else ""
    return described("class", name, f"({ast.unparse(arguments)})", about, keywords)


def task_class(name: str, kind: type) -> Entry:
    """Return the entry of a dataclass, with the table of its fields."""
    docs, rows = field_docs(kind), []
    for field in dataclasses.fields(kind):
        default = "required"
        if field.default is not dataclasses.MISSING:
            default = f"`{field.default!r}`"
        elif field.default_factory is not dataclasses.MISSING:
            default = f"`{field.type}()`"
        types = f"`{field.type}`".replace("|", "\\|")
        rows.append((f"`{field.name}`", f"{types}, {default}", to_markdown(docs.get(field.name, ""))))
    fields = table(("Field", "Type, default", "Meaning"), rows)
    return described("class", name, "", to_markdown(inspect.getdoc(kind) or ""), fields)


def constant(name: str, value: int) -> Entry:
    """Return the entry of a phase of a jump."""
    module: Any = inspect.getmodule(mdp.commanded.func)
    comment = re.search(rf"^{name.rpartition('.')[2]} = .*?# (?:phases: )?(.*)$", inspect.getsource(module), re.M)
    return described("data", name, "", f"Phase of a jump, {value}: {to_markdown(comment[1] if comment else '')}.")


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    head = list(head)
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows])
