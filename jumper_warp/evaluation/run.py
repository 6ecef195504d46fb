"""A policy under evaluation: its environment, runs that are followed and filmed, and their report.

Experiments and the commands `jumper evaluate` and `jumper play` share it.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.film import Film
from jumper_warp.evaluation.log import EvaluationLog, run_evaluation
from jumper_warp.evaluation.registry import evaluation_of
from jumper_warp.policies.conditions import Conditions, env_of_policy
from jumper_warp.policies.restore import restored_task
from jumper_warp.policies.runs import open_policy
from jumper_warp.policies.skills import SkillNames, SkillPolicies
from jumper_warp.policies.spec import PolicyError
from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.robot.values import TRANSVERSAL
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import announce
from jumper_warp.utils.threads import checked_threads

HEIGHTS = ("height", "height-mars")
"""Evaluations of policies that jump to heights."""
PLACES = ("place", "around", "place-mars")
"""Of those that jump to places."""
Log = TypeVar("Log", bound=EvaluationLog)


@dataclass(frozen=True)
class EvaluationArgs(Conditions):
    """Flags of every experiment that evaluates a policy; randomised robots have observation noise too."""

    noise: tyro.conf.Suppress[tyro.conf.Fixed[bool]] = False
    policy: str = "horizontal_jump"
    """Name or folder of a policy, a run's folder, or a checkpoint."""
    num_recorded: int = 1
    """Number of jumps to record for the Rerun viewer and, one of them, as a filmstrip; 0: none."""
    out: Path | None = None
    """Folder for figures, plots, recordings and filmstrips (default: outputs/<name>/<time>)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_recorded < 0:
            raise InputError(f"num_recorded must not be negative, got {self.num_recorded}")
        checked_threads(self.threads)


def conditions_of(args: EvaluationArgs) -> Conditions:
    """Return the conditions that an experiment's flags ask for."""
    values: dict[str, Any] = {spec.name: getattr(args, spec.name) for spec in fields(Conditions)}
    values["noise"] = args.randomize
    return Conditions(**values)


