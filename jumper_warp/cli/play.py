"""`jumper play POLICY` records a policy for the Rerun viewer, `jumper play --script FILE` several in sequence.

The policy comes first: its task decides which flags there are. A script lists the commands to one robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

from jumper_warp.cli.evaluate import open_run, parse, policy_of, saved_task
from jumper_warp.cli.main import parse as parse_flags

ABOUT = """\
Simulate a policy, and write a picture and a recording for the Rerun viewer;
--viewer rerun opens it, --video FILE writes a film.
jumper play --script FILE.json [flags] makes one robot walk and jump with
several policies."""
SCRIPT = "--script"


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper play` with the given arguments; modules: the user's, for tasks outside the project.

    args: the policy, then flags, or flags with --script. Raises InputError or OSError: the policy, script or a flag is
    invalid. Exits as tyro does.
    """
    if args and args[0].startswith("-") and any(arg.partition("=")[0] == SCRIPT for arg in args):
        from jumper_warp.evaluation.commands import ScriptCfg, play_script

        play_script(parse_flags(ScriptCfg, f"play {SCRIPT} FILE", args))
        return
    policy = policy_of("play", ABOUT, args)
    from jumper_warp.evaluation.commands import PlayCfg, play

    cfg = parse("play", saved_task(policy, modules), args, PlayCfg, lambda kind: kind.play)
    play(open_run(policy, modules), cfg)
