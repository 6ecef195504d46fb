"""The paper's test of the vertical jump: a policy jumps to heights spread evenly over 0.5 to 1.2 m, each once.

    python experiments/vertical_jump_sweep.py --policy vertical_jump --jumps 200 --out outputs/sweep

Every robot stands in the default pose and is told to jump after half a second. A jump succeeds if the highest base
height is within 0.1 m of the commanded one. A landing is good if nothing but the paws touched anything, the base
stayed within 10° of level and was at rest a second after touchdown. A fall or a collision ends a jump: what it had
reached before counts. `--randomize` adds the randomisation, noise and latency of the training; `--solver mujoco` is a
check against physics that the policy was not trained on.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import matplotlib
import numpy as np
import torch
import tyro
import warp as wp
from rich.console import Console
from rich.table import Table

from jumper_warp.env import JumpEnv
from jumper_warp.evaluate import COLLIDED, REST_SPEED, Jumps, check_task, run_jumps
from jumper_warp.figures import output_dir, write_figures
from jumper_warp.policy import Policy
from jumper_warp.runtime import report_device
from jumper_warp.saved_run import open_policy, restored_task
from jumper_warp.solver import SolverJumper

matplotlib.use("Agg")
import matplotlib.pyplot as plt

LOWER, UPPER = 0.5, 1.2
"""[m] Commanded base heights."""
NEAR = 0.1
"""[m] A jump that comes this close succeeds."""
LEVEL = 10.0
"""[deg] A good landing tilts the base less."""
OPEN_LOOP_LIMIT = 1.0748
"""[m] Highest base height that `open_loop_jump.py` reaches at 18 N m; the paper's robot reached 1.075 m."""
ENDS = ("success", "came_apart", "low_base", "tilted", "collided", "no_jump", "too_long")
"""Rules of the task that end a jump here; the others only shape the training."""
FALLS = ("low_base", "tilted")
PAPER = {"mean_abs_error_m": 0.04, "success_rate": 0.91, "success_rate_in_range": 1.0}
"""The paper's figures for this test, in its simulation."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    policy: str = "vertical_jump"
    """Name or folder of a policy, a run's folder, or a checkpoint."""
    solver: Literal["jumper", "mujoco"] = "jumper"
    """Physics: the dedicated solver, or Newton's SolverMuJoCo."""
    jumps: int = 200
    """Number of jumps, one world each."""
    randomize: bool = False
    """Randomisation, observation noise, latency and pushes as in training."""
    seed: int = 0
    """Of these."""
    record: int = 5
    """Number of jumps to record for the Rerun viewer and, one of them, as a filmstrip; 0: none."""
    out: Path | None = None
    """Folder for figures, plot, recording and filmstrip (default: outputs/vertical_jump_sweep/<time>)."""
    device: str | None = None
    """Warp device."""

    def __post_init__(self) -> None:
        """Check the values."""
        if not 0 <= self.record <= self.jumps or self.jumps < 3:
            raise ValueError(f"need 0 <= record <= jumps and at least 3 jumps, got {self.record}, {self.jumps}")


def make_env(policy: Policy, args: Args) -> JumpEnv:
    """Return the environment that the policy was trained in, with this test's ends of a jump."""
    task = restored_task(policy.config)
    task = replace(task, rules=tuple(rule for rule in task.rules if rule.name in ENDS))
    return JumpEnv(
        task,
        args.jumps,
        seed=args.seed,
        device=args.device,
        solver=args.solver,
        randomize=args.randomize,
        noise=args.randomize,
        auto_reset=False,
    )


