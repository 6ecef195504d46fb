"""Ablations (arms) of `experiments/paper_trainings.py`: their flags, the paper's tests, and the learning curve."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.cli.train import parse_train
from jumper_warp.evaluation.evaluations import default_flags
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import EvaluationLog, run_evaluation
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.evaluation.suites import Grid
from jumper_warp.evaluation.velocities import SLEW_RATE, VELOCITY_METRICS, VelocityLog
from jumper_warp.policies.conditions import Conditions
from jumper_warp.policies.runs import open_policy
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.training import train
from jumper_warp.utils.metrics import Metrics, measure
from support.learning import places_ahead

FULL, ARMS = "full", ("full", "no_initialisation", "no_estimates", "no_curriculum")
"""Arms: the recipe, and without reference state initialisation, projectile estimates or curriculum."""
HEIGHTS, DISTANCES = (0.5, 1.2), (0.3, 1.5)  # [m] Ranges of the paper's tests
WALK = ((0.0, 0.0, 0.0), (0.8, 0.0, 0.0), (0.4, 0.0, 0.4), (0.0, 0.4, 0.0), (-0.5, 0.0, 0.0), (0.0, -0.4, -0.4),
        (0.0, 0.0, 0.8), (0.8, 0.2, -0.4), (0.0, 0.0, 0.0))  # fmt: skip
"""[m/s], [m/s], [rad/s] Written sequence of commands, which change at the authors' rate."""
COMMAND_TIME = 3.0  # [s] Time of each command of `WALK`
OFF = 1.0e6  # [m] Tolerance of a termination that never ends an episode
NOMINAL, RANDOMIZED = "nominal", "randomized"
PRIMARY = {"height": "sweep_goal_reached_rate", "place": "straight_goal_reached_rate",
           "velocity": "walk_slewed_rmse_vx_m_s"}  # fmt: skip
"""Primary metric of nominal robots at the end, by `Evaluation.kind`."""
RATE = 0.5  # [1] Success rate whose number of steps is the second primary metric of jumps


def arm_flags(task: TaskCfg, arm: str) -> list[str]:
    """Return the flags of `jumper train` that make an ablation (arm) of a task; none for FULL and for walking.

    Without initialisation every episode starts in the default pose. Without estimates neither rewards nor terminations
    use them. Without curriculum all levels are the last.
    """
    flags: list[str] = []

    def add(name: str, *values: float) -> None:
        flags.extend([f"--env.{name.replace('_', '-')}", *(f"{value:g}" for value in values)])

    if arm == "no_initialisation":
        for mode in vars(task.reset.settings.start_probability):
            add(f"reset.start_probability.{mode}", float(mode == "default"))
    if arm == "no_estimates":
        for term in task.rewards:
            if term.name.startswith("estimated"):
                add(f"rewards.{term.name}.weight", 0.0)
        for term in task.terminations:
            if term.name.startswith("predicted"):
                add(f"terminations.{term.name}.tolerance", OFF)
    if arm == "no_curriculum":
        last = task.levels[-1]
        for i in range(len(task.levels) - 1):
            for name in ("goal_lower", "goal_upper", "base_height"):
                add(f"levels.{i}.{name}", *getattr(last, name))
            add(f"levels.{i}.next_jump_probability", last.next_jump_probability)
    return flags


def train_arm(arguments: Sequence[str]) -> tuple[Path, int]:
    """Train a policy, or continue the training in its log folder; arguments: of `jumper train`.

    Returns the run's folder, and the number of policy steps of all worlds in an iteration.
    """
    recipe, checkpoint = parse_train([*arguments, "--resume", "latest-or-new"])
    command = shlex.join(["jumper", "train", *arguments])
    result = train(recipe, checkpoint=checkpoint, command=command)
    return result.folder, recipe.train.num_envs * recipe.train.ppo.num_steps


