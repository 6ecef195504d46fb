"""Reference page of the `jumper` commands, as MyST Markdown from their settings."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from jumper_warp.bench.logs import LogCfg
from jumper_warp.cli.bus_sim import BusSimCfg
from jumper_warp.cli.compare import CompareCfg
from jumper_warp.cli.doctor import DoctorCfg
from jumper_warp.cli.drive import DriveCfg
from jumper_warp.cli.evaluate import ABOUT as ABOUT_EVALUATE
from jumper_warp.cli.export import ExportCfg
from jumper_warp.cli.export_robot import ExportRobotCfg
from jumper_warp.cli.flags import Flag, list_flags
from jumper_warp.cli.info import InfoCfg
from jumper_warp.cli.list import ListCfg, RunsCfg
from jumper_warp.cli.main import COMMANDS, EXIT_CODES
from jumper_warp.cli.play import ABOUT as ABOUT_PLAY
from jumper_warp.cli.rescore import RescoreCfg
from jumper_warp.cli.robot import CheckCfg, NewCfg, ShowCfg
from jumper_warp.cli.sweep import SweepCfg
from jumper_warp.cli.sysid import ExciteCfg, SysidCfg
from jumper_warp.cli.task_flags import flags_of
from jumper_warp.cli.train import SHORT_HELP, TrainArgs
from jumper_warp.cli.try_task import TryCfg
from jumper_warp.cli.watch import WatchArgs
from jumper_warp.deploy.main import parser as deploy_parser
from jumper_warp.evaluation.agents import AgentCfg
from jumper_warp.evaluation.commands import DumpCfg, PlayCfg, ScriptCfg
from jumper_warp.evaluation.finetuning_cfg import FinetuneArgs
from jumper_warp.evaluation.run import EvaluateCfg
from jumper_warp.evaluation.suites import SUITES
from jumper_warp.registry import TASKS, make_task
from jumper_warp.tasks.evaluation import EpisodeEvaluation
from plain_text import to_markdown

EXAMPLE_TASK = "vertical-jump"
COMMON = {
    "finetune": ("num-goals", "height-range", "distance-range", "iterations", "out", "overwrite"),
    "drive": ("agent", "solver", "ground", "port", "out", "friction", "latency", "gravity"),
    "play": ("seconds", "solver", "robot", "gravity", "video", "viewer", "out"),
    "evaluate": ("solver", "randomize", "noise", "seed", "robot", "gravity", "friction", "save-trials", "out"),
    "compare": ("file", "primary", "metric", "evaluate", "html", "out"),
    "sysid fit": ("params", "mass", "torque-limit", "gain-preset", "out"),
    "sysid excite": ("params", "seconds", "robot", "seed", "out"),
}
"""Names of the flags that stand before the list of all flags."""
METAVARS: dict[Any, str] = {bool: "", int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}
FULL_LIST = 10  # Largest number of flags without a second list


def cli_page() -> str:
    """Return the Markdown of the command reference: a section for each command, then exit codes."""
    of_tasks = [entry.task(name).evaluation for name, entry in TASKS.items() if entry.of_project]
    stock = {each.kind: each for each in (*of_tasks, EpisodeEvaluation())}
    parts = [
        section("train TASK", COMMANDS["train"], list_flags(TrainArgs), headings={"Common flags": SHORT_HELP},
                more={f"Flags of a task, here {EXAMPLE_TASK}": list_flags(flags_of(make_task(EXAMPLE_TASK)), "env.")}),
        section("watch RUN", doc(WatchArgs), list_flags(WatchArgs)),
        section("finetune POLICY", COMMANDS["finetune"], list_flags(FinetuneArgs)),
        of_kinds("play", ABOUT_PLAY,
                 {name: list_flags(PlayCfg(each.default_flags("play"))) for name, each in stock.items()},
                 {"Flags with --script": list_flags(ScriptCfg), "Flags with --dump": list_flags(DumpCfg),
                  "Flags with --log": list_flags(LogCfg), "Flags with --agent": list_flags(AgentCfg)}),
        section("drive POLICY ...", doc(DriveCfg), list_flags(DriveCfg)),
        of_kinds("evaluate", ABOUT_EVALUATE,
                 {name: list_flags(EvaluateCfg(each.default_flags("evaluate"))) for name, each in stock.items()},
                 {f"Flags with --suite {suite.name}": list_flags(suite) for suite in SUITES}),
        section("compare A B ...", doc(CompareCfg), list_flags(CompareCfg)),
        section("try FILE", doc(TryCfg), list_flags(TryCfg)),
        section("sweep FILE", doc(SweepCfg), list_flags(SweepCfg)),
        section("rescore RECORDING", doc(RescoreCfg), list_flags(RescoreCfg)),
        section("export SOURCE", doc(ExportCfg), list_flags(ExportCfg)),
        section("export robot", doc(ExportRobotCfg), list_flags(ExportRobotCfg)),
        f"## `jumper deploy BUNDLE`\n\n```text\n{deploy_parser().format_help()}```",
        section("bus-sim", doc(BusSimCfg), list_flags(BusSimCfg)),
        *(section(f"robot {name}", doc(kind), list_flags(kind))
          for name, kind in (("new FOLDER", NewCfg), ("check ROBOT", CheckCfg), ("show ROBOT", ShowCfg))),
        section("sysid fit DATA ...", doc(SysidCfg), list_flags(SysidCfg)),
        section("sysid excite", doc(ExciteCfg), list_flags(ExciteCfg)),
        section("list", COMMANDS["list"], list_flags(ListCfg)),
        section("list runs", doc(RunsCfg), list_flags(RunsCfg)),
        section("info NAME", COMMANDS["info"], list_flags(InfoCfg)),
        section("doctor", COMMANDS["doctor"], list_flags(DoctorCfg)),
    ]  # fmt: skip
    return "\n\n".join([summary(), *parts, exit_codes()]) + "\n"


def summary() -> str:
    """Return the Markdown table of all commands and their purposes."""
    anchors = {
        "train": "train-task", "watch": "watch-run", "finetune": "finetune-policy", "play": "play-policy",
        "drive": "drive-policy",
        "evaluate": "evaluate-policy",
        "export": "export-source", "sysid": "sysid-fit-data", "info": "info-name",
        "compare": "compare-a-b", "rescore": "rescore-recording", "sweep": "sweep-file", "try": "try-file",
        "deploy": "deploy-bundle", "robot": "robot-new-folder",
    }  # fmt: skip
    rows = [
        f"| [`{name}`](#jumper-{anchors.get(name, name)}) | {paragraph(about)} |" for name, about in COMMANDS.items()
    ]
    return "\n".join(["| Command | Purpose |", "|---|---|", *rows])


def doc(kind: Any) -> str:
    """Return the description of a command from the docstring of its settings."""
    return inspect.getdoc(kind) or ""


def section(
    command: str, about: str, flags: Sequence[Flag], *, headings: Any = None, more: dict[str, list[Flag]] | None = None
) -> str:
    """Return the section of a command: description, common flags, and all flags in a collapsed block.

    command: with its positional arguments. headings: names of the common flags by heading. more: further flags, each
    list in a collapsed block of its own.
    """
    name = command.split(" POLICY")[0].split(" DATA")[0].split(" A B")[0]
    by_name = {flag.name: flag for flag in flags}
    if headings is None and name in COMMON:
        headings = {"Common flags": COMMON[name]}
    if headings is None or len(flags) <= FULL_LIST:
        shown = definitions(flags)
    else:
        positional = definitions(flag for flag in flags if flag.positional)
        common = [f"**{title}**\n\n{definitions(by_name[each] for each in names if each in by_name)}"
                  for title, names in headings.items()]  # fmt: skip
        shown = "\n\n".join([*filter(None, [positional]), *common, dropdown("All flags", grouped(flags))])
    rest = [dropdown(title, grouped(list_of)) for title, list_of in (more or {}).items()]
    return "\n\n".join([f"## `jumper {command}`", paragraph(about), shown, *rest])


def of_kinds(command: str, about: str, kinds: dict[str, list[Flag]], more: dict[str, list[Flag]]) -> str:
    """Return the section of a command whose flags depend on the policy; kinds: flags by kind of evaluation."""
    first, *others = kinds.values()
    common = [flag for flag in first if all(flag.name in {each.name for each in flags} for flags in others)]
    shared = {flag.name for flag in common}
    own: dict[str, list[Flag]] = {}
    for name, flags in kinds.items():
        title = f"Flags for policies of the kind {name.replace('_', ' ')}"
        own[title] = [flag for flag in flags if flag.name not in shared]
    return section(f"{command} POLICY", about, common, headings={"Common flags": COMMON[command]}, more=own | more)


def grouped(flags: Sequence[Flag]) -> str:
    """Return the definitions of flags below the names of their groups."""
    groups: dict[str, list[Flag]] = {}
    for flag in flags:
        groups.setdefault(flag.name.rpartition(".")[0], []).append(flag)
    parts = []
    for group, members in groups.items():
        about = to_markdown(members[0].group_about)
        title = f"**`{group}`** {about}\n\n" if group else ""
        parts.append(title + definitions(members))
    return "\n\n".join(parts)


def metavar(kind: Any) -> str:
    """Return the placeholder of a type's values: INT, {a,b}, FLOAT FLOAT, TEXT ...; empty for a switch."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return metavar(parts[0])
    if origin is Literal:
        return f"{{{','.join(str(part) for part in parts if part != '')}}}"
    if origin in (Union, UnionType):
        return "|".join(metavar(part) for part in parts if part is not type(None))
    if origin is tuple:
        return f"{metavar(parts[0])} ..." if Ellipsis in parts else " ".join(map(metavar, parts))
    return METAVARS.get(kind, getattr(kind, "__name__", str(kind)).upper())


