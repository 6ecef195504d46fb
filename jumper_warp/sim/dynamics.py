"""Dynamics of the quadruped Jumper in dedicated Warp kernels, which work on the arrays of a Newton model.

In single or double precision.
"""

from __future__ import annotations

import functools
import importlib
from types import ModuleType
from typing import Any

import newton
import numpy as np
import warp as wp

from jumper_warp.robot.description import LEGS, RobotDescription, load_description
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.model import leg_geometry_array
from jumper_warp.sim.precision import float64_kernels
from jumper_warp.sim.slices import WorldRange
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.newton_types import Model

LINKS = ("housing", "outer_thigh", "outer_shank", "inner_thigh", "inner_shank")
JOINTS = ("lateral", "outer", "outer_knee", "inner", "inner_knee")
KERNEL_MODULES = (
    "actuation.command_filter", "actuation.motors", "dynamics.adjoint.constants_adjoint",
    "dynamics.adjoint.gradients", "dynamics.adjoint.leg_record", "dynamics.adjoint.multipliers",
    "dynamics.adjoint.rollout_adjoint", "dynamics.adjoint.rollout_legs_adjoint", "dynamics.adjoint.step_adjoint",
    "dynamics.contact", "dynamics.drive", "dynamics.legs.advance_legs",
    "dynamics.legs.rollout_legs", "dynamics.momentum", "dynamics.parameters", "dynamics.step", "dynamics.trajectory",
    "dynamics.world.advance", "dynamics.world.rollout", "kinematics.full_state", "kinematics.geometry",
    "layout", "scalar", "state", "terrain.ground",
)  # fmt: skip
ALONE = "this robot alone, besides shapes and sites"


class NotThisRobotError(InputError):
    """Error raised for a Newton model whose bodies, joints or shapes are not those of this robot."""


class KernelModules:
    """Warp kernel modules of the robot's dynamics, in single or double precision.

    Each is an attribute, named after the module, for those in `KERNEL_MODULES`; it is imported at its first use.
    """

    def __init__(self, double: bool = False) -> None:
        """Import no module yet; double: whether the kernels compute in float64."""
        self._package = float64_kernels().__name__ if double else "jumper_warp.kernels"

    def __getattr__(self, name: str) -> Any:
        """Import a kernel module by name, and cache it. Raises AttributeError: there is no such module."""
        for path in KERNEL_MODULES:
            if path.split(".")[-1] == name:
                module = importlib.import_module(f"{self._package}.{path}")
                setattr(self, name, module)
                return module
        raise AttributeError(f"no kernel module {name!r}")


@functools.cache
def kernel_modules(double: bool = False) -> KernelModules:
    """Return the kernel modules of the robot's dynamics; double: whether in float64."""
    return KernelModules(double)


def advance_kernel(
    device: wp.Device, modules: KernelModules | None = None, by_legs: bool | None = None
) -> tuple[wp.Kernel, int]:
    """Return the kernel that advances the physics, and its number of threads per block.

    modules: default in single precision; by_legs: as in `JumperDynamics.advance`.
    """
    modules = modules or kernel_modules()
    if device.is_cuda if by_legs is None else by_legs:
        return modules.advance_legs.advance_legs_kernel, 32 if device.is_cuda else 4
    return modules.advance.advance_kernel, 32 if device.is_cuda else 1


def check_model(model: Model) -> None:
    """Raise NotThisRobotError unless every world of a model is this robot, with its labels in the expected order."""
    bodies = ["body"] + [f"{leg}_{link}" for leg in LEGS for link in LINKS]
    joints = ["base"] + [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS] + [f"{leg}_ankle" for leg in LEGS]
    count = model.world_count
    if count < 1:
        raise NotThisRobotError("the model has no worlds; build it with jumper_warp.robot.model.build_model")
    for noun, labels, expected in (("body", model.body_label, bodies), ("joint", model.joint_label, joints)):
        names = [label.split("/")[-1] for label in labels]
        unknown = next((label for label, name in zip(labels, names, strict=True) if name not in expected), None)
        if unknown is not None and len(names) > count * len(expected):
            raise NotThisRobotError(f"{noun} {unknown!r:.60} cannot be simulated: every world must hold {ALONE}")
        if len(names) != count * len(expected):
            raise NotThisRobotError(
                f"{count} worlds of this robot have {count * len(expected)} {noun} labels, the model has {len(names)}"
            )
        for i, name in enumerate(names):
            if name != expected[i % len(expected)]:
                raise NotThisRobotError(f"{noun} {i} must be {expected[i % len(expected)]!r}, found {name!r}")
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


