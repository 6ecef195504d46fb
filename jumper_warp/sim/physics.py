"""Common interface of SolverJumper and SolverMuJoCo for simulations and environments."""

from __future__ import annotations

import weakref
from abc import ABC, abstractmethod
from typing import Any

import newton
import warp as wp
from newton import ModelFlags

from jumper_warp.kernels.actuation.motors import motor_torque_kernel
from jumper_warp.kernels.actuation.passive import passive_torque_kernel
from jumper_warp.kernels.actuation.readout import arrived_target_kernel, motor_values_kernel, paw_force_kernel
from jumper_warp.kernels.dynamics.restore import mask_kernel, zero_worlds_kernel
from jumper_warp.kernels.layout import COORDS, DOFS
from jumper_warp.robot.description import load_description
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.model import KNEE_DOFS
from jumper_warp.sim.dynamics import JumperDynamics
from jumper_warp.sim.mujoco import mujoco_solver
from jumper_warp.sim.slices import WorldRange
from jumper_warp.sim.solver import SolverJumper

EXPLICIT_STOP = (1000.0, 2.0)
"""[N m/rad], [N m s/rad] of the outer + inner stop on MuJoCo: an explicit torque, so softer than SolverJumper's."""
RANDOMIZED_FLAGS = (
    ModelFlags.BODY_INERTIAL_PROPERTIES
    | ModelFlags.JOINT_DOF_FORCE_PROPERTIES
    | ModelFlags.JOINT_DOF_INERTIAL_PROPERTIES
    | ModelFlags.SHAPE_PROPERTIES
)
"""Flags of the model's properties that domain randomisation changes."""


class Physics(ABC):
    """Interface of the solver and motors with which a `Simulation` advances its worlds.

    Arrays are never reallocated; legs FL, FR, BL, BR.
    """

    sliced: bool  # Whether `advance` supports a range of worlds
    solver: newton.solvers.SolverBase
    dynamics: JumperDynamics  # Geometry, ground and friction ratio; SolverMuJoCo uses it for kinematics only
    diverged: wp.array  # (num_worlds,) int, 1: the world diverged
    impulse: wp.array
    """(4, num_worlds) vec3 [N s] Paws' contact impulses, world frame, with which the next contact iteration starts."""
    torque: wp.array  # (12, num_worlds) [N m] Motor torques of the last physics step, in motor order
    paw_force: wp.array  # (4, num_worlds) vec3 [N] Ground forces on the paws in the last physics step, world frame
    peak_force: wp.array  # (num_worlds,) [N] Largest total paw force in the last call of `advance`
    peak_paw_force: wp.array  # (4, num_worlds) [N] Largest force on each paw in the last call of `advance`

    def __init__(self, sim: Any) -> None:
        """Keep a weak reference to a `Simulation`, whose model, state, control and motors are allocated.

        The simulation owns the physics: with a strong reference, its memory would wait for a garbage collection.
        """
        self._sim: Any = weakref.proxy(sim)

    @abstractmethod
    def advance(
        self, substeps: int, target: wp.array, previous: wp.array | None = None, delay: wp.array | None = None,
        bodies: bool = True, worlds: WorldRange | None = None,
    ) -> None:  # fmt: skip
        """Launch `substeps` physics steps, with motors that follow target [rad], (12, num_worlds).

        With delay [physics steps], (num_worlds,), they follow `previous` (12, num_worlds) until the target arrives.
        bodies: whether to write passive joints and bodies of the state. worlds: range to advance, by default all.
        """

    @abstractmethod
    def parameters_changed(self, mask: wp.array | None = None, worlds: WorldRange | None = None) -> None:
        """Make the solver use masses, joints and friction that were changed in the model.

        mask: (num_worlds,) float, not 0 in changed worlds; None: all worlds. worlds: range in which the mask is read,
        by default all.
        """

    @abstractmethod
    def forget(self, mask: wp.array) -> None:
        """Clear warm starts, contact history and divergence flags of the worlds in a mask.

        mask: (num_worlds + 1,) bool; the last entry belongs to no world.
        """

    @abstractmethod
    def after_reset(self, mask: wp.array) -> None:
        """Update the solver after joint coordinates were written in worlds whose mask (num_worlds,) is not 0."""

    def write_bodies(self) -> None:
        """Compute the state's passive joints, body poses and body velocities from base and motor coordinates."""
        state = self._sim.state
        self.dynamics.full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)

    def kernels(self) -> list[tuple[wp.Kernel, int]]:
        """Return the kernels that a policy step launches, to compile them in advance.

        As (kernel, threads per block).
        """
        return []

    def carried(self) -> dict[str, wp.array]:
        """Return by name the arrays, besides joint_q, joint_qd, `impulse`, that the next step depends on; no copies.

        An example is a warm start of the solver. A solver without memory has none.
        """
        return {}