class Observer:
    """Acts with the policy and watches: who jumped before being told to, and what some of the robots look like."""

    def __init__(self, policy: Policy, env: JumpEnv, targets: np.ndarray, count: int) -> None:
        """Record `count` of the worlds, evenly chosen; targets: (num_envs,) commanded heights [m]."""
        self.policy, self.env = policy, env
        self.worlds = np.linspace(0, env.num_envs - 1, count).round().astype(int)
        self.targets = targets[self.worlds]
        self.early = np.zeros(env.num_envs, dtype=bool)
        self.steps = 0
        self.command_step = 0
        if count == 0:
            return
        from jumper_warp.recording import Recorder  # not needed on a machine without viewer and meshes
        from jumper_warp.robot import build_model

        self.model = build_model(count)
        self.recorder = Recorder(self.model, range(count), spacing=1.2, notes={"targets_m": self.targets.tolist()})

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the actions, as `Policy.act`."""
        if self.steps == 0:
            self.command_step = int(self.env.task_arrays()["command_step"][0])
        if self.steps == self.command_step:
            self.early = self.env.task_arrays()["phase"] != 0
        if len(self.worlds):
            self._record()
        self.steps += 1
        return self.policy.act(obs)

    def _record(self) -> None:
        from jumper_warp.play import ankles

        sim, state = self.env.sim, self.env.sim.state
        if isinstance(sim.solver, SolverJumper):
            sim.solver.dynamics.full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)
        poses = state.body_q.numpy().reshape(sim.num_worlds, -1, 7)[self.worlds]
        series = {}
        for world, target, base in zip(self.worlds, self.targets, poses[:, 0], strict=True):
            series[f"height/base of jump {world} [m]"] = base[2]
            series[f"height/target of jump {world} [m]"] = target
        forces = sim.paw_force.numpy().transpose(1, 0, 2)[self.worlds]
        now = (self.steps + 1) * self.env.step_dt
        self.recorder.record(now, poses.reshape(-1, 7), series, ankles(poses), forces)

    def save(self, folder: Path) -> None:
        """Write `jumps.rrd` and the filmstrip of the jump closest to 1 m."""
        from jumper_warp.snapshot import Camera, contact_sheet

        recording = self.recorder.recording()
        recording.save_rrd(folder / "jumps.rrd")
        index = int(np.argmin(np.abs(self.targets - 1.0)))
        height = recording.poses[:, index * len(recording.bodies) // len(self.worlds), 2]
        frames = moments(height, self.command_step)
        camera = Camera(self.model, (1.5, 2.0, 0.9), (0.0, 0.0, 0.55), (320, 420), world=index)
        state, pictures = self.model.state(), []
        for frame in frames:
            state.body_q.assign(recording.poses[frame])
            pictures.append(camera.picture(state))
        captions = [f"{recording.times[frame]:.2f} s, {height[frame]:.2f} m" for frame in frames]
        contact_sheet(pictures, folder / f"jump_{self.targets[index]:.2f}_m.png", captions)


def moments(height: np.ndarray, command: int) -> list[int]:
    """Return the frames of a filmstrip: command, squat, push-off, apex, fall, catch, end; height (frames,) [m]."""
    command = min(command, len(height) - 1)
    apex = command + int(np.argmax(height[command:]))
    squat = command + int(np.argmin(height[command : apex + 1]))
    catch = apex + int(np.argmin(height[apex : apex + 60]))
    push = squat + int(np.argmax(height[squat : apex + 1] >= 0.5 * (height[squat] + height[apex])))
    return [command, squat, push, apex, (apex + catch) // 2, catch, len(height) - 1]


def figures(jumps: Jumps, early: np.ndarray) -> dict:
    """Return the figures of the sweep; early: (jumps,) whether a jump was begun before the command."""
    target, error = jumps.target, np.abs(jumps.error)
    near = (error <= NEAR) & ~early
    tilt = np.where(np.isnan(error), 0.0, np.degrees(jumps.tilt))
    landed = jumps.success & (tilt < LEVEL) & (jumps.rest_speed < REST_SPEED)

    def share(what: np.ndarray, lower: float, upper: float) -> float:
        # Half a millimetre, so that evenly spaced targets do not fall out by rounding.
        return float(what[(target >= lower - 5e-4) & (target <= upper + 5e-4)].mean())

    reachable = OPEN_LOOP_LIMIT + NEAR
    return {
        "jumps": len(target),
        "mean_abs_error_m": float(np.nanmean(error)),
        "mean_abs_error_in_range_m": float(np.nanmean(error[target <= 1.1 + 5e-4])),
        "mean_error_m": float(np.nanmean(jumps.error)),
        "success_rate": float(near.mean()),
        "success_rate_in_range": share(near, 0.5, 1.1),
        "success_rate_0_6_1_1": share(near, 0.6, 1.1),
        "success_rate_reachable": share(near, LOWER, reachable),
        "reachable_share": float((target <= reachable).mean()),
        "largest_reached_m": float(np.nanmax(jumps.error + target)),
        "open_loop_limit_m": OPEN_LOOP_LIMIT,
        "success_and_landing_rate": float((near & landed).mean()),
        "landing_rate": float(landed.mean()),
        "collision_rate": float((jumps.outcomes == COLLIDED).mean()),
        "fall_rate": float(np.isin(jumps.outcomes, FALLS).mean()),
        "no_jump_rate": float((jumps.outcomes == "no_jump").mean()),
        "early_rate": float(early.mean()),
        "at_rest_within_1_s_rate": float((jumps.rest_speed < REST_SPEED).mean()),
        "largest_tilt_deg": float(tilt.max()),
        "came_apart": int(np.isnan(jumps.error).sum()),
    }


def plot(jumps: Jumps, path: Path, title: str) -> None:
    """Draw reached over commanded height."""
    line = np.array([LOWER, UPPER])
    near = np.abs(jumps.error) <= NEAR
    fig, axis = plt.subplots(figsize=(6, 5.5), constrained_layout=True)
    axis.fill_between(line, line - NEAR, line + NEAR, color="tab:green", alpha=0.12, label=f"within {NEAR:g} m")
    axis.plot(line, line, color="tab:green", linewidth=1.0, label="commanded")
    axis.axhline(OPEN_LOOP_LIMIT, color="0.5", linestyle="--", linewidth=1.0, label="open-loop jump, 18 N m")
    axis.scatter(jumps.target[near], jumps.apex[near], s=9, color="tab:blue", label="reached")
    axis.scatter(jumps.target[~near], jumps.apex[~near], s=14, color="tab:red", marker="x", label="missed")
    axis.set(xlabel="commanded base height [m]", ylabel="highest base height [m]", title=title)
    axis.legend(loc="upper left")
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main(args: Args) -> dict:
    """Run the sweep and return its figures."""
    wp.config.log_level = wp.LOG_WARNING
    report_device(args.device)
    start = time.perf_counter()
    policy = open_policy(args.policy)
    check_task(policy.interface.task)
    env = make_env(policy, args)
    policy.to(env.device)
    targets = np.linspace(LOWER, UPPER, args.jumps)
    observer = Observer(policy, env, targets, args.record)
    jumps = run_jumps(observer.act, env, targets)
    conditions = {"solver": args.solver, "randomize": args.randomize, "seed": args.seed}
    values = conditions | {"torque_limit_nm": env.task.motors.transversal.saturation} | figures(jumps, observer.early)
    folder = output_dir("vertical_jump_sweep", args.out)
    write_figures(folder, values)
    title = f"{args.jumps} jumps, {args.solver}, {'randomised' if args.randomize else 'nominal'}"
    plot(jumps, folder / "sweep.png", title)
    if args.record:
        observer.save(folder)
    table = Table("figure", title, "paper")
    for name, value in values.items():
        table.add_row(name, f"{value:.4g}" if isinstance(value, float) else str(value), str(PAPER.get(name, "")))
    Console().print(table)
    print(f"{time.perf_counter() - start:.1f} s; figures, plot and recordings in {folder}")
    return values


if __name__ == "__main__":
    main(tyro.cli(Args))
