"""`jumper play POLICY` records a policy for the Rerun viewer, `jumper play --script FILE` several policies in sequence.

The policy comes first: its task decides which flags there are. A script lists the commands to one robot.
`jumper play --log FOLDER` shows a log of the robot beside the simulation, and
`jumper play --dump FILE` shows the state in which a term of a training was not finite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from jumper_warp.cli.evaluate import open_run, parse, policy_of
from jumper_warp.cli.flags import option_of, wants_help
from jumper_warp.cli.flags import parse as parse_flags

if TYPE_CHECKING:
    from jumper_warp.tasks.cfg import TaskCfg
    from jumper_warp.viz.recording import Recording

ABOUT = """\
Simulate a policy, and write a picture and a recording for the Rerun viewer;
--viewer rerun opens it, --video FILE writes a film.
jumper play --script FILE.json [flags] makes one robot walk and jump with
several policies.
jumper play A B ... [flags] shows several motions side by side, with the rewards
of the first one's task: policies, runs, or recordings (.rrd), of which each
NAME=SOURCE has a name; of several robots the first one counts.
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

        play_agent(make_task(args[0]), parse_flags(AgentCfg, f"play {args[0]}", args[1:]))
        return
    if len(args) > 1 and not any(arg.startswith("-") for arg in args[:2]):
        play_together(args, modules)
        return
    policy = policy_of("play", ABOUT, args)
    from jumper_warp.evaluation.commands import PlayCfg, play

    run = open_run(policy, modules, args)
    play(run, parse("play", run.task, args, PlayCfg))


def play_together(args: Sequence[str], modules: Sequence[ModuleType]) -> None:
    """Show motions side by side; args: policies, runs or recordings, then flags of `jumper play` for all of them.

    Raises InputError or OSError: see `run`.
    """
    from jumper_warp.compare.motions import compare_motions
    from jumper_warp.compare.tasks import task_of
    from jumper_warp.evaluation.commands import PlayCfg, RecordingCfg, open_viewer, record
    from jumper_warp.utils.output import output_dir
    from jumper_warp.viz.pairs import write_pictures
    from jumper_warp.viz.recording import load_npz
    from jumper_warp.viz.rerun import write_rrd

    sources = list(takewhile(lambda arg: not arg.startswith("-"), args))
    flags = args[len(sources) :]
    motions: dict[str, Recording] = {}
    tasks: list[TaskCfg] = []
    cfg: Any = None
    folder: Path | None = None
    for source in sources:
        name, _, path = source.rpartition("=")
        if Path(path).suffix in (".rrd", ".npz"):
            recording = load_npz(Path(path))
            tasks.append(task_of(str(recording.notes.get("task", ""))))
        else:
            run = open_run(path, modules, flags)
            cfg = parse("play", run.task, [path, *flags], PlayCfg)
            folder = folder or output_dir("play", cfg.out)
            _, recording = record(run, replace(cfg, out=folder))
            tasks.append(run.task)
        name = name or str(recording.notes.get("policy", Path(path).stem))
        motions[f"{name} {len(motions) + 1}" if name in motions else name] = recording
    cfg = cfg or parse_flags(RecordingCfg, "play A B", flags)
    folder = folder or output_dir("play", cfg.out)
    together = compare_motions(motions, tasks[0])
    together = replace(together, notes=together.notes | cfg.film.notes)
    path = write_rrd(together, folder / "motions.rrd")
    picture = write_pictures(together, folder / "motions.png", true_scale=cfg.film.true_scale, **cfg.film.view)
    print(picture, path, *([] if cfg.film.video is None else [cfg.film.write(together)]), sep="\n")
    open_viewer(path, cfg.viewer)
