"""`jumper evaluate POLICY [--suite NAME]`: measure a policy over many trials, or in a test suite.

The policy comes first: its task decides which flags there are.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, cast

from jumper_warp.cli.flags import list_flags, option_of, wants_help
from jumper_warp.cli.flags import parse as parse_flags
from jumper_warp.cli.main import TASK_MODULE_HELP, UsageError
from jumper_warp.utils.errors import suggestion
from jumper_warp.utils.files import read_json

if TYPE_CHECKING:
    from jumper_warp.evaluation.run import EvaluationRun
    from jumper_warp.tasks.cfg import TaskCfg

HELP = """\
usage: jumper {command} POLICY [flags]

{about}

  POLICY    name or folder of a policy, folder of a training run (logs/TASK: the
            task's newest run), or checkpoint;
            `jumper list` shows the names

jumper {command} POLICY --help lists the flags."""
ABOUT = """\
Measure a policy over many trials, print its metrics and write metrics.json.
jumper evaluate POLICY --suite NAME [flags] runs a test of jumps instead: range
of heights or distances, grid, ring, consecutive, platform, or max distance."""
SUITE = "--suite"


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper evaluate` with the given arguments; args: the policy, then flags.

    modules: loaded by --task-module, for tasks outside the project. Raises InputError or OSError: the policy or a flag
    is invalid. Exits with 0 after help.
    """
    policy = policy_of("evaluate", ABOUT, args)
    args = [part for arg in args for part in (arg.split("=", 1) if arg.startswith(f"{SUITE}=") else [arg])]
    run = open_run(policy, modules, args)
    if SUITE in args:
        run_suite(run.task, args, modules)
        return
    from jumper_warp.evaluation.run import EvaluateCfg, evaluate

    check_suite_flags(run.task, args)
    evaluate(run, parse("evaluate", run.task, args, EvaluateCfg))


def check_suite_flags(task: TaskCfg, args: Sequence[str]) -> None:
    """Raise UsageError if args, without --suite, have a flag that only test suites of the task's policies have."""
    from jumper_warp.evaluation.run import EvaluateCfg
    from jumper_warp.evaluation.suites import suites_for

    def flags_of(settings: Any) -> set[str]:
        """Return the flags of a settings dataclass, with leading dashes."""
        return {f"--{flag.name}" for flag in list_flags(settings, described=False)}

    known = flags_of(EvaluateCfg(task.evaluation.default_flags("evaluate")))
    for flag in map(option_of, args):
        of = [suite for suite, kind in suites_for(task).items() if flag in flags_of(kind)]
        if of and flag not in known:
            raise UsageError(f"{flag} needs a test suite: add {SUITE} {' or '.join(of)}")


def run_suite(task: TaskCfg, args: Sequence[str], modules: Sequence[ModuleType]) -> None:
    """Run the test suite whose name follows --suite in args (policy, then flags). Raises UsageError: no such suite."""
    from jumper_warp.evaluation.suites import suites_for

    flag = args.index(SUITE)
    suites = suites_for(task)
    name = "".join(args[flag + 1 : flag + 2])
    if name not in suites:
        if not suites:
            raise UsageError(f"there are no suites for policies of {task.name}")
        near = suggestion(name, suites) or f"; there are {', '.join(suites)}"
        raise UsageError(f"no suite {name!r:.60} for policies of {task.name}{near}")
    command = f"evaluate {args[0]} {SUITE} {name}"
    default = suites[name](policy=args[0])
    parse_flags(suites[name], command, [*args[1:flag], *args[flag + 2 :]], default=default).run(list(modules))


def policy_of(command: str, about: str, args: Sequence[str]) -> str:
    """Return the policy, the first command-line argument; print the general help and exit with 0 if it is --help.

    about: text for the help. Raises UsageError: the first argument is missing or another flag.
    """
    if args and args[0] in ("-h", "--help"):
        print(f"{HELP.format(command=command, about=about)}\n\n{TASK_MODULE_HELP}")
        raise SystemExit(0)
    if not args or args[0].startswith("-"):
        raise UsageError(f"the policy comes first: jumper {command} POLICY [flags]")
    return args[0]


def open_run(policy: str, modules: Sequence[ModuleType], args: Sequence[str] = ()) -> EvaluationRun:
    """Load a policy or a training run for evaluation.

    If args ask for help, only its saved recipe, whose `task` decides which flags there are, without PyTorch.
    Raises PolicyError, CheckpointError or TaskError if it cannot be used.
    """
    from jumper_warp.utils.progress import phase

    if wants_help(args):
        from jumper_warp.policies.catalog import CONFIG, find_policy, newest_run, run_folder
        from jumper_warp.recipe import Recipe

        folder = run_folder(Path(policy)) if Path(policy).suffix == ".pt" else find_policy(newest_run(policy))
        return cast("Any", Recipe.from_json(read_json(folder / CONFIG, "configuration"), modules, complete=False))
    with phase(f"opening {policy}"):
        from jumper_warp.evaluation.run import EvaluationRun

        run = EvaluationRun(policy, modules)
    if run.policy.checkpoint is not None:
        print(f"checkpoint: {run.policy.checkpoint}", file=sys.stderr)
    return run


def parse(command: Literal["evaluate", "play"], task: TaskCfg, args: Sequence[str], kind: Any) -> Any:
    """Parse the flags of a command that runs a policy, and return the settings; args: the policy, then flags.

    kind: generic dataclass of the settings, such as `EvaluateCfg`. Raises UsageError: a flag belongs to other tasks
    only, or a setting is out of range.
    """

    policy, *args = args
    flags = task.evaluation.default_flags(command)
    return parse_flags(kind[type(flags)], f"{command} {policy}", args, description=kind.__doc__, default=kind(flags))
