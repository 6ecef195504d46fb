"""Train the paper's tasks with and without each of the paper's three techniques, test the policies, and write metrics.

    python experiments/paper_trainings.py --tasks vertical-jump-paper --arms full --seeds 0 --out outputs/paper
    python experiments/paper_trainings.py --table --out outputs/paper     # table and curves so far

An arm is a task, an ablation and a seed. Its folder in `--out` has the training and `metrics.json`. Before the training
this file names the primary metrics, with no values: the success of nominal robots over the paper's range at the end,
and the number of policy steps to 50 % success. A success is a jump within 0.1 m of its goal, as in the paper. For
walking it is the tracking error ahead in a written sequence of commands.

A finished arm is skipped, and an interrupted training continues at its last checkpoint. Several processes may train
different arms in one folder. `full` is the task; `no_initialisation` starts in the default pose; `no_estimates` has
neither rewards nor terminations of predicted jumps; `no_curriculum` begins at the last level. Walking has `full` only.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.cli.train import parse_train
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.evaluations import default_flags
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import EvaluationLog, run_evaluation
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.evaluation.suites import Grid
from jumper_warp.evaluation.velocities import SLEW_RATE, VELOCITY_METRICS, VelocityLog
from jumper_warp.policies.policy import Policy
from jumper_warp.registry import make_task
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.training import train
from jumper_warp.utils.files import Json
from jumper_warp.utils.metrics import Metrics, measure
from jumper_warp.utils.output import read_values, write_metrics
from jumper_warp.viz.plots import figure
from support.learning import places_ahead
from support.scripts import ThreadArgs, announce, prepare, run_script, tracked

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
        """Add a flag of `jumper train` with its values."""
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
    recipe, checkpoints = parse_train([*arguments, "--resume", "latest-or-new"])
    command = shlex.join(["jumper", "train", *arguments])
    result = train(recipe, checkpoints=checkpoints, command=command)
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
    run = EvaluationRun(checkpoint)
    metrics = {}
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
        policy = Policy.load(checkpoint)
        log = make_log(env.task, test, num_jumps)
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


GAP, NEVER = "not measured", "not reached"
ROWS = (
    ("vertical-jump-paper", "0.5–1.2 m, success", "nominal_sweep_goal_reached_rate", "0.91"),
    ("vertical-jump-paper", "0.5–1.1 m, success", "nominal_sweep_in_range_goal_reached_rate", "1.00"),
    ("vertical-jump-paper", "0.5–1.2 m, also on command, landed, at rest", "nominal_sweep_success_rate", "–"),
    ("vertical-jump-paper", "mean error [m]", "nominal_sweep_apex_error_abs_mean_m", "0.040"),
    ("vertical-jump-paper", "steps to 50 % [million]", "steps_to_50_percent", "–"),
    ("horizontal-jump-paper", "0.3–1.5 m, success", "nominal_straight_goal_reached_rate", "0.97"),
    ("horizontal-jump-paper", "0.3–1.4 m, success", "nominal_straight_in_range_goal_reached_rate", "1.00"),
    ("horizontal-jump-paper", "0.3–1.5 m, also landed, at rest", "nominal_straight_success_rate", "–"),
    ("horizontal-jump-paper", "mean error, all jumps [m]", "nominal_straight_goal_distance_at_end_mean_m", "0.026"),
    ("horizontal-jump-paper", "mean error, at rest [m]", "nominal_straight_goal_distance_at_rest_mean_m", "0.026"),
    ("horizontal-jump-paper", "grid, success", "nominal_grid_goal_reached_rate", "0.968"),
    ("horizontal-jump-paper", "grid, mean error [m]", "nominal_grid_goal_distance_at_end_mean_m", "0.025"),
    ("horizontal-jump-paper", "steps to 50 % [million]", "steps_to_50_percent", "–"),
    ("velocity-paper", "RMSE ahead [m/s]", "nominal_walk_slewed_rmse_vx_m_s", "0.17"),
    ("velocity-paper", "RMSE left [m/s]", "nominal_walk_slewed_rmse_vy_m_s", "0.05"),
    ("velocity-paper", "RMSE yaw rate [rad/s]", "nominal_walk_slewed_rmse_yaw_rate_rad_s", "0.12"),
    ("velocity-paper", "falls", "nominal_walk_fall_rate", "–"),
)
"""Task, words, metric and the paper's value of each row; the paper's walk is one of its robot."""
CURVES = (
    ("vertical-jump-paper", "success, 0.5–1.2 m", 0.91),
    ("horizontal-jump-paper", "success, 0.3–1.5 m", 0.97),
    ("velocity-paper", "RMSE ahead [m/s]", 0.17),
)
"""Task, label of the primary metric and the paper's value of each plot of `plot_curves`."""


