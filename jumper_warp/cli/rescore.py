"""`jumper rescore RECORDING --task FILE.py`: rewards that a changed task would pay for a recorded motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Literal

import tyro

from jumper_warp.cli.flags import parse


@dataclass(frozen=True)
class RescoreCfg:
    """Evaluate a task's rewards on a recorded motion, term by term and step by step, without training.

    The result is a table, a picture and a recording with the rewards as curves.
    """

    recording: tyro.conf.Positional[Path]  # Recording of jumper play: its .npz file, or the .rrd file beside it
    task: str  # Task with the changed rewards: a FILE.py that registers one task, FILE.py:TASK, or a name
    base: str = ""  # Task to compare with (default: the recorded policy's, else the most similar of the project)
    out: Path | None = None  # Folder for the results (default: outputs/rescore/<time>)
    viewer: Literal["none", "rerun"] = "none"
    """Open the recording in Rerun's viewer. It listens on this machine's loopback address only."""


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> None:
    """Run `jumper rescore` with the given arguments; modules: loaded by --task-module.

    Raises InputError or OSError: the recording or a task is invalid.
    """
    cfg: RescoreCfg = parse(RescoreCfg, "rescore", args)
    from rich.table import Column, Table

    from jumper_warp.compare.rescore import rescore
    from jumper_warp.compare.tasks import base_of, task_of
    from jumper_warp.evaluation.commands import open_viewer
    from jumper_warp.evaluation.recorder import save_recording
    from jumper_warp.registry import TASKS, make_task
    from jumper_warp.utils.output import output_dir, write_metrics
    from jumper_warp.utils.tables import print_table
    from jumper_warp.viz.recording import load_npz

    task = task_of(cfg.task)
    recording = load_npz(cfg.recording)
    recorded = str(recording.notes.get("task", ""))
    base = cfg.base or (recorded if recorded in TASKS and recorded != task.name else base_of(task))
    result = rescore(recording, task, make_task(base))
    folder = output_dir("rescore", cfg.out)
    names = (Column(name, overflow="fold") for name in (base, task.name))
    table = Table(Column("sum over an episode", no_wrap=True), *names, "not zero", "least", "most", box=None)
    for row in result.table:
        sums = ("–" if value is None else f"{value:.4g}" for value in (row.base, row.task))
        ends = (f"{end + 0.0:.3g}" for end in (row.low, row.high))  # 0.0 makes 0 of -0
        table.add_row(row.term, *sums, f"{100.0 * row.nonzero:.0f} %", *ends)
    write_metrics(folder, {f"sum_{row.term}": row.task for row in result.table}, {"task": task.name, "base": base})
    result.plot(folder / "rewards.png")
    path = save_recording(result.with_lanes(), folder, cfg.recording.stem)
    print_table(table)
    print(folder / "rewards.png", path, sep="\n")
    open_viewer(path, cfg.viewer)
