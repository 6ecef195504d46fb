"""Pages of the types and stock terms of `jumper_warp.mdp`, as MyST Markdown from docstrings and field comments."""

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
from stock_terms import SPACES, TASK_KINDS, helpers, stock_terms, task_terms, tasks_by_function, words_for_tasks

MDP = mdp.__name__
STRUCT = type(mdp.RobotView)  # type of what @wp.struct returns
INNER_STRUCTS = (Block, FilterParams, LegGeometry, Limits, MotorArrays)
"""Structs that are fields of public ones."""
UNIT = re.compile(r"(\[[^\]]+\](?:, \[[^\]]+\])*),? ?")
SHAPE = re.compile(r"(\([^()]*,[^()]*\))[,;]? ?")


class Section(NamedTuple):
    """Section of a page: a title and the names in `jumper_warp.mdp` that it describes."""

    title: str
    names: tuple[str, ...]


class Page(NamedTuple):
    """Page about a part of `jumper_warp.mdp`; a page named in `SPACES` also describes the terms of that namespace."""

    title: str
    about: str
    sections: tuple[Section, ...]


PAGES = {
    "tasks": Page("Tasks", "A task is a `TaskCfg`: terms, functions, motors and constants.", (
        Section("Task", ("TaskCfg",)),
        Section("Motors and command filters", ("jumping_motors", "walking_motors", "vertical_jump_filter",
                                               "walking_filter")),
    )),
    "states": Page("Robot and states", "Terms read the robot as a `RobotView`, and the task's state as a struct of "
                   "the task. `Advance` updates the state after each policy step.", (
        Section("Robot", ("RobotView", "RobotArrays", "LegGeometry", "in_flight", "tilt", "yaw_of")),
        Section("Task states", ("Advance", "JumpState", "STANCE", "FLIGHT", "LANDED", "VelocityState",
                                "AttitudeState", "commanded", "waiting")),
        Section("Scene and ground", ("Scene", "Ground", "Block", "surface", "world_ground")),
    )),
    "observations": Page("Observations", "An observation term returns a number or a vector: a part of the network's "
                         "input. The namespace `mirror` has mirror images: `VECTOR` and `ROTATION` of x, y, z in body "
                         "axes, `LEGS` of four and `MOTORS` of twelve columns.",
                         (Section("Classes", ("ObservationTerm", "ObservationsCfg")),)),
    "rewards": Page("Rewards", "A reward term returns a number. Each policy step adds weight × number × 1/60 s to the "
                    "reward.", (Section("Classes", ("RewardTerm",)),)),
    "terminations": Page("Terminations", "A termination term returns whether the episode ends.",
                         (Section("Classes", ("TerminationTerm",)),)),
    "commands": Page("Commands and resets", "A command is the goal of a robot; a reset writes the first state of an "
                     "episode. Both sample random numbers.", (
        Section("Commands", ("Command", "Handover")),
        Section("Resets", ("Reset", "NoSettings", "SkillSettings", "write_default_pose")),
        Section("Random numbers", ("RngStream", "uniform", "uniform_range", "clamped_normal", "fold_in")),
    )),
    "events": Page("Events", "An event writes parameters of a robot, at every reset or at intervals.", (
        Section("Classes", ("EventTerm", "RandomizationCfg")),
        Section("Parameters of a robot", ("RobotParameters", "MotorArrays", "FilterParams", "Limits")),
    )),
    "curricula": Page("Curricula and metrics", "A curriculum raises the level of a robot after successes. A metric is "
                      "logged as its mean. An evaluation has the metrics and the goal marker of `jumper evaluate` and "
                      "`play`.", (Section("Classes", ("Curriculum", "StateMetric", "EpisodeEvaluation",
                                                      "EpisodeMetric")),)),
}  # fmt: skip
"""Pages by file name."""