def finished(folder: Path, task: str, arm: str) -> list[Json]:
    """Return the metrics of all finished trainings of a task with an ablation (arm), one dict per seed."""
    files = sorted((folder / task).glob(f"{arm}_*/metrics.json"))
    return [values for path in files if "curve_steps" in (values := read_values(path.parent))]


def cell(folder: Path, task: str, arm: str, key: str) -> str:
    """Format a metric of an ablation (arm): mean and range over seeds, and how many have a value if not all do.

    GAP: no seed has it, NEVER: none reached it.
    """
    seeds = finished(folder, task, arm)
    found = [values[key] for values in seeds if values.get(key) is not None]
    if not found:
        return NEVER if seeds and key.startswith("steps") else GAP
    values = np.array(found) * (1.0e-6 if key.startswith("steps") else 1.0)
    spread = f" ({values.min():.3g}–{values.max():.3g})" if len(values) > 1 else ""
    return f"{values.mean():.3g}{spread}" + f", {len(values)} of {len(seeds)}" * (len(values) < len(seeds))


def results_table(folder: Path) -> str:
    """Return a Markdown table of the paper's results and those of all ablations that were trained in a folder."""
    lines = [f"| task | test | paper | {' | '.join(arm.replace('_', ' ') for arm in ARMS)} |", "|---" * 7 + "|"]
    for task, words, key, paper in ROWS:
        arms = ARMS if task != "velocity-paper" else ARMS[:1]
        cells = [cell(folder, task, arm, key) for arm in arms] + ["–"] * (len(ARMS) - len(arms))
        lines.append(f"| `{task}` | {words} | {paper} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def plot_curves(folder: Path, path: Path) -> None:
    """Plot learning curves (primary metric of nominal robots) to a file: a line per training, thick ones for means."""
    with figure(path, 1, len(CURVES), figsize=(11, 4), title="Learning curves of the paper's tasks") as axes:
        for axis, (task, label, paper) in zip(axes, CURVES, strict=True):
            for i, arm in enumerate(ARMS):
                curves = [(values["curve_steps"], values["curve_values"]) for values in finished(folder, task, arm)]
                if not curves:
                    continue
                steps = max((steps for steps, _ in curves), key=len)
                means = np.mean([np.interp(steps, *curve) for curve in curves], axis=0)
                for those, curve in curves:
                    axis.plot(np.array(those) * 1.0e-6, curve, color=f"C{i}", linewidth=0.7, alpha=0.5)
                axis.plot(np.array(steps) * 1.0e-6, means, color=f"C{i}", linewidth=2.5, label=arm.replace("_", " "))
            axis.axhline(paper, color="black", linestyle=":", label="the paper")
            axis.set(title=task, xlabel="policy steps [million]", ylabel=label, xlim=(0.0, None), ylim=(0.0, None))


STEPS = f"steps_to_{100 * RATE:g}_percent"
PAPER_TASKS = ("vertical-jump-paper", "horizontal-jump-paper", "velocity-paper")


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the trainings of the paper's tasks."""

    tasks: tuple[str, ...] = PAPER_TASKS  # Names of tasks
    arms: tuple[str, ...] = ARMS  # Ablations to train
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)  # Seeds of the trainings
    num_jumps: int = 200  # Number of jumps, or of walks, of a test
    save_interval: int = 100  # Number of iterations between two points of the learning curve
    train_flags: str = ""  # More flags of `jumper train`: --train-flags="--max-iterations 10 --num-envs 64"
    table: bool = False  # Print the table and plot the curves of --out, and train nothing

    def trainings(self) -> Iterator[tuple[str, str, int]]:
        """Yield (task, ablation or "full", seed) of each training: all trainings with the first seed, then the next."""
        for seed in self.seeds:
            for name in self.tasks:
                walks = make_task(name).evaluation.kind == "velocity"
                yield from ((name, arm, seed) for arm in self.arms if arm == FULL or not walks)

    def command(self, name: str, arm: str, seed: int, folder: Path) -> list[str]:
        """Return the arguments of `jumper train` for a task, an ablation (arm) and a seed; folder: root of the logs."""
        flags = f"--seed {seed} --save-interval {self.save_interval} --max-checkpoints 1000 --no-tensorboard"
        flags += "" if self.device is None else f" --device {self.device}"
        flags += "" if self.threads is None else f" --threads {self.threads}"
        return [name, *shlex.split(f"{flags} {self.train_flags}"), *arm_flags(make_task(name), arm),
                "--log-root", str(folder)]  # fmt: skip


