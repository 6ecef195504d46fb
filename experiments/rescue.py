"""Rescue jumps that a policy loses on changed robots, by whole-jump predictive control.

    python experiments/rescue.py --out outputs/rescue

A robot is lost if the policy makes the jump with the nominal robot and not with the changed one. Of the lost robots,
the script counts those that the controller saves: after a long optimisation before the jump (offline), with two
iterations in every policy step and the changed robot as the assumed one (known), or a robot that is identified from the
lost jump (identified). It measures the time of a policy step too, and writes `metrics.json` and `rescue.png`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from jumper_warp.envs.env import Env
from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.predictive_control import PredictiveController
from jumper_warp.evaluation.recorder import EnvRecorder, save_recording
from jumper_warp.policies.policy import Policy
from jumper_warp.robot.gravity import EARTH, MARS
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.viz.plots import figure
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


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the rescue of jumps."""

    changes: tuple[str, ...] = tuple(CHANGES)  # Names of the changes
    modes: tuple[str, ...] = ("offline", "known", "identified")  # Knowledge of the controller
    count: int = 16  # Number of lost robots of each change
    nominal: int = 16  # Number of nominal robots of each policy
    candidates: int = 96  # Number of jumps from which lost ones are taken
    iterations: int = 2  # Iterations in a policy step
    offline_iterations: int = 150  # Iterations before the jump in the mode offline
    timed: int = 3  # Number of jumps of a single robot whose steps are timed
    seed: int = 0  # Seed of the goals


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

    def lost(self) -> tuple[np.ndarray, int]:
        """Return the goals [m] of at most `count` lost robots, and the number of all lost ones."""
        rng = np.random.default_rng(self.args.seed)
        goals = rng.uniform(*self.change.goals, self.args.candidates)
        made = [
            self.run(self.env(len(goals), changed=changed), self.policy.act, goals).success[:, 0]
            for changed in (False, True)
        ]
        lost = goals[made[0] & ~made[1]]
        return lost[: self.args.count], len(lost)

    def controller(self, env: Env, assumed: Env) -> PredictiveController:
        """Return the controller of the robots of `env` with assumed ones."""
        return PredictiveController(
            env, self.policy, assumed, iterations=self.args.iterations, threads=self.args.threads
        )

    def record(self, goals: np.ndarray) -> Record:
        """Return the motion of the lost jumps to goals, with the policy."""
        env = self.env(len(goals))
        record, act = recorder_of(env, self.policy.act)
        self.run(env, act, goals)
        return record

    def rescue(self, mode: str, goals: np.ndarray, folder: Path) -> tuple[np.ndarray, RobotChange | None]:
        """Return which robots the controller saves, (len(goals),), and the identified change, if any."""
        env = self.env(len(goals))
        found = None
        if mode == "identified":
            assumed = self.env(len(goals), changed=False)
            found = identify(self.record(goals), assumed)
            write_changes(assumed, found)
        else:
            assumed = self.env(len(goals))
        controller = self.controller(env, assumed)
        if mode == "offline":
            controller.first_iterations = self.args.offline_iterations
        log = self.log(env, goals)
        recorder = EnvRecorder(env, log, range(min(3, len(goals))), notes={"task": f"rescued, {mode}"})
        run_evaluation(controller.act, env, log, on_begin=recorder.begin, on_step=recorder)
        folder.mkdir(exist_ok=True)
        save_recording(recorder.recording(), folder, mode)
        return log.success[:, 0], found


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


def main(args: Args) -> dict:
    """Rescue the lost jumps of all changes, compare nominal jumps, time the controller, and return the metrics."""
    torch.set_num_threads(1)
    folder = prepare("rescue", args, args.threads)
    values: dict[str, float] = time_steps(args) if args.timed else {}
    for name, change in NOMINAL.items():
        if args.nominal:
            robots = Robots(change, args)
            goals = np.linspace(*change.goals, args.nominal)
            env = robots.env(args.nominal)
            values[f"{name}_policy_success_rate"] = float(robots.run(env, robots.policy.act, goals).success.mean())
            act = robots.controller(env, robots.env(args.nominal)).act
            values[f"{name}_success_rate"] = float(robots.run(env, act, goals).success.mean())
            announce(f"{name}: {values[f'{name}_success_rate']:.1%}")
    shares = {}
    for name in args.changes:
        robots = Robots(CHANGES[name], args)
        goals, lost = robots.lost()
        values |= {f"{name}_lost_rate": lost / args.candidates, f"{name}_robots": float(len(goals))}
        saved = {}
        for mode in args.modes if len(goals) else ():
            saved[mode], found = robots.rescue(mode, goals, folder / name)
            if found is not None:
                values |= {f"{name}_identified_{key}": value for key, value in found.means().items()}
            announce(f"{name}, {mode}: {saved[mode].sum()} of {len(goals)} saved")
        if saved:
            values |= {f"{name}_{mode}_saved_rate": float(row.mean()) for mode, row in saved.items()}
            shares[name] = [row.mean() for row in saved.values()]
        report(args, folder, values, f"Rescue of jumps with {', '.join(args.changes)}", [])
    with figure(folder / "rescue.png", title="Jumps that the policy loses and the controller saves") as axis:
        for i, mode in enumerate(args.modes):
            axis.bar(np.arange(len(shares)) + 0.25 * i, [row[i] for row in shares.values()], 0.25, label=mode)
        axis.set_xticks(np.arange(len(shares)), list(shares))
        axis.set_ylabel("share of lost robots")
        axis.legend()
    return report(args, folder, values, "Rescue of jumps", [key for key in values if "saved" in key or "step" in key])


if __name__ == "__main__":
    run_script(main, Args)
