"""Train ablations of a jump task, each without one departure from the paper; write metrics, a table, a plot and runs.

    python experiments/departures.py --task vertical-jump --out outputs/departures
    python experiments/departures.py --task horizontal-jump --only bracing goals --seeds 1 2

A departure is a difference of a task from the paper and its authors' configuration (DEPARTURES). Trainings
differ only in the departure that is undone. They are equally long, randomised, and start from random weights (on Mars
from the policy of Earth). The task with all departures, `kept`, is trained with each seed of `--baseline-seeds`, to
show the spread between seeds.

Each policy then makes nominal and randomised jumps as in `jumper evaluate`, where a fall or a collision after the
landing is a failure. Nominal and randomised robots also hold their squats for 3 s. The task's terminations end the
jumps, regardless of those of the training. A training that is already in `--out` is loaded, so that an interrupted run
continues. `--no-measure` only trains.
"""

from __future__ import annotations

import io
import json
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jumper_warp.cli.train import parse_train
from jumper_warp.evaluation.conditions import Conditions
from jumper_warp.evaluation.evaluations import default_flags
from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.recipe import Recipe
from jumper_warp.registry import make_task
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.rl.run_folder import CONFIG
from jumper_warp.rl.run_names import newest
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.training import train
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, write_atomically
from jumper_warp.utils.output import write_metrics
from jumper_warp.viz.plots import figure
from support.scripts import ThreadArgs, announce, prepare, report, run_script, tracked
from support.squats import SquatLog, squat_goals, squat_metrics

Ablation = str | Callable[[TaskCfg], TaskCfg]
"""Change that undoes a departure: flags of `jumper train TASK`, or a function that returns the task without it."""
Point = tuple[float, float, float]  # [m] x, y, z of a goal