def run_arm(args: Args, name: str, arm: str, seed: int, folder: Path) -> Json:
    """Train and test a task with an ablation (arm) and a seed, unless `folder` has the results; return them by name."""
    primary = f"{NOMINAL}_{PRIMARY[make_task(name).evaluation.kind]}"
    jumps = not primary.startswith(f"{NOMINAL}_walk")
    if (folder / "metrics.json").exists() and (values := read_values(folder)).get(primary) is not None:
        return values
    folder.mkdir(parents=True, exist_ok=True)
    command = args.command(name, arm, seed, folder / "runs")
    plan: Json = {"task": name, "arm": arm, "seed": seed, "flags": shlex.join(command[1:-2])}
    plan["primary"] = [primary, STEPS] if jumps else [primary]
    write_metrics(folder, dict.fromkeys(plan["primary"]), plan)
    run, samples = train_arm(command)
    conditions = Conditions(device=args.device, threads=args.threads)
    curve = learning_curve(run, args.num_jumps, conditions)
    steps = [samples * iteration for iteration in curve["iterations"]]
    values: Json = {"curve_steps": steps, "curve_values": curve["values"], **training_metrics(run)}
    if jumps:
        reached = (step for step, value in zip(steps, curve["values"], strict=True) if value >= RATE)
        values[STEPS] = next(reached, None)
    checkpoint = sorted((run / CHECKPOINTS).glob("iteration_*.pt"))[-1]
    values |= evaluate_arm(checkpoint, folder, args.num_jumps, conditions)
    write_metrics(folder, values, plan)
    return read_values(folder)


def main(args: Args) -> Json:
    """Run and test all trainings in turn, print a table, plot learning curves; return the primary metric of each."""
    folder = prepare("paper_trainings", args, args.threads)
    results = {}
    for name, arm, seed in [] if args.table else tracked([*args.trainings()], "arms"):
        values = run_arm(args, name, arm, seed, folder / name / f"{arm}_{seed}")
        key = f"{NOMINAL}_{PRIMARY[make_task(name).evaluation.kind]}"
        results[f"{name}_{arm}_{seed}"] = values[key]
        announce(f"{name}, {arm}, seed {seed}: {key.replace('_', ' ')} {values[key]:.3g}")
    plot_curves(folder, folder / "curves.webp")
    print(results_table(folder), end="")
    return results


if __name__ == "__main__":
    run_script(main, Args)
