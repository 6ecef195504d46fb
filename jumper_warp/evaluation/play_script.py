"""What `jumper play --script` does: one robot walks and jumps as a file says, and is recorded."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from jumper_warp.evaluation.commands import print_figures, viewer_command
from jumper_warp.evaluation.course_metrics import course_metrics, draw_course
from jumper_warp.evaluation.courses import Course
from jumper_warp.evaluation.film import Film
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.plots import drawn
from jumper_warp.evaluation.scripts import read_script
from jumper_warp.evaluation.skills import SkillRun
from jumper_warp.policies.conditions import Conditions
from jumper_warp.policies.skills import SkillNames
from jumper_warp.utils.output import write_metrics


@dataclass(frozen=True)
class ScriptCfg:
    """Let one robot walk and jump with several policies, as a script says, and record it.

    A script is a JSON list of {"walk": [vx, vy, yaw_rate], "seconds": s}, {"stand": s}, {"jump_up": height},
    {"jump_to": [ahead, left]} and {"jump_onto": [ahead, left]} (a block); SI units, as in
    assets/scripts/walk_jump_walk.json.
    """

    script: Path
    """File with the commands."""
    policies: Annotated[SkillNames, tyro.conf.arg(name="")] = field(default_factory=SkillNames)
    """Who carries them out."""
    conditions: Annotated[Conditions, tyro.conf.arg(name="")] = field(default_factory=Conditions)
    """What the policies are tried in."""
    out: Path | None = None
    """Folder for the recording, a plot and metrics.json (default: outputs/play/<time>)."""
    viewer: Literal["none", "rerun"] = "none"
    """Open the recording in Rerun's viewer, which then listens on this machine's loopback address only."""


def play_script(cfg: ScriptCfg) -> Path:
    """Simulate, write a recording, a plot and `metrics.json`, print a table; return the path of the recording.

    Raises:
        InputError: The script cannot be used, or there is no such device.
        PolicyError: A policy cannot be used.
        OSError: The folder cannot be made.
    """
    script = read_script(cfg.script)
    run = SkillRun(cfg.policies)
    run.prepare("play", cfg.conditions, cfg.out)
    course = Course([script])
    env = run.env(1, block=course.block)
    film = Film(env, course, [0], notes={**course.notes([0]), "solver": cfg.conditions.solver})
    run_evaluation(run.actor(env), env, course, watch=film)
    path = film.save_rrd(run.folder / "course.rrd")
    with drawn(run.folder / "course.png", 5, 1, figsize=(10, 9), sharex=True) as axes:
        draw_course(axes, course, 0)
    figures = {"outcome": str(course.outcomes[0]), **course_metrics(course)}
    write_metrics(run.folder, figures)
    print_figures(figures)
    Console(stderr=True).print(str(path), highlight=False, soft_wrap=True)
    if cfg.viewer == "rerun":
        subprocess.run(viewer_command(path), check=False)
    return path