class Run(ABC):
    """Follows robots as often as wanted, films some, and reports. Those who inherit say who acts."""

    folder: Path

    def __init__(self) -> None:
        """Call `prepare` before anything else."""
        self.started = time.perf_counter()
        self.conditions, self.record = Conditions(), 0
        self.told: dict[str, Any] = {}
        self._latency: list[np.ndarray] = []
        self._physics_dt = PHYSICS_DT

    @abstractmethod
    def actor(self, env: Env) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return what gives actions for the environment's observations, as `run_evaluation` takes it."""

    def prepare(self, name: str, conditions: Conditions, out: Path | None = None, *, record: int = 0) -> None:
        """Take up the conditions, look for the device and make the folder, before anything is simulated.

        name: of the folder, unless `out` is given; record: number of worlds that are filmed.
        Raises InputError: there is no such device or number of threads; OSError: the folder cannot be made.
        """
        announce(conditions.device, conditions.threads)
        self.conditions, self.record = conditions, record
        self.folder = output_dir(name, out)

    @property
    def title(self) -> str:
        """What the policy is tried in."""
        conditions = self.conditions
        words = [conditions.solver, "randomised" if conditions.randomize else "nominal"]
        if conditions.latency is not None and self._latency:
            words.append(f"latency {latency_text(self._latency[0], self._physics_dt)}")
        words += [] if conditions.gain_scale is None else ["kp x {:g}, kd x {:g}".format(*conditions.gain_scale)]
        words += [] if conditions.friction is None else [f"friction {conditions.friction:g}"]
        words += [] if conditions.robot is None else [f"robot of {conditions.robot.name}"]
        return ", ".join(words + (["pushed in flight too"] if conditions.push_in_flight else []))

    @property
    def tried_in(self) -> dict[str, Any]:
        """The conditions as they are reported, latency as it was simulated in all that was followed."""
        conditions, values = self.conditions, {**self.told}
        values |= {name: getattr(conditions, name) for name in ("solver", "randomize", "seed")}
        if conditions.randomize:
            values["push_in_flight"] = conditions.push_in_flight
        values |= {} if conditions.gain_scale is None else {"gains": list(conditions.gain_scale)}
        values |= {} if conditions.friction is None else {"friction": conditions.friction}
        values |= {} if conditions.robot is None else {"robot": str(conditions.robot)}
        if self._latency:
            values |= latency_metrics(np.concatenate(self._latency), self._physics_dt, conditions.latency)
        return values

    def follow(
        self,
        env: Env,
        log: Log,
        *,
        film: str = "",
        drawn: Mapping[str, Any] | None = None,
        watch: Callable[[Log], None] | None = None,
    ) -> Log:
        """Run one episode a world as a log commands, and return the log.

        film: name of the recording and filmstrip of some of the worlds; no film without. drawn: the environment's
        `ground` and `block`, if the film shows them. watch: called with the log after every policy step.
        """
        pictures = self._film(env, log, drawn or {}) if film and self.record else None

        def look() -> None:
            if watch is not None:
                watch(log)
            if pictures is not None:
                pictures()

        run_evaluation(self.actor(env), env, log, watch=look)
        self._latency.append(env.parameters.latency.numpy().copy())
        self._physics_dt = env.physics_dt
        if pictures is not None:
            self._develop(pictures, log, film)
        return log

    def _film(self, env: Env, log: EvaluationLog, drawn: Mapping[str, Any]) -> Film:
        """Return the film of some worlds, evenly chosen."""
        ground = drawn.get("ground", "plane")
        worlds = np.linspace(0, env.num_envs - 1, min(self.record, env.num_envs)).round().astype(int).tolist()
        spacing = log.spacing if isinstance(ground, str) else 0.0
        block, notes = drawn.get("block"), log.notes(worlds)
        return Film(env, log.series, worlds, spacing=spacing, ground=ground, block=block, notes=notes)

    def _develop(self, film: Film, log: EvaluationLog, name: str) -> None:
        """Write a film as a recording, and as a filmstrip; this shows no blocks."""
        film.save_rrd(self.folder / f"{name}.rrd", log.marks(film.worlds))
        strip = None if film.block is not None else log.strip(film)
        if strip is not None:
            film.save_strip(strip, self.folder / f"{strip.name or name}.png")

    def report(self, metrics: Mapping[str, Any], paper: Mapping[str, float]) -> dict[str, Any]:
        """Write and print metrics beside the paper's, conditions before them; return all."""
        values = self.tried_in | dict(metrics)
        write_metrics(self.folder, values)
        table = Table("figure", self.title, "paper")
        for name, value in values.items():
            table.add_row(name, shown(value), str(paper.get(name, "")))
        Console().print(table)
        print(f"{time.perf_counter() - self.started:.1f} s; figures, plots and recordings in {self.folder}")
        return values