def mdp_pages() -> dict[str, str]:
    """Return the Markdown of all pages about `jumper_warp.mdp` by file name, with a table of all names in `mdp.md`."""
    inner = {struct.key: (f"{struct.cls.__module__}.{struct.key}", struct) for struct in INNER_STRUCTS}
    used, pages, rows = tasks_by_function(), {}, []
    for key, page in PAGES.items():
        parts, link = [f"# {page.title}", page.about], f"[{page.title}](../reference/mdp/{key}.md)"
        sections = [(title, [inner.get(name) or (f"{MDP}.{name}", getattr(mdp, name)) for name in members])
                    for title, members in page.sections]  # fmt: skip
        for title, things in (*sections, *(term_sections(key) if key in SPACES else ())):
            parts += [f"## {title}", *(described_thing(name, thing, used.get(thing)) for name, thing in things)]
            rows.append((link, title, ", ".join(f"{{py:obj}}`~{name}`" for name, _ in things)))
            link = ""
        pages[f"{key}.md"] = "\n\n".join(parts) + "\n"
    contents = "\n".join(["```{toctree}", ":hidden:", *(f"mdp/{key}" for key in PAGES), "```"])
    return pages | {"mdp.md": f"{table(('Page', 'Section', 'Names'), rows)}\n\n{contents}\n"}


def term_sections(space: str) -> list[tuple[str, list[tuple[str, Any]]]]:
    """Return the sections of a namespace of stock terms: titles, and functions with full names."""
    groups = {f"Stock {space}": stock_terms(space)}
    groups |= {f"{space.capitalize()} of {words}": task_terms(space, kind) for kind, words in TASK_KINDS.items()}
    groups["Functions"] = helpers(space)
    return [(title, sorted(group.items(), key=lambda item: item[0].rpartition(".")[2].lower()))
            for title, group in groups.items() if group]  # fmt: skip


def described_thing(name: str, thing: Any, tasks: Sequence[str] | None) -> str:
    """Return the Sphinx directive that documents an object; tasks: names of those that use it as a term."""
    if isinstance(thing, wp.Function):
        return function_entry(name, thing, tasks)
    if isinstance(thing, STRUCT):
        return struct_entry(name, thing)
    if isinstance(thing, int):
        return constant(name, thing)
    if inspect.isfunction(thing):
        return factory(name, thing)
    return (term_class if issubclass(thing, Term) else task_class)(name, thing)


def described(kind: str, name: str, signature: str, *paragraphs: str) -> str:
    """Return a directive `py:<kind>` of a full name, a signature, and paragraphs of Markdown."""
    local = name.removeprefix(f"{MDP}.").removeprefix("jumper_warp.kernels.")
    body = "\n\n".join(paragraph for paragraph in paragraphs if paragraph)
    return f"````{{py:{kind}}} {local}{signature}\n:module: {name.removesuffix(f'.{local}')}\n\n{body}\n````"


def parsed(thing: Any) -> Any:
    """Return the syntax tree of a class or function."""
    return ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]


def plain_type(annotation: ast.expr) -> str:
    """Return the name of an annotated type, without `wp.`: `array2d of vec3`."""
    return re.sub(r"(array\w*)\(dtype=(\w+)\)", r"\1 of \2", ast.unparse(annotation).replace("wp.", ""))


def split(pattern: re.Pattern[str], text: str) -> tuple[str, str]:
    """Split a text into the match of a pattern at its start, empty if there is none, and the rest."""
    match = pattern.match(text)
    return (match[1], text[match.end() :]) if match else ("", text)


def function_entry(name: str, func: Any, tasks: Sequence[str] | None = None) -> str:
    """Return the entry of a Warp function; tasks: names of those that use it as a term."""
    tree = parsed(func.func)
    returns = f" -> {plain_type(tree.returns)}" if tree.returns else ""
    for arg in tree.args.args:
        arg.annotation = ast.Name(plain_type(arg.annotation)) if arg.annotation else None
    names = f"Used by {words_for_tasks(tasks)}." if tasks else ""
    about = to_markdown(inspect.getdoc(func.func) or "")
    return described("function", name, f"({ast.unparse(tree.args)}){returns}", about, names)


def factory(name: str, function: Any) -> str:
    """Return the entry of a Python function that returns settings of a task."""
    return described("function", name, str(inspect.signature(function)).replace("'", ""),
                     to_markdown(inspect.getdoc(function) or ""))  # fmt: skip


def struct_entry(name: str, struct: Any) -> str:
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


def term_class(name: str, kind: type[Term]) -> str:
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


def task_class(name: str, kind: type) -> str:
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


def constant(name: str, value: int) -> str:
    """Return the entry of an integer constant that names a phase of a jump."""
    module: Any = inspect.getmodule(mdp.commanded.func)
    comment = re.search(rf"^{name.rpartition('.')[2]} = .*?# (?:phases: )?(.*)$", inspect.getsource(module), re.M)
    return described("data", name, "", f"Phase of a jump, {value}: {to_markdown(comment[1] if comment else '')}.")


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    head = list(head)
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows])
