"""Playing a policy: jumps from the command line, as a recording for the Rerun viewer."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.cli.evaluate import flags_for, measure_of
from jumper_warp.evaluation.film import Film
from jumper_warp.evaluation.jumps import JumpLog, Jumps, rule_names
from jumper_warp.evaluation.landings import Landings
from jumper_warp.policies.restore import Conditions, env_of_policy, open_policy
from jumper_warp.utils.output import output_dir, write_figures

MAX_ROBOTS = 64
SECONDS = 3.5
"""[s] Length of a recording of one jump."""
SECONDS_MORE = 2.5
"""[s] For each further jump."""

Place = tuple[float, float]


@dataclass(frozen=True)
class HeightGoals:
    """What vertical jumps are asked for."""

    height: tuple[float, ...] | None = None
    """[m] Commanded base heights, one robot each; vertical jumps only (default: 0.6 0.9 1.1)."""

    spacing = 1.2
    """[m] Between robots in the picture."""

    def __post_init__(self) -> None:
        """Raises ValueError: a height is out of range, or their number."""
        if self.height is None:
            return
        if not 1 <= len(self.height) <= MAX_ROBOTS or not all(0.0 < height < 10.0 for height in self.height):
            raise ValueError(f"height takes 1 to {MAX_ROBOTS} numbers in (0, 10) m, got {self.height}")

    def __len__(self) -> int:
        return len(self.height)

    @property
    def seconds(self) -> float:
        """[s] Length of the recording."""
        return SECONDS

    @property
    def notes(self) -> dict[str, tuple]:
        """What to save with the recording."""
        return {"heights_m": self.height}

    def log(self, rules: tuple[str, ...]) -> Jumps:
        """Return one jump a robot."""
        return Jumps(np.array(self.height), rules)


@dataclass(frozen=True)
class PlaceGoals:
    """What jumps to places are asked for."""

    goal: tyro.conf.UseAppendAction[tuple[Place, ...]] = ()
    """[m] Where to land, ahead and to the left; once for each robot (default: 0.5, 0.9 and 1.3 ahead). Horizontal
    jumps only, like the next."""
    then: tyro.conf.UseAppendAction[tuple[Place, ...]] = ()
    """[m] Where all robots jump next, a second after touchdown, from where they are by then; once for each jump."""

    spacing = 2.0
    """[m] Between robots in the picture."""

    def __post_init__(self) -> None:
        """Raises ValueError: a place is out of range, or their number."""
        for name in ("goal", "then"):
            places = getattr(self, name)
            if len(places) > MAX_ROBOTS or not all(-10.0 < value < 10.0 for place in places for value in place):
                raise ValueError(f"{name} takes up to {MAX_ROBOTS} places in (-10, 10) m, got {places}")

    def __len__(self) -> int:
        return len(self.goal)

    @property
    def seconds(self) -> float:
        """[s] Length of the recording."""
        return SECONDS + SECONDS_MORE * len(self.then)

    @property
    def notes(self) -> dict[str, tuple]:
        """What to save with the recording."""
        return {"goals_m": self.goal, "then_m": self.then}

    def log(self, rules: tuple[str, ...]) -> Landings:
        """Return one row of jumps a robot."""
        return Landings(np.array([[goal, *self.then] for goal in self.goal]), rules)


GOALS: dict[str, HeightGoals | PlaceGoals] = {
    "vertical-jump": HeightGoals((0.6, 0.9, 1.1)),
    "horizontal-jump": PlaceGoals(((0.5, 0.0), (0.9, 0.0), (1.3, 0.0))),
    "omnidirectional-jump": PlaceGoals(((0.5, 0.0), (0.0, 0.5), (-0.5, 0.0))),
}
"""What policies of a task play unless told otherwise."""


@dataclass(frozen=True)
class PlayCfg:
    """Let a policy jump, and record it."""

    policy: tyro.conf.Positional[str]
    """Name or folder of a policy, a run's folder, or a checkpoint."""
    heights: Annotated[HeightGoals, tyro.conf.arg(name="")] = field(default_factory=HeightGoals)
    """For vertical jumps."""
    places: Annotated[PlaceGoals, tyro.conf.arg(name="")] = field(default_factory=PlaceGoals)
    """For jumps to places."""
    seconds: float | None = None
    """[s] Length of the recording; the jump is commanded after half a second (default: 3.5, and 2.5 for each further
    jump)."""
    conditions: Annotated[Conditions, tyro.conf.arg(name="")] = field(default_factory=Conditions)
    """What the policy is tried in."""
    out: Path | None = None
    """Folder for jump.rrd and figures.json (default: outputs/play/<time>)."""
    viewer: Literal["none", "rerun"] = "none"
    """Open the recording in Rerun's viewer, which then listens on this machine's loopback address only."""

    def __post_init__(self) -> None:
        """Raises ValueError: a setting is out of range."""
        if self.seconds is not None and not 0.0 < self.seconds <= 600.0:
            raise ValueError(f"seconds must be in (0, 600], got {self.seconds}")


def play(cfg: PlayCfg) -> Path:
    """Simulate the jumps, write `jump.rrd` and `figures.json`, print a table; return the path of the recording.

    Raises:
        PolicyError: The policy cannot be used, its task cannot be played, or a flag is not for its task.
        CheckpointError: The checkpoint cannot be used.
        OSError: The folder cannot be made.
    """
    policy = open_policy(cfg.policy)
    task = policy.interface.task
    measure = measure_of(task)
    asked = flags_for(task, GOALS[task], cfg.heights, cfg.places)
    folder = output_dir("play", cfg.out)
    env = env_of_policy(policy, len(asked), cfg.conditions, change=measure.change)
    policy.to(env.device)
    log = asked.log(rule_names(env))
    log.begin(env)
    notes = {"task": task, **asked.notes, "solver": cfg.conditions.solver}
    film = Film(env, log, range(len(asked)), spacing=asked.spacing, notes=notes, motors=True)
    for _ in range(round((cfg.seconds or asked.seconds) / env.step_dt)):
        env.step(policy.act(env.obs))
        log.follow(env)
        film()
    path = film.save_rrd(folder / "jump.rrd", log.marks(range(len(asked))))
    write_figures(folder, log.columns())
    print_jumps(log)
    Console(stderr=True).print(str(path), highlight=False, soft_wrap=True)
    if cfg.viewer == "rerun":
        subprocess.run(viewer_command(path), check=False)
    return path


def viewer_command(path: Path) -> list[str]:
    """Return the command that shows a recording and listens on loopback only."""
    return [sys.executable, "-m", "rerun", str(path), "--bind", "127.0.0.1"]


def print_jumps(log: JumpLog) -> None:
    """Print one line a jump to standard output."""
    columns = log.columns()
    table = Table(*columns, box=None)
    for row in zip(*columns.values(), strict=True):
        table.add_row(*(f"{value:.3f}" if isinstance(value, float) else str(value) for value in row))
    Console().print(table)