class EvaluationRun(Run):
    """Opens a policy, follows it as often as wanted, and reports."""

    def __init__(self, source: str | Path, modules: Iterable[ModuleType] = ()) -> None:
        """Open a policy; call `prepare` before anything else.

        source: name or folder of a policy, a run's folder, or a checkpoint; modules: that the user has named, for tasks
        that are not the project's. Raises PolicyError, also for an unknown evaluation, or CheckpointError.
        """
        super().__init__()
        self.source, self.modules = source, list(modules)
        self.policy = open_policy(source)
        self.task = restored_task(self.policy.config, self.modules)
        self.evaluation = evaluation_of(self.task)

    @classmethod
    def of(
        cls,
        name: str,
        args: EvaluationArgs,
        evaluations: Sequence[str] = PLACES,
        modules: Iterable[ModuleType] = (),
    ) -> EvaluationRun:
        """Return the run of an experiment, prepared.

        evaluations: keys of `EVALUATIONS`, one of which the policy must have, else PolicyError; modules: that the user
        has named. Raises as the constructor and `prepare`.
        """
        run = cls(args.policy, modules)
        if run.task.evaluation not in evaluations:
            raise PolicyError(
                f"this needs a policy that is evaluated by {' or '.join(evaluations)}, "
                f"{args.policy} is of {run.task.name}, by {run.task.evaluation}"
            )
        run.prepare(name, conditions_of(args), args.out, record=args.num_recorded)
        run.told = {"task": run.task.name} if len(evaluations) > 1 else {}
        return run

    def actor(self, env: Env) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return the policy's action."""
        return self.policy.act

    def env(
        self,
        count: int,
        change: Callable[[TaskCfg], TaskCfg] | None = None,
        conditions: Conditions | None = None,
        **scene: Any,
    ) -> Env:
        """Return the policy's environment of `count` worlds. Raises PolicyError as `env_of_policy`.

        change: returns the task with the terminations that count (default: as its evaluation says); conditions: other
        ones than the run's; scene: more settings of `Env`.
        """
        change, conditions = change or self.evaluation.for_evaluation, conditions or self.conditions
        env = env_of_policy(self.policy, count, conditions, change=change, modules=self.modules, **scene)
        self.policy.to(env.device)
        self.told["gravity_m_s2"] = env.task.gravity
        self.told["torque_limit_nm"] = torque_limit(env)
        return env


class SkillRun(Run):
    """Opens the policies of one robot, follows it as often as wanted, and reports."""

    def __init__(self, names: SkillNames | None = None) -> None:
        """Open policies; call `prepare` before anything else. Raises PolicyError or CheckpointError."""
        super().__init__()
        self.skills = SkillPolicies(names)

    @classmethod
    def of(cls, name: str, args: EvaluationArgs, names: SkillNames) -> SkillRun:
        """Return the run of an experiment, prepared. Raises PolicyError, CheckpointError, or InputError: no device."""
        run = cls(names)
        run.prepare(name, conditions_of(args), args.out, record=args.num_recorded)
        return run

    def actor(self, env: Env) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return the actions of all skills."""
        return lambda obs: self.skills.act(env)

    def env(self, count: int, **scene: Any) -> Env:
        """Return the environment of the robot; scene: more settings of `Env`."""
        return self.skills.env(count, self.conditions, **scene)


def latency_metrics(steps: np.ndarray, physics_dt: float, asked: float | None = None) -> dict[str, Any]:
    """Return the latency from action to motor as it was simulated.

    steps: [physics steps] of all worlds; physics_dt [s]; asked [ms]: what was asked for, if anything.
    `latency_ms` is the mean, `latency` all of it in words.
    """
    told: dict[str, Any] = {} if asked is None else {"latency_asked_ms": asked}
    mean = 1000.0 * physics_dt * float(np.mean(steps))
    return told | {"latency_ms": mean, "latency": latency_text(steps, physics_dt)}


def latency_text(steps: np.ndarray, physics_dt: float) -> str:
    """Return a latency in milliseconds and in physics steps, or the range and the mean of several."""
    least, most = int(np.min(steps)), int(np.max(steps))
    low, high, mean = (f"{1000.0 * physics_dt * float(value):.3g}" for value in (least, most, np.mean(steps)))
    if least == most:
        return f"{low} ms ({least} physics step{'' if least == 1 else 's'})"
    return f"{low} to {high} ms ({least} to {most} physics steps), mean {mean} ms"


def torque_limit(env: Env) -> float:
    """Return the least torque limit of the thighs' motors [N m]: the task's, as an overlay scales it."""
    limit = env.task.motors.transversal.saturation
    return limit if env.sim.robot is None else limit * float(env.sim.robot.saturation[:, TRANSVERSAL].min())


def shown(value: Any) -> str:
    """Return a figure as it is printed: numbers, and those in lists, with four digits."""
    if isinstance(value, list):
        return ", ".join(shown(item) for item in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)