def may_jump_early(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task in which a takeoff before the command does not end the episode."""
    terminations = tuple(term for term in task.terminations if term.name != "early_takeoff")
    return replace(task, terminations=terminations)


def with_goals(task: TaskCfg, goals: Sequence[tuple[Point, Point]], starts: int) -> TaskCfg:
    """Return a copy of a jump task with other goals in its curriculum levels.

    The levels are every goal range with each of the last `starts` start height ranges.
    goals [m]: lower and upper point of each range; all other fields are those of the task's last level.
    """
    last = task.levels[-1]
    heights = [*dict.fromkeys(level.base_height for level in task.levels)][-starts:]
    levels = (replace(last, goal_lower=low, goal_upper=top, base_height=z) for low, top in goals for z in heights)
    return replace(task, levels=tuple(levels))


def heights_of_paper(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with goal heights of 0.6 to 1.1 m in three levels.

    All levels have the last range of start heights of the task.
    """
    return with_goals(task, [((0.0, 0.0, 0.6), (0.0, 0.0, top)) for top in (0.75, 0.9, 1.1)], starts=1)


def places_of_paper(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with goals 0.4 to 1.0 m ahead and up to 0.3 m to either side.

    There are four goal ranges, each with the last two ranges of start heights of the task.
    """
    tops = ((0.55, 0.0), (0.7, 0.1), (0.85, 0.2), (1.0, 0.3))
    return with_goals(task, [((0.4, -y, 0.0), (top, y, 0.0)) for top, y in tops], starts=2)


def places_of_sequel(task: TaskCfg) -> TaskCfg:
    """Return a copy of the Mars task with the goals of the authors' sequel, 1.4 to 4.75 m ahead.

    There are four goal ranges, each with the last two ranges of start heights of the task.
    """
    (_, *low), (_, *top) = task.levels[-1].goal_lower, task.levels[-1].goal_upper
    ahead = ((1.4, 1.85), (1.6, 2.25), (2.0, 3.75), (3.0, 4.75))
    return with_goals(task, [((near, *low), (far, *top)) for near, far in ahead], starts=2)


def alike_all_around(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with circular instead of elliptical goal ranges.

    The radius is the reach ahead.
    """
    levels = list(task.levels)
    for i, level in enumerate(levels):
        reach = level.goal_upper[0]
        if level.elliptical:
            levels[i] = replace(level, goal_lower=(-reach, -reach, 0.0), goal_upper=(reach, reach, 0.0))
    return replace(task, levels=tuple(levels))


def without_another_goal(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task in which a landed robot never gets a goal for a next jump."""
    return replace(task, levels=tuple(replace(level, next_jump_probability=0.0) for level in task.levels))


DEPARTURES: dict[str, dict[str, Ablation]] = {
    "vertical-jump": {
        "standing_still_and_level": "--env.rewards.base-at-rest.weight 0 --env.rewards.landing-tilt.weight 0",
        "paws_down": "--env.rewards.paws-down.weight 0",
        "second_takeoff": "--env.terminations.second-takeoff.speed 100",
        "quiet_standing": (
            "--env.rewards.resting-action-rate.weight 0 --env.rewards.torque-ripple.weight 0 "
            "--env.rewards.force-ripple.weight 0"
        ),
        "changes_of_the_action": "--env.rewards.action-rate.weight -0.1",
        "one_step_seen": "--history 1",
        "links_may_come_near": "--env.self-collision-margin 0",
        "shares_of_resets": "--env.reset.balance-by resets",
        "none_pushing_off": "--env.reset.start-probability.pushing 0 --env.reset.start-probability.standing 0.6",
        "promoted_after_one": "--env.curriculum.promote-after 1",
        "jumping_early": may_jump_early,
        "ground_forces": "--env.rewards.ground-force.weight 0",
        "rewards_below_zero": "--env.reward-floor None",
        "critic_sees_what_the_actor_does": "--ppo.no-asymmetric-critic",
        "entropy": "--ppo.entropy-coef 0.00075 --ppo.final-desired-kl 0.01",
        "goals": heights_of_paper,
        "drift": "--env.terminations.moved-away.distance 0.2",
        "starts": "--env.reset.tilt 1 --env.reset.base-xy 0",
    },
    "horizontal-jump": {
        "estimated_tracking": "--env.rewards.estimated-tracking.std-fine 0.001",
        "error_at_touchdown": "--env.terminations.missed-goal.tolerance 0.2",
        "predicted_error": "--env.terminations.predicted-miss.tolerance 0.45",
        "base_at_touchdown": "--env.terminations.low-touchdown.height 0.3",
        "symmetry": "--env.rewards.left-right-symmetry.waiting-scale 1",
        "bracing": "--env.rewards.capture-point.weight 0",
        "goals": places_of_paper,
        "heading": "--env.reset.heading 0",
        "no_command_delay": "--env.reset.command-delay 0",
        "level_squats": "--env.reset.lean 0",
        "takeoffs": "--env.reset.takeoff-angle 50 75 --env.reset.takeoff-ahead 0 0.1 --env.reset.takeoff-pitch 0 0",
        "touchdowns": "--env.reset.touchdown-behind 0 0",
        "another_goal": without_another_goal,
        "level_ground": "--env.reset.ground.platform 0 --env.reset.ground.block 0",
    },
    "omnidirectional-jump": {"reaches": alike_all_around},
    "horizontal-jump-mars-loose": {
        "goals": places_of_sequel,
        "wide_kernels": (
            "--env.rewards.estimated-tracking.std-middle 0.3 --env.rewards.estimated-tracking.std-wide 0.5 "
            "--env.rewards.estimated-tracking.std-fine 0.1 --env.rewards.tracking.std-wide 0.15 "
            "--env.rewards.tracking.std-fine 0.03"
        ),
        "limits": (
            "--env.terminations.predicted-miss.tolerance 0.55 --env.terminations.missed-goal.tolerance 0.5 "
            "--env.terminations.turned-touchdown.rotation 0.3491 --env.terminations.turned-touchdown.yaw 0.1745 "
            "--env.curriculum.tolerance 0.1"
        ),
    },
}
"""Ablations by task and name; most of the vertical jump also apply to the horizontal one; Mars refers to the sequel."""


def ablation_flags(ablation: Ablation) -> str:
    """Return the flags of `jumper train` that make an ablation; empty if it is a function that changes the task."""
    return ablation if isinstance(ablation, str) else ""


NOT_COMPARED = {"log_root", "device", "threads"}  # Settings in which a training may differ from a saved one
HOLD = 3.0  # [s] Time for which squats are held
TESTS = ("nominal", "randomized")  # Robots of the evaluations
BASELINE = "kept"  # Name of the training with all departures
COLUMNS = {
    "error [mm]": ("error_m", 1000.0), "success [%]": ("success_rate", 100.0), "falls [%]": ("fall_rate", 100.0),
    "still [%]": ("no_paw_lift_rate", 100.0), "hops again [%]": ("second_takeoff_rate", 100.0),
    "at rest [%]": ("at_rest_rate", 100.0), "largest tilt [deg]": ("landing_tilt_max_deg", 1.0),
    "waits [%]": ("holding_rate", 100.0), "paw force varies [N]": ("paw_force_range_median_n", 1.0),
    "torque ripple [N m]": ("torque_ripple_mean_nm", 1.0),
}  # fmt: skip
"""Columns of the table: metric and scale; cells are nominal / randomised."""
WIDTH = 180  # Width of the table in characters
MetricsByTraining = dict[tuple[str, int], dict[str, Json]]  # Metrics by training (name, seed), test and name


@dataclass(frozen=True)
class DepartureCfg:
    """Settings with which the ablations of a task are trained and evaluated."""

    iterations: int  # Iterations of each training
    goals: Json  # [m] Flags that set the goals of the evaluated jumps
    squats: tuple[float, float]  # [m] Range of goals for which squats are held
    begin: str = ""  # Further flags of `jumper train` for every training


JumpTask = Literal["vertical-jump", "horizontal-jump", "omnidirectional-jump", "horizontal-jump-mars-loose"]
JUMP_TASKS: dict[JumpTask, DepartureCfg] = {
    "vertical-jump": DepartureCfg(1000, {"height_range": (0.5, 1.05)}, (0.6, 1.05)),
    "horizontal-jump": DepartureCfg(800, {"goal_x": (0.3, 1.5)}, (0.3, 1.5)),
    "omnidirectional-jump": DepartureCfg(1000, {"goal_x": (-0.8, 1.2), "goal_y": (-0.8, 0.8)}, (0.3, 1.2)),
    "horizontal-jump-mars-loose": DepartureCfg(
        1000, {"goal_x": (0.5, 4.2)}, (0.5, 4.2), "--init-policy horizontal_jump --ppo.init-std 0.3"
    ),
}


def parse(ablation: Ablation, arguments: list[str]) -> Recipe:
    """Return the recipe that arguments of `jumper train` make, with the task of an ablation."""
    recipe, _ = parse_train(arguments)
    return recipe if isinstance(ablation, str) else replace(recipe, task=ablation(recipe.task))


def train_or_load(ablation: Ablation, arguments: list[str]) -> Path:
    """Return the last checkpoint of a training, and run the training unless the checkpoint exists.

    arguments: of `jumper train`. Raises InputError: the existing training has other settings.
    """
    recipe = parse(ablation, arguments)
    name = f"{CHECKPOINTS}/iteration_{{:06d}}.pt"
    last = name.format(recipe.train.max_iterations)
    if run := newest(path.parents[1] for path in recipe.train.log_root.glob(f"*/*/{last}")):
        config = json.loads((run / CONFIG).read_text())
        requested = recipe.to_json()
        train_settings = requested["train"]
        changed = [k for k in train_settings.keys() - NOT_COMPARED if train_settings[k] != config["train"].get(k)]
        if changed or config["env"]["task"] != requested["env"]["task"]:
            raise InputError(f"{run} was trained with other settings: choose another --out")
        return run / last
    result = train(recipe, command=shlex.join(["jumper", "train", *arguments]))
    return result.folder / name.format(result.iteration)


def evaluate(checkpoint: Path, args: Any, folder: Path) -> dict[str, Json]:
    """Evaluate a policy's jumps and held squats: return the scalar metrics by name, for each of TESTS.

    args: `Args`; folder: for outputs of the run.
    """
    run = EvaluationRun(checkpoint)
    ends = make_task(args.task).terminations
    run.prepare("departures", Conditions(device=args.device, threads=args.threads), folder)
    tests = {}
    for test, count in zip(TESTS, args.num_jumps, strict=True):
        randomize = test == "randomized"
        conditions = replace(run.conditions, randomize=randomize, noise=randomize)
        flags = default_flags(run.evaluation, "evaluate")
        flags = replace(flags, num_jumps=count, **JUMP_TASKS[args.task].goals)
        env = run.env(count, lambda task: run.evaluation.prepare_task(replace(task, terminations=ends)), conditions)
        values = flags.metrics(run.run_episodes(env, flags.log(env.task, 0)))
        up = run.evaluation.kind == "height"
        values["error_m"] = values["apex_error_abs_mean_m" if up else "goal_distance_at_end_mean_m"]
        goals = squat_goals(args.num_squats, JUMP_TASKS[args.task].squats, up=up)
        values |= squat_metrics(
            run.run_episodes(run.env(args.num_squats, conditions=conditions), SquatLog(goals, HOLD))
        )
        tests[test] = {key: metric.value for key, metric in values.items()}
    return tests


def write_table(results: MetricsByTraining, title: str, folder: Path) -> None:
    """Write the results of all ablations into a folder, as table `departures.txt` and plot `departures.png`."""
    table = Table("ablation, seed", *map(escape, COLUMNS), title=title)
    for (name, seed), tests in results.items():
        table.add_row(f"{name.replace('_', ' ')}, {seed}", *(cell(tests, *column) for column in COLUMNS.values()))
    text = io.StringIO()
    Console(file=text, width=WIDTH).print(table)
    write_atomically(folder / "departures.txt", text.getvalue().encode())
    plot_results(results, folder / "departures.png")


def cell(tests: dict[str, Json], name: str, scale: float) -> str:
    """Format a metric of nominal and randomised jumps for the table, as `nominal / randomized`, times `scale`.

    tests: metrics by test and name.
    """
    values = (tests[test][name] for test in TESTS)
    return " / ".join("-" if value is None else f"{scale * value:.3g}" for value in values)


def plot_results(results: MetricsByTraining, path: Path) -> None:
    """Plot success and error of every ablation's policy; grey lines mark the trainings with all departures."""
    rows = [*results]
    with figure(path, 1, 2, figsize=(11, 2.0 + 0.3 * len(rows)), sharey=True, title="Ablations") as axes:
        for axis, name, scale in zip(axes, ("success_rate", "error_m"), (100.0, 1000.0), strict=True):
            for test, marker in zip(TESTS, "ox", strict=True):
                x = [np.nan if (v := results[row][test][name]) is None else scale * v for row in rows]
                axis.plot(x, range(len(rows)), marker, label=test)
                for value in (x[i] for i, (row, _) in enumerate(rows) if row == BASELINE):
                    axis.axvline(value, color="0.5", linewidth=0.8, zorder=0, label="all departures")
        axes[0].set(xlabel="success [%]", yticks=range(len(rows)))
        axes[0].set_yticklabels([f"{name.replace('_', ' ')}, {seed}" for name, seed in rows])
        axes[0].invert_yaxis()
        axes[1].set(xlabel="mean error [mm]")


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the training of ablations of a jump task, each without one departure from the paper."""

    task: JumpTask = "vertical-jump"  # Task whose departures are undone
    only: tuple[str, ...] = ()  # Names of the departures to undo, or kept for none (default: all)
    iterations: int | None = None
    """Iterations of each training (default: 800 or 1000, when the task with all departures has learned)."""
    num_envs: int = 8192  # Number of environments
    seeds: tuple[int, ...] = (1,)  # Seeds of the trainings without one departure
    baseline_seeds: tuple[int, ...] = (1, 2, 3)  # Seeds of the trainings with all departures
    num_jumps: tuple[int, int] = (200, 1000)  # Numbers of nominal and of randomised jumps
    num_squats: int = 100  # Number of robots that hold a squat
    train_flags: str = ""  # More flags of `jumper train`, for all trainings: --train-flags="--ppo.gamma 0.98"
    measure: bool = True  # Make the jumps after each training

    def __post_init__(self) -> None:
        """Raise InputError for a departure that the task does not have."""
        unknown = set(self.only) - {BASELINE, *DEPARTURES[self.task]}
        if unknown:
            raise InputError(f"departures of {self.task} are {', '.join(DEPARTURES[self.task])}, not {min(unknown)}")

    @property
    def length(self) -> int:
        """Number of iterations of each training."""
        return JUMP_TASKS[self.task].iterations if self.iterations is None else self.iterations

    def trainings(self) -> Iterator[tuple[str, int, Ablation]]:
        """Yield the departure that is left out (BASELINE: none), the seed and the ablation of every training."""
        for name in self.only or (BASELINE, *DEPARTURES[self.task]):
            for seed in self.baseline_seeds if name == BASELINE else self.seeds:
                yield name, seed, DEPARTURES[self.task].get(name, "")

    def command(self, ablation: Ablation, seed: int, folder: Path) -> list[str]:
        """Return the command-line arguments of `jumper train` for an ablation and a seed; folder: root of the logs."""
        flags = f"--num-envs {self.num_envs} --max-iterations {self.length} --seed {seed} --no-tensorboard"
        flags += "" if self.device is None else f" --device {self.device}"
        flags += "" if self.threads is None else f" --threads {self.threads}"
        flags = f"{flags} {JUMP_TASKS[self.task].begin} {self.train_flags} {ablation_flags(ablation)}"
        return [self.task, *shlex.split(flags), "--log-root", str(folder)]


def main(args: Args) -> Json:
    """Train and evaluate each ablation of a jump task, write results as a table and a plot, and return the metrics."""
    for name, seed, ablation in args.trainings():  # refuse wrong flags before the first training
        parse(ablation, args.command(ablation, seed, Path(name)))
    folder = prepare("departures", args, args.threads)
    results = {}
    values: Json = {"task": args.task, "iterations": args.length, "envs": args.num_envs}
    for name, seed, ablation in tracked([*args.trainings()], "trainings"):
        checkpoint = train_or_load(ablation, args.command(ablation, seed, folder / f"{name}_{seed}"))
        if not args.measure:
            continue
        tests = results[name, seed] = evaluate(checkpoint, args, folder)
        values[f"flags_{name}"] = ablation_flags(ablation)
        values |= {f"{test}_{key}_{name}_{seed}": tests[test][key] for test in TESTS for key in tests[test]}
        write_metrics(folder, values)
        write_table(results, f"{args.task}, {args.length} iterations", folder)
        announce(f"{name}, seed {seed}: {tests['randomized']['success_rate']:.1%} success of randomised robots")
    if not results:
        announce(f"runs in {folder}")
        return values
    keys = [key for key in values if key.startswith("randomized_success_rate_")]
    return report(args, folder, values, f"Departures of {args.task}, {args.length} iterations", keys)


if __name__ == "__main__":
    run_script(main, Args)
