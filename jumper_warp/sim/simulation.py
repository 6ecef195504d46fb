"""Batched simulation of the robot: motor command filter, motors and a solver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, cast

import newton
import numpy as np
import warp as wp

from jumper_warp.kernels.actuation.command_filter import command_filter_kernel
from jumper_warp.kernels.actuation.readout import base_velocity_kernel
from jumper_warp.kernels.dynamics.restore import restore_motors_kernel, restore_state_kernel
from jumper_warp.kernels.layout import COORDS, DOFS
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.model import PHYSICS_DT, Extras, build_model
from jumper_warp.robot.motors import FilterCfg, MotorCfg, filter_params, jumping_motors, motor_arrays
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.overlay import write_model, write_motors, write_springs
from jumper_warp.sim.physics import JumperPhysics, MujocoPhysics, Physics
from jumper_warp.sim.slices import SlicedGraph, WorldRange, slices_of
from jumper_warp.sim.solver import TOLERANCE, check_step, check_tolerance, state_arrays
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.checks import check_count, check_flags
from jumper_warp.utils.copying import Uncopied
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.threads import WARP_LOCK, checked_threads, locked, stop_spinning

if TYPE_CHECKING:
    import torch

SUBSTEPS = 8  # Physics steps of 1/480 s in a policy step of 1/60 s

SolverName = Literal["jumper", "mujoco"]


class Simulation(Uncopied):
    """Batched simulation of the robot under position targets, which starts standing in the default pose.

    Pass motor targets [rad] to `set_targets`, or write them unchecked on the device to `target`, (12, num_worlds).
    Then call `step` for one policy step: the filter once, then motors and physics `substeps` times.
    Calls are asynchronous.

    Args:
        solver: "jumper" or "mujoco" (Newton's SolverMuJoCo).
        motors: By default the jumping gains at 18 N m.
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
        robot: Overlay, or values of one robot (N = 1) or of every world (N = num_worlds), that replace the
            description's. Their latency is not applied.
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
        robot: RobotOverlay | RobotValues | None = None,
        device: wp.DeviceLike = None,
        threads: int | None = None,
    ):
        if solver not in ("jumper", "mujoco"):
            raise InputError(f"solver must be 'jumper' or 'mujoco', got {solver!r}")
        check_flags(keep_momentum=keep_momentum, observe_forces=observe_forces, visuals=visuals)
        if not isinstance(block, BlockCfg | None):
            raise InputError(f"block must be a BlockCfg, got {block!r:.60}")
        if solver == "mujoco" and block is not None:
            raise InputError("a moving block needs solver='jumper', got 'mujoco'")
        if not isinstance(robot, RobotOverlay | RobotValues | None):
            raise InputError(f"robot must be a RobotOverlay (see load_overlay) or RobotValues, got {robot!r:.60}")
        num_worlds, substeps = check_count("num_worlds", num_worlds), check_step(dt, substeps)
        check_tolerance(tolerance)
        threads = checked_threads(threads)
        self.model = build_model(
            num_worlds, ground=ground, friction=friction, gravity=gravity, visuals=visuals, extras=extras,
            device=device, mujoco=solver == "mujoco",
        )  # fmt: skip
        self.device, self.num_worlds, self.block = self.model.device, num_worlds, block
        self.dt, self.substeps = dt, substeps
        self.motors = motor_arrays(motors or jumping_motors(), num_worlds, device=self.device)
        self.robot = self._write_robot(robot)
        self._filter = None if command_filter is None else filter_params(command_filter)
        self._make_arrays()
        self.physics: Physics = (
            JumperPhysics(self, block, tolerance, keep_momentum)
            if solver == "jumper"
            else MujocoPhysics(self, observe_forces)
        )
        if self.robot is not None:
            write_springs(self.physics.dynamics, self.robot)
        shared = self.physics.sliced and not self.device.is_cuda
        self.slices = slices_of(num_worlds, threads if shared else 1)
        if len(self.slices) > 1:
            stop_spinning()
        self.solver = self.physics.solver
        self.torque, self.paw_force = self.physics.torque, self.physics.paw_force
        self.peak_force = self.physics.peak_force
        self.physics.write_bodies()
        start = self.model.state()
        start.assign(self.state)
        self._start = state_arrays(start)

    def _write_robot(self, robot: RobotOverlay | RobotValues | None) -> RobotValues | None:
        """Replace model and motor parameters by those of an overlay or of given robots, and return these values.

        None: the described robot.
        """
        values = robot.robots() if isinstance(robot, RobotOverlay) else robot
        if values is not None:
            paws = not isinstance(robot, RobotOverlay) or "paw_friction" in robot.values
            write_model(self.model, values, paws=paws)
            write_motors(self.motors, values)
        return values

    def _make_arrays(self) -> None:
        """Allocate state, control, targets, standing pose, reset mask and readout arrays."""
        self.state, self.control = self.model.state(), self.model.control()
        standing = motor_values(self.model.joint_q.numpy().reshape(self.num_worlds, -1)[:, 7:])
        self._standing = wp.array(standing.T, dtype=float, device=self.device)
        self.target, self._safe_target = wp.clone(self._standing), wp.clone(self._standing)
        self._mask = wp.zeros(self.num_worlds + 1, dtype=wp.bool, device=self.device)  # last entry: no world
        self._base_velocity = wp.zeros(self.num_worlds, dtype=wp.vec3, device=self.device)
        self._graphs: dict[str, SlicedGraph | None] = {}

    @locked
    def set_targets(self, angles: np.ndarray | torch.Tensor | Sequence) -> None:
        """Write raw motor targets [rad], (12, num_worlds), or (12,) for all worlds, to `target`.

        Raises InputError: another shape or type, or not finite.
        """
        array: Any = angles
        values = real_array(array.detach().cpu() if hasattr(array, "detach") else array, "targets")
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
        self.physics.forget(self._mask)
        inputs = [self._mask, self._start]
        self._launch(restore_state_kernel, (self.num_worlds, int(COORDS)), inputs, [state_arrays(self.state)])
        forces = [self.torque, self.paw_force, self.peak_force, self.physics.peak_paw_force]
        results = [self.target, self._safe_target, *forces]
        self._launch(restore_motors_kernel, self.num_worlds, [self._mask, self._standing], results)

    def _take_mask(self, mask: Sequence[bool] | np.ndarray | torch.Tensor | wp.array | None) -> None:
        """Copy the mask of the worlds that are to be reset to the device.

        mask: bool of shape (num_worlds,); None: all True. Raises InputError.
        """
        if mask is None:
            self._mask.fill_(True)
            return
        array: Any = mask
        is_tensor = hasattr(mask, "is_cuda")
        try:
            array = array if is_tensor or isinstance(array, wp.array) else np.asarray(array)
            dtype, shape = getattr(array.dtype, "__name__", str(array.dtype)), tuple(array.shape)
        except ValueError:  # lists of different lengths
            dtype, shape = "lists", "several lengths"
        if dtype not in ("bool", "torch.bool") or shape != (self.num_worlds,):
            raise InputError(f"mask must be bool of shape ({self.num_worlds},), got {dtype} of shape {shape}")
        if is_tensor:
            array = wp.from_torch(cast("torch.Tensor", array).contiguous())
        elif isinstance(array, np.ndarray):
            array = wp.array(array, dtype=wp.bool, device=self.device)
        wp.copy(self._mask, array, count=self.num_worlds)

    def filter_targets(self) -> None:
        """Run the motor command filter on `target` once, with measured angles (true angle + `motors.offset`).

        `target` stays; the next physics steps use the filtered targets. Call `physics_step` afterwards. A captured
        graph may contain both calls.
        """
        self._captured("filter", self._filter_targets)

    def physics_step(self) -> None:
        """Advance one physics step towards the filtered targets."""
        self._captured("physics", lambda worlds: self._physics(1, worlds))

    def _step(self, worlds: WorldRange) -> None:
        """Launch one policy step (command filter and physics) of a range of worlds."""
        self._filter_targets(worlds)
        self._physics(self.substeps, worlds)

    def _captured(self, name: str, body: Callable[[WorldRange], None]) -> None:
        """Run kernel launches for all worlds; from the second call of a name on they are replayed as a captured graph.

        body: launches them for a range of worlds. Within a capture it is called directly.
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
            [worlds.first, self.target, self.state.joint_q, self.state.joint_qd, COORDS, DOFS, self.motors.offset,
             self._filter],
            [self._safe_target],
        )  # fmt: skip

    def _physics(self, substeps: int, worlds: WorldRange) -> None:
        """Launch `substeps` physics steps of a range of worlds towards the filtered targets."""
        self.physics.advance(substeps, self._safe_target, worlds=worlds)

    def _launch(self, kernel: Any, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
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

    @locked
    def loop_gap(self) -> np.ndarray:
        """Return the largest distance [m] between the two anchors of an ankle, over the four legs, (num_worlds,)."""
        model = self.model
        parents, children = model.joint_parent.numpy(), model.joint_child.numpy()
        frames = self.state.body_q.numpy()
        gaps = []
        for joint in (i for i, label in enumerate(model.joint_label) if label.endswith("_ankle")):
            ends = []
            for body, anchor in ((parents[joint], model.joint_X_p), (children[joint], model.joint_X_c)):
                point, quat = anchor.numpy()[joint, :3], frames[body, 3:6]
                rotated = point + 2.0 * np.cross(quat, np.cross(quat, point) + frames[body, 6] * point)
                ends.append(frames[body, :3] + rotated)
            gaps.append(np.linalg.norm(ends[0] - ends[1]))
        return np.array(gaps).reshape(self.num_worlds, 4).max(axis=1)


def motor_values(joint_values: np.ndarray) -> np.ndarray:
    """Return the 12 motors' entries of an array with one value for each joint.

    joint_values: (..., 20 or more), the joints after the base. Returned: (..., 12).
    """
    return joint_values[..., [5 * leg + j for leg in range(4) for j in (0, 1, 3)]]
