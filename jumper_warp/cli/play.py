"""`jumper play POLICY` records a policy for the Rerun viewer, `jumper play --script FILE` several policies in sequence.

The policy comes first: its task decides which flags there are. A script lists the commands to one robot.
`jumper play --log FOLDER` shows a log of the robot beside the simulation, and
`jumper play --dump FILE` shows the state in which a term of a training was not finite.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

from jumper_warp.cli.evaluate import open_run, parse, policy_of
from jumper_warp.cli.flags import option_of, wants_help
from jumper_warp.cli.main import parse as parse_flags

ABOUT = """\
Simulate a policy, and write a picture and a recording for the Rerun viewer;
--viewer rerun opens it, --video FILE writes a film.
jumper play --script FILE.json [flags] makes one robot walk and jump with
several policies.
jumper play TASK --agent zero|random|hold [flags] shows a task without a policy,
and the range of each reward and the share of each termination.
jumper play --log FOLDER [flags] shows a log of the robot beside the simulation.
jumper play --dump FILE [flags] shows a state that a training has saved because a
term was not finite."""
SCRIPT, DUMP, LOG, AGENT = "--script", "--dump", "--log", "--agent"


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper play` with the given arguments; args: the policy, then flags, or flags with --script or --dump.

    modules: loaded by --task-module, for tasks outside the project. Raises InputError or OSError: the policy, a file or
    a flag is invalid. Exits with 0 after help.
    """
    names = {arg.partition("=")[0] for arg in args} if args and args[0].startswith("-") else set()
    if DUMP in names:
        from jumper_warp.evaluation.commands import DumpCfg, play_dump

        play_dump(parse_flags(DumpCfg, f"play {DUMP} FILE", args))
        return
    if LOG in names:
        from jumper_warp.bench.logs import LogCfg, play_log

        play_log(parse_flags(LogCfg, f"play {LOG} FOLDER", args))
        return
    if SCRIPT in names:
        from jumper_warp.evaluation.commands import ScriptCfg, play_script

        play_script(parse_flags(ScriptCfg, f"play {SCRIPT} FILE", args))
        return
    if AGENT in map(option_of, args) and not wants_help(args[:1]):
        from jumper_warp.evaluation.agents import AgentCfg, play_agent
        from jumper_warp.registry import make_task

        cfg = parse_flags(AgentCfg, f"play {args[0]}", args[1:])
        play_agent(make_task(args[0]), cfg)
        return
    policy = policy_of("play", ABOUT, args)
    from jumper_warp.evaluation.commands import PlayCfg, play

    run = open_run(policy, modules, args)
    play(run, parse("play", run.task, args, PlayCfg))
