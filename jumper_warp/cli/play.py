"""`jumper play POLICY`: a policy acts, as a recording for the Rerun viewer. `jumper play --script FILE`: several do.

The policy comes first: what it is decides which flags there are. A script says what one robot does with several.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

from jumper_warp.cli.evaluate import open_run, parse, policy_of
from jumper_warp.cli.main import parse as parse_flags

ABOUT = """\
Let a policy act and record it for the Rerun viewer; --viewer rerun opens the recording.
jumper play --script FILE.json [flags] lets one robot walk and jump with several policies, as the script says."""
SCRIPT = "--script"


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Play as the arguments say; modules: that the user has named, for tasks that are not the project's.

    Raises UsageError or OSError with one line: the policy or a flag cannot be used. Exits where tyro does.
    """
    if args and args[0].startswith("-") and any(arg.partition("=")[0] == SCRIPT for arg in args):
        from jumper_warp.evaluation.commands import ScriptCfg, play_script

        play_script(parse_flags(ScriptCfg, f"play {SCRIPT} FILE", args))
        return
    policy = policy_of("play", ABOUT, args)
    from jumper_warp.evaluation.commands import PlayCfg, play

    opened = open_run(policy, modules)
    play(opened, parse("play", opened, args[1:], PlayCfg, lambda kind: kind.play))
