"""Recorded targets replayed in many worlds, each with parameters and a start of its own, in double precision."""

from __future__ import annotations

import importlib
import itertools
import math
import threading
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import warp as wp

from jumper_warp.kernels.layout import (
    ARMATURE,
    BASE,
    BODIES,
    COORDS,
    DOFS,
    FRICTION,
    GRAVITY,
    KNEE_DAMPING,
    LEG_ROWS,
    MOMENT_ROWS,
    MU_DYNAMIC,
    MU_STATIC,
    SPRING,
)
from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.model import build_model
from jumper_warp.robot.motors import OVERSPEED_END, OVERSPEED_START, MotorCfg
from jumper_warp.robot.values import LINK_KINDS, RobotValues
from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.sim.precision import float64_kernels
from jumper_warp.sim.simulation import motor_values
from jumper_warp.sim.slices import Worlds
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.rotations import rotate
from jumper_warp.utils.threads import checked_threads, run_side_by_side

MAX_SWEEPS = 60
TOLERANCE = 1.0e-10
"""[m/s] Of the contact iteration, whose error differences inherit."""
STEPS_A_GRAPH = 12
"""Physics steps that one launch of a captured graph takes."""
HELD_MASS = 2.0**30
"""[kg], [kg m^2] Of a base that is held: its weight is exact in single precision, so that a wrench cancels it."""
_capturing = threading.Lock()
KIND_OF_MOTOR = np.tile([0, 1, 1], 4)
"""Kind of each motor."""


@dataclass
class Starts:
    """States at the first row, N worlds."""

    position: np.ndarray
    """(N, 3) [m] Of the base's origin, world frame."""
    quaternion: np.ndarray
    """(N, 4) xyzw."""
    velocity: np.ndarray
    """(N, 3) [m/s] Of the base's origin, world frame."""
    spin: np.ndarray
    """(N, 3) [rad/s] World frame."""
    angle: np.ndarray
    """(N, 12) [rad] True motor angles."""
    rate: np.ndarray
    """(N, 12) [rad/s]"""


@dataclass
class Record:
    """What happens in a replay: R rows, N worlds. True values, without the errors of sensors."""

    angle: np.ndarray
    """(R, 12, N) [rad]"""
    rate: np.ndarray
    """(R, 12, N) [rad/s]"""
    torque: np.ndarray
    """(R, 12, N) [N m]"""
    position: np.ndarray
    """(R, 3, N) [m]"""
    quaternion: np.ndarray
    """(R, 4, N) xyzw"""
    valid: np.ndarray
    """(N,) bool, whether the world stayed finite."""


