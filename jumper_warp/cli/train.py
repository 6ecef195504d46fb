"""`jumper train TASK`: train a policy; every setting of training and task has a flag."""

from __future__ import annotations

import dataclasses
import os
import shlex
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from jumper_warp.cli.flags import option_of, parse, switch_of, values_of, wants_help
from jumper_warp.cli.main import TASK_MODULE, UsageError
from jumper_warp.registry import TASKS, TaskEntry, find_task, task_names
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.utils.errors import is_out_of_memory
from jumper_warp.utils.files import parse_json
from jumper_warp.utils.threads import checked_threads

if TYPE_CHECKING:
    from types import ModuleType

    from jumper_warp.recipe import Recipe
    from jumper_warp.rl.checkpoint import Checkpoint
    from jumper_warp.rl.run_folder import TrainResult
    from jumper_warp.rl.runner import Observer


CPU_STEPS_PER_SECOND = 10_000.0  # [1/s] Policy steps per thread, of all worlds, in a training on a CPU
PRESET_STEPS_PER_SECOND = 20_000.0  # [1/s] Policy steps on two cores with a preset, of all worlds
SHORT_TRAINING = 60.0  # [s] Time of a training on a CPU that is not announced
SHORT_HELP = (
    "preset", "num-envs", "max-iterations", "max-seconds", "seed", "randomize", "noise", "history", "solver", "robot",
    "resume", "init-policy", "ppo.hidden", "ppo.lr", "ppo.entropy-coef", "device", "threads", "log-root",
    "save-interval", "watch", "video-every", "task-module",
)  # fmt: skip
"""Flags on the page of `jumper train --help`."""


@dataclass(frozen=True)
class TrainArgs:
    """Train a policy on a task."""

    cfg: Annotated[TrainCfg, tyro.conf.arg(name="")] = field(default_factory=TrainCfg)
    solver: Literal["jumper", "mujoco"] = "jumper"  # Physics: the dedicated solver, or Newton's SolverMuJoCo
    randomize: bool = True
    """Randomise masses, friction, motors, latency and pushes. Each world has other values; the flags
    --env.randomization set their ranges."""
    noise: bool = True  # Add noise to observations
    history: int | None = None
    """Policy steps in the observation (default: the task's). Velocities, gravity, angles and actions of these steps are
    observed. With 1 the observation has a third of the size; the policy learns faster on few worlds, and 1 is enough
    without randomisation and noise."""
    robot: Path | None = None
    """Robot: its folder or name, or an overlay. Robots are sampled around its values. Its randomisation ranges override
    the task's; flags override both."""
    preset: str | None = None
    """Named group of settings, which other flags override: `laptop` trains a nominal robot on two CPU cores, in 5 to 30
    minutes."""
    watch: bool = False
    """Show the training while it runs: robots, reward terms and learning curves. `jumper watch RUN` joins later."""
    viewer: Literal["rerun", "viser"] = "rerun"  # Viewer of --watch: the Rerun viewer, or a page in the browser
    video_every: int = 0  # Iterations between two films in the run's folder; 0: none


