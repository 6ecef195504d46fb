"""A trial of a policy that jumps to places, as the experiments share it: flags, environment, film and report."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from jumper_warp.cli.main import announce
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.film import Film, moments
from jumper_warp.evaluation.jumps import rule_names, run
from jumper_warp.evaluation.landings import Landings, ends_of_a_test, longest
from jumper_warp.policies.restore import Conditions, env_of_policy, open_policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.utils.output import output_dir, write_figures

TASKS = ("horizontal-jump", "omnidirectional-jump")
SPACING = 3.0
"""[m] Between filmed robots, which jump in any direction."""
SHOWN_DISTANCE = 1.0
"""[m] The filmstrip shows the jump nearest to this."""
EYE_DISTANCE = 2.4
"""[m] From the jump's path to the eye."""
PICTURE = (400, 320)
"""[px]"""


@dataclass(frozen=True)
class TrialArgs:
    """Flags of every trial."""

    policy: str = "horizontal_jump"
    """Name or folder of a policy, a run's folder, or a checkpoint."""
    solver: Literal["jumper", "mujoco"] = "jumper"
    """Physics: the dedicated solver, or Newton's SolverMuJoCo."""
    randomize: bool = False
    """Randomisation, observation noise, latency and pushes as in training."""
    seed: int = 0
    """Of these, and of whatever else is drawn."""
    record: int = 1
    """Number of jumps to record for the Rerun viewer and, one of them, as a filmstrip; 0: none."""
    out: Path | None = None
    """Folder for figures, plots, recordings and filmstrips (default: outputs/<name>/<time>)."""
    device: str | None = None
    """Warp device."""

    def __post_init__(self) -> None:
        """Check the values."""
        if self.record < 0:
            raise ValueError(f"record must not be negative, got {self.record}")


class Trial:
    """Opens a policy, lets it jump as often as wanted, and reports."""

    def __init__(self, name: str, args: TrialArgs) -> None:
        """Begin a trial.

        Args:
            name: Of the experiment and its folder.
            args: Flags.

        Raises:
            PolicyError: The policy cannot be used, or does not jump to places.
            CheckpointError: The checkpoint cannot be used.
            UsageError: There is no such device.
        """
        self.args, self.started = args, time.perf_counter()
        self.policy = open_policy(args.policy)
        self.task = self.policy.interface.task
        if self.task not in TASKS:
            raise PolicyError(f"this needs a policy of {' or '.join(TASKS)}, {args.policy} is of {self.task!r:.60}")
        announce(args.device)
        self.folder = output_dir(name, args.out)
        self.torque_limit = 0.0

    @property
    def title(self) -> str:
        """What the jumps were made in."""
        return f"{self.args.solver}, {'randomised' if self.args.randomize else 'nominal'}"

    def env(self, count: int, **scene: Any) -> Env:
        """Return the policy's environment with the ends of a test; scene: more settings of `Env`."""
        args = self.args
        conditions = Conditions(args.solver, args.randomize, args.randomize, args.seed, args.device)
        env = env_of_policy(self.policy, count, conditions, change=ends_of_a_test, **scene)
        self.policy.to(env.device)
        self.torque_limit = env.task.motors.transversal.saturation
        return env

    def jump(
        self,
        env: Env,
        goals: np.ndarray,
        *,
        film: str = "",
        drawn: Mapping[str, Any] | None = None,
        watch: Callable[[Landings], None] | None = None,
        **asked: Any,
    ) -> Landings:
        """Let every world jump to its goals (num_envs, jumps in a row, 2) [m]; return what became of it.

        Args:
            env: Of `env`.
            goals: As in `Landings`.
            film: Name of the recording and filmstrip of some of the worlds; no film without.
            drawn: The environment's `ground` and `block`, if they are to be seen in the film.
            watch: Called with the landings after every policy step.
            asked: More settings of `Landings`: headings, delay, rest.
        """
        landings = Landings(goals, rule_names(env), **asked)
        watchers: list[Callable[[], None]] = [] if watch is None else [partial(watch, landings)]
        pictures = self._film(env, landings, drawn or {}) if film and self.args.record else None
        if pictures is not None:
            watchers.append(pictures)
        seconds = longest(landings.goals.shape[1], landings.rest) + float(np.max(landings.delay))
        run(self.policy.act, env, landings, seconds, lambda: [watcher() for watcher in watchers])
        if pictures is not None:
            self._develop(pictures, landings, film)
        return landings

    def _film(self, env: Env, landings: Landings, drawn: Mapping[str, Any]) -> Film:
        """Return the film of some worlds, evenly chosen."""
        ground = drawn.get("ground", "plane")
        worlds = np.linspace(0, env.num_envs - 1, min(self.args.record, env.num_envs)).round().astype(int).tolist()
        spacing = SPACING if isinstance(ground, str) else 0.0
        notes = {"goals_m": landings.goals[worlds].tolist()}
        return Film(env, landings, worlds, spacing=spacing, ground=ground, block=drawn.get("block"), notes=notes)

    def _develop(self, film: Film, landings: Landings, name: str) -> None:
        """Write a film as a recording, and as pictures of the jump of about SHOWN_DISTANCE; these show no blocks."""
        film.save_rrd(self.folder / f"{name}.rrd", landings.marks(film.worlds))
        if film.block is not None:
            return
        distance = np.linalg.norm(landings.goals[film.worlds, 0], axis=1)
        index = int(np.argmin(np.abs(distance - SHOWN_DISTANCE)))
        base = film.base(index)
        if landings.goals.shape[1] == 1:
            delay = np.broadcast_to(landings.delay, film.env.num_envs)[film.worlds[index]]
            frames = moments(base[:, 2], round(delay / film.env.step_dt) - 1)
        else:
            frames = np.linspace(0, len(base) - 1, 9).round().astype(int).tolist()
        ends = landings.place[film.worlds[index]]
        eye, target = beside(base[0, :2], ends[np.isfinite(ends[:, 0])][-1])
        captions = [f"{(frame + 1) * film.env.step_dt:.2f} s" for frame in frames]
        film.strip(self.folder / f"{name}.png", index, frames, captions, eye, target, PICTURE)

    def report(self, figures: Mapping[str, Any], paper: Mapping[str, float]) -> dict[str, Any]:
        """Write and print figures beside the paper's, conditions before them; return all."""
        args = self.args
        values = {"task": self.task, "solver": args.solver, "randomize": args.randomize, "seed": args.seed}
        values |= {"torque_limit_nm": self.torque_limit, **figures}
        write_figures(self.folder, values)
        table = Table("figure", self.title, "paper")
        for name, value in values.items():
            table.add_row(name, shown(value), str(paper.get(name, "")))
        Console().print(table)
        print(f"{time.perf_counter() - self.started:.1f} s; figures, plots and recordings in {self.folder}")
        return values


def shown(value: Any) -> str:
    """Return a figure as it is printed: numbers, and those in lists, with four digits."""
    if isinstance(value, list):
        return ", ".join(shown(item) for item in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def beside(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an eye beside the way from start to end (2,), and the point that it looks at, (3,); [m], world frame."""
    way = end - start
    length = float(np.linalg.norm(way))
    ahead = way / length if length > 1.0e-3 else np.array([1.0, 0.0])
    middle = np.append(start + 0.5 * way, 0.4)
    back = EYE_DISTANCE * max(1.0, length / 1.5)
    return middle + np.array([back * ahead[1], -back * ahead[0], 0.35]), middle