def default_text(default: Any) -> str:
    """Return a flag's default value as text; empty for None, and for a value that no flag can give."""
    if isinstance(default, bool):
        return "on" if default else "off"
    if isinstance(default, tuple):
        return " ".join(map(default_text, default))
    if isinstance(default, float):
        return f"{default:g}"
    return str(default) if isinstance(default, str | int | Path) else ""


def definitions(flags: Iterable[Flag]) -> str:
    """Return the definition list of flags: name and value, then description and default."""
    return "\n\n".join(f"`{spelling(flag)}`\n: {meaning(flag)}" for flag in flags)


def spelling(flag: Flag) -> str:
    """Return a flag as on the command line, with a placeholder of its value."""
    if flag.positional:
        return flag.name
    start, dot, last = flag.name.rpartition(".")
    return f"--{start}{dot}[no-]{last}" if flag.has_negative else f"--{flag.name} {metavar(flag.kind)}".rstrip()


def meaning(flag: Flag) -> str:
    """Return the description of a flag with its default."""
    default = "" if "(default" in flag.about or flag.default is dataclasses.MISSING else default_text(flag.default)
    about = to_markdown(flag.about.rstrip(".") + "." if flag.about else "")
    return f"{about} Default: `{default}`.".strip() if default else about or "No description."


def dropdown(title: str, content: str) -> str:
    """Return the Markdown of a collapsed block with a title."""
    return f":::::{{dropdown}} {title}\n\n{content}\n:::::"


def paragraph(text: str) -> str:
    """Return a command's description as Markdown."""
    return to_markdown(" ".join(text.split(": jumper ")[0].rstrip(".").split()) + ".")


def exit_codes() -> str:
    """Return the section about exit codes."""
    codes = EXIT_CODES.removeprefix("Exit codes: ").rstrip(".").split(", ")
    rows = [f"| {code.split(' ', 1)[0]} | {code.split(' ', 1)[1]} |" for code in codes]
    return "\n".join(["## Exit codes", "", "| Code | Meaning |", "|---|---|", *rows])
