"""Rewards that a task would pay for a recorded motion, term by term and step by step, without a simulation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.motion import ROBOT_STATES, TERMINATION, set_motion
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.progress import phase
from jumper_warp.viz.plots import figure
from jumper_warp.viz.recording import Recording, load_npz

TOTAL = "total"  # Name of the sum of all terms


class TermRow(NamedTuple):
    """Sum of a reward term over the recorded episodes, mean over worlds, for a task and its base."""

    term: str
    base: float | None  # None: the base has no such term
    task: float | None
    nonzero: float  # share of the steps in which the task's term is not zero
    low: float  # smallest and largest value of the task's term in a step
    high: float


@dataclass(frozen=True)
class Rescored:
    """Rewards of a recorded motion: value times weight times policy step, as in `Env.reward_terms`."""

    recording: Recording
    task: str
    base: str
    terms: dict[str, np.ndarray]  # of the task by name, (frames, worlds); 0 after the end of an episode
    base_terms: dict[str, np.ndarray]  # of the base
    running: np.ndarray  # (frames, worlds) bool, whether the recorded episode had not ended before

    @property
    def changed(self) -> list[str]:
        """Names of the terms whose values differ between the task and its base, and the total."""
        names = dict.fromkeys([*self.base_terms, *self.terms])
        return [name for name in names if not np.array_equal(self.values(name), self.values(name, base=True))]

    @property
    def table(self) -> list[TermRow]:
        """A row for each term and the total, terms that differ first."""
        changed = self.changed
        names = [*changed, *(name for name in self.terms if name not in changed)]
        return [self._row(name) for name in names]

    def values(self, name: str, *, base: bool = False) -> np.ndarray:
        """Return a term of the task, or of its base, (frames, worlds); 0 if it has no such term."""
        return (self.base_terms if base else self.terms).get(name, np.zeros_like(self.running, dtype=float))

    def _row(self, name: str) -> TermRow:
        """Return the row of a term."""
        base, task = (
            float(terms[name].sum(axis=0).mean()) if name in terms else None for terms in (self.base_terms, self.terms)
        )
        steps = self.values(name)[self.running]
        return TermRow(name, base, task, float((steps != 0.0).mean()), float(steps.min()), float(steps.max()))

    def with_lanes(self) -> Recording:
        """Return the recording with the changed terms and both totals as series."""
        series = {}
        for rank in range(len(self.recording.worlds)):
            label = self.recording.label(rank)
            for name in (*self.changed, TOTAL):
                series[f"rewards/{name}, {label} [1]"] = self.values(name)[:, rank].astype(float)
            series[f"rewards/total of {self.base}, {label} [1]"] = self.values(TOTAL, base=True)[:, rank].astype(float)
        return replace(self.recording, series=series | self.recording.series)

    def plot(self, path: Path) -> None:
        """Plot the sum of all rewards so far and the changed terms over time, a line per robot; dashed: the base."""
        names = [TOTAL, *(name for name in self.changed if name != TOTAL)]
        settings: Any = {"figsize": (9.0, 2.2 * len(names) + 1.4), "sharex": True, "squeeze": False}
        with figure(path, len(names), 1, title=f"Rewards of {self.task}", **settings) as axes:
            for axis, name in zip(axes[:, 0], names, strict=True):
                for rank in range(len(self.recording.worlds)):
                    for base, task, style in ((True, self.base, "--"), (False, self.task, "-")):
                        values = self.values(name, base=base)[:, rank]
                        values = np.cumsum(values) if name == TOTAL else values
                        label = f"{self.recording.label(rank)}: {task}"
                        axis.plot(self.recording.times, values, style, color=f"C{rank}", label=label)
                axis.set(title=name.replace("_", " "), ylabel="sum so far [1]" if name == TOTAL else "per step [1]")
            axes[-1, 0].set(xlabel="time [s]")


def rescore(recording: Recording | Path | str, task: TaskCfg, base: TaskCfg) -> Rescored:
    """Return the rewards that a task and its base would pay for a recorded motion.

    recording: or its file, written by `jumper play` (`.npz`, or the `.rrd` beside it). The task's state is that of the
    recording before every step; fields that the recorded task did not have begin at 0, and the task advances them.
    Raises InputError: it has no complete states.
    """
    if not isinstance(recording, Recording):
        recording = load_npz(Path(recording))
    terms, base_terms = (reward_terms(recording, each) for each in (task, base))
    return Rescored(recording, task.name, base.name, terms, base_terms, running_steps(recording))


def running_steps(recording: Recording) -> np.ndarray:
    """Return whether each recorded episode had not ended before a step, (frames, worlds) bool."""
    ended = recording.motion[TERMINATION] >= 0
    return np.cumsum(ended, axis=0) - ended == 0


def reward_terms(recording: Recording, task: TaskCfg) -> dict[str, np.ndarray]:
    """Return the reward terms of a task and their total by name, (frames, worlds); 0 after the end of an episode.

    The robots are those of the recording's notes, else the Jumper. Raises InputError: it has no complete states.
    """
    if not {TERMINATION, *ROBOT_STATES} <= recording.motion.keys():
        raise InputError("the recording has no complete states; jumper play writes them beside the .rrd file")
    running = running_steps(recording)
    before_end = running & (recording.motion[TERMINATION] < 0)
    for name in ROBOT_STATES:
        if not np.isfinite(recording.motion[name][before_end]).all():
            raise InputError(f"the recorded {name} is not finite")
    frames, worlds = running.shape
    with phase(f"rewards of {task.name}", frames) as advance:
        robots = [RobotOverlay.from_json(each) for each in recording.notes.get("robots", ())]
        env = Env(task, worlds, device="cpu", randomize=False, noise=False, auto_reset=False, robot=robots)
        episode = env.stages()["episode"]
        steps = []
        for frame in range(frames):
            try:
                set_motion(env, recording.motion, frame)
            except (AttributeError, ValueError) as error:
                raise InputError(f"the recorded states are of another shape: {error}") from error
            episode()
            steps.append({name: values.numpy().copy() for name, values in env.reward_terms.items()})
            advance()
    terms = {name: np.where(running, [step[name] for step in steps], 0.0) for name in env.reward_terms}
    return terms | {TOTAL: np.sum([*terms.values(), np.zeros_like(running, dtype=float)], axis=0)}
