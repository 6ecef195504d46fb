"""`jumper train TASK`: every setting of training and task as a flag."""

from __future__ import annotations

import dataclasses
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
import tyro

from jumper_warp.cli import UsageError, announce
from jumper_warp.env import JumpEnv
from jumper_warp.simulation import SolverName
from jumper_warp.task_flags import TaskFlags
from jumper_warp.tasks import TASKS, make_task
from jumper_warp.tasks.task import TaskCfg
from jumper_warp.train import MakeEnv, TrainCfg, TrainResult, train
from jumper_warp.training_memory import check_memory


@dataclass(frozen=True)
class TrainArgs:
    """Train a policy on a task."""

    cfg: Annotated[TrainCfg, tyro.conf.arg(name="")]
    env: TaskFlags
    solver: SolverName = "jumper"
    """Physics: the dedicated solver, or Newton's SolverMuJoCo."""
    randomize: bool = True
    """Draw masses, friction, motors, latency and pushes for each world; single rows are under --env.randomization."""
    noise: bool = True
    """Add noise to observations."""


def parse_train(args: Sequence[str]) -> tuple[TrainArgs, TaskCfg]:
    """Return the settings, and the task with its settings; exits where tyro does.

    Raises:
        UsageError: The task is missing or given twice.
        ValueError: The task is unknown, or a setting is out of range.
    """
    names = ", ".join(TASKS)
    asks_help = not args or args[0] in ("-h", "--help")
    if not asks_help and args[0].startswith("-"):
        raise UsageError(f"the task comes first: jumper train TASK [flags]; tasks: {names}")
    task = make_task(next(iter(TASKS)) if asks_help else args[0])
    parsed = tyro.cli(
        TrainArgs,
        prog="jumper train TASK",
        description=f"Train a policy on a task: {names}. Values shown are those of {task.name}.",
        default=TrainArgs(TrainCfg(task=task.name, ppo=task.ppo), TaskFlags.of(task)),
        args=["--help"] if asks_help else list(args[1:]),
    )
    if parsed.cfg.task != task.name:
        raise UsageError(f"give the task once, got {task.name} and --task {parsed.cfg.task}")
    return parsed, dataclasses.replace(parsed.env.apply(task), ppo=parsed.cfg.ppo)


def env_maker(task: TaskCfg, args: TrainArgs) -> MakeEnv:
    """Return what makes the environment of a training; it raises ValueError, too, if memory is short."""

    def make(num_envs: int, seed: int, device: torch.device) -> JumpEnv:
        check_memory(task, args.solver, num_envs, device)
        return JumpEnv(
            task,
            num_envs,
            seed=seed,
            device=str(device),
            solver=args.solver,
            randomize=args.randomize,
            noise=args.noise,
        )

    return make


def command_line(args: Sequence[str]) -> str:
    """Return what was typed, without `--resume`."""
    kept = [arg for arg in args if not arg.startswith("--resume=")]
    while "--resume" in kept:
        at = kept.index("--resume")
        del kept[at : at + 2]
    return shlex.join(["jumper", "train", *kept])


def run_train(args: Sequence[str]) -> TrainResult:
    """Train as the arguments say; raises as `parse_train` and `jumper_warp.train.train`."""
    parsed, task = parse_train(args)
    first = os.environ.get("RANK", "0") == "0"
    if first:
        announce(parsed.cfg.device)
    result = train(parsed.cfg, env_maker(task, parsed), command_line(args))
    if first:
        print(result.folder)
    return result
