"""Batched rollouts with gradients: forward and reverse passes through command filter, latency, motors and physics.

A forward pass is one launch for all worlds (on a CPU one launch for each thread), as is a reverse pass; on a GPU the
reverse pass is four launches for every few rows (`reverse_legs`). Between the passes only a row of the state every few
physics steps, motor torques and the paws' impulses are stored; see `jumper_warp.kernels.dynamics.adjoint.step_adjoint`.

`Rollout` is one class, since its methods share its arrays. Its sections: construction; start poses and leg geometry;
forward and reverse pass (`run`, `backward`); arrays and launches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike

from jumper_warp.diff.reverse_legs import LegThreadReverse
from jumper_warp.robot.description import RobotDescription
from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.robot.motors import (
    MOTOR_CONSTANTS,
    FilterCfg,
    MotorCfg,
    filter_constants,
    jumping_motors,
    motor_arrays,
)
from jumper_warp.sim.dynamics import JumperDynamics, WorldRange, check_step, slices_of
from jumper_warp.sim.simulation import SUBSTEPS, motor_values
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.checks import check_count, check_flags, check_type, check_within
from jumper_warp.utils.copying import Uncopied
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Kernel, KernelStruct
from jumper_warp.utils.newton_types import Model
from jumper_warp.utils.threads import checked_threads, locked, run_in_parallel

MAX_SWEEPS = 200  # largest number of sweeps of the contact iteration in a physics step
TOLERANCE = 1.0e-6  # [m/s] of the contact iteration in single precision; gradients inherit its error
TOLERANCE_DOUBLE = 1.0e-13  # [m/s] of the contact iteration in double precision
LATENCY_RANGE = (0.0, 0.1)  # [s] Allowed values of `Rollout.parameters["latency"]`
GEOMETRY_NAMES = ("hip_x", "hip_y", "hip_z", "outer_x", "inner_x", "plane_y", "knee_y", "thigh", "shank", "paw_radius")
"""Lengths [m] of a leg, in the order of `Rollout.geometry`; see `jumper_warp.kernels.kinematics.geometry`."""


@dataclass(frozen=True)
class Trajectory:
    """Recorded states, torques and impulses of a rollout over policy steps, for all worlds.

    T policy steps of S physics steps; a row every `every` physics steps, K = T S / every. Arrays have the rollout's
    precision, worlds last. A cotangent (gradient of a loss w.r.t. an array) has its shape. Motors and paws are ordered
    by leg FL, FR, BL, BR; motors of a leg: lateral, outer, inner.
    """

    q: wp.array
    """(K + 1, 19, num_worlds) Origin [m] and orientation (xyzw) of the base, world frame, motor angles [rad]; row 0 is
    the start."""
    qd: wp.array
    """(K + 1, 18, num_worlds) Velocity of the base's centre of mass [m/s], its angular velocity [rad/s], world frame,
    motor rates [rad/s]."""
    torque: wp.array  # (T S, 12, num_worlds) [N m] Motor torques in each physics step
    impulse: wp.array  # (T S, 4, num_worlds) vec3 [N s] Contact impulses on the paws in each physics step, world frame
    pressed: wp.array
    """(T S, 4, num_worlds) Bit sets of each leg's pressed hard stops, see `jumper_warp.kernels.actuation.stops`."""
    filtered_target: wp.array  # (T, 12, num_worlds) [rad] Targets after the command filter
    commands: KernelStruct  # The kernels' `Commands` of the rollout
    kept: int  # Number of filtered targets that may still act after the end
    from_start: bool = False
    """True: `initial_target` was omitted, so that the gradient w.r.t. q includes that w.r.t. initial_target."""

    def end(self) -> dict[str, Any]:
        """Return the final state as arguments with which `Rollout.run` continues: q, qd, initial_target, impulse."""
        past = [wp.to_torch(array) for array in (self.commands.initial_target, self.filtered_target)]
        state = {"q": self.q[-1], "qd": self.qd[-1], "initial_target": wp.from_torch(torch.cat(past)[-self.kept :])}
        return state | {"impulse": self.impulse[self.impulse.shape[0] - 1]}


