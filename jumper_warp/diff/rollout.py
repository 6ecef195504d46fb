"""Batches of rollouts with gradients: policy steps of filter, latency, motors and physics, forwards and backwards.

A rollout of all worlds is one launch, and so is its reverse pass, on a CPU one for each thread; on a GPU the reverse
pass is four launches for every few policy steps (`reverse_legs`). Nothing but a row of the state every few physics
steps and the paws' impulses is kept in between; see `jumper_warp.kernels.dynamics.adjoint.step_adjoint`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from jumper_warp.diff.actuation import MOTOR_CONSTANTS, filter_rows
from jumper_warp.diff.reverse_legs import LegReverse
from jumper_warp.robot.description import RobotDescription
from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.robot.motors import FilterCfg, MotorCfg, jumping_motors, motor_arrays
from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.sim.simulation import SUBSTEPS, motor_values
from jumper_warp.sim.slices import WorldRange, slices_of
from jumper_warp.sim.solver import check_step
from jumper_warp.utils.checks import check_within
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.newton_types import Model
from jumper_warp.utils.threads import checked_threads, run_side_by_side

MAX_SWEEPS = 200
"""Most sweeps of the contact iteration in a step."""
TOLERANCE = 1.0e-6
"""[m/s] Of the contact iteration in single precision. Gradients inherit its error."""
TOLERANCE_DOUBLE = 1.0e-13
"""[m/s] The same in double precision."""
LATENCY_RANGE = (0.0, 0.1)
"""[s] Of `Rollout.parameters`, as long as an environment's may be."""
GEOMETRY_NAMES = (
    "hip_x", "hip_y", "hip_z", "outer_x", "inner_x", "plane_y", "knee_y", "thigh", "shank", "paw_radius",
)  # fmt: skip
"""Rows of the gradient by a leg's geometry [m], see `jumper_warp.kernels.kinematics.geometry`."""


@dataclass(frozen=True)
class Trajectory:
    """What a rollout left behind: T policy steps of S physics steps, rows every `every` of these, K = T S / every.

    Arrays of the rollout's precision, worlds last; a gradient by a trajectory has the same shapes.
    """

    q: wp.array
    """(K + 1, 19, num_worlds): position [m] and orientation (xyzw) of the base, motor angles [rad]; row 0 the start."""
    qd: wp.array
    """(K + 1, 18, num_worlds): velocity of the base's centre of mass [m/s], its angular velocity [rad/s], world frame,
    motor rates [rad/s]."""
    torque: wp.array
    """(T S, 12, num_worlds) [N m] Of the motors, in each physics step."""
    impulse: wp.array
    """(T S, 4, num_worlds) vec3 [N s] Of the ground on each paw, world frame, in each physics step."""
    pressed: wp.array
    """(T S, 4, num_worlds) Sets of the legs' pressed hard stops, see `jumper_warp.kernels.actuation.stops`."""
    safe: wp.array
    """(T, 12, num_worlds) [rad] Targets that the filter let through."""
    commands: Any
    """The kernels' `Commands` that led to it."""
    from_start: bool = False
    """Whether the motors followed the angles that they started at, and not a `before` that was given."""

    def end(self) -> dict[str, Any]:
        """Return what a rollout that goes on from here is given: q, qd, before, impulse."""
        last = self.impulse.shape[0] - 1
        return {"q": self.q[-1], "qd": self.qd[-1], "before": self.safe[-1], "impulse": self.impulse[last]}


