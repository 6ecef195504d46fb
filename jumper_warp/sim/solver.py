"""`SolverJumper`: the robot's dedicated solver behind Newton's solver interface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import newton
import numpy as np
import warp as wp
from newton import ModelFlags, StateFlags
from newton.solvers import SolverBase

from jumper_warp.kernels.actuation.readout import body_acceleration_kernel
from jumper_warp.kernels.collision.paw_contacts import ContactRows, PawShapes, paw_contacts_kernel
from jumper_warp.robot.description import RobotDescription
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.sim.dynamics import MAX_SWEEPS, TOLERANCE, JumperDynamics, check_step
from jumper_warp.sim.model_parts import warn_of_colliders
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.checks import check_finite, check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.newton_types import Control, Model, State
from jumper_warp.utils.threads import locked


class SolverJumper(SolverBase):
    """Solver of the Jumper's exact 18-coordinate dynamics with rigid paw contact.

    The five-bar loops hold by construction. Integration is semi-implicit Euler. Contact is solved
    paw by paw to `tolerance`: in turn on a CPU (Gauss-Seidel), all at once on a GPU, or in turn where that does not
    converge. Hard stops of motors and of a leg's outer + inner are solved together with contact
    (`kernels.actuation.stops`). Masses, inertias, armature, motor friction, damping, joint stops, paw friction and
    gravity of each world are read from the model: write its arrays, then call `notify_model_changed`.

    Reads base and motor coordinates of `joint_q`/`joint_qd`, `control.joint_f` of base and motors (world wrench [N],
    [N m] at the base's com; motor torques [N m]) and `state.body_f` of the base. Writes every joint, loop joint and
    body. Forces on other bodies and passive joints are not read. On a CPU one thread simulates a world, on a GPU
    four threads share a world and sum in a fixed order, so that results on a device are bitwise reproducible.

    `wp.Tape` cannot differentiate `step`: `jumper_warp.diff.rollout.Rollout` computes gradients.

    With `block`, each world has a block that the paws can push over the floor. A paw touches floor or block, whichever
    is nearer.

    For Newton's sensors: accelerations of all bodies, where a step's observables or `state_out.body_qdd` request them;
    contacts of the paws (`update_contacts`), where its observables request `contact_f`.

    Shapes of the model other than paws and ground do not collide; a warning names the first such shape. Sites and
    shapes that do not collide are for sensors and viewers.

    A diverged (non-finite) world is flagged in `diverged` and frozen at rest in the model's reference pose until
    `reset` clears it.
    """

    model: Model
    SUPPORTED_OBSERVABLES = frozenset({SolverBase.ObservableKind.BODY_QDD, SolverBase.ObservableKind.CONTACT_F})

    @locked
    def __init__(
        self,
        model: Model,
        *,
        description: RobotDescription | None = None,
        block: BlockCfg | None = None,
        max_sweeps: int = MAX_SWEEPS,
        tolerance: float = TOLERANCE,
        dynamics: JumperDynamics | None = None,
    ):
        """Prepare the solver for a model of `jumper_warp.robot.model.build_model`.

        dynamics: the model's, if it has some already, such as those of a `Simulation`; the other arguments are theirs.

        Raises:
            NotThisRobotError: the model is another robot's, or holds more bodies, joints or particles than it.
            InputError: `max_sweeps` below 1, `tolerance` [m/s] not finite and positive, or arrays of `block` that do
                not have one row per world.
        """
        super().__init__(model)
        check_type("dynamics", dynamics, JumperDynamics | None)
        if dynamics is None:
            dynamics = JumperDynamics(
                model, description=description, block=block, max_sweeps=max_sweeps, tolerance=tolerance
            )
            warn_of_colliders(model)
        self.dynamics = dynamics
        work = self.dynamics.work
        self.contact_force: wp.array = work.contact_force
        """Force of the ground on each paw (FL, FR, BL, BR) in the last step [N], world frame, (4, num_worlds) vec3."""
        self.peak_force: wp.array = work.peak_force  # Largest total paw force of the last call [N], shape (num_worlds,)
        self.torque: wp.array = work.torque  # Torque of each motor in the last step [N m], shape (12, num_worlds)
        self.residual: wp.array = work.residual
        """Largest velocity change [m/s] of the last contact sweep, worst step of the last call, (num_worlds,)."""
        self.sweeps: wp.array = work.sweeps
        """Largest number of contact sweeps of a step in the last call (on a GPU: rounds of all paws), (num_worlds,)."""
        self.diverged: wp.array = work.diverged
        """1: the world diverged and is frozen until `reset`, int of shape (num_worlds,)."""
        self._default_control = model.control(clone_variables=False)
        n = model.world_count
        self._state_shapes = {"joint_q": (43 * n,), "joint_qd": (38 * n,), "body_q": (21 * n,), "body_qd": (21 * n,)}
        self._no_body_f = wp.zeros(model.body_count, dtype=wp.spatial_vectorf, device=model.device)
        self._old_body_qd = wp.zeros(model.body_count, dtype=wp.spatial_vectorf, device=model.device)

    @locked
    def step(
        self, state_in: State, state_out: State, control: Control | None, contacts: newton.Contacts | None, dt: float,
        *, observables: SolverBase.Observables | None = None,
    ) -> None:  # fmt: skip
        """Advance every world by dt [s]. The solver finds the paws' contacts itself.

        contacts: not read; filled as by `update_contacts` where `observables` requests `contact_f`.
        Raises InputError: a dt that is not finite and positive, arrays of another model or device, or as
        `update_contacts`.
        """
        self.validate_observables(observables, contacts)
        drive = self.dynamics.drive(*self._forces(state_in, control))
        check_step(dt, 1)
        if state_out is not state_in:
            self._check_state("state_out", state_out)
        qdd = state_out.body_qdd
        contact_f = None
        if observables is not None:
            qdd = qdd if observables.body_qdd is None else observables.body_qdd
            contact_f = observables.contact_f
        if qdd is not None:
            self._check("body_qdd", qdd, self._state_shapes["body_qd"])
            wp.copy(self._old_body_qd, state_in.body_qd)
        if state_out.joint_q.requires_grad:
            raise InputError("SolverJumper has no gradients on Warp's tape; use jumper_warp.diff.rollout.Rollout")
        out = (state_out.joint_q, state_out.joint_qd)
        self.dynamics.advance(dt, 1, drive, state_in.joint_q, state_in.joint_qd, *out)
        self.dynamics.full_state(*out, state_out.body_q, state_out.body_qd)
        if qdd is not None:
            wp.launch(
                body_acceleration_kernel,
                dim=self.model.body_count,
                inputs=[self._old_body_qd, state_out.body_qd, dt],
                outputs=[qdd],
                device=self.model.device,
            )
        if observables is not None and contact_f is not None and observables.contacts is not None:
            self._write_contacts(observables.contacts, state_out, contact_f)

    def _forces(self, state: State, control: Control | None) -> tuple[wp.array, wp.array]:
        """Return the joint forces of a control and the body wrenches of a state, or zeros where they are None."""
        self._check_state("state_in", state)
        body_f = self._no_body_f if state.body_f is None else state.body_f
        joint_f = (control or self._default_control).joint_f
        self._check("control.joint_f", joint_f, self._state_shapes["joint_qd"])
        self._check("state_in.body_f", body_f, self._state_shapes["body_q"])
        return joint_f, body_f

    def _check(self, name: str, array: wp.array | None, shape: tuple[int, ...]) -> None:
        """Raise InputError unless an array has the given shape and is on the model's device; kernels check neither."""
        is_array = isinstance(array, wp.array)
        if not is_array or array.shape != shape or array.device is not self.model.device:
            found = f"{array.shape} on {array.device}" if is_array else type(array).__name__
            raise InputError(
                f"{name} must have shape {shape} on {self.model.device}, for {self.model.world_count} worlds of this "
                f"solver's model, got {found}"
            )

    def _check_state(self, name: str, state: State) -> None:
        """Raise InputError unless the arrays of a state are those of a state of this model; name: for the message."""
        for field, shape in self._state_shapes.items():
            self._check(f"{name}.{field}", getattr(state, field, None), shape)

    @locked
    def update_contacts(self, contacts: newton.Contacts, state: State | None = None) -> None:
        """Write the paws' contacts of the last step to `contacts`, touching or not: four rows a world, FL, FR, BL, BR.

        Shape 0 is the paw, shape 1 the ground, on which a block counts as ground; without ground there are no rows.
        state: the last step's. `contacts.force`, if allocated, gets the force of the ground on the paw [N], world.
        Raises InputError: there is no state of this model, or the contacts hold fewer rows.
        """
        if state is None:
            raise InputError("update_contacts needs the state of the last step")
        check_type("contacts", contacts, newton.Contacts)
        force = contacts.force
        if force is None:
            force = wp.zeros(contacts.rigid_contact_max, dtype=wp.spatial_vectorf, device=self.model.device)
        self._write_contacts(contacts, state, force)

    def _write_contacts(self, contacts: newton.Contacts, state: State, contact_f: wp.array) -> None:
        """Write the paws' contacts of the last step to `contacts`, and their forces to `contact_f`.

        As `update_contacts`. Raises InputError: too few rows.
        """
        dynamics = self.dynamics
        n = self.model.world_count
        device = self.model.device
        self._check("state.body_q", getattr(state, "body_q", None), self._state_shapes["body_q"])
        if contacts.rigid_contact_max < 4 * n:
            raise InputError(f"contacts must hold {4 * n} rows, four a world, got {contacts.rigid_contact_max}")
        if dynamics.ground_shape < 0:
            contacts.rigid_contact_count.zero_()
            return
        rows = ContactRows()
        shapes = PawShapes()
        for name in rows._cls.vars:
            setattr(rows, name, getattr(contacts, f"rigid_contact_{name}"))
        shapes.paws = dynamics.paws
        shapes.ground = dynamics.ground_shape
        for name in ("body", "transform", "scale"):
            setattr(shapes, name, getattr(self.model, f"shape_{name}"))
        contact_f.zero_()
        inputs = [shapes, dynamics.robot.ground, state.body_q, self.contact_force]
        wp.launch(paw_contacts_kernel, dim=(4, n), inputs=inputs, outputs=[rows, contact_f], device=device)

    @locked
    def block_position(self) -> np.ndarray:
        """Return the sliding blocks' centres [m], world frame, (num_worlds, 2). Raises InputError without blocks."""
        return self._block_values()["center"].copy()

    @locked
    def block_velocity(self) -> np.ndarray:
        """Return the sliding blocks' velocities [m/s], world frame, (num_worlds, 2). Raises InputError: no blocks."""
        return self._block_values()["velocity"].copy()

    @locked
    def place_blocks(self, center: np.ndarray, worlds: Sequence[int] | None = None) -> None:
        """Move the sliding blocks of some worlds (indices), by default all, to new start positions, at rest.

        center: x and y [m], world frame, (2,) or (len(worlds), 2). Raises InputError without blocks, or
        unless they are finite numbers.
        """
        center = real_array(center, "center")
        check_finite("center", *center.ravel())
        values = self._block_values()
        values["start"][slice(None) if worlds is None else list(worlds)] = center
        self._blocks().assign(values)
        self.reset_blocks(worlds)

    @locked
    def reset_blocks(self, worlds: Sequence[int] | wp.array | None = None) -> None:
        """Reset the sliding blocks of some worlds, by default all, to their start positions, at rest.

        `worlds`: indices, or a mask on the device, bool of shape (num_worlds,) or longer. Raises InputError without
        blocks, or for a shorter mask.
        """
        n = self._blocks().shape[0]
        if isinstance(worlds, wp.array):
            self._check("worlds", cast(wp.array, worlds[:n]), (n,))
            self.dynamics.reset_blocks(worlds)
            return
        selected = np.zeros(n, dtype=bool)
        selected[slice(None) if worlds is None else list(worlds)] = True
        self.dynamics.reset_blocks(wp.array(selected, dtype=wp.bool, device=self.model.device))

    def _block_values(self) -> np.ndarray:
        """Return positions, velocities and properties of all blocks as a structured array, (num_worlds,).

        Raises InputError without blocks.
        """
        return self._blocks().numpy()

    def _blocks(self) -> wp.array:
        """Return the device array of the sliding blocks that paws can push, (num_worlds,).

        Raises InputError without blocks.
        """
        blocks = self.dynamics.robot.ground.blocks
        if blocks.shape[0] == 0:
            raise InputError("the solver was made without a block")
        return blocks

    @locked
    def notify_model_changed(self, flags: ModelFlags | int) -> None:
        """Update the solver after parameters of the model have changed: all of them, whatever the flags."""
        self.dynamics.pack()

    @locked
    def reset(self, state: State, world_mask: wp.array | None = None, flags: StateFlags | int | None = None) -> None:
        """Clear contact history and `diverged` of the masked worlds, and write the reference pose to their state.

        world_mask: bool (num_worlds + 1,), the last entry for the global world; None: all. Blocks return to their
        starts. With `flags=StateFlags.NONE` state and blocks do not change. Raises InputError: another model's state.
        """
        world_mask = self._normalize_reset_world_mask(world_mask)
        if world_mask is None:
            world_mask = wp.full(self.model.world_count + 1, True, dtype=wp.bool, device=self.model.device)
        if flags is None or int(flags) != int(StateFlags.NONE):
            self._check_state("state", state)
        self.dynamics.clear_contact(world_mask)
        if flags is not None and int(flags) == int(StateFlags.NONE):
            return
        self.dynamics.reset_blocks(world_mask)
        self.dynamics.restore(world_mask, self.model, state)
        self.dynamics.full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)