def ground_struct(model: Model, shape: int, ground_module: ModuleType) -> Any:
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
    values: Any = np.zeros(num_worlds if fields else 0, dtype=block.numpy_dtype())
    for name, value in fields.items():
        values[name] = value
    if fields:
        values["exists"] = 1
        values["start"] = values["center"]
    return wp.array(values, dtype=block, device=device)


class JumperDynamics:
    """Dedicated dynamics of the Jumper for every world of a Newton model: parameters, work arrays and kernel launches.

    `SolverJumper` uses it in single precision. Tests use it in double precision, as the reference for rounding errors
    and gradients. q, qd: flat arrays of `real` in the layout of `joint_q` (43 a world) and `joint_qd` (38 a world).
    """

    def __init__(
        self,
        model: Model,
        *,
        description: RobotDescription | None = None,
        block: BlockCfg | None = None,
        double: bool = False,
    ):
        """Read all robot parameters from a Newton model, and allocate the work arrays of the kernels.

        block: a moving block for every world; double: whether in float64. Raises NotThisRobotError: the model is not
        this robot, InputError: `block` has another number of worlds.
        """
        check_model(model)
        self.model = model
        self.description = load_description() if description is None else description
        self.modules = kernel_modules(double)
        self.real = self.modules.scalar.real
        self.device = model.device
        self.num_worlds = model.world_count
        self.paws = wp.array(find_paws(model).flatten(), dtype=int, device=self.device)
        self.ground_shape = find_ground(model)
        self.static_friction_ratio = wp.full(self.num_worlds, 1.0, dtype=float, device=self.device)
        """Static over dynamic friction coefficient [1], shape (num_worlds,); call `pack_friction` after a change."""
        self.leg_springs = wp.zeros(self.num_worlds, dtype=wp.vec2, device=self.device)
        """Stiffness [N/m], 0: none, and rest length [m] of the springs between knees, vec2 of shape (num_worlds,).

        Call `pack_springs` after a change."""

        self.robot = self.modules.step.RobotModel()
        self.robot.geometry = leg_geometry_array(self.description, self.modules.geometry, self.device)
        shape = (self.modules.layout.PARAMETER_ROWS, self.num_worlds)
        self.robot.table = wp.zeros(shape, dtype=self.real, device=self.device)
        self.robot.ground = ground_struct(model, self.ground_shape, self.modules.ground)
        self.robot.ground.blocks = block_array(block, self.num_worlds, self.modules, self.device)
        self.robot.held = wp.zeros(0, dtype=int, device=self.device)
        self.work = self._workspace()
        self.pack()

    def _workspace(self) -> Any:
        """Allocate the arrays that the solver's kernels write, such as impulses, forces and torques, all zero.

        The reference pose is the model's `joint_q`. Returned as the kernels' `Workspace`.
        """
        scalar, n = self.modules.scalar, self.num_worlds
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

    def step_record(self, steps: int) -> Any:
        """Allocate zeroed arrays in which backpropagation records up to `steps` time steps that it recomputes."""
        record, n = self.modules.multipliers.StepRecord(), self.num_worlds
        for name, var in record._cls.vars.items():
            shape = (n, steps + (name in ("base", "angles", "rates")))
            shape += () if name in ("base", "inverse") else (4,)
            setattr(record, name, wp.zeros(shape, dtype=var.type.dtype, device=self.device))
        return record

    def pack(self) -> None:
        """Copy masses, joints, friction, gravity and knee springs from the model to the kernels' parameter table."""
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

        mask: (num_worlds,) float, not 0 in worlds to update. worlds: range in which the mask is read, by default all.
        """
        m, (first, count) = self.model, worlds or (0, self.num_worlds)
        self._launch(
            self.modules.parameters.repack_kernel,
            (count, 25),
            [first, mask, m.body_mass, m.body_com, m.body_inertia, m.joint_armature, m.joint_friction, self.paws,
             self.ground_shape, m.shape_material_mu, self.static_friction_ratio],
        )  # fmt: skip

    def pack_gravity(self) -> None:
        """Copy gravity of every world from the model to the parameter table of the kernels."""
        self._launch(self.modules.parameters.pack_gravity_kernel, self.num_worlds, [self.model.gravity])

    def pack_springs(self) -> None:
        """Copy stiffness and rest length of the springs between knees to the parameter table of the kernels."""
        self._launch(self.modules.parameters.pack_springs_kernel, (self.num_worlds, 4), [self.leg_springs])

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list) -> None:
        """Launch a kernel that writes to the table of robot parameters."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[self.robot.table], device=self.device)

    def settings(self, dt: float, substeps: int, max_sweeps: int, tolerance: float) -> Any:
        """Return step size, step count and limits of the contact iteration as the struct that the step kernels read.

        dt [s]; max_sweeps and tolerance [m/s] end the contact iteration.
        """
        settings = self.modules.step.StepSettings()
        settings.dt, settings.substeps = dt, substeps
        settings.max_sweeps, settings.tolerance = max_sweeps, tolerance
        return settings

    def drive(
        self, joint_f: wp.array, body_f: wp.array, motors: Any = None, target: wp.array | None = None,
        previous: wp.array | None = None, delay: wp.array | None = None,
    ) -> Any:  # fmt: skip
        """Return the inputs that drive the robots in a launch, a struct: joint forces, base wrench, motor targets.

        The struct is the kernels' `Drive`. joint_f: (num_worlds * 38,), body_f: wrenches (num_worlds * 21,), as in
        Newton. With motors (`MotorArrays`) they follow target [rad], (12, num_worlds); with delay [physics steps],
        (num_worlds,), they follow `previous`, shaped as target, until the target arrives.
        """
        drive = self.modules.drive.Drive()
        drive.joint_f, drive.body_f = joint_f, body_f
        if motors is not None:
            drive.closed_loop, drive.motors, drive.target = 1, motors, target
        if delay is not None:
            drive.previous, drive.delay = previous, delay
        return drive

    def advance_kernel(self, by_legs: bool | None = None) -> tuple[wp.Kernel, int]:
        """Return the kernel that `advance` launches, and its number of threads per block; by_legs: see `advance`."""
        return advance_kernel(self.device, self.modules, by_legs)

    def advance(
        self, settings: Any, drive: Any, q: wp.array, qd: wp.array, q_out: wp.array, qd_out: wp.array,
        worlds: WorldRange | None = None, by_legs: bool | None = None,
    ) -> None:  # fmt: skip
        """Advance all robots by `settings.substeps` physics steps.

        Base and motor coordinates after the steps are written to q_out and qd_out, which may be q and qd. worlds: range
        to advance, by default all. by_legs: whether each leg has a thread (default on a GPU) or each world (default on
        a CPU).
        """
        settings.first, count = worlds or (0, self.num_worlds)
        inputs, outputs = [self.robot, settings, drive, q, qd, self.work], [q_out, qd_out]
        by_legs = self.device.is_cuda if by_legs is None else by_legs
        kernel, block_dim = self.advance_kernel(by_legs)
        dim, inputs = ((-(-count // 8) * 8, 4), [count, *inputs]) if by_legs else (count, inputs)  # 8 worlds a warp
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=block_dim)

    def momenta(self) -> Any:
        """Allocate arrays for the linear and angular momentum of every robot, all zero.

        Returned as the kernels' `Momenta`: `lin` [kg m/s] and `ang` [kg m^2/s], vec3 of shape (num_worlds,).
        """
        momenta = self.modules.momentum.Momenta()
        for name in ("lin", "ang"):
            setattr(momenta, name, wp.zeros(self.num_worlds, dtype=self.modules.scalar.vec3, device=self.device))
        return momenta

    def read_momenta(self, q: wp.array, qd: wp.array, momenta: Any, worlds: WorldRange | None = None) -> None:
        """Compute the linear and angular momentum of every robot at q, qd, in world axes, and write it to `momenta`.

        worlds: range, by default all.
        """
        first, count = worlds or (0, self.num_worlds)
        inputs = [first, self.robot, q, qd, momenta]
        wp.launch(self.modules.momentum.momentum_kernel, count, inputs, device=self.device, block_dim=32)

    def project_momentum(
        self, q: wp.array, qd: wp.array, momenta: Any, body_f: wp.array, time: float, worlds: WorldRange | None = None
    ) -> None:
        """Correct the base's velocity in qd so that only gravity changes the momentum of a robot in free flight.

        Call it after `advance` by `time` [s]. momenta: before that call. body_f: wrenches during it; a robot with a
        contact or a wrench on its base stays uncorrected. worlds: range, by default all.
        """
        first, count = worlds or (0, self.num_worlds)
        inputs = [first, self.robot, momenta, body_f, self.work.peak_force, self.work.diverged, time, q, qd]
        wp.launch(self.modules.momentum.project_momentum_kernel, count, inputs, device=self.device, block_dim=32)

    def full_state(
        self, q: wp.array, qd: wp.array, body_q: wp.array, body_qd: wp.array, worlds: WorldRange | None = None
    ) -> None:
        """Compute knee and ankle joints, and poses and velocities of all links, from base and motor coordinates.

        All joint coordinates are in q, qd: those of base and motors are read, the others written. body_q: poses [m],
        xyzw; body_qd: velocities [m/s], [rad/s]. worlds: range, by default all.
        """
        first, count = worlds or (0, self.num_worlds)
        wp.launch(
            self.modules.full_state.full_state_kernel,
            dim=(count, 4),
            inputs=[first, self.robot.geometry, self.model.body_com, q, qd],
            outputs=[body_q, body_qd],
            device=self.device,
        )