def parse_train(args: Sequence[str]) -> tuple[Recipe, list[Checkpoint], TrainArgs]:
    """Return the recipe that the arguments of `jumper train` make, the checkpoints that are resumed, and all flags.

    Exits with 0 after help. args: the task, then flags. With --resume the saved recipe of the run has the defaults.
    Raises InputError: the task is missing, unknown or given twice, a setting is out of range, or there
    is no such run.
    """
    names = ", ".join(task_names())
    if wants_help(args[:1]):
        about = f"Train a policy on a task: {names}.\njumper train TASK --help also lists the task's own settings."
        parse(TrainArgs, "train TASK", args, description=about, short=SHORT_HELP)
    if not args or args[0].startswith("-"):
        raise UsageError(f"the task comes first: jumper train TASK [flags]; tasks: {names}")
    name, entry = find_task(args[0])
    args = args[1:]
    preset = preset_flags(name, entry, args)
    from jumper_warp.cli.task_flags import parse_with_task
    from jumper_warp.recipe import Recipe
    from jumper_warp.robot.overlay import load_overlay
    from jumper_warp.tasks.observations import with_history
    from jumper_warp.tasks.overlay_ranges import with_flagged_ranges

    files = values_of("--robot", args)
    robot = load_overlay(Path(files[0])) if files else None
    recipe, checkpoints = resumed(Recipe(entry.task(name, robot), entry.training(name), robot=robot), args)
    default = TrainArgs(recipe.train, recipe.solver, recipe.randomize, recipe.noise)
    parsed, task = parse_with_task(default, recipe.task, f"train {name}", [*preset, *args], SHORT_HELP)
    if parsed.cfg.task != name:
        raise UsageError(f"give the task once, got {name} and --task {parsed.cfg.task}")
    robot = robot or recipe.robot
    if robot is not None:
        task, robot = with_flagged_ranges(recipe.task, task, robot, flagged_ranges([*preset, *args]))
    task = with_history(task, parsed.history)
    return Recipe(task, parsed.cfg, parsed.solver, parsed.randomize, parsed.noise, robot), checkpoints, parsed


def resumed(recipe: Recipe, args: Sequence[str]) -> tuple[Recipe, list[Checkpoint]]:
    """Return the recipe and the checkpoints, one of each seed, of the run that --resume selects in unparsed arguments.

    The saved recipe gives the defaults of all other flags, so that they are parsed after it is found. Without the flag,
    and for a new run, the given recipe and no checkpoint. Raises CheckpointError: the run is of another task, or cannot
    be used.
    """
    flags = {name: values_of(f"--{name.replace('_', '-')}", args) for name in ("resume", "log_root", "init_policy")}
    session = {name: values[0] for name, values in flags.items() if values}
    if "resume" not in session:
        return recipe, []
    from jumper_warp.rl.checkpoint import CheckpointError, find_checkpoints

    checkpoints = find_checkpoints(dataclasses.replace(recipe.train, **session))
    if not checkpoints:
        return recipe, []
    checkpoint = checkpoints[0]
    try:
        saved = recipe.from_json(parse_json(checkpoint.state["config"], "config"), defaults=recipe.train)
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{checkpoint.path}: {error}") from error
    if saved.train.task != recipe.train.task:
        raise CheckpointError(f"{checkpoint.path}: of a run of {saved.train.task:.60}, not of {recipe.train.task}")
    seeds = tuple(each.seed for each in checkpoints if each.seed is not None)
    return dataclasses.replace(saved, train=dataclasses.replace(saved.train, seeds=seeds)), checkpoints


def preset_flags(task: str, entry: TaskEntry, args: Sequence[str]) -> list[str]:
    """Return and print the flags of the task's preset that --preset selects in unparsed arguments.

    Flags that the arguments override are left out.
    Raises UsageError: the task has no such preset.
    """
    names = values_of("--preset", args)
    if not names:
        return []
    name = names[-1]
    if name not in entry.presets:
        available = ", ".join(
            f"{other} ({', '.join(known.presets)})" for other, known in TASKS.items() if known.presets
        )
        raise UsageError(f"{task} has no preset {name!r:.60}; tasks with presets: {available}")
    flags = []
    option = ""
    given = {switch_of(option_of(arg)) for arg in args}
    for word in shlex.split(entry.presets[name]):
        option = option_of(word) or option
        flags += [] if switch_of(option) in given else [word]
    print(f"preset {name}: {shlex.join(flags)}", file=sys.stderr)
    return flags


def flagged_ranges(args: Sequence[str]) -> set[str]:
    """Return the names of the ranges of `RandomizationCfg` that have a flag in unparsed arguments.

    Such a flag overrides the range in a robot overlay, even if its value is the default.
    """
    from jumper_warp.robot.overlay import RANDOMIZED

    options = {option_of(arg) for arg in args}
    return {name for name in RANDOMIZED if f"--env.randomization.{name.replace('_', '-')}" in options}


