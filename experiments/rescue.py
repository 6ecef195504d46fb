"""Rescue jumps that a policy loses on changed robots, by whole-jump predictive control.

    python experiments/rescue.py --out outputs/rescue

A robot is lost if the policy makes the jump with the nominal robot and not with the changed one. Of the lost robots,
the script counts those that the controller saves: after long optimisations before the jump, from several first plans
and with the simulation's own physics step (offline), with two iterations in every policy step and the changed robot as
the assumed one (known), or a robot that is identified from the lost jump (identified). A robot that any of these saves
is savable. The script also compares policy and controller on nominal robots, measures the time of a policy step, and
writes `metrics.json`, the outcome of each robot (`outcomes.json`), `rescue.png` and, with `--film`, a film of each
change. Processes (`--processes`) share the robots, in batches of similar goals.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import SUCCESS, run_evaluation
from jumper_warp.evaluation.predictive_control import SCALES, PredictiveController
from jumper_warp.evaluation.recorder import EnvRecorder
from jumper_warp.policies.policy import Policy
from jumper_warp.robot.gravity import EARTH, MARS
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.utils.runtime import configure_device
from jumper_warp.viz.film import write_film
from jumper_warp.viz.pairs import side_by_side
from jumper_warp.viz.plots import figure
from jumper_warp.viz.recording import Recording
from measure_policies import payload_overlay
from support.own_motion import Record, RobotChange, identify, recorder_of, write_changes
from support.scripts import ThreadArgs, announce, prepare, report, run_script

WEAK_MOTOR = RobotOverlay({"saturation": (1.0, 1.0, 0.5, *(9 * (1.0,)))})  # Left front inner motor


@dataclass(frozen=True)
class Change:
    """Change of the robot or its surroundings, and the jumps from which lost ones are sampled."""

    robot: RobotOverlay | None = None
    gravity: float = EARTH  # [m/s^2]
    policy: str = "horizontal_jump"
    goals: tuple[float, float] = (0.4, 2.0)  # [m] Range of the distances or heights


CHANGES = {
    "payload_5_kg": Change(payload_overlay(None, 5.0), policy="vertical_jump", goals=(0.9, 1.08)),
    "weak_motor": Change(WEAK_MOTOR),
    "friction_0.3": Change(RobotOverlay({"paw_friction": (0.3,)})),
    "mars": Change(gravity=MARS),
}
NOMINAL = {"nominal_places": Change(), "nominal_heights": Change(policy="vertical_jump", goals=(0.5, 1.08))}
STARTS = (SCALES, (1.0,), (0.4,))  # Scales of the first plans that the mode offline tries in turn


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the rescue of jumps."""

    changes: tuple[str, ...] = tuple(CHANGES)  # Names of the changes
    modes: tuple[str, ...] = ("offline", "known", "identified")  # Knowledge of the controller
    count: int = 250  # Number of lost robots of each change
    nominal: int = 400  # Number of nominal robots of each policy
    candidates: int = 1500  # Number of jumps from which lost ones are taken
    iterations: int = 2  # Iterations in a policy step
    substeps: int = 4  # Physics steps of a plan in a policy step, except in the mode offline
    offline_iterations: int = 200  # Iterations before the jump in the mode offline
    timed: int = 3  # Number of jumps of a single robot whose steps are timed
    seed: int = 1  # Seed of the goals; the controller was tuned with seed 0
    processes: int = 1  # Number of processes that share the robots
    batch: int = 8  # Number of robots that a process simulates at once
    noise: bool = False  # Identify from a motion that is measured with the noise of the policy's observation
    film: bool = False  # Film a saved robot of each change beside the same robot with the policy


class Rescue(NamedTuple):
    """Outcome of a batch of jumps."""

    ends: np.ndarray  # (robots,) names of the outcomes, see `JumpLog.outcomes`
    found: RobotChange | None = None  # identified changes
    recording: Recording | None = None  # of the first robot


