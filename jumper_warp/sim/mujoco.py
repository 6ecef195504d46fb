"""Newton's MuJoCo solver with settings for this robot, and dynamics of a simulation that use it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import newton
import warp as wp
from newton import ModelFlags, StateFlags

from jumper_warp.kernels.actuation.motors import motor_torque_kernel
from jumper_warp.kernels.actuation.passive import passive_torque_kernel
from jumper_warp.kernels.actuation.readout import arrived_target_kernel, motor_values_kernel, paw_force_kernel
from jumper_warp.kernels.dynamics.restore import mask_kernel, zero_worlds_kernel
from jumper_warp.robot.description import RobotDescription, leg_dimensions, load_description
from jumper_warp.robot.model import KNEE_DOFS, LOOP_IMPEDANCE, PAWS, PHYSICS_DT, other_colliders
from jumper_warp.sim.dynamics import TOLERANCE, JumperDynamics, WorldRange
from jumper_warp.sim.model_parts import LINKS
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Kernel, KernelStruct
from jumper_warp.utils.newton_types import Control, Model, State

EXPLICIT_STOP = (1000.0, 2.0)
"""[N m/rad], [N m s/rad] of the outer + inner stop on MuJoCo: an explicit torque, so softer than SolverJumper's."""
RANDOMIZED_FLAGS = (
    ModelFlags.BODY_INERTIAL_PROPERTIES
    | ModelFlags.JOINT_DOF_FORCE_PROPERTIES
    | ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES
    | ModelFlags.SHAPE_PROPERTIES
)
"""Flags of the model's properties that domain randomisation changes."""
MUJOCO_FRICTION = 0.005
"""[1] Least friction of the paws on SolverMuJoCo: at 0.001 its pyramidal cone gives NaN in single precision."""


def mujoco_solver(model: Model, *, dt: float = PHYSICS_DT, **overrides) -> newton.solvers.SolverMuJoCo:
    """Return Newton's MuJoCo solver, set so that the robot's closed leg loops stay stiff at physics steps of `dt` [s].

    MuJoCo has neither a damper with a torque limit nor a stop of the sum of two angles: here the knees' damping is
    unlimited and outer + inner has no stop. `MujocoDynamics` adds both as torques (`kernels.actuation.passive`).

    overrides: arguments of `newton.solvers.SolverMuJoCo`. Raises InputError: paw friction below `MUJOCO_FRICTION`, or
    `save_to_mjcf`, whose file has open loops: it anchors them where the joint angles are 0.
    """
    if overrides.get("save_to_mjcf"):
        raise InputError("save_to_mjcf writes open loops; use: jumper export robot --format mjcf --out FOLDER")
    paws = [index for index, label in enumerate(model.shape_label) if label.split("/")[-1] in PAWS]
    friction = model.shape_material_mu.numpy()[paws].min(initial=math.inf)
    if not friction >= MUJOCO_FRICTION:
        raise InputError(f"SolverMuJoCo needs paws of friction {MUJOCO_FRICTION:g} or more, got {friction:g}")
    many_contacts = newton.GeoType.HFIELD in model.shape_type.numpy() or len(other_colliders(model)) > 0
    settings = {
        "njmax": 128 if many_contacts else 64,  # constraint rows of a world
        "nconmax": None if many_contacts else 12,  # contacts of a world; None: estimated from the shapes
        "iterations": 6,
        "ls_iterations": 6,
        "cone": "pyramidal",
        "integrator": "implicitfast",
        "kinematic_switchable_roots": False,
    }
    solver = newton.solvers.SolverMuJoCo(model, **(settings | overrides))
    solver.mjw_model.opt.warn_overflow = 0
    solver.mjw_model.eq_solref.fill_(wp.vec2(2.0 * dt, 1.0))
    impedance = solver.mjw_model.eq_solimp.numpy()
    impedance[:] = LOOP_IMPEDANCE
    solver.mjw_model.eq_solimp.assign(impedance)
    return solver


def take_knee_damping(model: Model) -> float:
    """Set the damping of all knees of a model to 0, and return that of world 0's first knee before [N m s/rad].

    MuJoCo's own damper has no limit of its torque; `MujocoDynamics` adds one that has.
    """
    damping = model.joint_damping.numpy().reshape(model.world_count, -1)
    knee_damping = float(damping[0, KNEE_DOFS[0]])
    damping[:, KNEE_DOFS] = 0.0
    model.joint_damping.assign(damping.ravel())
    return knee_damping


