"""Agents without a policy, to examine a task before a training: range of each reward, share of each termination."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro
from rich.table import Column, Table

from jumper_warp.evaluation.commands import FilmCfg, open_viewer
from jumper_warp.evaluation.log import EvaluationLog, run_evaluation
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.metrics import Metrics, MetricValue
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.tables import print_table

if TYPE_CHECKING:
    import torch

    from jumper_warp.envs.env import Env
    from jumper_warp.envs.gradient_check import GradientCheck


@dataclass(frozen=True)
class AgentCfg:
    """Show a task without a policy: range of each reward, share of each termination, a recording."""

    agent: Literal["zero", "random", "hold"]
    """Actions: zero (the default pose), uniformly random, or hold (the pose in which the episode began)."""
    num_envs: int = 64  # Number of robots
    seconds: float = 10.0  # [s] Simulated time; ended episodes begin again
    randomize: bool = True  # Randomise robots as in training
    seed: int = 0  # Seed of resets, randomisation and actions
    device: str | None = None  # Warp device (default: a GPU if there is one)
    check_gradients: bool = False
    """Compare the gradient of each reward with differences, every 10 policy steps."""
    film: Annotated[FilmCfg, tyro.conf.arg(name="")] = field(default_factory=FilmCfg)
    """Film of the recording to write."""
    out: Path | None = None  # Folder for all results (default: outputs/play/<time>)
    viewer: Literal["none", "rerun"] = "none"
    """Open the recording in Rerun's viewer. It listens on this machine's loopback address only."""

    def __post_init__(self) -> None:
        """Raise InputError for no robots or an invalid time."""
        if self.num_envs < 1 or not 0.02 <= self.seconds <= 600.0:
            raise InputError(f"needs a robot and 0.02 to 600 s, got {self.num_envs} and {self.seconds:g}")


@dataclass
class AgentLog(EvaluationLog):
    """Log of the reward terms and terminations of all worlds, whose episodes begin in sampled states."""

    task: TaskCfg
    count: int  # Number of worlds
    seconds: float = 10.0  # [s] Simulated time
    _rewards: list[np.ndarray] = field(default_factory=list, init=False)
    _endings: list[np.ndarray] = field(default_factory=list, init=False)
    row_name = "robot"
    spacing = 2.0

    def begin(self, env: Env) -> None:
        """Reset every world to a start state of training."""
        env.reset()

    def read_env(self, env: Env) -> dict[str, np.ndarray]:
        """Return the task's arrays, and `rewards`, (num_envs, terms)."""
        terms = [values.cpu().numpy() for values in env.reward_terms.values()]
        return env.task_arrays() | {"rewards": np.array(terms).reshape(-1, self.count).T}

    def update(self, arrays: dict[str, np.ndarray], step_dt: float) -> bool:
        """Record the rewards and terminations of a policy step; return False."""
        self._rewards.append(arrays["rewards"].copy())
        self._endings.append(arrays["termination"].copy())
        return False

    @property
    def rewards(self) -> dict[str, np.ndarray]:
        """Reward of each term in every step of all worlds, (steps, num_envs), by name."""
        values = np.stack(self._rewards)
        return {term.name: values[..., i] for i, term in enumerate(self.task.rewards)}

    @property
    def endings(self) -> dict[str, float]:
        """Share of the ended episodes that each termination ended, by name; 0 of all if none ended."""
        ended = np.concatenate(self._endings)
        count = max(int((ended >= 0).sum()), 1)
        return {name: float((ended == i).sum()) / count for i, name in enumerate(self.task.termination_names)}

    @property
    def num_ended(self) -> int:
        """Number of ended episodes."""
        return int((np.concatenate(self._endings) >= 0).sum())

    def columns(self) -> dict[str, list]:
        """Return no columns: the log has no trials."""
        return {}

    def series(self) -> dict[str, np.ndarray]:
        """Return the base's present height [m], (num_envs,); {} stands for a robot's name.

        The recorder adds the reward terms of the first robot.
        """
        return {"height/base, {} [m]": self.arrays["base_pos"][:, 2]}


