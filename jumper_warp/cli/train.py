"""`jumper train TASK`: train a policy; every setting of training and task has a flag."""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import tyro

from jumper_warp.cli.flags import list_flags, option_of, switch_of, values_of
from jumper_warp.cli.help import wants_help
from jumper_warp.cli.main import TASK_MODULE, UsageError, parse
from jumper_warp.cli.renamed_flags import use_new_names
from jumper_warp.registry import TASKS, TaskEntry, find_task, make_task, task_names
from jumper_warp.rl.cfg import UNUSED, TrainCfg
from jumper_warp.utils.errors import InputError, OutOfMemoryError, is_out_of_memory
from jumper_warp.utils.threads import checked_threads, torchrun_variable

if TYPE_CHECKING:
    from types import ModuleType

    import torch

    from jumper_warp.envs.vec_env import VecEnv
    from jumper_warp.rl.runner import MakeEnv, TrainResult
    from jumper_warp.robot.overlay import RobotOverlay
    from jumper_warp.tasks.cfg import TaskCfg


CPU_STEPS_PER_SECOND = 10_000.0  # [1/s] Policy steps per thread, of all worlds, in a training on a CPU
PRESET_STEPS_PER_SECOND = 20_000.0  # [1/s] Policy steps on two cores with a preset, of all worlds
SHORT_TRAINING = 60.0  # [s] Time of a training on a CPU that is not announced
SHORT_HELP = {
    "Size and length": ("preset", "num-envs", "max-iterations", "max-seconds", "seed"),
    "Physics and robot": ("randomize", "noise", "history", "solver", "robot"),
    "Continue or start from a policy": ("resume", "init-policy"),
    "Learning": ("trainer", "ppo.hidden", "ppo.lr", "ppo.entropy-coef"),
    "Machine and output": ("device", "threads", "log-root", "save-interval", "task-module"),
}
"""Flags on the page of `jumper train --help`, by heading."""


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
    """Robot overlay, written by `jumper sysid fit`. Robots are sampled around its values. Its randomisation ranges
    override the task's; flags override both."""
    preset: str | None = None
    """Named group of settings, which other flags override: `laptop` trains a nominal robot on two CPU cores, in 5 to 20
    minutes."""
    overlay: Annotated[Any, tyro.conf.Suppress] = None  # Overlay of --robot or the resumed run, with flags' ranges
    checkpoint: Annotated[Any, tyro.conf.Suppress] = None  # Checkpoint that is resumed


def parse_train(args: Sequence[str]) -> tuple[TrainArgs, TaskCfg]:
    """Return the settings of `jumper train`, and the task changed by --env flags; exits with 0 after help.

    args: the task, then flags. With --resume the saved settings of the run are the defaults.
    Raises InputError: the task is missing, unknown or given twice, a setting is out of range, the trainer does not use
    a flag, or there is no such run.
    """
    names = ", ".join(task_names())
    if wants_help(args[:1]):
        about = f"Train a policy on a task: {names}.\njumper train TASK --help also lists the task's own settings."
        parse(TrainArgs, "train TASK", args, description=about, short=SHORT_HELP)
    if not args or args[0].startswith("-"):
        raise UsageError(f"the task comes first: jumper train TASK [flags]; tasks: {names}")
    name, entry = find_task(args[0])
    preset, args = preset_flags(name, entry, args[1:]), args[1:]
    default, task = TrainArgs(entry.training(name)), make_task(name)
    flags = {name: values_of(f"--{name.replace('_', '-')}", args) for name in ("resume", "log_root", "init_policy")}
    session = {name: values[0] for name, values in flags.items() if values}
    if "resume" in session:
        from jumper_warp.cli.resumed import settings_of_run
        from jumper_warp.rl.resume import find_checkpoint

        named = dataclasses.replace(default.cfg, **session)
        if checkpoint := find_checkpoint(named):
            settings, task = settings_of_run(checkpoint, default.cfg)
            default = dataclasses.replace(default, **settings)
    parsed, flagged = parse_settings(task, default, [*preset, *args])
    if parsed.cfg.task != name:
        raise UsageError(f"give the task once, got {name} and --task {parsed.cfg.task}")
    if unused := unused_flags(parsed.cfg.trainer, args):
        raise UsageError(f"{', '.join(unused)}: not supported with trainer {parsed.cfg.trainer}")
    from jumper_warp.tasks.observations import with_history
    from jumper_warp.tasks.overlay_ranges import with_flagged_ranges

    overlay = overlay_in(args) or default.overlay
    if overlay is not None:
        flagged, overlay = with_flagged_ranges(task, flagged, overlay, flagged_ranges([*preset, *args]))
    return dataclasses.replace(parsed, overlay=overlay), with_history(flagged, parsed.history)