def command_line(args: Sequence[str], modules: Sequence[ModuleType]) -> str:
    """Return the command line that repeats a training, without --resume and --init-policy, for a later resume.

    args: after `jumper train`. modules: each becomes a --task-module with its file, or its name if it is in a package.
    """
    kept = []
    remaining = iter(args)
    for arg in remaining:
        if option_of(arg) not in ("--resume", "--init-policy"):
            kept.append(arg)
        elif "=" not in arg:
            next(remaining, None)
    for module in modules:
        name = module.__name__ if "." in module.__name__ or not module.__file__ else module.__file__
        kept += [TASK_MODULE, name]
    return shlex.join(["jumper", "train", *kept])


def report_cpu_time(cfg: TrainCfg, done: int, preset: bool) -> None:
    """Print the expected duration of a training on a CPU, unless it is short.

    done: iterations before a resume; preset: whether a preset is used.
    """
    from jumper_warp.rl.logger import format_duration

    steps = (cfg.max_iterations - done) * cfg.ppo.num_steps * cfg.num_envs * max(1, len(cfg.seeds))
    threads = checked_threads(cfg.threads)
    rate = PRESET_STEPS_PER_SECOND * min(threads, 2) / 2 if preset else CPU_STEPS_PER_SECOND * threads
    seconds = steps / rate
    reason = f": {steps / 1.0e6:.1f} M steps at {rate:,.0f} steps/s"
    if 0.0 < cfg.max_seconds < seconds:
        seconds = cfg.max_seconds
        reason = ""
    if seconds < SHORT_TRAINING:
        return
    names = "" if preset or done else " or ".join(f"--preset {name}" for name in TASKS[cfg.task].presets)
    advice = f"; settings for such a machine: {names}" if names else ""
    duration = f"{seconds / 3600.0:.0f} h" if seconds > 5400.0 else format_duration(seconds)
    print(f"without a GPU this training takes about {duration}{reason}{advice}", file=sys.stderr)


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> TrainResult:
    """Run `jumper train` with the given arguments, and print the run's folder on rank 0.

    modules: the user's, whose tasks are registered already.
    Raises as `parse_train` and `jumper_warp.training.train`.
    """
    recipe, checkpoints, parsed = parse_train(args)
    from jumper_warp.tasks.overlay_ranges import range_words
    from jumper_warp.utils.runtime import configure_device, git_commit

    cfg = recipe.train
    task = recipe.task
    is_rank_0 = os.environ.get("RANK", "0") == "0"
    with ThreadPoolExecutor(2) as pool:  # CUDA and git run while torch is imported
        pool.submit(git_commit)
        device = pool.submit(configure_device, cfg.device, cfg.threads) if is_rank_0 else None
        from jumper_warp.training import train
    if device is not None and device.result().driver is None:
        report_cpu_time(cfg, checkpoints[0].state["iteration"] if checkpoints else 0, bool(parsed.preset))
    if is_rank_0 and recipe.randomize and (words := range_words(task, recipe.robot, changed=True)):
        print(f"ranges of this robot: {', '.join(words)}", file=sys.stderr)
    command = command_line(args, modules)
    observers: list[Observer] = []
    if is_rank_0 and (parsed.watch or parsed.video_every):
        from jumper_warp.live.training import TrainingWatch

        observers = [TrainingWatch(parsed.viewer if parsed.watch else "none", parsed.video_every)]
    try:
        result = train(recipe, checkpoints=checkpoints, command=command, observers=observers)
    except (MemoryError, RuntimeError) as error:
        if is_out_of_memory(error):
            worlds = f"num_envs {cfg.num_envs} does not fit"
            error.add_note(f"{worlds}: lower --num-envs, --ppo.num-steps or --ppo.hidden")
        raise
    if is_rank_0:
        print(result.folder)
    return result
