"""`jumper evaluate POLICY [--suite NAME]`: a policy is tried many times, in the way of its task, or of a suite.

The policy comes first: what it is decides which flags there are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

from jumper_warp.cli.main import TASK_MODULE_HELP, UsageError
from jumper_warp.cli.main import parse as parse_flags
from jumper_warp.cli.renamed_flags import join_height_range

if TYPE_CHECKING:
    from jumper_warp.evaluation.registry import Evaluation
    from jumper_warp.evaluation.run import EvaluationRun

HELP = """\
usage: jumper {command} POLICY [flags]

{about}

  POLICY    name or folder of a policy, a training run's folder, or a checkpoint; `jumper list` shows the project's

Flags differ between tasks: jumper {command} POLICY --help shows those of one."""
ABOUT = """\
Try a policy many times and report how well it did: metrics.json, and a list of all that was tried.
jumper evaluate POLICY --suite NAME [flags] runs a test of jumps instead, such as sweep, grid, ring or max."""
SUITE = "--suite"


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Evaluate as the arguments say; modules: that the user has named, for tasks that are not the project's.

    Raises UsageError or OSError with one line: the policy or a flag cannot be used. Exits where tyro does.
    """
    policy = policy_of("evaluate", ABOUT, args)
    from jumper_warp.evaluation.commands import EvaluateCfg, evaluate

    opened = open_run(policy, modules)
    if SUITE in args:
        run_suite(opened, args)
        return
    evaluate(opened, parse("evaluate", opened, args[1:], EvaluateCfg, lambda kind: kind.flags))


def run_suite(opened: EvaluationRun, args: Sequence[str]) -> None:
    """Run the suite that the arguments name. Raises UsageError: the policy's task has none of that name."""
    from jumper_warp.evaluation.suites import suites_for

    flag = args.index(SUITE)
    suites, name = suites_for(opened.task.evaluation), "".join(args[flag + 1 : flag + 2])
    if name not in suites:
        there = ", ".join(suites) or "none"
        raise UsageError(f"no suite {name!r:.60} for policies of {opened.task.name}; there are {there}")
    command, default = f"evaluate {opened.source} {SUITE} {name}", suites[name](policy=str(opened.source))
    parse_flags(suites[name], command, [*args[1:flag], *args[flag + 2 :]], default=default).run(opened.modules)


def policy_of(command: str, about: str, args: Sequence[str]) -> str:
    """Return the policy, which comes first; exits after the help that is the same for all. Raises UsageError."""
    if args and args[0] in ("-h", "--help"):
        print(f"{HELP.format(command=command, about=about)}\n\n{TASK_MODULE_HELP}")
        raise SystemExit(0)
    if not args or args[0].startswith("-"):
        raise UsageError(f"the policy comes first: jumper {command} POLICY [flags]")
    return args[0]


def open_run(policy: str, modules: Sequence[ModuleType]) -> EvaluationRun:
    """Return a policy under evaluation. Raises PolicyError or CheckpointError: it cannot be used."""
    from jumper_warp.evaluation.run import EvaluationRun

    return EvaluationRun(policy, modules)


def parse(
    command: str, opened: EvaluationRun, args: Sequence[str], kind: Any, flags_of: Callable[[Evaluation], Any]
) -> Any:
    """Return the settings of a kind, with the flags of the policy's evaluation; exits where tyro does.

    Raises UsageError: a flag is not one of the policy's task, or a setting is out of range.
    """
    flags, about = flags_of(opened.evaluation), kind.__doc__
    if hasattr(flags, "height_range"):
        args = join_height_range(args, flags.height_range)
    cfg, unknown = parse_flags(
        kind[type(flags)],
        f"{command} {opened.source}",
        args,
        description=about,
        default=kind(flags),
        return_unknown_args=True,
    )
    if unknown:
        what = f"{unknown[0]} is not for policies of {opened.task.name}"
        raise UsageError(f"{what}; jumper {command} {opened.source} --help shows what is")
    return cfg
