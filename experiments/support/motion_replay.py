"""A motion replayed from its targets in the simulation that trains policies, followed at every physics step."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from jumper_warp.evaluation.film import ankles
from jumper_warp.kernels.collision.robot import collision_kernel
from jumper_warp.kernels.layout import COORDS
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.model import MOTOR_JOINTS, build_model
from jumper_warp.robot.motors import FilterCfg, MotorCfg
from jumper_warp.sim.simulation import Simulation, motor_values
from jumper_warp.tasks.jump.references import COLUMNS, ROWS

CONTACT_FORCE = 0.1
"""[N] Above it a paw is in contact."""
SPEED = 0.25
"""[m/s] Of the base upward, with which a jump takes off."""
LONGEST_PUSH = 0.15
"""[s] From the deepest squat until the first paw lifts, at most."""
FRICTION, PAW_RADIUS = 0.85, 0.025
"""[1] Of the paws, [m]."""


class Replay:
    """A motion in one world of the simulation that trains policies, in single precision, at every physics step."""

    def __init__(
        self,
        targets: np.ndarray,
        motors: MotorCfg,
        command_filter: FilterCfg,
        *,
        friction: float = FRICTION,
        device: str | None = None,
        notes: dict[str, Any] | None = None,
    ) -> None:
        """Simulate targets [rad] (steps, 12) from standing."""
        from jumper_warp.viz.recorder import Recorder

        self.sim = Simulation(
            1, motors=motors, command_filter=command_filter, friction=friction, device=device
        )  # fmt: skip
        self.targets, self.recorder = targets, Recorder(self.sim.model, notes=notes)
        rows: list[tuple] = []
        self.states: list[tuple[np.ndarray, np.ndarray]] = []
        self.poses: list[np.ndarray] = []
        self.flags, self.work = 0, 0.0
        for target in targets:
            self.sim.set_targets(target)
            self.sim.filter_targets()
            for _ in range(self.sim.substeps):
                rows.append(self._physics_step(len(rows)))
            self._record(rows[-1])
        (
            self.time,
            self.height,
            self.up,
            self.force,
            self.gap,
            self.tilt,
            self.power,
            self.angle,
            self.torque,
            self.base,
        ) = (np.array(column) for column in zip(*rows, strict=True))
        self._follow()

    def _physics_step(self, number: int) -> tuple:
        sim = self.sim
        before = motor_values(sim.joint_qd()[0, 6:])
        sim.physics_step()
        q, qd = sim.joint_q()[0], sim.joint_qd()[0]
        torque = sim.torque.numpy()[:, 0].copy()
        power = torque * 0.5 * (before + motor_values(qd[6:]))
        force = np.linalg.norm(sim.paw_force.numpy()[:, 0], axis=1)
        pose = sim.state.body_q.numpy().copy()
        tilt = math.acos(min(1.0, 1.0 - 2.0 * (q[3] ** 2 + q[4] ** 2)))
        gap = ankles(pose[None])[0, :, 2] - PAW_RADIUS
        velocity = sim.base_velocity()[0]
        paws = ankles(pose[None])[0, :, 0].mean()
        base = (q[0] - paws, q[2], 2.0 * math.atan2(q[4], q[6]), velocity[0], velocity[2], qd[4])
        return (
            (number + 1) * sim.dt, q[2], velocity[2], force, gap, tilt, np.maximum(power, 0.0).sum(),
            motor_values(q[7:]), torque, base,
        )  # fmt: skip

    def _record(self, row: tuple) -> None:
        sim = self.sim
        pose = sim.state.body_q.numpy().copy()
        self.poses.append(pose)
        self.states.append((sim.joint_q()[0].copy(), sim.joint_qd()[0].copy()))
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
        self.recorder.record(row[0], sim.state.body_q, series, ankles(pose[None])[0], sim.paw_force.numpy()[:, 0])

    def _follow(self) -> None:
        """Find takeoff, apex and what happens after touchdown."""
        down = self.force > CONTACT_FORCE
        ticks = slice(self.sim.substeps - 1, None, self.sim.substeps)
        free = ~down[ticks].any(axis=1) & (self.up[ticks] > SPEED)
        self.takeoff = int(free.argmax()) + 1 if free.any() else len(free)
        """Policy step at whose end the robot is off the ground; the last where it never is."""
        first = self.takeoff * self.sim.substeps
        self.work = float(self.sim.dt * self.power[:first].sum())
        """[J] Positive, of the motors until takeoff."""
        landing = np.flatnonzero(down[first:].any(axis=1))
        self.apex = float(self.height[first - 1 : first + landing[0] if len(landing) else None].max())
        """[m] Highest base before a paw comes down."""
        ups = np.diff(self.up[ticks][max(self.takeoff - 1, 0) :], prepend=self.up[ticks][max(self.takeoff - 1, 0)])
        self.hardest = float(ups.max() / (self.sim.substeps * self.sim.dt * EARTH))
        """[g] Largest upward acceleration of the base over a policy step after takeoff."""
        self.longest_lift, self.highest_lift, self.touched = 0.0, 0.0, 0
        """[s] and [m] Of a paw that had come down after the flight; how many have."""
        for leg in range(4):
            later = np.flatnonzero(down[first:, leg])
            if len(later):
                off = ~down[first + later[0] :, leg]
                edges = np.flatnonzero(np.diff(np.concatenate([[False], off, [False]]).astype(int)))
                self.longest_lift = max(self.longest_lift, self.sim.dt * max(np.diff(edges)[::2], default=0.0))
                self.highest_lift = max(self.highest_lift, float((self.gap[first + later[0] :, leg] * off).max()))
                self.touched += 1

    def reference(self, distance: float) -> dict[str, Any]:
        """Return the base's motion from the deepest squat until a paw lifts for good, as `assets/motions` holds it.

        distance: [m] that the jump flies, from its start.
        """
        first = self.takeoff * self.sim.substeps
        end = int(np.flatnonzero((self.force[:first] > CONTACT_FORCE).all(axis=1))[-1])
        begin = max(0, end - round(LONGEST_PUSH / self.sim.dt))
        begin += int(np.argmin(self.height[begin : end + 1]))
        places = np.linspace(begin, end, ROWS)
        moments = np.arange(len(self.base))
        rows = np.stack([np.interp(places, moments, column) for column in self.base.T], axis=1)
        middle = float(np.interp(0.5 * (begin + end), moments, self._paws_x()))
        return {
            "columns": list(COLUMNS), "seconds": (end - begin) * self.sim.dt, "distance_m": round(distance - middle, 4),
            "apex_m": round(self.apex, 4), "rows": [[round(float(x), 4) for x in row] for row in rows],
        }  # fmt: skip

    def _paws_x(self) -> np.ndarray:
        """Return the middle of the paws along x [m], at every physics step."""
        ticks = np.array([ankles(pose[None])[0, :, 0].mean() for pose in self.poses])
        return np.repeat(ticks, self.sim.substeps)

    def metrics(self) -> dict[str, Any]:
        """Return what is told of every jump."""
        return {
            "apex_m": self.apex, "takeoff_s": float(self.takeoff / 60.0), "landing_g": self.hardest,
            "work_j": self.work,
            "largest_tilt_deg": math.degrees(float(self.tilt.max())), "collisions": self.flags,
            "deepest_paw_mm": float(-1000.0 * self.gap.min()), "peak_torque_nm": float(np.abs(self.torque).max()),
        }  # fmt: skip

    def save_rrd(self, path: Path) -> None:
        """Write the recording."""
        self.recorder.save_rrd(path)

    def save_strip(self, path: Path, count: int = 8) -> None:
        """Draw the robot at evenly spaced moments from the push-off on."""
        from jumper_warp.viz.snapshot import Camera, contact_sheet

        first = max(self.takeoff - 20, 0)
        moments = np.linspace(first, len(self.poses) - 1, count).round().astype(int)
        model = build_model(1)
        state, pictures = model.state(), []
        for moment in moments:
            x = float(self.poses[moment][0, 0])
            state.body_q.assign(self.poses[moment])
            pictures.append(Camera(model, (x + 1.2, 2.0, 0.7), (x, 0.0, 0.5), (300, 400)).picture(state))
        contact_sheet(pictures, path, [f"{moment / 60:.2f} s" for moment in moments])