class Robots:
    """Robots of a change, or nominal ones, that jump with the change's policy."""

    def __init__(self, change: Change, args: Args) -> None:
        """Load the policy of a change."""
        self.change = change
        self.args = args
        self.policy = Policy.load(change.policy)
        self.recipe = self.policy.recipe()

    def env(self, count: int, *, changed: bool = True) -> Env:
        """Return an environment of `count` robots, changed or nominal."""
        conditions = Conditions(
            device=self.args.device, threads=self.args.threads, gravity=self.change.gravity if changed else EARTH
        )
        prepare_task = self.recipe.task.evaluation.prepare_task
        robot = self.change.robot if changed else None
        return env_of_recipe(self.recipe, count, conditions, change=prepare_task, robot=robot)

    def run(self, env: Env, act: Callable, goals: np.ndarray) -> JumpLog:
        """Return the log of jumps to goals [m] ahead or up, (num_envs,)."""
        log = self.log(env, goals)
        run_evaluation(act, env, log)
        return log

    def log(self, env: Env, goals: np.ndarray) -> JumpLog:
        """Return a new log of jumps to goals [m] ahead or up, (num_envs,)."""
        places = np.stack([goals, 0.0 * goals], axis=1)[:, None]
        return JumpLog(goals if self.change.policy == "vertical_jump" else places, env.task.termination_names)

    def goals(self, count: int) -> np.ndarray:
        """Return random goals [m], (count,)."""
        return np.random.default_rng(self.args.seed).uniform(*self.change.goals, count)

    def lost(self) -> tuple[np.ndarray, int]:
        """Return the goals [m] of at most `count` lost robots, and the number of all lost ones."""
        goals = self.goals(self.args.candidates)
        made = [
            self.run(self.env(len(goals), changed=changed), self.policy.act, goals).success[:, 0]
            for changed in (False, True)
        ]
        lost = goals[made[0] & ~made[1]]
        return lost[: self.args.count], len(lost)

    def controller(self, env: Env, assumed: Env, **options: Any) -> PredictiveController:
        """Return the controller of the robots of `env` with assumed ones; options: of `PredictiveController`."""
        args = self.args
        options = {"iterations": args.iterations, "substeps": args.substeps, "threads": args.threads} | options
        return PredictiveController(env, self.policy, assumed, **options)

    def record(self, goals: np.ndarray) -> Record:
        """Return the motion of the lost jumps to goals, with the policy."""
        env = self.env(len(goals))
        record, act = recorder_of(env, self.policy.act)
        self.run(env, act, goals)
        return record

    def offline(self, goals: np.ndarray) -> np.ndarray:
        """Return the outcomes of jumps after long optimisations before them, (len(goals),)."""
        ends = np.full(len(goals), "", dtype=object)
        for scales in STARTS:
            rest = np.flatnonzero(ends != SUCCESS)
            if len(rest):
                env = self.env(len(rest))
                controller = self.controller(env, self.env(len(rest)), scales=scales, iterations=1, substeps=SUBSTEPS)
                controller.first_iterations = self.args.offline_iterations
                ends[rest] = self.run(env, controller.act, goals[rest]).outcomes[:, 0]
        return ends

    def rescue(self, mode: str, goals: np.ndarray, film: bool = False) -> Rescue:
        """Return the outcome of jumps to goals [m] with the policy, or with the controller in one of `Args.modes`."""
        if mode == "offline":
            return Rescue(self.offline(goals))
        env = self.env(len(goals))
        act = self.policy.act
        found = None
        if mode != "policy":
            assumed = self.env(len(goals), changed=mode != "identified")
            if mode == "identified":
                rng = np.random.default_rng(self.args.seed) if self.args.noise else None
                found = identify(self.record(goals), assumed, rng)
                write_changes(assumed, found)
            act = self.controller(env, assumed).act
        log = self.log(env, goals)
        recorder = EnvRecorder(env, log, range(1)) if film else None
        calls = {} if recorder is None else {"on_begin": recorder.begin, "on_step": recorder}
        run_evaluation(act, env, log, **calls)
        return Rescue(log.outcomes[:, 0], found, recorder and recorder.recording())


@dataclass(frozen=True)
class Job:
    """Jumps of a batch of robots, for one process."""

    args: Args
    name: str  # of the change
    mode: str  # `policy`, or one of `Args.modes`
    goals: np.ndarray  # [m]


def start_process(args: Args) -> None:
    """Prepare a process of the pool, which computes on one thread."""
    torch.set_num_threads(1)
    configure_device(args.device, 1)


def run_job(job: Job) -> Rescue:
    """Run a job in a process of the pool."""
    return Robots((CHANGES | NOMINAL)[job.name], job.args).rescue(job.mode, job.goals)


def run_jobs(args: Args, jobs: list[Job], folder: Path) -> dict[tuple[str, str], tuple[np.ndarray, list[RobotChange]]]:
    """Return the successes and identified changes of all robots by name of the change and mode.

    Writes the outcomes so far to `outcomes.json` in the folder after every batch.
    """
    results: dict[tuple[str, str], tuple[np.ndarray, list[RobotChange]]] = {}
    rows: list[dict] = []
    pool = None
    if args.processes > 1:
        pool = ProcessPoolExecutor(args.processes, get_context("spawn"), start_process, (args,))
    for i, (ends, found, _) in enumerate((pool.map if pool else map)(run_job, jobs), 1):
        job = jobs[i - 1]
        key = job.name, job.mode
        successes, changes = results.get(key, (np.zeros(0, dtype=bool), []))
        results[key] = np.concatenate([successes, ends == SUCCESS]), changes + ([] if found is None else [found])
        total = results[key][0]
        rows += [
            {"change": job.name, "mode": job.mode, "goal_m": goal, "outcome": end}
            for goal, end in zip(job.goals.tolist(), ends.tolist(), strict=True)
        ]
        (folder / "outcomes.json").write_text(json.dumps(rows, indent=0))
        announce(f"{i} of {len(jobs)}: {', '.join(key)}: {total.sum()} of {len(total)}")
    if pool:
        pool.shutdown()
    return results