class Replay:
    """Worlds that replay motor targets. It holds the arrays of `capacity` worlds; a call uses as many as it needs."""

    def __init__(
        self,
        capacity: int,
        *,
        description: RobotDescription | None = None,
        device: wp.DeviceLike = None,
        threads: int | None = None,
        tolerance: float = TOLERANCE,
    ):
        """Make the arrays; tolerance [m/s] of the contact iteration. Raises InputError as `build_model`."""
        self.description = load_description() if description is None else description
        model = build_model(capacity, description=self.description, visuals=False, device=device)
        self.dynamics = JumperDynamics(model, description=self.description, double=True)
        self.capacity, self.device = capacity, model.device
        self.threads = 1 if self.device.is_cuda else checked_threads(threads)
        self.tolerance, self.world_steps = tolerance, 0
        package = float64_kernels().__name__
        self._kernels = importlib.import_module(f"{package}.actuation.replay")
        real, n = wp.float64, capacity
        self._nominal_table = self.dynamics.robot.table.numpy()[:, :1].copy()
        self._q = wp.zeros(int(COORDS) * n, dtype=real, device=self.device)
        self._qd = wp.zeros(int(DOFS) * n, dtype=real, device=self.device)
        self._target = wp.zeros((12, n), dtype=real, device=self.device)
        self._latency = wp.zeros(n, dtype=real, device=self.device)
        self._clock = wp.zeros(max(self.threads, 1), dtype=int, device=self.device)
        self._wrench = wp.zeros(model.body_count, dtype=wp.spatial_vector, device=self.device)
        self._motors = self.dynamics.modules.motors.MotorArrays()
        for name in ("kp", "kd", "saturation", "peak", "cutoff_speed", "no_load_speed", "offset"):
            setattr(self._motors, name, wp.zeros((12, n), dtype=real, device=self.device))
        self._motors.fade_start, self._motors.fade_end = OVERSPEED_START, OVERSPEED_END
        self._record = wp.zeros((0, 0, 0), dtype=real, device=self.device)
        self._schedule = wp.zeros((0, 0), dtype=real, device=self.device)
        self._graphs: dict[tuple, list[tuple[int, Any]]] = {}
        self._load_kernels()
        self._no_force = wp.zeros(int(DOFS) * n, dtype=real, device=self.device)
        self._drive = self.dynamics.drive(self._no_force, self._wrench, self._motors, self._target)

    def _load_kernels(self) -> None:
        """Load all kernels, which a capture cannot."""
        modules = self.dynamics.modules
        parts = (modules.advance_legs if self.device.is_cuda else modules.advance, self._kernels)
        for part in parts:
            wp.load_module(part, device=self.device)

    def run(
        self,
        robots: RobotValues,
        starts: Starts,
        target: np.ndarray,
        *,
        rows: int,
        stride: int,
        dt: float,
        lead: int = 0,
        base: Literal["free", "fixed"] = "free",
        gains: Literal["jumping", "walking"] = "jumping",
        torque_limit: float = 18.0,
    ) -> Record:
        """Return what N worlds do.

        Args:
            robots: Of N worlds.
            starts: Of N worlds, without contact history.
            target: Motor targets [rad] of every physics step, (lead + steps, 12), held from step to step.
            rows: To record; row 0 is the start.
            stride: Physics steps from row to row.
            dt: Physics step [s].
            lead: Steps of `target` before the start, a multiple of the stride; a latency asks for them.
            base: "fixed" holds the base where it starts.
            gains: Of the description, which the ratios of `robots` scale.
            torque_limit: [N m] Likewise.

        Raises:
            InputError: more worlds than the capacity.
        """
        count = len(starts.angle)
        if not 1 <= count <= self.capacity:
            raise InputError(f"a replay of {self.capacity} worlds cannot run {count}")
        motors = MotorCfg.from_description(self.description, gains, torque_limit, torque_limit)
        self._write_motors(robots, motors, dt)
        self._write_table(robots, base == "fixed")
        self._write_starts(starts, robots)
        self.dynamics.work.impulse.zero_()
        self.dynamics.work.invalid.zero_()
        self._reserve(rows, len(target))
        self._schedule.assign(np.pad(target, ((0, self._schedule.shape[1] - len(target)), (0, 0)), mode="edge").T)
        self._clock.fill_(lead)
        slices = balanced(count, self.threads)
        jobs = [partial(self._replay, slot, part, rows, stride, dt, lead) for slot, part in enumerate(slices)]
        run_side_by_side(jobs, len(jobs))
        self.world_steps += count * (rows - 1) * stride
        values, valid = self._record.numpy()[:rows, :, :count], self.dynamics.work.invalid.numpy()[:count] == 0
        return Record(values[:, :12], values[:, 12:24], values[:, 24:36], values[:, 36:39], values[:, 39:43], valid)

    def _reserve(self, rows: int, steps: int) -> None:
        """Make room for a motion."""
        if rows > self._record.shape[0] or steps > self._schedule.shape[1]:
            rows, steps = max(rows, self._record.shape[0]), max(steps, self._schedule.shape[1])
            shape = (rows, int(self._kernels.RECORD_ROWS), self.capacity)
            self._record = wp.zeros(shape, dtype=wp.float64, device=self.device)
            self._schedule = wp.zeros((12, steps), dtype=wp.float64, device=self.device)
            self._graphs.clear()

    def _replay(self, slot: int, worlds: Worlds, rows: int, stride: int, dt: float, lead: int) -> None:
        """Run some of the worlds through all rows; captured graphs take them through many rows, one row, the last."""
        key = (slot, worlds, stride, dt, lead)
        if key not in self._graphs:
            with _capturing:
                graphs = []
                for count in (max(1, STEPS_A_GRAPH // stride), 1, 0):
                    with wp.ScopedCapture(device=self.device) as capture:
                        for _ in range(count):
                            self._next_row(slot, worlds, stride, dt, lead)
                        if not count:
                            self._note(slot, worlds, stride, lead)
                    graphs.append((max(count, 1), capture.graph))
            self._graphs[key] = graphs
        (many, run), (_, onward), (_, last) = self._graphs[key]
        for _ in range((rows - 1) // many):
            wp.capture_launch(run)
        for _ in range((rows - 1) % many):
            wp.capture_launch(onward)
        wp.capture_launch(last)

    def _note(self, slot: int, worlds: Worlds, stride: int, lead: int) -> None:
        """Aim at the targets of the step, and record."""
        inputs = [worlds.first, self._schedule, self._latency, self._clock, slot]
        self._launch(self._kernels.scheduled_target_kernel, (12, worlds.count), inputs, [self._target])
        inputs = [worlds.first, self._q, self._qd, self._target, self._motors, self._clock, slot, stride, lead]
        self._launch(self._kernels.record_motion_kernel, worlds.count, inputs, [self._record])

    def _next_row(self, slot: int, worlds: Worlds, stride: int, dt: float, lead: int) -> None:
        """Record, and advance to the next row."""
        settings = self.dynamics.settings(dt, 1, MAX_SWEEPS, self.tolerance)
        self._note(slot, worlds, stride, lead)
        for step in range(stride):
            if step:
                inputs = [worlds.first, self._schedule, self._latency, self._clock, slot]
                self._launch(self._kernels.scheduled_target_kernel, (12, worlds.count), inputs, [self._target])
            self.dynamics.advance(settings, self._drive, self._q, self._qd, self._q, self._qd, worlds)
            self._launch(self._kernels.tick_kernel, 1, [slot], [self._clock])

    def _launch(self, kernel: wp.Kernel, dim: Any, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _write_motors(self, robots: RobotValues, motors: MotorCfg, dt: float) -> None:
        """Write the constants of the motors, and the latency."""
        kinds = [motors.lateral, motors.transversal]
        values = {
            name: np.array([getattr(kinds[kind], name) for kind in KIND_OF_MOTOR])
            for name in ("kp", "kd", "saturation", "peak")
        }
        for name in ("kp", "kd", "saturation"):
            self._assign(getattr(self._motors, name), (values[name] * getattr(robots, name)).T)
        self._assign(self._motors.peak, np.tile(values["peak"][:, None], (1, len(robots.kp))))
        for name in ("no_load_speed", "cutoff_speed", "offset"):
            self._assign(getattr(self._motors, name), getattr(robots, name).T)
        self._assign(self._latency, robots.latency[:, 0] / dt)

    def _write_table(self, robots: RobotValues, held: bool) -> None:
        """Write the parameter table and the wrench that holds the base."""
        count = len(robots.base_mass)
        table = np.repeat(self._nominal_table, count, axis=1)
        mass, com = robots.base_mass[:, 0], robots.base_com.T
        old_mass, old_first = table[BASE], table[BASE + 1 : BASE + 4]
        pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        for row, (i, j) in enumerate(pairs, int(BASE) + 4):
            central = table[row] - old_first[i] * old_first[j] / old_mass
            table[row] = central * robots.base_inertia[:, 0] * mass / old_mass + mass * com[i] * com[j]
        table[BASE], table[BASE + 1 : BASE + 4] = mass, mass * com
        wrench = np.zeros((self.capacity, int(BODIES), 6), dtype=np.float32)
        if held:
            table[BASE : BASE + MOMENT_ROWS] = 0.0
            table[[BASE, BASE + 4, BASE + 5, BASE + 6]] = HELD_MASS
            wrench[:, 0, :3] = -HELD_MASS * self._nominal_table[GRAVITY : GRAVITY + 3, 0]
        for leg in range(4):
            row = leg * int(LEG_ROWS)
            for link in range(len(LINK_KINDS)):
                at = row + link * MOMENT_ROWS
                table[at : at + MOMENT_ROWS] *= robots.link_mass[:, link]
            table[row + ARMATURE : row + ARMATURE + 3] = robots.armature[:, 3 * leg : 3 * leg + 3].T
            table[row + FRICTION : row + FRICTION + 3] = robots.motor_friction[:, 3 * leg : 3 * leg + 3].T
            table[row + KNEE_DAMPING : row + KNEE_DAMPING + 2] = robots.knee_damping[:, 0]
            table[[row + MU_DYNAMIC, row + MU_STATIC]] = robots.paw_friction[:, 0]
            table[row + SPRING], table[row + SPRING + 1] = robots.spring_stiffness[:, 0], robots.spring_length[:, 0]
        self._assign(self.dynamics.robot.table, table)
        self._wrench.assign(wrench.reshape(-1, 6))

    def _write_starts(self, starts: Starts, robots: RobotValues) -> None:
        """Write coordinates and rates."""
        count = len(starts.angle)
        q, qd = np.zeros((self.capacity, int(COORDS))), np.zeros((self.capacity, int(DOFS)))
        q[:, 6] = 1.0
        q[:count, :3], q[:count, 3:7] = starts.position, starts.quaternion
        slots = motor_values(np.arange(20))
        q[:count, 7 + slots], qd[:count, 6 + slots] = starts.angle, starts.rate
        arm = rotate(starts.quaternion, robots.base_com)
        qd[:count, :3] = starts.velocity + np.cross(starts.spin, arm)
        qd[:count, 3:6] = starts.spin
        self._q.assign(q.ravel())
        self._qd.assign(qd.ravel())

    def _assign(self, array: wp.array, values: np.ndarray) -> None:
        """Write the first worlds of an array."""
        full = np.zeros(array.shape)
        full[..., : values.shape[-1]] = values
        if values.shape[-1] < self.capacity:
            full[..., values.shape[-1] :] = values[..., -1:]
        array.assign(full)


def balanced(count: int, threads: int) -> list[Worlds]:
    """Return the worlds in slices of about the same size, one a thread."""
    parts = max(1, min(threads, count // 4))
    edges = [round(count * i / parts) for i in range(parts + 1)]
    return [Worlds(a, b - a) for a, b in itertools.pairwise(edges)]


def grid_steps(period: float, dt: float | None) -> tuple[int, float]:
    """Return the physics steps in a sample period [s], and the step [s]: at most dt, by default 1/480 s."""
    longest = 1.0 / 480.0 if dt is None else dt
    if not 1.0e-6 <= longest <= 0.01:
        raise InputError(f"dt must lie in 1e-6 to 0.01 s, got {dt}")
    steps = max(1, math.ceil(period / longest - 1.0e-6))
    return steps, period / steps