class JumperPhysics(Physics):
    """Physics of a simulation by `SolverJumper`, which advances a whole policy step in one launch."""

    sliced = True
    solver: SolverJumper

    def __init__(self, sim: Any, block: BlockCfg | None, tolerance: float, keep_momentum: bool) -> None:
        """Create the `SolverJumper` of a simulation's model. Raises ValueError as `SolverJumper`."""
        super().__init__(sim)
        self.solver = SolverJumper(sim.model, block=block, tolerance=tolerance)
        self.dynamics = self.solver.dynamics
        work = self.dynamics.work
        self.diverged, self.impulse, self.torque = work.diverged, work.impulse, work.torque
        self.paw_force, self.peak_force, self.peak_paw_force = work.contact_force, work.peak_force, work.peak_paw_force
        self._momenta = self.dynamics.momenta() if keep_momentum else None

    def advance(
        self, substeps: int, target: wp.array, previous: wp.array | None = None, delay: wp.array | None = None,
        bodies: bool = True, worlds: WorldRange | None = None,
    ) -> None:  # fmt: skip
        """Launch `substeps` physics steps of SolverJumper, with motors that follow target [rad], (12, num_worlds)."""
        state, sim = self._sim.state, self._sim
        q, qd, momenta = state.joint_q, state.joint_qd, self._momenta
        if momenta is not None:
            self.dynamics.read_momenta(q, qd, momenta, worlds)
        self.solver.step_motors(
            state, state, sim.motors, target, sim.dt, substeps, previous=previous, delay=delay,
            bodies=bodies and momenta is None, worlds=worlds,
        )  # fmt: skip
        if momenta is not None:
            self.dynamics.project_momentum(q, qd, momenta, state.body_f, sim.dt * substeps, worlds)
            if bodies:
                self.dynamics.full_state(q, qd, state.body_q, state.body_qd, worlds)

    def parameters_changed(self, mask: wp.array | None = None, worlds: WorldRange | None = None) -> None:
        """Copy changed masses, joints and friction from the model to SolverJumper; see `Physics.parameters_changed`."""
        if mask is None:
            self.dynamics.pack()
        else:
            self.dynamics.repack(mask, worlds)

    def after_reset(self, mask: wp.array) -> None:
        """Do nothing after a reset, as SolverJumper reads base and motor coordinates alone."""

    def forget(self, mask: wp.array) -> None:
        """Clear contact history and divergence flags of masked worlds, and return their blocks to the start."""
        self.solver.reset(self._sim.state, mask, flags=newton.StateFlags.NONE)
        if self._sim.block is not None:
            self.solver.reset_blocks(mask)

    def kernels(self) -> list[tuple[wp.Kernel, int]]:
        """Return the kernels that a policy step launches; with `keep_momentum` also those that correct the momentum."""
        momentum = self.dynamics.modules.momentum
        projection = [(momentum.momentum_kernel, 32), (momentum.project_momentum_kernel, 32)]
        return [self.dynamics.advance_kernel(), *(projection if self._momenta is not None else [])]