def time_steps(args: Args) -> dict[str, float]:
    """Return times [ms] of the policy steps of single nominal robots: on the wall clock, and of the processor."""
    robots = Robots(Change(), replace(args, threads=1))
    env = robots.env(1)
    controller = robots.controller(env, robots.env(1))
    times = []

    def act(obs: torch.Tensor) -> torch.Tensor:
        """Return the controller's actions, and time it from the second step of a jump on, before the policy stands."""
        begins = env.task_arrays()["steps"][0] == 0
        wall = time.perf_counter()
        cpu = time.process_time()
        action = controller.act(obs)
        if not begins and not controller.stands.all():
            times.append((time.perf_counter() - wall, time.process_time() - cpu))
        return action

    for goal in np.linspace(0.5, 1.4, args.timed):
        robots.run(env, act, np.array([goal]))
    values = {"load_average": os.getloadavg()[0]}
    for name, column in zip(("wall", "cpu"), 1000.0 * np.array(times).T, strict=True):
        values |= {
            f"step_{name}_median_ms": float(np.median(column)),
            f"step_{name}_p99_ms": float(np.percentile(column, 99)),
        }
    return values


def make_jobs(args: Args, values: dict[str, float]) -> list[Job]:
    """Return the jobs of all robots, and add the shares of lost robots to `values`."""
    jobs = []
    for name, modes in (dict.fromkeys(NOMINAL, ("policy", "known")) | dict.fromkeys(args.changes, args.modes)).items():
        robots = Robots((CHANGES | NOMINAL)[name], args)
        if name in NOMINAL:
            goals = robots.goals(args.nominal)
        else:
            goals, lost = robots.lost()
            values |= {f"{name}_lost_rate": lost / args.candidates, f"{name}_robots": float(len(goals))}
            announce(f"{name}: {lost} of {args.candidates} lost")
        batches = np.array_split(np.sort(goals), -(-len(goals) // args.batch)) if len(goals) else []
        jobs += [Job(replace(args, threads=1), name, mode, batch) for mode in modes for batch in batches]
    return jobs


def film_rescues(args: Args, jobs: list[Job], results: dict, folder: Path) -> None:
    """Film a saved robot of each change, with the policy and with the controller that knows the change."""
    for name in args.changes:
        goals = [job.goals for job in jobs if (job.name, job.mode) == (name, "known")]
        saved = np.concatenate(goals)[results[name, "known"][0]] if goals else np.zeros(0)
        if len(saved):
            goal = saved[[len(saved) // 2]]
            labels = {"policy": f"{name.replace('_', ' ')}: policy", "known": "controller"}
            robots = Robots(CHANGES[name], args)
            made = {label: robots.rescue(mode, goal, film=True).recording for mode, label in labels.items()}
            films = {label: film for label, film in made.items() if film}
            write_film(side_by_side(films), folder / f"rescue_{name}.webp", size=(480, 270), fps=15.0)


def main(args: Args) -> dict:
    """Rescue the lost jumps of all changes, compare nominal jumps, time the controller, and return the metrics."""
    torch.set_num_threads(1)
    folder = prepare("rescue", args, args.threads)
    values: dict[str, float] = time_steps(args) if args.timed else {}
    jobs = make_jobs(args, values)
    results = run_jobs(args, jobs, folder)
    for (name, mode), (success, changes) in results.items():
        if name in NOMINAL:
            values[f"{name}_{mode}_success_rate"] = float(success.mean())
            continue
        savable = np.any([results[name, other][0] for other in args.modes], axis=0)
        values[f"{name}_savable_rate"] = float(savable.mean())
        values[f"{name}_{mode}_saved_rate"] = float(success.mean())
        values[f"{name}_{mode}_saved_of_savable_rate"] = float(success.sum() / max(savable.sum(), 1))
        if changes:
            found = RobotChange(np.concatenate([change.theta for change in changes], axis=1))
            values |= {f"{name}_identified_{key}": value for key, value in found.means().items()}
    names = [name for name in args.changes if (name, args.modes[0]) in results]
    with figure(folder / "rescue.png", title="Jumps that the policy loses and the controller saves") as axis:
        for i, mode in enumerate(args.modes):
            shares = [values[f"{name}_{mode}_saved_rate"] for name in names]
            axis.bar(np.arange(len(names)) + 0.25 * i, shares, 0.25, label=mode)
        axis.set_xticks(np.arange(len(names)), names)
        axis.set_ylabel("share of lost robots")
        axis.legend()
    if args.film:
        film_rescues(args, jobs, results, folder)
    keys = [key for key in values if key.endswith(("saved_rate", "success_rate", "_ms"))]
    return report(args, folder, values, "Rescue of jumps", keys)


if __name__ == "__main__":
    run_script(main, Args)
