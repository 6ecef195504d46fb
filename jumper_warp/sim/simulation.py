"""Batched simulation of the robot: motor command filter, motors and a solver."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Literal, cast

import newton
import numpy as np
import warp as wp

from jumper_warp.kernels.actuation.command_filter import command_filter_kernel
from jumper_warp.kernels.actuation.readout import base_velocity_kernel
from jumper_warp.kernels.dynamics.restore import restore_motors_kernel
from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.model import PHYSICS_DT, Extras, build_model
from jumper_warp.robot.motors import FilterCfg, MotorCfg, filter_params, jumping_motors, motor_arrays
from jumper_warp.robot.overlay import RobotOverlay, robots_of
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.dynamics import TOLERANCE, JumperDynamics, WorldRange, check_step, check_worlds, slices_of
from jumper_warp.sim.model_parts import warn_of_colliders
from jumper_warp.sim.mujoco import MujocoDynamics
from jumper_warp.sim.solver import SolverJumper
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.checks import check_count, check_flags
from jumper_warp.utils.copying import Uncopied
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Kernel
from jumper_warp.utils.newton_types import State
from jumper_warp.utils.threads import WARP_LOCK, checked_threads, locked, run_in_parallel, stop_spinning

if TYPE_CHECKING:
    import torch

SUBSTEPS = 8  # Physics steps of 1/480 s in a policy step of 1/60 s

SolverName = Literal["jumper", "mujoco"]


@functools.cache
def _capture_stream(device: str) -> wp.Stream:
    """Return the CUDA stream on which only captures of graphs run; device: torch's name of the device.

    It is a stream of torch, since other threads may not use the default stream while a stream of Warp is captured.
    """
    import torch

    return wp.stream_from_torch(torch.cuda.Stream(device))


def _on_capture_stream(device: wp.Device) -> AbstractContextManager[object]:
    """Return a context in which a device captures a graph on a stream that no other thread's work uses."""
    return wp.ScopedStream(_capture_stream(wp.device_to_torch(device))) if device.is_cuda else nullcontext()


class SlicedGraph:
    """Kernel launches that are captured as one graph for each slice of worlds, and replayed together."""

    @locked
    def __init__(self, launch: Callable[[WorldRange], None], slices: list[WorldRange], device: wp.Device) -> None:
        """Capture the kernel launches of each slice of worlds as a graph.

        launch: function that launches kernels for a slice; their modules must be loaded.
        """
        self._device = device
        self._graphs: list[wp.Graph] = []
        for worlds in slices:
            with _on_capture_stream(device), wp.ScopedCapture(device=device) as capture:
                launch(worlds)
            assert capture.graph is not None
            self._graphs.append(capture.graph)

    def replay(self) -> None:
        """Replay the captured kernel launches of all slices, concurrently on a CPU.

        With several graphs all have ended when this returns.
        """
        if self._device.is_cuda:  # one graph; a capture changes the device's stream
            with WARP_LOCK:
                wp.capture_launch(self._graphs[0])
        elif len(self._graphs) == 1:
            wp.capture_launch(self._graphs[0])
        else:
            jobs = [functools.partial(wp.capture_launch, graph) for graph in self._graphs]
            run_in_parallel(jobs, len(jobs))