def preset_flags(task: str, entry: TaskEntry, args: Sequence[str]) -> list[str]:
    """Return and print the flags of the task's preset that --preset selects in unparsed arguments.

    Flags that the arguments override, or that the --trainer does not use, are left out.
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
    flags, option, preset = [], "", shlex.split(entry.presets[name])
    unused = unused_flags("".join(values_of("--trainer", args)[:1]), preset)
    given = {switch_of(option_of(arg)) for arg in args}
    for word in preset:
        option = option_of(word) or option
        flags += [] if option in unused or switch_of(option) in given else [word]
    print(f"preset {name}: {shlex.join(flags)}", file=sys.stderr)
    return flags


def unused_flags(trainer: str, args: Sequence[str]) -> list[str]:
    """Return the flags in unparsed arguments that a trainer does not use."""
    names = [name.replace("_", "-") for name in UNUSED.get(trainer, ())]
    flags = list_flags(TrainArgs, described=False)
    unused = {option for flag in flags if flag.name in names for option in flag.options}
    return list(dict.fromkeys(option for arg in args if (option := option_of(arg)) in unused))


def parse_settings(task: TaskCfg, default: TrainArgs, args: Sequence[str]) -> tuple[Any, TaskCfg]:
    """Return the settings parsed from `args`, and the task changed by its --env flags.

    Exits with 0 after help. Raises InputError: a setting is out of range.
    """
    from jumper_warp.cli.task_flags import flags_of, with_flags

    flags = flags_of(task)
    made: dict[str, Any] = {"bases": (TrainArgs,), "frozen": True, "namespace": {"__module__": __name__}}
    kind: Any = dataclasses.make_dataclass("TaskTrainArgs", [("env", type(flags), flags)], **made)
    defaults = {spec.name: getattr(default, spec.name) for spec in dataclasses.fields(default)}
    settings: dict[str, Any] = {"default": kind(**defaults), "short": SHORT_HELP}
    parsed = parse(kind, f"train {task.name}", args, description=f"Train a policy on {task.name}.", **settings)
    return parsed, with_flags(task, parsed.env)


def overlay_in(args: Sequence[str]) -> RobotOverlay | None:
    """Return the robot overlay of the flag --robot in unparsed arguments, None without it.

    Raises InputError or OSError: the overlay is invalid.
    """
    path = values_of("--robot", args)
    if not path:
        return None
    from jumper_warp.robot.overlay import load_overlay

    return load_overlay(Path(path[0]))


def flagged_ranges(args: Sequence[str]) -> set[str]:
    """Return the names of the ranges of `RandomizationCfg` that have a flag in unparsed arguments."""
    from jumper_warp.robot.overlay import RANDOMIZED

    options = {option_of(arg) for arg in args}
    return {name for name in RANDOMIZED if f"--env.randomization.{name.replace('_', '-')}" in options}


def env_maker(task: TaskCfg, args: TrainArgs) -> MakeEnv:
    """Return the function that makes a training's environment from num_envs, seed and device.

    It raises InputError: memory is too small.
    """
    from jumper_warp.cli.training_memory import check_memory
    from jumper_warp.envs.env import Env

    def make_env(num_envs: int, seed: int, device: torch.device) -> VecEnv:
        """Return the training's environment, differentiable for trainer shac."""
        check_memory(task, args.cfg.ppo, args.solver, num_envs, device)
        settings: dict[str, Any] = {name: getattr(args, name) for name in ("solver", "randomize", "noise")}
        env = Env(task, num_envs, seed=seed, device=str(device), robot=args.overlay, **settings)
        if args.cfg.trainer != "shac":
            return env
        from jumper_warp.diff.differentiable_env import DifferentiableEnv

        return cast("VecEnv", DifferentiableEnv(env))

    return make_env


def memory_message(task: TaskCfg, args: TrainArgs, error: Exception) -> str:
    """Return one line about a training that ran out of memory: need, number of worlds that fits, and how to resume."""
    import torch
    import warp as wp

    from jumper_warp.cli.training_memory import describe_need, memory_pools

    device = torch.device(wp.device_to_torch(wp.get_device(args.cfg.device)))
    if device.type == "cuda":
        device = torch.device("cuda", torch.cuda.current_device())  # of this rank
    num_envs = args.cfg.num_envs // torchrun_variable("WORLD_SIZE")
    pools = memory_pools(task, args.cfg.ppo, args.solver, device, rebuilt=True)
    parts = [f"out of memory: {describe_need(pools, args.cfg.ppo, num_envs)}", *getattr(error, "__notes__", [])]
    return "; ".join(parts)