def goals_of_test(test: str, num_jumps: int) -> np.ndarray:
    """Return the goals ahead and to the left [m], (jumps, 1, 2), of the tests `straight` and `grid`."""
    if test == "grid":
        return Grid().goals
    return places_ahead(DISTANCES, num_jumps)


def make_log(task: TaskCfg, test: str, num_jumps: int) -> EvaluationLog:
    """Return an empty log for one of the paper's tests, with the commands of the test.

    Jumps to places are commanded at once, as their goals are always observed.
    """
    if test == "sweep":
        return JumpLog(np.linspace(*HEIGHTS, num_jumps), task.termination_names)
    if test == "walk":
        commands = np.tile(np.array(WALK), (num_jumps, 1, 1))
        times = COMMAND_TIME * np.arange(len(WALK))
        return VelocityLog(commands, task, COMMAND_TIME * len(WALK), times=times, slew=SLEW_RATE)
    return JumpLog(goals_of_test(test, num_jumps), task.termination_names, delay=0.0)


def names_of_tests(task: TaskCfg) -> tuple[str, ...]:
    """Return the names of the paper's tests of a task, the primary one first."""
    return {"height": ("sweep",), "place": ("straight", "grid")}.get(task.evaluation.kind, ("walk",))


def metrics_of(run: EvaluationRun, log: EvaluationLog) -> Metrics:
    """Return the metrics of a finished test."""
    if isinstance(log, VelocityLog):
        return measure(VELOCITY_METRICS, log)
    return default_flags(run.evaluation, "evaluate").metrics(log)


def evaluate_arm(checkpoint: Path, folder: Path, num_jumps: int, conditions: Conditions) -> Metrics:
    """Run the paper's tests of a policy on nominal and noisy, randomised robots; keys: `<robots>_<test>_<metric>`."""
    run, metrics = EvaluationRun(checkpoint), {}
    run.prepare("paper_trainings", conditions, folder)
    for robots in (NOMINAL, RANDOMIZED):
        drawn = robots == RANDOMIZED
        those = dataclasses.replace(conditions, randomize=drawn, noise=drawn)
        for test in names_of_tests(run.task):
            count = make_log(run.task, test, num_jumps).count
            env = run.env(count, conditions=those)
            values = metrics_of(run, run.run_episodes(env, make_log(env.task, test, num_jumps)))
            metrics |= {f"{robots}_{test}_{key}": value for key, value in values.items()}
    return metrics


def learning_curve(run_folder: Path, num_jumps: int, conditions: Conditions) -> dict[str, list[float]]:
    """Return iterations and success of nominal robots in the primary test, for all checkpoints of a training."""
    checkpoints = sorted((run_folder / CHECKPOINTS).glob("iteration_*.pt"))
    run = EvaluationRun(checkpoints[-1])
    run.prepare("paper_trainings", conditions, run_folder)
    test = names_of_tests(run.task)[0]
    env = run.env(make_log(run.task, test, num_jumps).count)
    key = PRIMARY[run.evaluation.kind].removeprefix(f"{test}_")
    curve: dict[str, list[float]] = {"iterations": [], "values": []}
    for checkpoint in checkpoints:
        policy, log = open_policy(checkpoint), make_log(env.task, test, num_jumps)
        policy.to(env.device)
        run_evaluation(policy.act, env, log)
        curve["iterations"].append(int(checkpoint.stem.removeprefix("iteration_")))
        value: Any = metrics_of(run, log)[key].value
        curve["values"].append(float(value))
    return curve


def training_metrics(run_folder: Path) -> dict[str, float]:
    """Return the last logged metrics of a training by name: reward terms, shares of terminations, levels, time."""
    lines = (run_folder / METRICS_FILE).read_text().splitlines()
    kept = ("Episode_Reward/", "Episode_Termination/", "Curriculum/", "Metrics/", "Perf/elapsed_s")
    return {key: value for key, value in json.loads(lines[-1]).items() if key.startswith(kept)}