class Simulation(Uncopied):
    """Batched simulation of the robot under position targets, which starts standing in the default pose.

    Pass motor targets [rad] to `set_targets`, or write them unchecked on the device to `target`, (12, num_worlds).
    Then call `step` for one policy step: the filter once, then motors and physics `substeps` times.
    Calls are asynchronous.

    Args:
        solver: "jumper" or "mujoco" (Newton's SolverMuJoCo).
        motors: By default the Jumper's jumping gains at 18 N m; those of another robot: `motors_for`.
        command_filter: Motor command filter; None passes targets to the motors unchanged.
        ground: As in `build_model`.
        block: A block in each world that slides when the robot pushes it; on SolverJumper only.
        friction: Coulomb coefficient of the paws [1].
        gravity: Downward, of every world [m/s^2].
        dt: Physics step [s], `substeps` of which are in a policy step.
        tolerance: Of SolverJumper's contact iteration [m/s].
        keep_momentum: Whether to correct the base's velocity after every policy step, so that gravity alone changes
            the momentum of a robot in free flight; on SolverJumper only.
        observe_forces: Whether to measure paw forces on MuJoCo, which costs time; SolverJumper always has them.
        visuals: Whether to add shapes that only viewers see.
        extras: Adds the caller's own sites and shapes to every world, as in `build_model`.
        robot: A robot (`load_overlay`), several that the worlds take in turn, or values of one robot (N = 1) or of
            every world (N = num_worlds) that replace those of `description`. Their latency is not applied.
        description: Robot that `robot` has the values of; by default the overlay's, or the Jumper.
        threads: Number of CPU threads, which does not change results; by default that of
            `jumper_warp.utils.threads.set_threads`, or all cores. SolverMuJoCo and few worlds use one.

    Raises:
        InputError: unknown solver, a block on MuJoCo, dt or tolerance not finite and positive, substeps or
            threads no whole number of at least 1, or as `build_model` and `SolverJumper`.
        NotThisRobotError: `extras` adds more than sites and shapes.
    """

    @locked
    def __init__(
        self,
        num_worlds: int,
        *,
        solver: SolverName = "jumper",
        motors: MotorCfg | None = None,
        command_filter: FilterCfg | None = None,
        ground: str | newton.Heightfield | None = "plane",
        block: BlockCfg | None = None,
        friction: float = 0.9,
        gravity: float = EARTH,
        dt: float = PHYSICS_DT,
        substeps: int = SUBSTEPS,
        tolerance: float = TOLERANCE,
        keep_momentum: bool = False,
        observe_forces: bool = True,
        visuals: bool = True,
        extras: Extras | None = None,
        robot: RobotOverlay | Sequence[RobotOverlay] | RobotValues | None = None,
        description: RobotDescription | None = None,
        device: wp.DeviceLike = None,
        threads: int | None = None,
    ):
        if solver not in ("jumper", "mujoco"):
            raise InputError(f"solver must be 'jumper' or 'mujoco', got {solver!r}")
        check_flags(keep_momentum=keep_momentum, observe_forces=observe_forces, visuals=visuals)
        if solver == "mujoco" and block is not None:
            raise InputError("a moving block needs solver='jumper', got 'mujoco'")
        num_worlds = check_count("num_worlds", num_worlds)
        substeps = check_step(dt, substeps)
        threads = checked_threads(threads)
        self.robot = values = _values_of(robot, friction, num_worlds)
        self.descriptions = _descriptions_of(robot) if description is None else [description]
        self.model = build_model(
            num_worlds, description=self.descriptions, ground=ground, friction=friction, gravity=gravity,
            visuals=visuals, extras=extras, device=device, mujoco=solver == "mujoco", robot=values,
        )  # fmt: skip
        self.device = self.model.device
        self.num_worlds = num_worlds
        self.block = block
        self.dt = dt
        self.substeps = substeps
        self.motors = motor_arrays(
            jumping_motors() if motors is None else motors, num_worlds, device=self.device, robot=values
        )
        self._filter = None if command_filter is None else filter_params(command_filter)
        self._make_arrays()
        if solver == "jumper":
            self.dynamics = JumperDynamics(
                self.model, block=block, tolerance=tolerance, keep_momentum=keep_momentum, description=self.descriptions
            )
            warn_of_colliders(self.model)
        else:
            self.dynamics = MujocoDynamics(
                self.model, self.state, self.control, dt=dt, tolerance=tolerance, observe_forces=observe_forces,
                description=self.descriptions,
            )  # fmt: skip
        if values is not None:
            self.dynamics.set_springs(values.spring_stiffness, values.spring_length)
        shared = self.dynamics.sliced and not self.device.is_cuda
        self.slices = slices_of(num_worlds, threads if shared else 1)
        if len(self.slices) > 1:
            stop_spinning()
        work = self.dynamics.work
        self.torque: wp.array = work.torque  # (12, num_worlds) [N m] Motor torques of the last physics step
        self.paw_force: wp.array = work.contact_force
        """(4, num_worlds) vec3 [N] Ground forces on the paws in the last physics step, world frame"""
        self.peak_force: wp.array = work.peak_force
        """(num_worlds,) [N] Largest total paw force in the last call of `advance`"""
        self.peak_paw_force: wp.array = work.peak_paw_force
        """(4, num_worlds) [N] Largest force on each paw in the last call of `advance`"""
        self.write_bodies()
        self._start = self.model.state()
        self._start.assign(self.state)

    @functools.cached_property
    def solver(self) -> SolverJumper | newton.solvers.SolverMuJoCo:
        """Newton's interface of the solver, on this simulation's dynamics; steps of the simulation do not use it."""
        if isinstance(self.dynamics, MujocoDynamics):
            return self.dynamics.solver
        return SolverJumper(self.model, dynamics=self.dynamics)

    def _make_arrays(self) -> None:
        """Allocate state, control, targets, standing pose, reset mask and readout arrays."""
        self.state = self.model.state()
        self.control = self.model.control()
        standing = motor_values(self.model.joint_q.numpy().reshape(self.num_worlds, -1)[:, 7:])
        self._standing = wp.array(standing.T, dtype=float, device=self.device)
        self.target = wp.clone(self._standing)
        self._safe_target = wp.clone(self._standing)
        self._mask = wp.zeros(self.num_worlds + 1, dtype=wp.bool, device=self.device)  # last entry: no world
        self._base_velocity = wp.zeros(self.num_worlds, dtype=wp.vec3, device=self.device)
        self._graphs: dict[str, SlicedGraph | None] = {}
        self._links: State | None = None  # allocated by `links`

    @locked
    def set_targets(self, angles: np.ndarray | torch.Tensor | Sequence) -> None:
        """Write raw motor targets [rad], (12, num_worlds), or (12,) for all worlds, to `target`.

        Raises InputError: another shape or type, or not finite.
        """
        values = real_array(angles, "targets")
        if values.shape not in ((12,), (12, self.num_worlds)):
            raise InputError(f"targets must have shape (12, {self.num_worlds}) or (12,), got {values.shape}")
        if not np.isfinite(values).all():
            raise InputError("targets must be finite")
        self.target.assign(np.broadcast_to(values.reshape(12, -1), (12, self.num_worlds)))

    def step(self) -> None:
        """Advance one policy step of `substeps` physics steps towards `target`."""
        self._captured("step", self._step)

    @locked
    def reset(self, mask: Sequence[bool] | np.ndarray | torch.Tensor | wp.array | None = None) -> None:
        """Reset worlds to the initial state of the simulation: standing at rest, with the standing pose as target.

        Contact history, torques, forces and the flags of diverged worlds are cleared; blocks return to their starts.
        Changes of the model stay. A captured graph may contain the call; a mask on the device is read at every replay.

        mask: Worlds to reset, bool of shape (num_worlds,), by default all. Raises InputError for anything else.
        """
        self._take_mask(mask)
        self.dynamics.forget(self._mask)
        self.dynamics.restore(self._mask, self._start, self.state)
        forces = [self.torque, self.paw_force, self.peak_force, self.peak_paw_force]
        results = [self.target, self._safe_target, *forces]
        self._launch(restore_motors_kernel, self.num_worlds, [self._mask, self._standing], results)

    def _take_mask(self, mask: Sequence[bool] | np.ndarray | torch.Tensor | wp.array | None) -> None:
        """Copy the mask of the worlds that are to be reset to the device.

        mask: bool of shape (num_worlds,); None: all True. Raises InputError.
        """
        if mask is None:
            self._mask.fill_(True)
            return
        if hasattr(mask, "is_cuda"):
            mask = wp.from_torch(cast("torch.Tensor", mask).contiguous())
        elif not isinstance(mask, wp.array):
            values = np.asarray(mask)
            if values.dtype != bool:
                raise InputError(f"mask must be bool of shape ({self.num_worlds},), got {values.dtype} {values.shape}")
            mask = wp.array(values, dtype=wp.bool, device=self.device)
        if mask.dtype is not wp.bool or mask.shape != (self.num_worlds,):
            raise InputError(f"mask must be bool of shape ({self.num_worlds},), got {mask.dtype} {mask.shape}")
        wp.copy(self._mask, mask, count=self.num_worlds)

    def filter_targets(self) -> None:
        """Run the motor command filter on `target` once, with measured angles (true angle + `motors.offset`).

        `target` stays; the next physics steps use the filtered targets. Call `physics_step` afterwards. A captured
        graph may contain both calls.
        """
        self._captured("filter", self._filter_targets)

    def physics_step(self) -> None:
        """Advance one physics step towards the filtered targets."""
        self._captured("physics", lambda worlds: self.advance(1, self._safe_target, worlds=worlds))

    def advance(
        self, substeps: int, target: wp.array, previous: wp.array | None = None, delay: wp.array | None = None, *,
        bodies: bool = True, worlds: WorldRange | None = None,
    ) -> None:  # fmt: skip
        """Launch `substeps` physics steps, with motors that follow target [rad], (12, num_worlds), unfiltered.

        With delay [physics steps], (num_worlds,), they follow `previous` (12, num_worlds) until the target arrives.
        bodies: whether to write passive joints and bodies of the state. worlds: range to advance, by default all.
        Raises InputError: substeps no whole number of at least 1, arrays of another shape or type, a delay without
        `previous`, or a range beyond the worlds.
        """
        check_worlds(worlds, self.num_worlds)
        if delay is not None and previous is None:
            raise InputError("a delay needs the previous target")
        substeps = check_count("substeps", substeps)
        n = self.num_worlds
        arrays = {"target": (target, (12, n)), "previous": (previous, (12, n)), "delay": (delay, (n,))}
        for name, (array, shape) in arrays.items():
            fits = isinstance(array, wp.array) and array.shape == shape
            if not fits and (array is not None or name == "target"):
                found = getattr(array, "shape", array)
                raise InputError(f"{name} must be an array of shape {shape}, got {found!r:.60}")
        self.dynamics.follow(
            self.state, self.motors, target, self.dt, substeps, previous=previous, delay=delay, bodies=bodies,
            worlds=worlds,
        )  # fmt: skip

    def write_bodies(self) -> None:
        """Compute the state's passive joints, body poses and body velocities from base and motor coordinates."""
        state = self.state
        self.dynamics.full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)

    def _step(self, worlds: WorldRange) -> None:
        """Launch one policy step (command filter and physics) of a range of worlds."""
        self._filter_targets(worlds)
        self.advance(self.substeps, self._safe_target, worlds=worlds)

    def _captured(self, name: str, body: Callable[[WorldRange], None]) -> None:
        """Run kernel launches for all worlds; from the second call of a name on they are replayed as a captured graph.

        The first call launches them directly, which loads their modules: a capture cannot. body: launches them for a
        range of worlds. Within a capture it is called directly.
        """
        with WARP_LOCK:
            if self.device.is_capturing:
                body(WorldRange(0, self.num_worlds))
                return
            if name not in self._graphs:
                body(WorldRange(0, self.num_worlds))
                self._graphs[name] = None
                return
            graph = self._graphs[name]
            if graph is None:
                graph = self._graphs[name] = SlicedGraph(body, self.slices, self.device)
        graph.replay()

    def _filter_targets(self, worlds: WorldRange) -> None:
        """Write the filtered targets of a range of worlds; without a filter copy the targets."""
        if self._filter is None:
            if worlds.count == self.num_worlds:
                wp.copy(self._safe_target, self.target)
                return
            for motor in range(12):  # a CPU graph cannot capture one strided copy of all motors
                first = motor * self.num_worlds + worlds.first
                wp.copy(self._safe_target.flatten(), self.target.flatten(), first, first, worlds.count)
            return
        self._launch(
            command_filter_kernel,
            (4, worlds.count),
            [worlds.first, self.target, self.state.joint_q, self.state.joint_qd, self.motors.offset,
             self._filter],
            [self._safe_target],
        )  # fmt: skip

    def _launch(self, kernel: Kernel, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        """Launch a kernel on the simulation's device."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    @locked
    def joint_q(self) -> np.ndarray:
        """Return the joint coordinates, (num_worlds, 43), in the layout of `jumper_warp.robot.model`."""
        return self.state.joint_q.numpy().reshape(self.num_worlds, -1)

    @locked
    def joint_qd(self) -> np.ndarray:
        """Return the joint rates, (num_worlds, 38): base [m/s] at its COM, [rad/s], 20 hinges [rad/s], four ankles."""
        return self.state.joint_qd.numpy().reshape(self.num_worlds, -1)

    def links(self) -> tuple[np.ndarray, np.ndarray]:
        """Return pose (num_worlds, 21, 7) and twist (num_worlds, 21, 6) of every link, world frame.

        They are computed from the joint coordinates; the state does not change. pose: position [m] and quaternion
        (xyzw); twist: velocity of the COM [m/s] and angular velocity [rad/s]. Waits for the device.
        """
        state = self._links = self._links or self.model.state()
        wp.copy(state.joint_q, self.state.joint_q)
        wp.copy(state.joint_qd, self.state.joint_qd)
        self.dynamics.full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)
        n = self.num_worlds
        return state.body_q.numpy().reshape(n, -1, 7), state.body_qd.numpy().reshape(n, -1, 6)

    @locked
    def base_velocity(self) -> np.ndarray:
        """Return the velocity of the base link's origin [m/s], world frame, (num_worlds, 3). Waits for the device."""
        return self.read_base_velocity().numpy().copy()

    @locked
    def read_base_velocity(self) -> wp.array:
        """Return the velocity of the base link's origin [m/s], world frame, vec3 of shape (num_worlds,).

        Every call overwrites and returns the same array; a captured graph may contain the call.
        """
        inputs = [self.state.joint_q, self.state.joint_qd, self.model.body_com]
        self._launch(base_velocity_kernel, self.num_worlds, inputs, [self._base_velocity])
        return self._base_velocity


def _values_of(
    robot: RobotOverlay | Sequence[RobotOverlay] | RobotValues | None, friction: float, num_worlds: int
) -> RobotValues | None:
    """Return the robots' values; the paws of an overlay without `paw_friction` have the given friction coefficient.

    Raises InputError: an argument of another type.
    """
    if robot is None or isinstance(robot, RobotValues):
        return robot
    each = []
    for one in robots_of(robot):
        values = one.robots()
        if "paw_friction" not in one.values:
            values.paw_friction[:] = friction
        each.append(values)
    if len(each) < 2:
        return each[0] if each else None
    turns = np.arange(num_worlds) % len(each)
    return RobotValues(**{name: np.vstack([getattr(one, name) for one in each])[turns] for name in vars(each[0])})


def _descriptions_of(robot: RobotOverlay | Sequence[RobotOverlay] | RobotValues | None) -> list[RobotDescription]:
    """Return the descriptions of the robots that worlds take in turn."""
    if robot is None or isinstance(robot, RobotValues):
        return [load_description()]
    return [one.description for one in robots_of(robot)] or [load_description()]


def motor_values(joint_values: np.ndarray) -> np.ndarray:
    """Return the 12 motors' entries of an array with one value for each joint.

    joint_values: (..., 20 or more), the joints after the base: of each leg lateral, outer, outer knee, inner, inner
    knee, of which the knees have no motor. Returned: (..., 12).
    """
    return joint_values[..., [5 * leg + j for leg in range(4) for j in (0, 1, 3)]]
