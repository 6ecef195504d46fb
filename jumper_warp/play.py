"""Playing a policy: jumps to heights from the command line, as a recording for the Rerun viewer."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from jumper_warp.evaluate import Jumps, check_task
from jumper_warp.figures import output_dir, write_figures
from jumper_warp.recording import Recorder
from jumper_warp.robot import LEGS, MOTOR_JOINTS
from jumper_warp.saved_run import Conditions, env_of_policy, open_policy
from jumper_warp.solver import SolverJumper

if TYPE_CHECKING:
    from jumper_warp.env import JumpEnv

SPACING = 1.2
"""[m] Between robots in the picture."""
SHANK_LENGTH = 0.3
"""[m] From the knee to the ankle, along the shank's -z."""
MAX_ROBOTS = 64


@dataclass(frozen=True)
class PlayCfg:
    """Let a policy jump, and record it."""

    policy: tyro.conf.Positional[str]
    """Name or folder of a policy, a run's folder, or a checkpoint."""
    height: tuple[float, ...] = (0.6, 0.9, 1.1)
    """[m] Commanded base heights, one robot each."""
    seconds: float = 3.5
    """[s] Length of the recording; the jump is commanded after half a second."""
    conditions: Annotated[Conditions, tyro.conf.arg(name="")] = field(default_factory=Conditions)
    """What the policy is tried in."""
    out: Path | None = None
    """Folder for jump.rrd and figures.json (default: outputs/play/<time>)."""
    viewer: Literal["none", "rerun"] = "none"
    """Open the recording in Rerun's viewer, which then listens on this machine's loopback address only."""

    def __post_init__(self) -> None:
        """Raises ValueError: a setting is out of range."""
        if not 1 <= len(self.height) <= MAX_ROBOTS or not all(0.0 < height < 10.0 for height in self.height):
            raise ValueError(f"height takes 1 to {MAX_ROBOTS} numbers in (0, 10) m, got {self.height}")
        if not 0.0 < self.seconds <= 600.0:
            raise ValueError(f"seconds must be in (0, 600], got {self.seconds}")


def play(cfg: PlayCfg) -> Path:
    """Simulate the jumps, write `jump.rrd` and `figures.json`, print a table; return the path of the recording.

    Raises:
        PolicyError: The policy cannot be used, or does not jump vertically.
        CheckpointError: The checkpoint cannot be used.
    """
    policy = open_policy(cfg.policy)
    check_task(policy.interface.task)
    env = env_of_policy(policy, len(cfg.height), cfg.conditions, visuals=True)
    policy.to(env.device)
    goals = np.zeros((env.num_envs, 3), dtype=np.float32)
    goals[:, 2] = cfg.height
    env.evaluation_reset(goals)
    notes = {"task": policy.interface.task, "heights_m": cfg.height, "solver": cfg.conditions.solver}
    recorder = Recorder(env.sim.model, range(env.num_envs), spacing=SPACING, notes=notes)
    jumps = Jumps(np.array(cfg.height), tuple(rule.name for rule in env.task.rules))
    for tick in range(1, round(cfg.seconds / env.step_dt) + 1):
        env.step(policy.act(env.obs))
        jumps.update(env.task_arrays(), env.step_dt)
        record_frame(recorder, env, tick * env.step_dt, cfg.height)
    folder = output_dir("play", cfg.out)
    path = recorder.save_rrd(folder / "jump.rrd")
    write_figures(folder, jump_columns(jumps))
    print_jumps(jumps)
    Console(stderr=True).print(str(path), highlight=False, soft_wrap=True)
    if cfg.viewer == "rerun":
        subprocess.run(viewer_command(path), check=False)
    return path


def record_frame(recorder: Recorder, env: JumpEnv, time: float, heights: tuple[float, ...]) -> None:
    """Add the environment's state to a recording; motors are those of the first world. time [s], heights [m]."""
    sim = env.sim
    if isinstance(sim.solver, SolverJumper):
        sim.solver.dynamics.full_state(sim.state.joint_q, sim.state.joint_qd, sim.state.body_q, sim.state.body_qd)
    poses = sim.state.body_q.numpy()
    base_height = sim.joint_q()[:, 2]
    torque, action = sim.torque.numpy()[:, 0], env.action[0].cpu().numpy()
    series: dict[str, float] = {}
    for world, height in enumerate(heights):
        series[f"height/base of {world} [m]"] = base_height[world]
        series[f"height/target of {world} [m]"] = height
    for i, name in enumerate(MOTOR_JOINTS):
        series[f"torque/{name} [N m]"] = torque[i]
        series[f"action/{name} [1]"] = action[i]
    forces = sim.paw_force.numpy().transpose(1, 0, 2)
    recorder.record(time, poses, series, ankles(poses.reshape(env.num_envs, -1, 7)), forces)


def ankles(poses: np.ndarray) -> np.ndarray:
    """Return the ankles [m], world frame, (num_worlds, 4, 3), from the poses (num_worlds, 21, 7) of all links."""
    shanks = poses[:, 5 * np.arange(1, len(LEGS) + 1)]
    x, y, z, w = np.moveaxis(shanks[..., 3:], -1, 0)
    axis = np.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)], axis=-1)
    return shanks[..., :3] - SHANK_LENGTH * axis


def viewer_command(path: Path) -> list[str]:
    """Return the command that shows a recording and listens on loopback only."""
    return [sys.executable, "-m", "rerun", str(path), "--bind", "127.0.0.1"]


def jump_columns(jumps: Jumps) -> dict[str, list]:
    """Return targets and apexes [m] and the ends, for `write_figures`."""
    apex = [float(height) if np.isfinite(height) else None for height in jumps.apex]
    return {"target_m": jumps.target.tolist(), "apex_m": apex, "end": jumps.outcomes.tolist()}


def print_jumps(jumps: Jumps) -> None:
    """Print one line a jump to standard output."""
    table = Table("target [m]", "apex [m]", "error [m]", "end", box=None)
    for target, apex, end in zip(jumps.target, jumps.apex, jumps.outcomes, strict=True):
        table.add_row(f"{target:.3f}", f"{apex:.3f}", f"{apex - target:+.3f}", str(end))
    Console().print(table)