def actor(agent: str, env: Env, seed: int) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return an agent's function from observations, which it ignores, to actions (num_envs, 12)."""
    import torch

    from jumper_warp.sim.simulation import motor_values

    generator = np.random.default_rng(seed)
    held = torch.zeros(env.num_envs, 12, device=env.device)
    lateral, transversal = (math.radians(scale) for scale in env.task.action_scale)
    first = np.ones(env.num_envs, dtype=bool)

    def act(_: torch.Tensor) -> torch.Tensor:
        """Return the next actions."""
        if agent == "random":
            actions = generator.uniform(-1.0, 1.0, (env.num_envs, 12)).astype(np.float32)
            return torch.from_numpy(actions).to(env.device)
        if agent == "hold":
            begun = np.flatnonzero((env.episodes.done.numpy() != 0.0) | first)
            first[:] = False
            angles = motor_values(env.sim.joint_q()[begun][:, 7:]) - env.robot.default_angle.numpy()
            pose = angles / np.tile([lateral, transversal, transversal], 4)
            held[begun] = torch.from_numpy(pose.clip(-1.0, 1.0).astype(np.float32)).to(env.device)
        return held

    return act


def play_agent(task: TaskCfg, cfg: AgentCfg) -> Path:
    """Run an agent in a task, print and write the statistics of its terms, and return the recording's path.

    Raises InputError: no such device; OSError: the folder cannot be created.
    """
    from jumper_warp.envs.env import Env
    from jumper_warp.envs.gradient_check import GradientCheck
    from jumper_warp.evaluation.recorder import EnvRecorder, save_recording
    from jumper_warp.utils.runtime import configure_device

    configure_device(cfg.device)
    env = Env(task, cfg.num_envs, seed=cfg.seed, device=cfg.device, randomize=cfg.randomize)
    log = AgentLog(task, cfg.num_envs, cfg.seconds)
    recorder = EnvRecorder(env, log, [0], notes={"task": task.name, "policy": f"agent {cfg.agent}"})
    act = actor(cfg.agent, env, cfg.seed)
    if cfg.check_gradients:
        env.reset()
        with env.gradients() as gradients:
            check = GradientCheck(gradients)
            every = min(10, round(cfg.seconds / env.step_dt))
            run_evaluation(act, env, log, on_step=lambda: (recorder(), check.every(every)))
        print_gradients(check)
    else:
        run_evaluation(act, env, log, on_step=recorder)
    folder = output_dir("play", cfg.out)
    metrics = agent_metrics(log)
    write_metrics(folder, metrics, {"task": task.name, "agent": cfg.agent, "seconds": cfg.seconds, "seed": cfg.seed})
    print_statistics(log)
    recording = recorder.recording()
    path = save_recording(recording, folder, "agent")
    print(path, *([] if cfg.film.video is None else [cfg.film.write(recording)]), sep="\n")
    open_viewer(path, cfg.viewer)
    return path


def print_gradients(check: GradientCheck) -> None:
    """Print a table of the gradients of the reward terms, and what is wrong with them."""
    table = Table(Column("gradient of the reward", no_wrap=True), "not zero", "at a kink", "fault", box=None)
    faults = check.faults()
    kinks = check.kinks()
    for name, (found, _) in check.results().items():
        share = 100.0 * (found != 0.0).mean()
        table.add_row(name, f"{share:.1f} %", f"{100.0 * kinks[name]:.1f} %", faults.get(name, ""))
    print_table(table)


def agent_metrics(log: AgentLog) -> Metrics:
    """Return range and share of non-zero values of each reward term, and the share of each termination."""
    metrics = {}
    for name, values in log.rewards.items():
        for key, value in (("min", values.min()), ("max", values.max()), ("nonzero_rate", (values != 0.0).mean())):
            metrics[f"reward_{name}_{key}"] = MetricValue(float(value), values.size, None, "steps")
    for name, share in log.endings.items():
        metrics[f"ended_by_{name}_rate"] = MetricValue(share, log.num_ended, None, "episodes")
    return metrics


def print_statistics(log: AgentLog) -> None:
    """Print a table of the reward terms and one of the terminations."""
    table = Table(Column("reward, per step", no_wrap=True), "smallest", "largest", "mean", "not zero", box=None)
    for name, values in log.rewards.items():
        numbers = (f"{value + 0.0:.3g}" for value in (values.min(), values.max(), values.mean()))
        table.add_row(name, *numbers, f"{100.0 * (values != 0.0).mean():.1f} %")
    print_table(table)
    table = Table(Column(f"termination, of {log.num_ended} episodes", no_wrap=True), "share", box=None)
    for name, share in log.endings.items():
        table.add_row(name, f"{100.0 * share:.1f} %")
    print_table(table)