def command_line(args: Sequence[str], modules: Sequence[ModuleType]) -> str:
    """Return the command line that repeats a training, without --resume and --init-policy, for a later resume.

    args: after `jumper train`. modules: each becomes a --task-module with its file, or its name if it is in a package.
    """
    kept, remaining = [], iter(args)
    for arg in remaining:
        if option_of(arg) not in ("--resume", "--init-policy"):
            kept.append(arg)
        elif "=" not in arg:
            next(remaining, None)
    for module in modules:
        name = module.__name__ if "." in module.__name__ or not module.__file__ else module.__file__
        kept += [TASK_MODULE, name]
    return shlex.join(["jumper", "train", *kept])


def report_cpu_time(args: TrainArgs, presets: Iterable[str]) -> None:
    """Print the expected duration of a training on a CPU, unless it is short; presets: names of the task's presets."""
    from jumper_warp.rl.logger import format_duration

    cfg, done = args.cfg, args.checkpoint.state["iteration"] if args.checkpoint else 0
    steps, threads = (cfg.max_iterations - done) * cfg.ppo.num_steps * cfg.num_envs, checked_threads(cfg.threads)
    rate = PRESET_STEPS_PER_SECOND * min(threads, 2) / 2 if args.preset else CPU_STEPS_PER_SECOND * threads
    seconds, reason = steps / rate, f": {steps / 1.0e6:.1f} M steps at {rate:,.0f} steps/s"
    if 0.0 < cfg.max_seconds < seconds:
        seconds, reason = cfg.max_seconds, ""
    if seconds < SHORT_TRAINING:
        return
    names = " or ".join(f"--preset {name}" for name in presets)
    advice = f"; settings for such a machine: {names}" if names else ""
    duration = f"{seconds / 3600.0:.0f} h" if seconds > 5400.0 else format_duration(seconds)
    print(f"without a GPU this training takes about {duration}{reason}{advice}", file=sys.stderr)


def check_saving(task: TaskCfg) -> None:
    """Raise InputError unless the task, saved as JSON and read back, is unchanged."""
    from jumper_warp.cli.resumed import loaded_modules
    from jumper_warp.tasks.saving import task_from_json, task_to_json

    if task_from_json(json.loads(json.dumps(task_to_json(task))), loaded_modules()) != task:
        raise InputError(f"{task.name} differs from the original after it is saved as JSON and loaded")


def run(args: Sequence[str], modules: Sequence[ModuleType] = ()) -> TrainResult:
    """Run `jumper train` with the given arguments, and print the run's folder on rank 0.

    modules: the user's, whose tasks are registered already.
    Raises as `parse_train`, `jumper_warp.policies.warm_start.actor_init_from_policy` and `jumper_warp.rl.runner.train`.
    """
    args = [*args[:1], *use_new_names(args[1:], TrainArgs())]
    parsed, task = parse_train(args)
    from jumper_warp.rl.runner import train
    from jumper_warp.tasks.mirror import mirror_of
    from jumper_warp.tasks.overlay_ranges import range_words
    from jumper_warp.utils.runtime import configure_device

    check_saving(task)
    if parsed.cfg.ppo.symmetry != "off":
        mirror_of(task, "actor")  # raises InputError where a term has no known mirror image
    actor_init = None
    if parsed.cfg.init_policy and not parsed.checkpoint:
        from jumper_warp.policies.warm_start import actor_init_from_policy

        actor_init = actor_init_from_policy(parsed.cfg.init_policy, task, parsed.cfg.ppo)
    is_rank_0 = os.environ.get("RANK", "0") == "0"
    rate = 0.0
    if is_rank_0 and configure_device(parsed.cfg.device, parsed.cfg.threads).driver is None:
        report_cpu_time(parsed, () if parsed.preset or parsed.checkpoint else find_task(task.name)[1].presets)
        if parsed.preset and parsed.solver == "jumper":
            rate = PRESET_STEPS_PER_SECOND
    if is_rank_0 and parsed.randomize and (words := range_words(task, parsed.overlay, changed=True)):
        print(f"ranges of this robot: {', '.join(words)}", file=sys.stderr)
    as_rsl_rl = None
    if parsed.cfg.trainer == "rsl-rl":
        from jumper_warp.envs.rsl_rl import RslRlVecEnv as as_rsl_rl
    make_env, command = env_maker(task, parsed), command_line(args, modules)
    try:
        result = train(parsed.cfg, make_env, command, as_rsl_rl, actor_init, parsed.checkpoint, rate)
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise OutOfMemoryError(memory_message(task, parsed, error)) from error
    if is_rank_0:
        print(result.folder)
    return result
