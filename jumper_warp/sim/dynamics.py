"""Dynamics of the quadruped Jumper in dedicated Warp kernels, which work on the arrays of a Newton model.

In single or double precision. Launches for a range of worlds (`WorldRange`) touch no other world: Warp runs a launch on
one thread of a CPU, so that threads can advance slices of the worlds concurrently. Nothing is summed across worlds:
results depend neither on the slices nor on the threads.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from numbers import Integral
from types import ModuleType
from typing import Any, NamedTuple

import newton
import numpy as np
import warp as wp

from jumper_warp.kernels.dynamics.restore import (
    StateArrays,
    clear_contact_kernel,
    rest_blocks_kernel,
    restore_state_kernel,
)
from jumper_warp.kernels.layout import COORDS
from jumper_warp.robot.description import LEGS, RobotDescription
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.model import described_robots, leg_geometry_array, other_colliders
from jumper_warp.sim.precision import KernelModules, kernel_modules
from jumper_warp.utils.checks import check_count, check_number, check_positive, check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Kernel, KernelStruct
from jumper_warp.utils.newton_types import Model, State

DT = (1.0e-6, 0.1)  # [s] Shortest and longest physics step
MAX_SUBSTEPS = 1000  # Largest number of physics steps in a policy step
MAX_SWEEPS = 50  # Largest number of contact sweeps in a step
TOLERANCE = 1.0e-5  # [m/s] The contact iteration ends when a sweep changes every contact velocity by at most this
MIN_WORLDS = 16
"""Smallest slice: for fewer worlds a thread costs more than it saves, and slices would share cache lines."""
LINKS = ("housing", "outer_thigh", "outer_shank", "inner_thigh", "inner_shank")
JOINTS = ("lateral", "outer", "outer_knee", "inner", "inner_knee")
ALONE = "this robot alone, besides shapes and sites"


# ---------------------------------------------------------------------- ranges of worlds and the kernel of a step


class NotThisRobotError(InputError):
    """Error raised for a Newton model whose bodies, joints or shapes are not those of this robot."""


class WorldRange(NamedTuple):
    """Contiguous range of worlds: first, ..., first + count - 1."""

    first: int
    count: int


def check_worlds(worlds: WorldRange | None, num_worlds: int) -> WorldRange:
    """Return a range of worlds, by default all. Raises InputError: it is no such range, empty, or beyond the worlds."""
    if worlds is None:
        return WorldRange(0, num_worlds)
    whole = isinstance(worlds, WorldRange) and all(isinstance(number, Integral) for number in worlds)
    if not whole or worlds.first < 0 or worlds.count < 1 or worlds.first + worlds.count > num_worlds:
        raise InputError(f"worlds must be a WorldRange in {num_worlds} worlds, got {worlds!r:.60}")
    return worlds


def slices_of(num_worlds: int, threads: int) -> list[WorldRange]:
    """Divide all worlds into at most `threads` slices of about equal size; if several, each has at least MIN_WORLDS."""
    count = max(1, min(threads, num_worlds // MIN_WORLDS))
    begins = [MIN_WORLDS * (num_worlds // MIN_WORLDS * i // count) for i in range(count)]
    return [WorldRange(a, b - a) for a, b in itertools.pairwise([*begins, num_worlds])]


def check_step(dt: float, substeps: int = 1) -> int:
    """Return `substeps` as int.

    Raises InputError: dt [s] not in the range DT, or substeps no whole number from 1 to MAX_SUBSTEPS.
    """
    check_number("dt", dt, *DT, "s")
    return check_count("substeps", substeps, MAX_SUBSTEPS)


def advance_kernel(
    device: wp.Device, modules: KernelModules | None = None, by_legs: bool | None = None
) -> tuple[Kernel, int]:
    """Return the kernel that advances the physics, and its number of threads per block.

    modules: default in single precision; by_legs: as in `JumperDynamics.advance`.
    """
    modules = modules or kernel_modules()
    if device.is_cuda if by_legs is None else by_legs:
        return modules.advance_legs.advance_legs_kernel, 32 if device.is_cuda else 4
    return modules.advance.advance_kernel, 32 if device.is_cuda else 1


# ---------------------------------------------------------------------- the robot's parts in a model


def check_model(model: Model) -> None:
    """Raise NotThisRobotError unless every world of a model is this robot, with its labels in the expected order.

    Raises InputError: it is no Newton model.
    """
    check_type("model", model, newton.Model)
    bodies = ["body"] + [f"{leg}_{link}" for leg in LEGS for link in LINKS]
    joints = ["base"] + [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS] + [f"{leg}_ankle" for leg in LEGS]
    count = model.world_count
    if count < 1:
        raise NotThisRobotError("the model has no worlds; build it with jumper_warp.robot.model.build_model")
    for noun, labels, expected in (("body", model.body_label, bodies), ("joint", model.joint_label, joints)):
        for label, name in itertools.zip_longest(labels, count * expected):
            if label is None or label.split("/")[-1] != name:
                found = f"{noun} {label!r:.60} cannot be simulated in place of {name!r}"
                raise NotThisRobotError(f"{found}: every world must hold {ALONE}")
    for name, size, per_world in (("joint_q", model.joint_coord_count, 43), ("joint_qd", model.joint_dof_count, 38)):
        if size != count * per_world:
            raise NotThisRobotError(f"{name} must hold {per_world} values a world, found {size / count:g}")
    unsupported = {
        "particles": model.particle_count,
        "muscles": model.muscle_count,
        "tendons": model.tendon_count,
        "mimic joints": np.count_nonzero(model.joint_mimic_joint.numpy() >= 0) + model.constraint_mimic_count,
        **{name: n for name, n in model.custom_frequency_counts.items() if name.startswith("mujoco:")},
    }
    for noun, number in unsupported.items():
        if number > 0:
            raise NotThisRobotError(f"{number} {noun} cannot be simulated: every world must hold {ALONE}")


def warn_of_colliders(model: Model) -> None:
    """Emit one UserWarning if the model has colliding shapes that `JumperDynamics` ignores."""
    ignored = other_colliders(model)
    if len(ignored) > 0:
        warnings.warn(
            f"SolverJumper ignores the collisions of {len(ignored)} shapes, such as "
            f"{model.shape_label[ignored[0]]!r:.60}: only paws, ground and blocks have contact",
            stacklevel=4,  # this function, the constructor, and its lock
        )


def find_paws(model: Model) -> np.ndarray:
    """Return the shape indices of the four paws in every world of a Newton model.

    Shape (num_worlds, 4) int32, legs FL, FR, BL, BR. Raises NotThisRobotError.
    """
    paws = {leg: [] for leg in LEGS}
    for i, label in enumerate(model.shape_label):
        name = label.split("/")[-1]
        if name.endswith("_paw") and name[:2] in paws:
            paws[name[:2]].append(i)
    for leg, shapes in paws.items():
        if len(shapes) != model.world_count:
            raise NotThisRobotError(f"each world must have one shape {leg}_paw, found {len(shapes)} in all")
    return np.array([paws[leg] for leg in LEGS], dtype=np.int32).T


def find_ground(model: Model) -> int:
    """Return the index of the ground shape that all worlds share, a plane or a heightfield; -1 without one.

    Raises NotThisRobotError for several, a plane other than z = 0, or a tilted heightfield.
    """
    worlds, types = model.shape_world.numpy(), model.shape_type.numpy()
    kinds = (int(newton.GeoType.PLANE), int(newton.GeoType.HFIELD))
    grounds = [i for i in np.flatnonzero(worlds == -1) if types[i] in kinds]
    if len(grounds) > 1:
        raise NotThisRobotError(f"the ground must be one plane or heightfield, found {len(grounds)}")
    if not grounds:
        return -1
    pose = model.shape_transform.numpy()[grounds[0]]
    tilted = np.abs(pose[3:5]).max() > 1e-6
    if tilted or (types[grounds[0]] == kinds[0] and abs(pose[2]) > 1e-6):
        raise NotThisRobotError("the ground plane must be z = 0 and a heightfield must not be tilted")
    return int(grounds[0])


def ground_struct(model: Model, shape: int, ground_module: ModuleType) -> KernelStruct:
    """Return the ground of a Newton model, a plane or heightfield, as the struct that the contact kernels read.

    shape: index from `find_ground`; for -1 a plane that nothing reaches.
    """
    ground = ground_module.Ground()
    heights = np.zeros((1, 1), dtype=np.float32)
    if shape < 0:
        heights = np.full((2, 2), -1000.0, dtype=np.float32)  # [m] far below every robot
        ground.rows, ground.cols, ground.half_x, ground.half_y = 2, 2, 1.0, 1.0
    elif model.shape_type.numpy()[shape] == int(newton.GeoType.HFIELD):
        field = model.shape_source[shape]
        pose = model.shape_transform.numpy()[shape]
        heights = field.min_z + np.asarray(field.data, dtype=np.float32) * (field.max_z - field.min_z) + pose[2]
        ground.rows, ground.cols = heights.shape
        ground.center_x, ground.center_y = float(pose[0]), float(pose[1])
        ground.half_x, ground.half_y = field.hx, field.hy
    ground.heights = wp.array(heights.astype(np.float32), dtype=wp.float32, device=model.device)
    return ground


def block_array(cfg: BlockCfg | None, num_worlds: int, modules: KernelModules, device: wp.DeviceLike) -> wp.array:
    """Return the sliding blocks of all worlds as an array of structs for the kernels, at rest at their starts.

    Shape (num_worlds,), or (0,) if cfg is None.
    """
    block = modules.ground.Block
    fields = {} if cfg is None else cfg.per_world(num_worlds)
    layout: Any = block.numpy_dtype()
    values: Any = np.zeros(num_worlds if fields else 0, dtype=layout)
    for name, value in fields.items():
        values[name] = value
    if fields:
        values["exists"] = 1
        values["start"] = values["center"]
    return wp.array(values, dtype=block, device=device)


def state_arrays(state: State | Model) -> KernelStruct:
    """Return the joint and body arrays of a Newton state as the struct that the kernels read.

    For a model: the arrays of its reference pose.
    """
    arrays = StateArrays()
    for name in StateArrays.vars:
        setattr(arrays, name, getattr(state, name))
    return arrays


# ---------------------------------------------------------------------- parameter table, launches, resets


class JumperDynamics:
    """Dedicated dynamics of the Jumper for every world of a Newton model: parameters, work arrays and kernel launches.

    A `Simulation` and `SolverJumper` use it in single precision. Tests use it in double precision, as the reference for
    rounding errors and gradients. q, qd: flat arrays of `real` in the layout of `joint_q` (43 a world) and `joint_qd`
    (38 a world). Arrays are never reallocated; legs FL, FR, BL, BR.
    """

    solver_name = "SolverJumper"
    sliced = True  # Whether launches support a range of worlds

    def __init__(
        self,
        model: Model,
        *,
        description: RobotDescription | Sequence[RobotDescription] | None = None,
        block: BlockCfg | None = None,
        max_sweeps: int = MAX_SWEEPS,
        tolerance: float = TOLERANCE,
        keep_momentum: bool = False,
        double: bool = False,
    ):
        """Read all robot parameters from a Newton model, and allocate the work arrays of the kernels.

        block: a moving block for every world; max_sweeps, tolerance [m/s]: end of the contact iteration; keep_momentum:
        see `follow`; double: whether in float64.
        Raises NotThisRobotError: the model is not this robot. InputError: `block` has another number of worlds,
        `max_sweeps` below 1, or `tolerance` not finite and positive.
        """
        check_model(model)
        robots = described_robots(description)
        check_type("block", block, BlockCfg | None)
        max_sweeps = check_count("max_sweeps", max_sweeps)
        check_positive("tolerance", tolerance)
        self.model = model
        self.max_sweeps = max_sweeps
        self.tolerance = tolerance
        self.description = robots[0]
        self.modules = kernel_modules(double)
        self.real: type = self.modules.scalar.real
        self.device = model.device
        self.num_worlds = model.world_count
        self.paws = wp.array(find_paws(model).flatten(), dtype=int, device=self.device)
        self.ground_shape = find_ground(model)
        self.static_friction_ratio = wp.full(self.num_worlds, 1.0, dtype=float, device=self.device)
        """Static over dynamic friction coefficient [1], shape (num_worlds,); call `pack_friction` after a change."""
        springs = np.array([robots[world % len(robots)].spring for world in range(self.num_worlds)], dtype=np.float32)
        self.leg_springs = wp.array(springs, dtype=wp.vec2, device=self.device)
        """Stiffness [N/m], 0: none, and rest length [m] of the springs between knees, vec2 of shape (num_worlds,).

        Call `pack_springs` after a change."""

        self.robot = self.modules.step.RobotModel()
        self.robot.geometry = leg_geometry_array(robots, self.modules.geometry, self.device)
        shape = (self.modules.layout.PARAMETER_ROWS, self.num_worlds)
        self.robot.table = wp.zeros(shape, dtype=self.real, device=self.device)
        self.robot.ground = ground_struct(model, self.ground_shape, self.modules.ground)
        self.robot.ground.blocks = block_array(block, self.num_worlds, self.modules, self.device)
        self.robot.held = wp.zeros(0, dtype=int, device=self.device)
        self.work = self._workspace()
        self._momenta = self.momenta() if keep_momentum else None
        self.pack()

    def _workspace(self) -> KernelStruct:
        """Allocate the arrays that the solver's kernels write, such as impulses, forces and torques, all zero.

        They persist between launches: a step begins with the last one's impulses. A diverged world is put into the
        reference pose, the model's `joint_q`. Returned as the kernels' `Workspace`.
        """
        scalar = self.modules.scalar
        n = self.num_worlds
        work = self.modules.drive.Workspace()
        for names, shape, dtype in (
            (("impulse", "contact_force"), (4, n), scalar.vec3),
            (("peak_force", "residual"), n, scalar.real),
            (("peak_paw_force",), (4, n), scalar.real),
            (("torque",), (12, n), scalar.real),
            (("sweeps", "diverged"), n, int),
        ):
            for name in names:
                setattr(work, name, wp.zeros(shape, dtype=dtype, device=self.device))
        work.reference_q = wp.array(self.model.joint_q.numpy(), dtype=scalar.real, device=self.device)
        return work

    def step_record(self, steps: int) -> KernelStruct:
        """Allocate zeroed arrays in which backpropagation records up to `steps` time steps that it recomputes."""
        record = self.modules.multipliers.StepRecord()
        n = self.num_worlds
        for name, var in record._cls.vars.items():
            shape = (n, steps + (name in ("base", "angles", "rates")))
            shape += () if name in ("base", "inverse") else (4,)
            setattr(record, name, wp.zeros(shape, dtype=var.type.dtype, device=self.device))
        return record

    def pack(self) -> None:
        """Copy masses, joints, friction, gravity and knee springs from the model to the kernels' parameter table.

        The table has a row of all worlds for each parameter, in the kernels' precision. A change of the model's arrays
        has no effect until it is copied.
        """
        self.pack_masses()
        self.pack_joints()
        self.pack_friction()
        self.pack_gravity()
        self.pack_springs()

    def pack_masses(self) -> None:
        """Copy masses, centres of mass and inertias of all links from the model to the parameter table."""
        m = self.model
        arrays = [m.body_mass, m.body_com, m.body_inertia]
        self._launch(self.modules.parameters.pack_masses_kernel, (self.num_worlds, 21), arrays)

    def pack_joints(self) -> None:
        """Copy armature, friction, damping and hard stops of all joints from the model to the parameter table."""
        m = self.model
        lower, upper = self.description.transversal_sum
        self._launch(
            self.modules.parameters.pack_joints_kernel,
            (self.num_worlds, 4),
            [m.joint_armature, m.joint_friction, m.joint_damping, m.joint_limit_lower, m.joint_limit_upper,
             m.joint_limit_ke, m.joint_limit_kd, m.joint_effort_limit, lower, upper],
        )  # fmt: skip

    def pack_friction(self) -> None:
        """Copy friction coefficients of paws and ground, and `static_friction_ratio`, to the parameter table."""
        self._launch(
            self.modules.parameters.pack_friction_kernel,
            (self.num_worlds, 4),
            [self.paws, self.ground_shape, self.model.shape_material_mu, self.static_friction_ratio],
        )

    def repack(self, mask: wp.array, worlds: WorldRange | None = None) -> None:
        """Update masses, armature and friction of some worlds in the kernels' parameter table, from the model.

        One thread for each of the 21 links and four legs of a world. mask: (num_worlds,) float, not 0 in worlds to
        update. worlds: range in which the mask is read, by default all.
        """
        m = self.model
        first, count = worlds or (0, self.num_worlds)
        self._launch(
            self.modules.parameters.repack_kernel,
            (count, 25),
            [first, mask, m.body_mass, m.body_com, m.body_inertia, m.joint_armature, m.joint_friction, self.paws,
             self.ground_shape, m.shape_material_mu, self.static_friction_ratio],
        )  # fmt: skip

    def parameters_changed(self, mask: wp.array | None = None, worlds: WorldRange | None = None) -> None:
        """Read masses, joints and friction that were changed in the model.

        mask: (num_worlds,) float, not 0 in changed worlds; None: all worlds, and gravity and springs too. worlds: range
        in which the mask is read, by default all.
        """
        if mask is None:
            self.pack()
        else:
            self.repack(mask, worlds)

    def pack_gravity(self) -> None:
        """Copy gravity of every world from the model to the parameter table of the kernels."""
        self._launch(self.modules.parameters.pack_gravity_kernel, self.num_worlds, [self.model.gravity])

    def pack_springs(self) -> None:
        """Copy stiffness and rest length of the springs between knees to the parameter table of the kernels."""
        self._launch(self.modules.parameters.pack_springs_kernel, (self.num_worlds, 4), [self.leg_springs])

    def set_springs(self, stiffness: np.ndarray, length: np.ndarray) -> None:
        """Set the springs between the knees of each leg: stiffness [N/m] and rest length [m].

        Both (1, 1) for all worlds, or (num_worlds, 1).
        """
        values = np.hstack([stiffness, length])
        self.leg_springs.assign(np.broadcast_to(values, (self.num_worlds, 2)).astype(np.float32))
        self.pack_springs()

    def _launch(self, kernel: Kernel, dim: int | tuple[int, ...], inputs: list) -> None:
        """Launch a kernel that writes to the table of robot parameters."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[self.robot.table], device=self.device)

    def settings(self, dt: float, substeps: int, first: int = 0) -> KernelStruct:
        """Return a new struct of step size dt [s], number of steps and limits of the contact iteration for a launch.

        The kernels' `StepSettings`. first: world of the first thread.
        """
        settings = self.modules.step.StepSettings()
        settings.dt = dt
        settings.substeps = substeps
        settings.max_sweeps = self.max_sweeps
        settings.tolerance = self.tolerance
        settings.first = first
        return settings

    def drive(
        self, joint_f: wp.array, body_f: wp.array, motors: KernelStruct | None = None, target: wp.array | None = None,
        previous: wp.array | None = None, delay: wp.array | None = None,
    ) -> KernelStruct:  # fmt: skip
        """Return the inputs that drive the robots in a launch, a struct: joint forces, base wrench, motor targets.

        The struct is the kernels' `Drive`. joint_f: (num_worlds * 38,), body_f: wrenches (num_worlds * 21,), as in
        Newton. With motors (`MotorArrays`) they follow target [rad], (12, num_worlds); with delay [physics steps],
        (num_worlds,), they follow `previous`, shaped as target, until the target arrives.
        """
        drive = self.modules.drive.Drive()
        drive.joint_f = joint_f
        drive.body_f = body_f
        if motors is not None:
            drive.closed_loop = 1
            drive.motors = motors
            drive.target = target
        if delay is not None:
            drive.previous = previous
            drive.delay = delay
        return drive

    def follow(
        self, state: State, motors: KernelStruct, target: wp.array, dt: float, substeps: int, *,
        previous: wp.array | None = None, delay: wp.array | None = None, bodies: bool = True,
        worlds: WorldRange | None = None,
    ) -> None:  # fmt: skip
        """Advance a state by `substeps` physics steps of dt [s], with motors that follow target [rad].

        motors, target, previous, delay: as in `drive`. bodies: whether to write passive joints and bodies of the state,
        which no step reads. worlds: range to advance, by default all. With `keep_momentum` the base's velocity is
        corrected at the end, so that gravity alone changes the momentum of a robot in free flight.
        """
        q, qd = state.joint_q, state.joint_qd
        if self._momenta is not None:
            self.read_momenta(q, qd, self._momenta, worlds)
        drive = self.drive(self.model.joint_f, state.body_f, motors, target, previous, delay)
        self.advance(dt, substeps, drive, q, qd, q, qd, worlds)
        if self._momenta is not None:
            self.project_momentum(q, qd, self._momenta, state.body_f, dt * substeps, worlds)
        if bodies:
            self.full_state(q, qd, state.body_q, state.body_qd, worlds)

    def step_kernels(self) -> list[tuple[Kernel, int]]:
        """Return the kernels that `follow` launches without bodies, each with its number of threads per block."""
        momentum = self.modules.momentum
        projection = [(momentum.momentum_kernel, 32), (momentum.project_momentum_kernel, 32)]
        return [advance_kernel(self.device, self.modules), *(projection if self._momenta is not None else [])]

    def advance(
        self, dt: float, substeps: int, drive: KernelStruct, q: wp.array, qd: wp.array, q_out: wp.array,
        qd_out: wp.array, worlds: WorldRange | None = None, by_legs: bool | None = None,
    ) -> None:  # fmt: skip
        """Advance all robots by `substeps` physics steps of dt [s]; drive: the kernels' `Drive`.

        Base and motor coordinates after the steps are written to q_out and qd_out, which may be q and qd. worlds: range
        to advance, by default all. by_legs: whether each leg has a thread (default on a GPU) or each world (default on
        a CPU).
        """
        first, count = worlds or (0, self.num_worlds)
        inputs = [self.robot, self.settings(dt, substeps, first), drive, q, qd, self.work]
        by_legs = self.device.is_cuda if by_legs is None else by_legs
        kernel, block_dim = advance_kernel(self.device, self.modules, by_legs)
        dim, inputs = ((-(-count // 8) * 8, 4), [count, *inputs]) if by_legs else (count, inputs)  # 8 worlds a warp
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[q_out, qd_out], device=self.device, block_dim=block_dim)

    def momenta(self) -> KernelStruct:
        """Allocate arrays for the linear and angular momentum of every robot, all zero.

        Returned as the kernels' `Momenta`: `lin` [kg m/s] and `ang` [kg m^2/s], vec3 of shape (num_worlds,).
        """
        momenta = self.modules.momentum.Momenta()
        for name in ("lin", "ang"):
            setattr(momenta, name, wp.zeros(self.num_worlds, dtype=self.modules.scalar.vec3, device=self.device))
        return momenta

    def read_momenta(self, q: wp.array, qd: wp.array, momenta: KernelStruct, worlds: WorldRange | None = None) -> None:
        """Compute the linear and angular momentum of every robot at q, qd, in world axes, and write it to `momenta`.

        worlds: range, by default all.
        """
        first, count = worlds or (0, self.num_worlds)
        inputs = [first, self.robot, q, qd, momenta]
        wp.launch(self.modules.momentum.momentum_kernel, count, inputs, device=self.device, block_dim=32)

    def project_momentum(
        self, q: wp.array, qd: wp.array, momenta: KernelStruct, body_f: wp.array, time: float,
        worlds: WorldRange | None = None,
    ) -> None:  # fmt: skip
        """Correct the base's velocity in qd so that only gravity changes the momentum of a robot in free flight.

        The integrator (semi-implicit Euler) lets the momentum drift while legs move. Call it after `advance` by `time`
        [s]. momenta: before that call. body_f: wrenches during it; a robot with a contact or a wrench on its base stays
        uncorrected. worlds: range, by default all.
        """
        first, count = worlds or (0, self.num_worlds)
        inputs = [first, self.robot, momenta, body_f, self.work.peak_force, self.work.diverged, time, q, qd]
        wp.launch(self.modules.momentum.project_momentum_kernel, count, inputs, device=self.device, block_dim=32)

    def full_state(
        self, q: wp.array, qd: wp.array, body_q: wp.array, body_qd: wp.array, worlds: WorldRange | None = None
    ) -> None:
        """Compute knee and ankle joints, and poses and velocities of all links, from base and motor coordinates.

        No step reads what it writes, which sensors, viewers and collision tests of links need. All joint coordinates
        are in q, qd: those of base and motors are read, the others written. body_q: poses [m], xyzw; body_qd:
        velocities [m/s], [rad/s]. worlds: range, by default all.
        """
        first, count = worlds or (0, self.num_worlds)
        wp.launch(
            self.modules.full_state.full_state_kernel,
            dim=(count, 4),
            inputs=[first, self.robot.geometry, self.model.body_com, q, qd],
            outputs=[body_q, body_qd],
            device=self.device,
        )

    def clear_contact(self, mask: wp.array) -> None:
        """Clear warm starts, contact forces and divergence flags of the worlds in a mask.

        A warm start is the impulse of the last step, with which the contact iteration of the next one begins. mask:
        (num_worlds + 1,) bool; the last entry belongs to no world.
        """
        outputs = [self.work.impulse, self.work.contact_force, self.work.diverged]
        wp.launch(clear_contact_kernel, self.num_worlds, [mask], outputs, device=self.device)

    def restore(self, mask: wp.array, start: State | Model, state: State) -> None:
        """Copy joint and body states of the worlds in a mask from `start`, for a model its reference pose, to `state`.

        mask: bool of shape (num_worlds,) or longer.
        """
        inputs, outputs = [mask, state_arrays(start)], [state_arrays(state)]
        wp.launch(restore_state_kernel, (self.num_worlds, int(COORDS)), inputs, outputs, device=self.device)

    def reset_blocks(self, mask: wp.array) -> None:
        """Return the moving blocks of the worlds in a mask, bool of shape (num_worlds,) or longer, to their starts."""
        if self.robot.ground.blocks.shape[0] > 0:
            wp.launch(rest_blocks_kernel, self.num_worlds, inputs=[mask, self.robot.ground], device=self.device)

    def forget(self, mask: wp.array) -> None:
        """Clear what a step inherits from the last one (see `clear_contact`), and return blocks to their starts.

        mask: as in `clear_contact`.
        """
        self.clear_contact(mask)
        self.reset_blocks(mask)

    def after_reset(self, mask: wp.array) -> None:
        """Update the dynamics after joint coordinates were written in worlds whose mask (num_worlds,) is not 0.

        Nothing to do here, as a step reads base and motor coordinates alone.
        """

    def carried(self) -> dict[str, wp.array]:
        """Return by name the arrays, besides joint_q, joint_qd and impulses, that the next step depends on: none.

        A saved state of an environment must hold them, so that it continues identically.
        """
        return {}