class Rollout:
    """Simulates worlds over policy steps, and runs the simulation backwards; in single or double precision.

    Gradients are those of the contact modes and of the branches of filter and motors that the rollout went through:
    exact where no mode changes (`adjoint.step_adjoint`). The worlds' parameters are in `parameters`, which may
    be written at any time between a reverse pass and the next rollout.

    Args:
        model: The robot's worlds, as `jumper_warp.robot.model.build_model` returns it, without moving blocks.
        motors: By default the jumping gains at 18 N m.
        command_filter: None leaves the targets as they are.
        description: The model's, by default the project's.
        dt: Physics step [s], `substeps` of which are in a policy step.
        every: Physics steps from one row of a trajectory to the next, a divisor of `substeps`; by default all.
        tolerance: Of the contact iteration [m/s], by default `TOLERANCE` or `TOLERANCE_DOUBLE`.
        threads: Of a CPU, which share the worlds out and change no bit; as in `Simulation`.

    Raises:
        NotThisRobotError: the model is another robot's.
        InputError: dt or tolerance not finite and positive, substeps no whole number above 0, or `every` no divisor
            of it.
    """

    def __init__(
        self,
        model: Model,
        motors: MotorCfg | None = None,
        command_filter: FilterCfg | None = None,
        *,
        description: RobotDescription | None = None,
        double: bool = False,
        dt: float = PHYSICS_DT,
        substeps: int = SUBSTEPS,
        every: int | None = None,
        tolerance: float | None = None,
        threads: int | None = None,
    ):
        check_step(dt, substeps)
        every = substeps if every is None else every
        if every not in range(1, substeps + 1) or substeps % every != 0:
            raise InputError(f"every must be a divisor of substeps = {substeps}, got {every!r}")
        if tolerance is not None and not 0.0 < tolerance < math.inf:
            raise InputError(f"tolerance must be finite and positive, got {tolerance!r:.40}")
        self.dynamics = JumperDynamics(model, description=description, double=double)
        self.num_worlds, self.device, self.real = model.world_count, model.device, self.dynamics.real
        self.dt, self.substeps, self.every = dt, substeps, every
        tolerance = tolerance or (TOLERANCE_DOUBLE if double else TOLERANCE)
        self._new_settings = partial(self.dynamics.settings, dt, 1, MAX_SWEEPS, tolerance)
        self._actuation = self._make_actuation(motors or jumping_motors(), command_filter)
        self.motors = self._actuation.motors
        """The kernels' `MotorArrays`, whose arrays are among the parameters."""
        self.parameters: dict[str, wp.array] = {
            "table": self.dynamics.robot.table,
            **{name: getattr(self._actuation.motors, name) for name in MOTOR_CONSTANTS},
            "fade": self._actuation.fade,
            "latency": self._actuation.latency,
            "filter": self._actuation.limits,
        }
        """By name, worlds last: the parameter table of `kernels.layout` (321, n), motor constants (12, n) as in
        `MotorKindCfg` and the sensors' `offset` [rad], `fade` [rad/s] (2, n), `latency` [s] (n,), and the filter's
        constants (14, n), rows as in `jumper_warp.diff.actuation.FILTER_NAMES`, in rad."""
        self.writes = dict.fromkeys([*self.parameters, "geometry"], 0)
        """How often `simulate` has changed each of them."""
        self.by_legs = self.device.is_cuda
        """Whether a thread has a leg or a world, by default a leg on a GPU and a world on a CPU."""
        self.slices = slices_of(self.num_worlds, 1 if self.device.is_cuda else checked_threads(threads))
        wrench = wp.zeros(model.body_count, dtype=wp.spatial_vectorf, device=self.device)
        self._drive = self.dynamics.drive(self._zeros(model.joint_dof_count), wrench)
        self._record: Any = None
        self._legs: LegReverse | None = None
        self._launched: set[str] = set()

    def _make_actuation(self, cfg: MotorCfg, command_filter: FilterCfg | None) -> Any:
        """Return the kernels' `Actuation` of motors, without latency."""
        modules, n = self.dynamics.modules, self.num_worlds
        actuation = modules.trajectory.Actuation()
        actuation.motors = motor_arrays(cfg, n, module=modules.motors, device=self.device)
        actuation.fade = self.array([[cfg.fade_start] * n, [cfg.fade_end] * n])
        actuation.latency = self._zeros(n)
        actuation.filtered = int(command_filter is not None)
        actuation.limits = self.array(np.repeat(filter_rows(command_filter)[:, None], n, axis=1))
        return actuation

    def standing(self) -> tuple[np.ndarray, np.ndarray]:
        """Return q (19, num_worlds) and qd (18, num_worlds) of the model's pose, at rest, in single precision."""
        return compact(self.dynamics.model.joint_q.numpy(), np.zeros(38 * self.num_worlds), self.num_worlds)

    def hold(self, worlds: Any = True) -> None:
        """Hang up the bases of some worlds: they keep the position and the velocity that they start with.

        worlds: bool, (num_worlds,) or one for all. Raises InputError for another shape.
        """
        if np.shape(worlds) not in ((), (self.num_worlds,)):
            raise InputError(f"worlds must be one bool, or ({self.num_worlds},), got {np.shape(worlds)}")
        held = np.broadcast_to(np.asarray(worlds, dtype=np.int32), self.num_worlds)
        self.dynamics.robot.held = wp.array(held, dtype=int, device=self.device)

    def geometry(self) -> np.ndarray:
        """Return the legs' lengths [m], (4, 10), see `GEOMETRY_NAMES`; all worlds have the same."""
        legs = self.dynamics.robot.geometry.numpy()
        return np.column_stack([legs["hip"], *(legs[name] for name in GEOMETRY_NAMES[3:])]).astype(np.float64)

    def set_geometry(self, lengths: np.ndarray) -> None:
        """Write the legs' lengths [m], (4, 10). Raises InputError for another shape or what is not finite."""
        if np.shape(lengths) != (4, len(GEOMETRY_NAMES)):
            raise InputError(f"geometry must have shape (4, {len(GEOMETRY_NAMES)}), got {np.shape(lengths)}")
        if not np.isfinite(lengths).all():
            raise InputError("geometry must be finite")
        legs = self.dynamics.robot.geometry.numpy().copy()
        legs["hip"] = lengths[:, :3]
        for name, column in zip(GEOMETRY_NAMES[3:], lengths.T[3:], strict=True):
            legs[name] = column
        self.dynamics.robot.geometry.assign(legs)

    def run(
        self, targets: Any, q: Any, qd: Any, *, before: Any = None, wrench: Any = None, impulse: wp.array | None = None
    ) -> Trajectory:
        """Simulate. Arrays of Warp or NumPy, of the shapes below or without worlds, which then are alike.

        Args:
            targets: Raw motor targets [rad] of T policy steps, (T, 12, num_worlds).
            q: First row, (19, num_worlds), as in `Trajectory.q`.
            qd: First row, (18, num_worlds).
            before: What the motors follow [rad] until the first target arrives, (12, num_worlds), by default the angles
                that they start at, by which the gradient by q has it too. Only `parameters["latency"]` makes it matter.
            wrench: Force [N] and moment [N m] on the base at its com, world axes, in each policy step,
                (T, 6, num_worlds).
            impulse: What pushed the paws in the step before, as in `Trajectory.impulse`, (4, num_worlds) vec3; zero
                by default. Contact is found from there, and paws that pushed and hardly slip have static friction.

        Raises:
            InputError: an array of another shape or type, numbers of NumPy that are not finite, or, on a CPU, a latency
                outside of `LATENCY_RANGE`. What is on a GPU is not waited for: a world of NaN ends as NaN, and no
                target arrives before it is sent.
        """
        if not self.device.is_cuda:
            check_within("latency [s]", self.parameters["latency"].numpy(), LATENCY_RANGE)
        vec3 = self.dynamics.modules.scalar.vec3
        count = len(targets) if hasattr(targets, "__len__") else 0
        commands = self.dynamics.modules.trajectory.Commands()
        commands.target = self._input("targets", targets, (count, 12))
        q, qd = self._input("q", q, (19,)), self._input("qd", qd, (18,))
        commands.before = q[7:] if before is None else self._input("before", before, (12,))
        commands.wrench = self._zeros(count, 6, self.num_worlds) if wrench is None else (
            self._input("wrench", wrench, (count, 6))
        )  # fmt: skip
        pushes = (4, self.num_worlds)
        if impulse is not None and not (
            isinstance(impulse, wp.array) and impulse.shape == pushes and impulse.dtype == vec3
        ):
            raise InputError(f"impulse must be an array {pushes} of {vec3.__name__}, as in `Trajectory.impulse`")
        commands.impulse = self._zeros(*pushes, dtype=vec3) if impulse is None else impulse
        if count < 1:
            raise InputError("a rollout needs at least one policy step of targets")
        rows = self._rows(count)
        wp.copy(rows.q[0], q)
        wp.copy(rows.qd[0], qd)
        safe = self._zeros(count, 12, self.num_worlds)
        inputs = [self._timing(count), self._actuation, commands, self._drive]
        modules = self.dynamics.modules
        if self.by_legs:
            self._launch_legs(modules.rollout_legs.rollout_legs_kernel, inputs, [safe, rows])
        else:
            self._launch(modules.rollout.rollout_kernel, inputs, [self.dynamics.work, safe, rows])
        return Trajectory(rows.q, rows.qd, rows.torque, rows.impulse, rows.pressed, safe, commands, before is None)

    def backward(
        self,
        trajectory: Trajectory,
        *,
        q: wp.array | None = None,
        qd: wp.array | None = None,
        torque: wp.array | None = None,
        impulse: wp.array | None = None,
        safe: wp.array | None = None,
    ) -> dict[str, wp.array]:
        """Return the gradient of one number a world, given its gradient by the trajectory.

        q, qd, torque, impulse, safe: that gradient, of the shapes and types of `Trajectory`; None is zero. The
        parameters must be those of the rollout.

        Returned by name, worlds last: targets, q, qd (of the first row), before, wrench, the entries of `parameters`,
        and `geometry` (4, 10, num_worlds) by the legs' lengths [m], see `GEOMETRY_NAMES`. The gradient by the first
        row's quaternion is that of a function which normalises it.
        """
        n, modules = self.num_worlds, self.dynamics.modules
        commands = trajectory.commands
        count = commands.target.shape[0]
        rows_of = (count * self.substeps // self.every + 1, 19, n)
        if trajectory.q.shape != rows_of or trajectory.q.dtype != self.real:
            raise InputError(f"this rollout makes trajectories {rows_of}, got {trajectory.q.shape}")
        seeds = self._seeds(trajectory, {"q": q, "qd": qd, "torque": torque, "impulse": impulse, "safe": safe})
        rows = modules.trajectory.Rows()
        for name in ("q", "qd", "torque", "impulse", "pressed"):
            setattr(rows, name, getattr(trajectory, name))
        gradients = modules.gradients.Gradients()
        shapes = {"q": (19,), "qd": (18,), "target": (count, 12), "before": (12,), "wrench": (count, 6),
                  "safe": (count, 12), "parameters": (int(modules.gradients.GRADIENT_ROWS),)}  # fmt: skip
        for name, shape in shapes.items():
            setattr(gradients, name, self._zeros(*shape, n))
        if safe is not None:
            wp.copy(gradients.safe, safe)  # which the reverse pass adds to
        motion = [self._timing(count), self._actuation, commands, trajectory.safe, rows]
        if self.by_legs:
            last: Any
            for into, last in ((gradients.q, q), (gradients.qd, qd)):
                if last is not None:
                    wp.copy(into, last[-1])
            if self._legs is None:
                self._legs = LegReverse(self.dynamics, self.every)
            self._legs.run(self._new_settings(), motion, seeds, gradients)
        else:
            if self._record is None:
                self._record = self.dynamics.step_record(self.every)
            self._launch(modules.rollout_adjoint.reverse_kernel, [*motion, seeds], [self._record, gradients])
        if trajectory.from_start:
            wp.map(wp.add, gradients.q[7:], gradients.before, out=gradients.q[7:])
        found = {"targets": gradients.target, "q": gradients.q, "qd": gradients.qd, "before": gradients.before}
        return found | {"wrench": gradients.wrench} | self._named(gradients.parameters)

    def _seeds(self, trajectory: Trajectory, given: dict[str, wp.array | None]) -> Any:
        """Return the kernels' `Rows` of a gradient by a trajectory. Raises InputError: an array unlike it."""
        seeds = self.dynamics.modules.trajectory.Rows()
        for name, array in given.items():
            like = getattr(trajectory, name)
            alike = isinstance(array, wp.array) and array.shape == like.shape and array.dtype == like.dtype
            if array is not None and not alike:
                got = f"{array.dtype.__name__} {array.shape}" if isinstance(array, wp.array) else type(array).__name__
                raise InputError(
                    f"the gradient by {name} must be like it, {like.dtype.__name__} {like.shape}, got {got}"
                )
            if name != "safe":
                empty = wp.zeros((0,) * like.ndim, dtype=like.dtype, device=self.device)
                setattr(seeds, name, empty if array is None else array)
        seeds.pressed = wp.zeros((0, 0, 0), dtype=wp.uint8, device=self.device)
        return seeds

    def _named(self, gradient: Any) -> dict[str, wp.array]:
        """Return the rows of a gradient by name."""
        names, first = {}, 0
        for name, array in self.parameters.items():
            count = 1 if array.ndim == 1 else array.shape[0]
            names[name] = gradient[first : first + count] if array.ndim > 1 else gradient[first]
            first += count
        return names | {"geometry": gradient[first:].reshape((4, len(GEOMETRY_NAMES), self.num_worlds))}

    def _timing(self, count: int) -> Any:
        timing = self.dynamics.modules.trajectory.Timing()
        timing.steps, timing.substeps, timing.every = count, self.substeps, self.every
        return timing

    def _rows(self, count: int) -> Any:
        """Return an empty trajectory."""
        steps, n = count * self.substeps, self.num_worlds
        rows = self.dynamics.modules.trajectory.Rows()
        rows.q, rows.qd = (self._empty(steps // self.every + 1, size, n) for size in (19, 18))
        rows.torque = self._empty(steps, 12, n)
        rows.impulse = self._empty(steps, 4, n, dtype=self.dynamics.modules.scalar.vec3)
        rows.pressed = self._empty(steps, 4, n, dtype=wp.uint8)
        return rows

    def _launch_legs(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        """Launch a kernel over all worlds, a thread a leg."""
        n = self.num_worlds
        inputs = [n, self.dynamics.robot, self._new_settings(), *inputs]
        wp.launch(
            kernel, dim=(-(-n // 8) * 8, 4), inputs=inputs, outputs=outputs,
            device=self.device, block_dim=32 if self.device.is_cuda else 4,
        )  # fmt: skip

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        """Launch a kernel over all worlds, on a CPU in slices side by side."""

        def launch(worlds: WorldRange) -> None:
            settings = self._new_settings()  # a copy of a Warp struct shares its memory, and slices run side by side
            settings.first = worlds.first
            wp.launch(
                kernel, dim=worlds.count, inputs=[self.dynamics.robot, settings, *inputs], outputs=outputs,
                device=self.device, block_dim=32 if self.device.is_cuda else 1,
            )  # fmt: skip

        jobs: list[Callable[[], None]] = [partial(launch, worlds) for worlds in self.slices]
        # Warp finds a kernel's function at its first launch; of two threads that do so at once one would run nothing
        run_side_by_side(jobs, len(jobs) if kernel.key in self._launched else 1)
        self._launched.add(kernel.key)

    def _input(self, name: str, values: Any, shape: tuple[int, ...]) -> wp.array:
        """Return values as an array (*shape, num_worlds). Raises InputError: another shape or type, or not finite."""
        full = (*shape, self.num_worlds)
        if isinstance(values, wp.array):
            if values.shape != full or values.dtype != self.real:
                raise InputError(
                    f"{name} must be {self.real.__name__} of shape {full}, got {values.dtype.__name__} {values.shape}"
                )
            return values
        values = np.asarray(values, dtype=np.float64)
        if values.shape == shape:
            values = np.repeat(values[..., None], self.num_worlds, axis=-1)
        if values.shape != full:
            raise InputError(f"{name} must have shape {full} or {shape}, got {values.shape}")
        if not np.isfinite(values).all():
            raise InputError(f"{name} must be finite")
        return self.array(values)

    def array(self, values: Any) -> wp.array:
        """Return values as an array of the rollout's precision on its device."""
        return wp.array(values, dtype=self.real, device=self.device)

    def vectors(self, values: Any) -> wp.array:
        """Return vectors (..., 3) as an array of the kernels' vec3."""
        return wp.array(np.ascontiguousarray(values), dtype=self.dynamics.modules.scalar.vec3, device=self.device)

    def _zeros(self, *shape: int, dtype: Any = None) -> wp.array:
        return wp.zeros(shape, dtype=dtype or self.real, device=self.device)

    def _empty(self, *shape: int, dtype: Any = None) -> wp.array:
        return wp.empty(shape, dtype=dtype or self.real, device=self.device)


def compact(joint_q: np.ndarray, joint_qd: np.ndarray, num_worlds: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return q (19, num_worlds) and qd (18, num_worlds) of (43,) coordinates and (38,) rates of Newton a world."""
    joint_q, joint_qd = np.reshape(joint_q, (num_worlds, 43)), np.reshape(joint_qd, (num_worlds, 38))
    q = np.concatenate([joint_q[:, :7], motor_values(joint_q[:, 7:])], axis=1)
    return q.T, np.concatenate([joint_qd[:, :6], motor_values(joint_qd[:, 6:])], axis=1).T
