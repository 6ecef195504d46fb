"""Dynamics of the quadruped Jumper in dedicated Warp kernels, which work on the arrays of a Newton model.

In single or double precision. Launches for a range of worlds (`WorldRange`) touch no other world: Warp runs a launch on
one thread of a CPU, so that threads can advance slices of the worlds concurrently. Nothing is summed across worlds:
results depend neither on the slices nor on the threads.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from numbers import Integral
from typing import NamedTuple

import numpy as np
import warp as wp

from jumper_warp.kernels.dynamics.restore import clear_contact_kernel, rest_blocks_kernel, restore_state_kernel
from jumper_warp.kernels.layout import COORDS
from jumper_warp.robot.description import RobotDescription
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.model import described_robots, leg_geometry_array
from jumper_warp.sim.model_parts import block_array, check_model, find_ground, find_paws, ground_struct, state_arrays
from jumper_warp.sim.precision import KernelModules, kernel_modules
from jumper_warp.utils.checks import check_count, check_number, check_positive, check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Kernel, KernelStruct
from jumper_warp.utils.newton_types import Model, State

DT = (1.0e-6, 0.1)  # [s] Shortest and longest physics step
MAX_SUBSTEPS = 1000  # Largest number of physics steps in a policy step
MAX_SWEEPS = 32  # Largest number of contact sweeps in a step
TOLERANCE = 1.0e-5  # [m/s] The contact iteration ends when a sweep changes every contact velocity by at most this
MIN_WORLDS = 16
"""Smallest slice: for fewer worlds a thread costs more than it saves, and slices would share cache lines."""


# ---------------------------------------------------------------------- ranges of worlds and the kernel of a step


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
        robots = described_robots(getattr(model, "robot_descriptions", None) if description is None else description)
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
        """Static over dynamic friction coefficient [1], shape (num_worlds,); call `pack` after a change."""
        springs = np.array([robots[world % len(robots)].spring for world in range(self.num_worlds)], dtype=np.float32)
        self.leg_springs = wp.array(springs, dtype=wp.vec2, device=self.device)
        """Stiffness [N/m], 0: none, and rest length [m] of the springs between knees, vec2 of shape (num_worlds,).

        Call `pack` after a change."""

        self.robot = self.modules.step.RobotModel()
        self.robot.geometry = leg_geometry_array(robots, self.modules.geometry, self.device)
        shape = (self.modules.layout.PARAMETER_ROWS, self.num_worlds)
        self.robot.table = wp.zeros(shape, dtype=self.real, device=self.device)
        self.robot.ground = ground_struct(model, self.ground_shape, self.modules.ground)
        self.robot.ground.blocks = block_array(block, self.num_worlds, self.modules, self.device)
        self.robot.held = wp.zeros(0, dtype=int, device=self.device)
        self.work = self._workspace()
        self._momenta = self.momenta() if keep_momentum else None
        self._every_world = wp.ones(self.num_worlds, dtype=float, device=self.device)  # mask
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

        The table has a row of all worlds for each parameter, in the kernels' precision. A change of the model's
        arrays, of `static_friction_ratio` or of `leg_springs` has no effect until it is copied.
        """
        self.repack(self._every_world)
        m = self.model
        self._launch(
            self.modules.parameters.pack_constants_kernel,
            (self.num_worlds, 4),
            [m.joint_damping, m.joint_limit_lower, m.joint_limit_upper, m.joint_limit_ke, m.joint_limit_kd,
             m.joint_effort_limit, *self.description.transversal_sum, self.leg_springs, m.gravity],
        )  # fmt: skip

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
        """Read parameters that were changed in the model.

        mask: (num_worlds,) float, not 0 in worlds whose masses, armature or friction changed, all that a randomisation
        changes; None: all parameters of all worlds. worlds: range in which the mask is read, by default all.
        """
        if mask is None:
            self.pack()
        else:
            self.repack(mask, worlds)

    def set_springs(self, stiffness: np.ndarray, length: np.ndarray) -> None:
        """Set the springs between the knees of each leg: stiffness [N/m] and rest length [m].

        Both (1, 1) for all worlds, or (num_worlds, 1).
        """
        values = np.hstack([stiffness, length])
        self.leg_springs.assign(np.broadcast_to(values, (self.num_worlds, 2)).astype(np.float32))
        self.pack()

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
        """Return the kernels that `follow` launches without bodies, each with its number of threads per block.

        `Env` compiles them before the first step.
        """
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