class Rollout(Uncopied):
    """Differentiable simulation of many worlds over policy steps: forward and reverse pass.

    In single or double precision. Gradients are exact at the contact modes and branches of filter and motors of the
    forward pass (`adjoint.step_adjoint`). The worlds' parameters are the arrays in `parameters`; write to them only
    between a reverse pass and the next forward pass.

    Args:
        model: The robot's worlds, as `jumper_warp.robot.model.build_model` returns it, without moving blocks.
        motors: By default the jumping gains at 18 N m.
        command_filter: Filter of motor targets; None: the targets are not filtered.
        description: Robot description, by default that of `build_model`; worlds take several in turn.
        double: Whether to compute in double precision.
        dt: Physics step [s].
        substeps: Physics steps in a policy step.
        every: Physics steps between rows of a trajectory, a divisor of `substeps`; by default `substeps`.
        tolerance: Tolerance of the contact iteration [m/s], by default `TOLERANCE` or `TOLERANCE_DOUBLE`.
        threads: Number of CPU threads, as in `Simulation`; results do not depend on it.

    Raises:
        NotThisRobotError: the model is another robot's.
        InputError: dt or tolerance not finite and positive, substeps not a whole number above 0, or not a multiple
            of `every`.
    """

    @locked
    def __init__(
        self,
        model: Model,
        motors: MotorCfg | None = None,
        command_filter: FilterCfg | None = None,
        *,
        description: RobotDescription | Sequence[RobotDescription] | None = None,
        double: bool = False,
        dt: float = PHYSICS_DT,
        substeps: int = SUBSTEPS,
        every: int | None = None,
        tolerance: float | None = None,
        threads: int | None = None,
    ):
        check_flags(double=double)
        substeps = check_step(dt, substeps)
        every = substeps if every is None else check_count("every", every, substeps)
        if substeps % every != 0:
            raise InputError(f"every must be a divisor of substeps = {substeps}, got {every}")
        if tolerance is None:
            tolerance = TOLERANCE_DOUBLE if double else TOLERANCE
        self.dynamics = JumperDynamics(
            model, description=description, max_sweeps=MAX_SWEEPS, tolerance=tolerance, double=double
        )
        self.num_worlds = model.world_count
        self.device = model.device
        self.real = self.dynamics.real
        self.dt = dt
        self.substeps = substeps
        self.every = every
        self.targets_kept = 1 + math.ceil(LATENCY_RANGE[1] / (dt * substeps))
        """Number of filtered targets that may still act after a policy step."""
        self._actuation = self._make_actuation(jumping_motors() if motors is None else motors, command_filter)
        self.motors = self._actuation.motors  # The kernels' `MotorArrays`, whose arrays are among the parameters
        self.parameters: dict[str, wp.array] = {
            "table": self.dynamics.robot.table,
            **{name: getattr(self._actuation.motors, name) for name in MOTOR_CONSTANTS},
            "fade": self._actuation.fade,
            "latency": self._actuation.latency,
            "filter": self._actuation.limits,
        }
        """By name, worlds last: the parameter table of `kernels.layout` (321, n), motor constants (12, n) as in
        `MotorKindCfg` and the sensors' `offset` [rad], `fade` [rad/s] (2, n), `latency` [s] (n,), and the filter's
        constants (14, n), rows as in `jumper_warp.robot.motors.FILTER_NAMES`, in rad."""
        self.writes = dict.fromkeys([*self.parameters, "geometry"], 0)
        """Number of times that `simulate` has written each parameter, by name."""
        self.by_legs = self.device.is_cuda
        """Whether kernels use a thread per leg (default on a GPU) or per world (default on a CPU)."""
        self.slices = slices_of(self.num_worlds, 1 if self.device.is_cuda else checked_threads(threads))
        wrench = wp.zeros(model.body_count, dtype=wp.spatial_vectorf, device=self.device)
        self._drive = self.dynamics.drive(self._zeros(model.joint_dof_count), wrench)
        self._record: KernelStruct | None = None
        self._legs: LegThreadReverse | None = None
        self._launched: set[Kernel] = set()

    def _make_actuation(self, cfg: MotorCfg, command_filter: FilterCfg | None) -> KernelStruct:
        """Return the constants of motors, latency and command filter of all worlds as the struct that the kernels read.

        The latency is zero.
        """
        modules = self.dynamics.modules
        n = self.num_worlds
        actuation = modules.trajectory.Actuation()
        actuation.motors = motor_arrays(cfg, n, module=modules.motors, device=self.device)
        actuation.fade = self.array([[cfg.fade_start] * n, [cfg.fade_end] * n])
        actuation.latency = self._zeros(n)
        actuation.filtered = int(command_filter is not None)
        actuation.limits = self.array(np.repeat(filter_constants(command_filter)[:, None], n, axis=1))
        return actuation

    # ------------------------------------------------------------------ start poses and leg geometry

    def standing(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the model's initial standing pose at rest, as coordinates and rates of base and motors.

        q (19, num_worlds) and qd (18, num_worlds), see `Trajectory`.
        """
        return compact(self.dynamics.model.joint_q.numpy(), np.zeros(38 * self.num_worlds), self.num_worlds)

    @locked
    def hold(self, worlds: ArrayLike = True) -> None:
        """Fix the bases of some worlds at their initial pose and velocity; release those of the others.

        worlds: bool, (num_worlds,) or one for all. Raises InputError: another shape or type.
        """
        held = np.asarray(worlds)
        if held.dtype != bool or held.shape not in ((), (self.num_worlds,)):
            raise InputError(f"worlds must be one bool, or ({self.num_worlds},), got {held.dtype} {held.shape}")
        held = np.broadcast_to(held, self.num_worlds)
        self.dynamics.robot.held = wp.array(held, dtype=int, device=self.device)

    def geometry(self) -> np.ndarray:
        """Return the lengths [m] that define the geometry of the four legs.

        Shape (4 legs, 10 `GEOMETRY_NAMES`) if all worlds share them, otherwise (4, 10, num_worlds). `shank` is the
        inner one; a change of it is one of both shanks.
        """
        legs = self.dynamics.robot.geometry.numpy()
        rows = np.column_stack([legs["hip"], *(legs[name] for name in GEOMETRY_NAMES[3:])]).astype(np.float64)
        return rows if len(rows) == 4 else np.resize(rows, (self.num_worlds, 4, rows.shape[1])).transpose(1, 2, 0)

    @locked
    def set_geometry(self, lengths: np.ndarray) -> None:
        """Set the lengths [m] that define the geometry of the four legs in all worlds, or in each.

        lengths: (4, 10) or (4, 10, num_worlds), see `geometry`. Raises InputError: another shape, or not finite.
        """
        lengths = real_array(lengths, "geometry", np.float64)
        shape = (4, len(GEOMETRY_NAMES))
        if lengths.shape not in (shape, (*shape, self.num_worlds)):
            raise InputError(f"geometry must have shape {shape} or {(*shape, self.num_worlds)}, got {lengths.shape}")
        if not np.isfinite(lengths).all():
            raise InputError("geometry must be finite")
        geometry = self.dynamics.robot.geometry
        legs = np.resize(geometry.numpy(), max(len(geometry), 4 * lengths[0, 0].size))
        rows = np.resize(np.moveaxis(lengths, -1, 0) if lengths.ndim == 3 else lengths, (len(legs), shape[1]))
        legs["outer_shank"] += rows[:, GEOMETRY_NAMES.index("shank")] - legs["shank"]
        legs["hip"] = rows[:, :3]
        for name, column in zip(GEOMETRY_NAMES[3:], rows.T[3:], strict=True):
            legs[name] = column
        if len(legs) > len(geometry):
            self.dynamics.robot.geometry = wp.empty(len(legs), dtype=geometry.dtype, device=self.device)
        self.dynamics.robot.geometry.assign(legs)

    # ------------------------------------------------------------------ forward and reverse pass

    @locked
    def run(
        self,
        targets: wp.array | np.ndarray | Sequence,
        q: wp.array | ArrayLike,
        qd: wp.array | ArrayLike,
        *,
        initial_target: wp.array | ArrayLike | None = None,
        wrench: wp.array | ArrayLike | None = None,
        impulse: wp.array | None = None,
    ) -> Trajectory:
        """Simulate all worlds over T policy steps, and return their trajectory.

        Args (arrays of Warp or NumPy; a NumPy array without the last axis holds for all worlds):
            targets: Motor targets before the command filter [rad], (T, 12, num_worlds).
            q: Initial coordinates, (19, num_worlds), as in `Trajectory.q`.
            qd: Initial rates, (18, num_worlds), as in `Trajectory.qd`.
            initial_target: Filtered targets [rad] of earlier policy steps, the latest one last, (steps, 12, num_worlds)
                or (12, num_worlds), in use until the first target arrives; matters with a latency. The first one
                stands for all before. By default the initial angles; the gradient w.r.t. q then includes this one.
            wrench: Force [N] and moment [N m] on the base at its com, world axes, in each policy step,
                (T, 6, num_worlds).
            impulse: Contact impulses of the previous physics step, as in `Trajectory.impulse`, (4, num_worlds) vec3; by
                default zero. They are the first guess of the contact iteration. A loaded paw that hardly slips has
                static friction.

        Raises:
            InputError: an array of another shape or type, NumPy values that are not finite, or, on a CPU, a latency
                outside of `LATENCY_RANGE`. Values on a GPU are not checked: NaN stays in its world, and latencies
                below 0 count as 0.
        """
        if not self.device.is_cuda:
            check_within("latency [s]", self.parameters["latency"].numpy(), LATENCY_RANGE)
        vec3 = self.dynamics.modules.scalar.vec3
        count = len(targets) if hasattr(targets, "__len__") else 0
        commands = self.dynamics.modules.trajectory.Commands()
        commands.target = self._input("targets", targets, (count, 12))
        q, qd = self._input("q", q, (19,)), self._input("qd", qd, (18,))
        initial: Any = q[7:] if initial_target is None else initial_target
        shape = (len(initial), 12) if np.ndim(initial) == 3 else (12,)
        commands.initial_target = (
            self._input("initial_target", initial, shape).contiguous().reshape((-1, 12, self.num_worlds))
        )
        commands.wrench = self._zeros(count, 6, self.num_worlds) if wrench is None else (
            self._input("wrench", wrench, (count, 6))
        )  # fmt: skip
        impulse_shape = (4, self.num_worlds)
        if impulse is not None and not (
            isinstance(impulse, wp.array) and impulse.shape == impulse_shape and impulse.dtype == vec3
        ):
            raise InputError(f"impulse must be an array {impulse_shape} of {vec3.__name__}, as in `Trajectory.impulse`")
        commands.impulse = self._zeros(*impulse_shape, dtype=vec3) if impulse is None else impulse
        if count < 1:
            raise InputError("a rollout needs at least one policy step of targets")
        rows = self._rows(count)
        wp.copy(rows.q[0], q)
        wp.copy(rows.qd[0], qd)
        filtered_target = self._zeros(count, 12, self.num_worlds)
        inputs = [self._timing(count), self._actuation, commands, self._drive]
        modules = self.dynamics.modules
        if self.by_legs:
            self._launch_legs(modules.rollout_legs.rollout_legs_kernel, inputs, [filtered_target, rows])
        else:
            self._launch(modules.rollout.rollout_kernel, inputs, [self.dynamics.work, filtered_target, rows])
        arrays = (rows.q, rows.qd, rows.torque, rows.impulse, rows.pressed, filtered_target)
        kept = max(self.targets_kept, len(commands.initial_target))
        return Trajectory(*arrays, commands, kept, from_start=initial_target is None)

    @locked
    def backward(
        self,
        trajectory: Trajectory,
        *,
        q: wp.array | None = None,
        qd: wp.array | None = None,
        torque: wp.array | None = None,
        impulse: wp.array | None = None,
        filtered_target: wp.array | None = None,
    ) -> dict[str, wp.array]:
        """Return the gradients of the worlds' losses w.r.t. the rollout's inputs, from those w.r.t. its trajectory.

        q, qd, torque, impulse, filtered_target: cotangents, the gradients of the loss w.r.t. these arrays of
        `trajectory`, of the same shapes and types; None: zero. The parameters must be those of the forward pass.

        Returned by name, worlds last: targets, q, qd (initial rows), initial_target (steps, 12), wrench, the entries of
        `parameters`, and `geometry` (4, 10, num_worlds) w.r.t. the legs' lengths. The gradient w.r.t. the initial
        quaternion assumes that it is normalised first. Raises InputError: another rollout's trajectory or other shapes.
        """
        check_type("trajectory", trajectory, Trajectory)
        n = self.num_worlds
        modules = self.dynamics.modules
        commands = trajectory.commands
        count = commands.target.shape[0]
        rows_of = (count * self.substeps // self.every + 1, 19, n)
        if trajectory.q.shape != rows_of or trajectory.q.dtype != self.real:
            raise InputError(f"trajectory.q must be {self.real.__name__} {rows_of}, got {trajectory.q.shape}")
        by_outputs = {"q": q, "qd": qd, "torque": torque, "impulse": impulse, "filtered_target": filtered_target}
        cotangents = self._cotangents(trajectory, by_outputs)
        rows = modules.trajectory.TrajectoryArrays()
        for name in ("q", "qd", "torque", "impulse", "pressed"):
            setattr(rows, name, getattr(trajectory, name))
        gradients = modules.gradients.Gradients()
        earlier = (len(commands.initial_target), 12)
        shapes = {"q": (19,), "qd": (18,), "target": (count, 12), "initial_target": earlier, "wrench": (count, 6),
                  "filtered_target": (count, 12), "parameters": (int(modules.gradients.GRADIENT_ROWS),)}  # fmt: skip
        for name, shape in shapes.items():
            setattr(gradients, name, self._zeros(*shape, n))
        if filtered_target is not None:
            wp.copy(gradients.filtered_target, filtered_target)  # the reverse pass adds to it
        motion = [self._timing(count), self._actuation, commands, trajectory.filtered_target, rows]
        if self.by_legs:
            last: Any
            for into, last in ((gradients.q, q), (gradients.qd, qd)):
                if last is not None:
                    wp.copy(into, last[-1])
            if self._legs is None:
                self._legs = LegThreadReverse(self.dynamics, self.every)
            self._legs.run(self.dynamics.settings(self.dt, 1), motion, cotangents, gradients)
        else:
            if self._record is None:
                self._record = self.dynamics.step_record(self.every)
            self._launch(modules.rollout_adjoint.reverse_kernel, [*motion, cotangents], [self._record, gradients])
        if trajectory.from_start:
            wp.map(wp.add, gradients.q[7:], gradients.initial_target[0], out=gradients.q[7:])
        by_inputs = {"targets": gradients.target, "q": gradients.q, "qd": gradients.qd, "wrench": gradients.wrench}
        return by_inputs | {"initial_target": gradients.initial_target} | self._split_parameters(gradients.parameters)

    def _cotangents(self, trajectory: Trajectory, by_outputs: dict[str, wp.array | None]) -> KernelStruct:
        """Collect the loss gradients w.r.t. the arrays of a trajectory in a struct, the input of the reverse kernels.

        Empty for None, and for the flags `pressed`, which have no gradient. That of filtered_target is only checked, as
        the reverse pass begins with `target`. Raises InputError: another shape or type than the trajectory's array.
        """
        cotangents = self.dynamics.modules.trajectory.TrajectoryArrays()
        for name, array in by_outputs.items():
            like = getattr(trajectory, name)
            alike = isinstance(array, wp.array) and array.shape == like.shape and array.dtype == like.dtype
            if array is not None and not alike:
                got = f"{array.dtype.__name__} {array.shape}" if isinstance(array, wp.array) else type(array).__name__
                raise InputError(
                    f"the gradient w.r.t. {name} must be {like.dtype.__name__} of shape {like.shape}, got {got}"
                )
            if name != "filtered_target":
                empty = wp.zeros((0,) * like.ndim, dtype=like.dtype, device=self.device)
                setattr(cotangents, name, empty if array is None else array)
        cotangents.pressed = wp.zeros((0, 0, 0), dtype=wp.uint8, device=self.device)
        return cotangents

    def _split_parameters(self, gradient: Any) -> dict[str, wp.array]:
        """Split the gradient w.r.t. all robot parameters into views by parameter name.

        gradient: (GRADIENT_ROWS, num_worlds); views are shaped as `parameters` and `geometry`.
        """
        names = {}
        first = 0
        for name, array in self.parameters.items():
            count = 1 if array.ndim == 1 else array.shape[0]
            names[name] = gradient[first : first + count] if array.ndim > 1 else gradient[first]
            first += count
        return names | {"geometry": gradient[first:].reshape((4, len(GEOMETRY_NAMES), self.num_worlds))}

    # ------------------------------------------------------------------ arrays and launches

    def _timing(self, count: int) -> KernelStruct:
        """Return the struct with a rollout's numbers of policy and physics steps, which the kernels read."""
        timing = self.dynamics.modules.trajectory.Timing()
        timing.steps, timing.substeps, timing.every = count, self.substeps, self.every
        return timing

    def _rows(self, count: int) -> KernelStruct:
        """Allocate the arrays that record a rollout of `count` policy steps, uninitialised."""
        steps = count * self.substeps
        n = self.num_worlds
        rows = self.dynamics.modules.trajectory.TrajectoryArrays()
        rows.q, rows.qd = (self._empty(steps // self.every + 1, size, n) for size in (19, 18))
        rows.torque = self._empty(steps, 12, n)
        rows.impulse = self._empty(steps, 4, n, dtype=self.dynamics.modules.scalar.vec3)
        rows.pressed = self._empty(steps, 4, n, dtype=wp.uint8)
        return rows

    def _launch_legs(self, kernel: Kernel, inputs: list, outputs: list) -> None:
        """Launch a kernel over all worlds, padded to a multiple of 8, with a thread for each leg."""
        n = self.num_worlds
        inputs = [n, self.dynamics.robot, self.dynamics.settings(self.dt, 1), *inputs]
        wp.launch(
            kernel, dim=(-(-n // 8) * 8, 4), inputs=inputs, outputs=outputs,
            device=self.device, block_dim=32 if self.device.is_cuda else 4,
        )  # fmt: skip

    def _launch(self, kernel: Kernel, inputs: list, outputs: list) -> None:
        """Launch a kernel over all worlds with a thread for each world; on a CPU concurrently over `slices`."""

        def launch(worlds: WorldRange) -> None:
            """Launch the kernel for a range of worlds, which one CPU thread runs; on a GPU it is the whole range."""
            settings = self.dynamics.settings(self.dt, 1, worlds.first)
            wp.launch(
                kernel, dim=worlds.count, inputs=[self.dynamics.robot, settings, *inputs], outputs=outputs,
                device=self.device, block_dim=32 if self.device.is_cuda else 1,
            )  # fmt: skip

        jobs: list[Callable[[], None]] = [partial(launch, worlds) for worlds in self.slices]
        # Warp loads a kernel at its first launch; if two threads do so at once, one of them launches nothing
        run_in_parallel(jobs, len(jobs) if kernel in self._launched else 1)
        self._launched.add(kernel)

    def _input(self, name: str, values: wp.array | ArrayLike, shape: tuple[int, ...]) -> wp.array:
        """Return an argument of `run` as a Warp array, after a check of its shape, type and values.

        Shape (*shape, num_worlds); NumPy values may lack the last axis. name: of the argument, for messages. Raises
        InputError: another shape or type, or NumPy values that are not finite.
        """
        full = (*shape, self.num_worlds)
        if isinstance(values, wp.array):
            if values.shape != full or values.dtype != self.real:
                raise InputError(
                    f"{name} must be {self.real.__name__} of shape {full}, got {values.dtype.__name__} {values.shape}"
                )
            if values.device != self.device:
                raise InputError(f"{name} must be on {self.device}, got an array on {values.device}")
            return values
        values = real_array(values, name, np.float64)
        if values.shape == shape:
            values = np.repeat(values[..., None], self.num_worlds, axis=-1)
        if values.shape != full:
            raise InputError(f"{name} must have shape {full} or {shape}, got {values.shape}")
        if not np.isfinite(values).all():
            raise InputError(f"{name} must be finite")
        return self.array(values)

    def array(self, values: ArrayLike) -> wp.array:
        """Convert values to a new Warp array of the rollout's precision on its device."""
        return wp.array(np.asarray(values), dtype=self.real, device=self.device)

    def vectors(self, values: ArrayLike) -> wp.array:
        """Convert vectors (..., 3) to a new Warp array (...) of the kernels' vec3."""
        return wp.array(np.ascontiguousarray(values), dtype=self.dynamics.modules.scalar.vec3, device=self.device)

    def _zeros(self, *shape: int, dtype: type | None = None) -> wp.array:
        """Return an array of zeros on the rollout's device, of its precision unless `dtype` is given."""
        return wp.zeros(shape, dtype=dtype or self.real, device=self.device)

    def _empty(self, *shape: int, dtype: type | None = None) -> wp.array:
        """Return an uninitialised array on the rollout's device, of its precision unless `dtype` is given."""
        return wp.empty(shape, dtype=dtype or self.real, device=self.device)


def compact(joint_q: np.ndarray, joint_qd: np.ndarray, num_worlds: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Extract coordinates and rates of base and motors from Newton's joint arrays.

    Returned: q (19, num_worlds) and qd (18, num_worlds), as in `Trajectory`. joint_q: 43 values for each world;
    joint_qd: 38 for each world; both of any shape, world by world.
    """
    joint_q, joint_qd = np.reshape(joint_q, (num_worlds, 43)), np.reshape(joint_qd, (num_worlds, 38))
    q = np.concatenate([joint_q[:, :7], motor_values(joint_q[:, 7:])], axis=1)
    return q.T, np.concatenate([joint_qd[:, :6], motor_values(joint_qd[:, 6:])], axis=1).T
