"""Replay of a motion's targets in the simulation that trains policies, measured at every physics step."""

from __future__ import annotations

import math
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from jumper_warp.diff.rollout import compact
from jumper_warp.diff.torch_rollout import TorchTrajectory
from jumper_warp.evaluation.recorder import ankles
from jumper_warp.kernels.collision.robot import collision_kernel
from jumper_warp.kernels.layout import COORDS
from jumper_warp.robot.description import MOTOR_JOINTS
from jumper_warp.robot.gravity import EARTH
from jumper_warp.sim.simulation import Simulation, motor_values
from jumper_warp.trajectory.problem import Problem, SimulatedMotion
from jumper_warp.viz.plots import figure
from jumper_warp.viz.style import LEG_COLORS
from support.open_loop import largest_forces, plot_motors

CONTACT_FORCE = 0.1  # [N] Force above which a paw is in contact
TAKEOFF_SPEED = 0.25  # [m/s] Smallest upward speed of the base at takeoff
PAW_RADIUS = 0.025  # [m] Radius of a paw


class MotionReplay:
    """One world of the simulation that trains policies, in single precision, driven by the targets of a motion.

    The measured arrays have one row per physics step: time [s], height [m] and up (upward speed) [m/s] of the base,
    force (n, 4) [N] and gap (n, 4) [m] above the ground of the paws FL, FR, BL, BR, tilt [rad], power (positive,
    all motors) [W], angle (n, 12) [rad], torque (n, 12) [N m]. `_evaluate` documents the results.
    """

    def __init__(self, targets: np.ndarray, problem: Problem, *, notes: dict[str, Any] | None = None) -> None:
        """Simulate motor targets [rad], (policy steps, 12), from standing, with the robot and ground of a problem.

        notes: JSON metadata of the recording.
        """
        from jumper_warp.viz.recorder import Recorder

        self.problem = problem
        self.sim = Simulation(1, motors=problem.motors, command_filter=problem.command_filter,
                              friction=problem.friction, gravity=problem.gravity, device=problem.device)  # fmt: skip
        self.targets, self.recorder = targets, Recorder(self.sim.model, notes=notes)
        rows: list[tuple] = []
        self.states = [compact(self.sim.joint_q(), self.sim.joint_qd())]
        self.impulses: list[np.ndarray] = []
        self.flags, self.work = 0, 0.0
        for target in targets:
            self.sim.set_targets(target)
            self.sim.filter_targets()
            for _ in range(self.sim.substeps):
                rows.append(self._physics_step(len(rows)))
            self._record(rows[-1])
        columns = (np.array(column) for column in zip(*rows, strict=True))
        (self.time, self.height, self.up, self.force, self.gap, self.tilt, self.power, self.angle,
         self.torque) = columns  # fmt: skip
        self._evaluate()

    def _physics_step(self, number: int) -> tuple:
        """Advance by a physics step, and return the measurements after it, a row of the measured arrays.

        number: of physics steps before it.
        """
        sim = self.sim
        before = motor_values(sim.joint_qd()[0, 6:])
        sim.physics_step()
        q, qd = sim.joint_q()[0], sim.joint_qd()[0]
        torque = sim.torque.numpy()[:, 0].copy()
        power = torque * 0.5 * (before + motor_values(qd[6:]))
        self.impulses.append(sim.dt * sim.paw_force.numpy())
        force = np.linalg.norm(sim.paw_force.numpy()[:, 0], axis=1)
        pose = sim.state.body_q.numpy().copy()
        tilt = math.acos(min(1.0, 1.0 - 2.0 * (q[3] ** 2 + q[4] ** 2)))
        gap = ankles(pose[None])[0, :, 2] - PAW_RADIUS
        return (
            (number + 1) * sim.dt, q[2], sim.base_velocity()[0, 2], force, gap, tilt, np.maximum(power, 0.0).sum(),
            motor_values(q[7:]), torque,
        )  # fmt: skip

    def _record(self, row: tuple) -> None:
        """Record a policy step: state, link poses, collision flags and a frame of the recording.

        row: measurements of its last physics step.
        """
        sim = self.sim
        pose = sim.state.body_q.numpy().copy()
        self.states.append(compact(sim.joint_q(), sim.joint_qd()))
        flags, clearance = wp.zeros(1, dtype=int, device=sim.device), wp.zeros(1, dtype=float, device=sim.device)
        robot = sim.physics.dynamics.robot
        wp.launch(
            collision_kernel, dim=1, inputs=[robot.geometry, robot.ground, sim.state.joint_q, COORDS, 0.0],
            outputs=[flags, clearance], device=sim.device,
        )  # fmt: skip
        self.flags |= int(flags.numpy()[0])
        series = {"base/height [m]": row[1], "base/vertical speed [m s⁻¹]": row[2]}
        for i, name in enumerate(MOTOR_JOINTS):
            series |= {f"torque/{name} [N m]": row[8][i], f"angle/{name} [deg]": math.degrees(row[7][i])}
        forces = largest_forces(np.array(self.impulses[-sim.substeps :])[:, :, 0] / sim.dt)
        self.recorder.record(row[0], sim.state.body_q, series, ankles(pose[None])[0], forces)

    def _evaluate(self) -> None:
        """Compute the jump's takeoff, work, apex, landing acceleration, and paws lifted after touchdown."""
        down = self.force > CONTACT_FORCE
        ticks = slice(self.sim.substeps - 1, None, self.sim.substeps)
        free = ~down[ticks].any(axis=1) & (self.up[ticks] > TAKEOFF_SPEED)
        self.takeoff = int(free.argmax()) + 1 if free.any() else len(free)
        """Policy step at whose end the robot is off the ground; the last if it never is."""
        first = self.takeoff * self.sim.substeps
        self.work = float(self.sim.dt * self.power[:first].sum())  # [J] Positive work of the motors until takeoff
        landing = np.flatnonzero(down[first:].any(axis=1))
        self.apex = float(self.height[first - 1 : first + landing[0] if len(landing) else None].max())
        """[m] Largest base height before a paw touches down."""
        ups = np.diff(self.up[ticks][max(self.takeoff - 1, 0) :], prepend=self.up[ticks][max(self.takeoff - 1, 0)])
        self.hardest = float(ups.max() / (self.sim.substeps * self.sim.dt * EARTH))
        """[g] Largest upward acceleration of the base over a policy step after takeoff, g of Earth."""
        self.longest_lift, self.highest_lift, self.touched = 0.0, 0.0, 0
        """[s] and [m] Longest time and largest height of a paw lifted after touchdown; number of paws that touched."""
        for leg in range(4):
            later = np.flatnonzero(down[first:, leg])
            if len(later):
                off = ~down[first + later[0] :, leg]
                edges = np.flatnonzero(np.diff(np.concatenate([[False], off, [False]]).astype(int)))
                self.longest_lift = max(self.longest_lift, self.sim.dt * max(np.diff(edges)[::2], default=0.0))
                self.highest_lift = max(self.highest_lift, float((self.gap[first + later[0] :, leg] * off).max()))
                self.touched += 1

    @cached_property
    def motion(self) -> SimulatedMotion:
        """Return the replay as a `SimulatedMotion`, the argument of objectives and constraints."""
        q, qd = (np.stack(column) for column in zip(*self.states, strict=True))
        parts = q, qd, self.torque[..., None], np.stack(self.impulses), self.targets[..., None]
        device = str(self.problem.rollout(1).device)
        return self.problem.motion_of(TorchTrajectory(*(torch.as_tensor(x, dtype=torch.float64, device=device)
                                                       for x in parts)))  # fmt: skip

    @property
    def violation(self) -> float:
        """Largest violation of a constraint of the problem by the replay, in its unit, at least 0."""
        constraints = self.problem.values(self.motion).constraints
        return max(0.0, float(constraints.max())) if constraints.shape[1] else 0.0

    def metrics(self) -> dict[str, Any]:
        """Return the metrics of the jump, with units at the end of the names; `collisions`: bit flags of contacts."""
        return {
            "apex_m": self.apex, "takeoff_s": float(self.takeoff / 60.0), "landing_g": self.hardest,
            "work_j": self.work,
            "largest_tilt_deg": math.degrees(float(self.tilt.max())), "collisions": self.flags,
            "deepest_paw_mm": float(-1000.0 * self.gap.min()), "peak_torque_nm": float(np.abs(self.torque).max()),
        }  # fmt: skip


def plot_replays(replays: dict[str, MotionReplay], path: Path) -> None:
    """Plot height, angles and torques of two legs, and paw forces over time into a file; replays: a column by label."""
    with figure(path, 4, len(replays), figsize=(5.0 * len(replays), 11), sharex="col", squeeze=False) as axes:
        for column, (label, replay) in zip(axes.T, replays.items(), strict=True):
            column[0].plot(replay.time, replay.height)
            column[0].axvline(replay.takeoff / 60.0, color="0.4", linestyle=":", label="takeoff")
            plot_motors(column[1:3], replay.time, replay.angle, replay.torque)
            for i, leg in ((0, "FL"), (2, "BL")):
                column[3].plot(replay.time, replay.force[:, i], color=LEG_COLORS[leg], label=f"{leg} paw")
            column[0].set_title(label)
            column[3].set_xlabel("time [s]")
        labels = ("base height [m]", "motor angle [deg]", "motor torque [N m]", "paw force [N]")
        for axis, label in zip(axes[:, 0], labels, strict=True):
            axis.set_ylabel(label)