class MujocoPhysics(Physics):
    """Physics of a simulation by Newton's SolverMuJoCo, with this robot's motors and passive joints as torques."""

    sliced = False
    solver: newton.solvers.SolverMuJoCo

    def __init__(self, sim: Any, observe_forces: bool) -> None:
        """Create Newton's MuJoCo solver for a simulation, with knee damping as an explicit torque.

        observe_forces: see `Simulation`.
        """
        super().__init__(sim)
        n, device, model = sim.num_worlds, sim.device, sim.model
        self.dynamics = JumperDynamics(model)  # refuses another robot
        damping = model.joint_damping.numpy().reshape(n, -1)
        knee_damping = float(damping[0, KNEE_DOFS[0]])
        damping[:, KNEE_DOFS] = 0.0
        model.joint_damping.assign(damping.ravel())
        self.solver = mujoco_solver(model, dt=sim.dt)
        robot = load_description()
        self._passive = [knee_damping, robot.knee_damping_limit, *robot.transversal_sum, *EXPLICIT_STOP,
                         self.dynamics.robot.geometry, self.dynamics.leg_springs]  # fmt: skip
        self.diverged = wp.zeros(n, dtype=int, device=device)
        self.impulse = wp.zeros((4, n), dtype=wp.vec3, device=device)
        self.torque = wp.zeros((12, n), dtype=float, device=device)
        self.paw_force = wp.zeros((4, n), dtype=wp.vec3, device=device)
        self.peak_force = wp.zeros(n, dtype=float, device=device)
        self.peak_paw_force = wp.zeros((4, n), dtype=float, device=device)
        self._arrived = wp.zeros((12, n), dtype=float, device=device)
        self._mask = wp.zeros(n + 1, dtype=wp.bool, device=device)  # the last entry belongs to no world
        self._sensor = self._contacts = self._observables = None
        if observe_forces:
            pipeline = newton.CollisionPipeline(
                model, rigid_contact_max=self.solver.get_max_contact_count(), soft_contact_max=0
            )
            self._contacts = pipeline.contacts()
            self._sensor = newton.sensors.SensorContact(model, sensing_shapes="*_paw", request_contact_attributes=False)
            self._observables = self.solver.observables({"contact_f"}, contacts=self._contacts)

    def advance(
        self, substeps: int, target: wp.array, previous: wp.array | None = None, delay: wp.array | None = None,
        bodies: bool = True, worlds: WorldRange | None = None,
    ) -> None:  # fmt: skip
        """Launch `substeps` physics steps of SolverMuJoCo for all worlds and bodies; ignores `bodies` and `worlds`."""
        for i in range(substeps):
            if delay is not None:
                self._launch(
                    arrived_target_kernel, (12, self._sim.num_worlds), [target, previous, delay, i], [self._arrived]
                )
            self._step(target if delay is None else self._arrived, restart=i == 0)

    def _step(self, target: wp.array, restart: bool) -> None:
        """Advance one physics step of SolverMuJoCo towards motor targets [rad], (12, num_worlds).

        restart: whether to reset peak forces.
        """
        sim, state, joint_f = self._sim, self._sim.state, self._sim.control.joint_f
        q, qd, motors = state.joint_q, state.joint_qd, (12, sim.num_worlds)
        self._launch(motor_torque_kernel, motors, [target, q, qd, COORDS, DOFS, sim.motors], [joint_f])
        self._launch(motor_values_kernel, motors, [joint_f], [self.torque])
        self._launch(passive_torque_kernel, (sim.num_worlds, 4), [q, qd, *self._passive], [joint_f])
        self.solver.step(state, state, sim.control, self._contacts, sim.dt, observables=self._observables)
        if self._sensor is not None and self._contacts is not None:
            self._sensor.update(state, self._contacts, observables=self._observables)
            inputs = [self._sensor.total_force, int(restart)]
            self._launch(
                paw_force_kernel, sim.num_worlds, inputs, [self.paw_force, self.peak_force, self.peak_paw_force]
            )

    def parameters_changed(self, mask: wp.array | None = None, worlds: WorldRange | None = None) -> None:
        """Make SolverMuJoCo read changed parameters of all worlds; ignores mask and range."""
        self.solver.notify_model_changed(RANDOMIZED_FLAGS)

    def after_reset(self, mask: wp.array) -> None:
        """Clear reset worlds' warm starts, compute poses and velocities of all bodies; see `Physics.after_reset`."""
        self._launch(mask_kernel, self._sim.num_worlds, [mask], [self._mask])
        self.forget(self._mask)
        self.write_bodies()

    def forget(self, mask: wp.array) -> None:
        """Clear masked worlds' contact history, and stored velocities that MuJoCo's constraints of the loops read."""
        self.solver.reset(self._sim.state, mask, flags=newton.StateFlags.NONE)
        for stale in (self.solver.mjw_data.cvel, self.solver.mjw_data.cdof_dot):
            self._launch(zero_worlds_kernel, stale.shape, [mask], [stale])

    def carried(self) -> dict[str, wp.array]:
        """Return MuJoCo's warm start, `cvel`, `cdof_dot`, and body poses and velocities; see `Physics.carried`."""
        data = self.solver.mjw_data
        names = ("qacc_warmstart", "cvel", "cdof_dot")
        bodies = {"body_q": self._sim.state.body_q, "body_qd": self._sim.state.body_qd}
        return bodies | {name: getattr(data, name) for name in names}

    def _launch(self, kernel: Any, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        """Launch a kernel on the simulation's device."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._sim.device)