class MujocoDynamics(JumperDynamics):
    """Dynamics of a simulation by Newton's SolverMuJoCo, with this robot's motors and passive joints as torques.

    The knees' damping is taken out of the model, where its array is 0 from then on, and acts as a torque with a limit.
    Kinematics, ground and readouts are those of `JumperDynamics`.
    """

    solver_name = "SolverMuJoCo"
    sliced = False

    def __init__(
        self,
        model: Model,
        state: State,
        control: Control,
        *,
        dt: float = PHYSICS_DT,
        tolerance: float = TOLERANCE,
        observe_forces: bool = True,
        description: RobotDescription | Sequence[RobotDescription] | None = None,
    ) -> None:
        """Create Newton's MuJoCo solver; state: the one that it advances; control: gets the torques; dt: step [s].

        tolerance: checked only. observe_forces: see `Simulation`. Raises as `JumperDynamics` and `mujoco_solver`.
        """
        super().__init__(model, tolerance=tolerance, description=description)
        self._state = state
        self._control = control
        knee_damping = take_knee_damping(model)
        self.solver = mujoco_solver(model, dt=dt)
        robot = self.description
        legs = [sum(one.link(f"FL_{link}").mass for link in LINKS) * leg_dimensions(one, "FL").thigh ** 2
                for one in (robot, load_description())]  # fmt: skip
        stop = (value * legs[0] / legs[1] for value in EXPLICIT_STOP)  # stable with the inertia of other legs
        self._passive = [knee_damping, robot.knee_damping_limit, *robot.transversal_sum, *stop, self.robot.geometry,
                         self.leg_springs]  # fmt: skip
        self._arrived = wp.zeros((12, self.num_worlds), dtype=float, device=self.device)
        self._mask = wp.zeros(self.num_worlds + 1, dtype=wp.bool, device=self.device)  # the last entry is no world's
        self._sensor = self._contacts = self._observables = None
        if observe_forces:
            pipeline = newton.CollisionPipeline(
                model, rigid_contact_max=self.solver.get_max_contact_count(), soft_contact_max=0
            )
            self._contacts = pipeline.contacts()
            self._sensor = newton.sensors.SensorContact(model, sensing_shapes="*_paw", request_contact_attributes=False)
            self._observables = self.solver.observables({"contact_f"}, contacts=self._contacts)

    def follow(
        self, state: State, motors: KernelStruct, target: wp.array, dt: float, substeps: int, *,
        previous: wp.array | None = None, delay: wp.array | None = None, bodies: bool = True,
        worlds: WorldRange | None = None,
    ) -> None:  # fmt: skip
        """Advance all worlds and bodies by SolverMuJoCo, see `JumperDynamics.follow`; ignores `bodies`, `worlds`."""
        for i in range(substeps):
            if delay is not None:
                inputs = [target, previous, delay, i]
                self._launch_on(arrived_target_kernel, (12, self.num_worlds), inputs, [self._arrived])
            self._step(state, motors, target if delay is None else self._arrived, dt, restart=i == 0)

    def _step(self, state: State, motors: KernelStruct, target: wp.array, dt: float, restart: bool) -> None:
        """Advance one physics step towards motor targets [rad], (12, num_worlds); restart: reset peak forces.

        Motor torques are written to the joints first; then torques of knees, springs and stops of sums are added.
        """
        q, qd = state.joint_q, state.joint_qd
        joint_f = self._control.joint_f
        work = self.work
        each_motor = (12, self.num_worlds)
        self._launch_on(motor_torque_kernel, each_motor, [target, q, qd, motors], [joint_f])
        self._launch_on(motor_values_kernel, each_motor, [joint_f], [work.torque])
        self._launch_on(passive_torque_kernel, (self.num_worlds, 4), [q, qd, *self._passive], [joint_f])
        self.solver.step(state, state, self._control, self._contacts, dt, observables=self._observables)
        if self._sensor is not None and self._contacts is not None:
            self._sensor.update(state, self._contacts, observables=self._observables)
            outputs = [work.contact_force, work.peak_force, work.peak_paw_force]
            self._launch_on(paw_force_kernel, self.num_worlds, [self._sensor.total_force, int(restart)], outputs)

    def parameters_changed(self, mask: wp.array | None = None, worlds: WorldRange | None = None) -> None:
        """Make SolverMuJoCo read changed parameters of all worlds; ignores mask and range, which Newton cannot take."""
        self.solver.notify_model_changed(RANDOMIZED_FLAGS)

    def after_reset(self, mask: wp.array) -> None:
        """Clear reset worlds' warm starts, and compute poses and velocities of all bodies."""
        state = self._state
        self._launch_on(mask_kernel, self.num_worlds, [mask], [self._mask])
        self.forget(self._mask)
        self.full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)

    def forget(self, mask: wp.array) -> None:
        """Clear masked worlds' contact history, and stored velocities that MuJoCo's constraints of the loops read."""
        self.solver.reset(self._state, mask, flags=StateFlags.NONE)
        for stale in (self.solver.mjw_data.cvel, self.solver.mjw_data.cdof_dot):
            self._launch_on(zero_worlds_kernel, stale.shape, [mask], [stale])

    def carried(self) -> dict[str, wp.array]:
        """Return MuJoCo's warm start, `cvel`, `cdof_dot`, and body poses and velocities."""
        data = self.solver.mjw_data
        names = ("qacc_warmstart", "cvel", "cdof_dot")
        bodies = {"body_q": self._state.body_q, "body_qd": self._state.body_qd}
        return bodies | {name: getattr(data, name) for name in names}

    def step_kernels(self) -> list[tuple[Kernel, int]]:
        """Return no kernels: Newton compiles those of SolverMuJoCo."""
        return []

    def _launch_on(self, kernel: Kernel, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        """Launch a kernel on the model's device."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
