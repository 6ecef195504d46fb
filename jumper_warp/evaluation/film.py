"""Recordings of some worlds of an environment, for the Rerun viewer and as filmstrips.

Viewer and renderer are imported only when something is recorded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from jumper_warp.robot.description import LEGS
from jumper_warp.robot.model import build_model
from jumper_warp.sim.solver import SolverJumper
from jumper_warp.utils.rotations import rotate

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env
    from jumper_warp.robot.grounds import BlockCfg
    from jumper_warp.sim.simulation import Simulation

ANKLE = np.array([0.0, 0.0, -0.3])  # [m] Position of the ankle in the shank's frame
CAMERA_DISTANCE = 2.4  # [m] Distance from the path to the camera in `side_view`
PICTURE_SIZE = (400, 320)  # [px] Width and height of a filmstrip's picture in `side_view`


@dataclass(frozen=True)
class Filmstrip:
    """Frames, captions and camera of a filmstrip of one world."""

    index: int  # Index among the recorded worlds
    frames: Sequence[int]  # Indices of the recorded frames
    captions: Sequence[str]
    eye: Sequence[float] | np.ndarray  # [m] Position of the camera, world frame, (3,)
    target: Sequence[float] | np.ndarray  # [m] Point in the middle of the picture, world frame, (3,)
    size: tuple[int, int]  # [px] Width and height of one picture
    name: str = ""  # Name of the file without suffix (default: name of the recording)


class LinkReader:
    """Computes poses and twists of all links from the joint coordinates, without changing the simulation."""

    def __init__(self, env: Env) -> None:
        """Allocate a separate state of the environment's model."""
        self._sim, self._state = env.sim, env.sim.model.state()

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return pose (num_envs, 21, 7) and twist (num_envs, 21, 6) of every link, world frame; waits for the device.

        pose: position [m] and quaternion (xyzw); twist: velocity of the COM [m/s] and angular velocity [rad/s].
        """
        state, n = self._state, self._sim.num_worlds
        wp.copy(state.joint_q, self._sim.state.joint_q)
        wp.copy(state.joint_qd, self._sim.state.joint_qd)
        self._sim.physics.dynamics.full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)
        return state.body_q.numpy().reshape(n, -1, 7), state.body_qd.numpy().reshape(n, -1, 6)


class Film:
    """Recorder of some worlds of an environment; call the object after every policy step to add a frame."""

    def __init__(
        self, env: Env, series: Callable[[Sequence[int]], Mapping[str, float]], worlds: Sequence[int], *,
        spacing: float = 1.2, ground: Any = "plane", block: BlockCfg | None = None,
        notes: Mapping[str, Any] | None = None, record_motors: bool = False,
    ) -> None:  # fmt: skip
        """Prepare an empty recording of worlds (indices, at least one) of the environment.

        series: function of `worlds` that returns the present values of the time series, as `EvaluationLog.series`;
        spacing [m]: distance along y at which worlds are shown side by side, 0 on a heightfield; ground: as in
        `build_model`; block: the environment's sliding blocks, if any; notes: JSON metadata of the recording;
        record_motors: add torques and actions of the first world.
        """
        from jumper_warp.viz.recorder import Recorder

        self.env, self.series, self.worlds = env, series, list(worlds)
        self.spacing, self.record_motors = spacing, record_motors
        self.links = LinkReader(env)
        self.model = build_model(len(worlds), ground=ground, device=env.wp_device)
        self.recorder = Recorder(self.model, range(len(worlds)), spacing=spacing, notes=notes)
        self.frames = 0
        self.block = None if block is None else block.per_world(env.num_envs)
        self.block_positions: list[np.ndarray] = []

    def __call__(self) -> None:
        """Append the environment's present state as a frame: link poses, series, ankle positions, paw forces."""
        sim = self.env.sim
        poses = self.links.read()[0][self.worlds]
        series = {**self.series(self.worlds), **(self._motor_series() if self.record_motors else {})}
        forces = sim.paw_force.numpy().transpose(1, 0, 2)[self.worlds]
        if self.block is not None:
            self.block_positions.append(block_positions(sim)[self.worlds])
        self.frames += 1
        self.recorder.record(self.frames * self.env.step_dt, poses.reshape(-1, 7), series, ankles(poses), forces)

    def _motor_series(self) -> dict[str, float]:
        """Return torque [N m] and action [1] of all 12 motors of the first recorded world, by name of the series."""
        from jumper_warp.robot.description import MOTOR_JOINTS

        world = self.worlds[0]
        torque, action = self.env.sim.torque.numpy()[:, world], self.env.action[world].cpu().numpy()
        series = {f"torque/{name} [N m]": torque[i] for i, name in enumerate(MOTOR_JOINTS)}
        return series | {f"action/{name} [1]": action[i] for i, name in enumerate(MOTOR_JOINTS)}

    def base_positions(self, index: int) -> np.ndarray:
        """Return the base positions [m] of the index-th recorded world, (frames, 3), world frame."""
        recording = self.recorder.recording()
        return recording.poses[:, index * len(recording.bodies) // len(self.worlds), :3]

    def save_rrd(self, path: Path, goals: np.ndarray | None = None) -> Path:
        """Write the recording to `path`, and return it; goals [m]: marked positions, (recorded worlds, n, 3), world."""
        from jumper_warp.viz.props import with_blocks, with_goal_markers
        from jumper_warp.viz.rerun import write_rrd

        recording = self.recorder.recording()
        if goals is not None:
            recording = with_goal_markers(recording, goals)
        if self.block is not None:
            half, height = self.block["half"][self.worlds], self.block["height"][self.worlds]
            recording = with_blocks(recording, np.stack(self.block_positions), half, height)
        return write_rrd(recording, path)

    def save_filmstrip(self, filmstrip: Filmstrip, path: Path) -> None:
        """Render the pictures of a filmstrip and write them side by side as one PNG file."""
        from jumper_warp.viz.snapshot import Camera, contact_sheet

        recording = self.recorder.recording()
        eye, target = tuple(filmstrip.eye), tuple(filmstrip.target)
        camera = Camera(self.model, eye, target, filmstrip.size, world=filmstrip.index)
        state, pictures = self.model.state(), []
        for frame in filmstrip.frames:
            state.body_q.assign(recording.poses[frame])
            pictures.append(camera.picture(state))
        contact_sheet(pictures, path, filmstrip.captions)


def block_positions(sim: Simulation) -> np.ndarray:
    """Return x and y [m] of the sliding blocks' centres, (num_worlds, 2), world frame; only SolverJumper has blocks."""
    assert isinstance(sim.solver, SolverJumper)
    return sim.solver.block_position()


def ankles(poses: np.ndarray) -> np.ndarray:
    """Return ankle positions [m], (num_worlds, 4, 3), world frame, legs FL, FR, BL, BR; poses: (num_worlds, 21, 7)."""
    shanks = poses[:, 5 * np.arange(1, len(LEGS) + 1)]  # the base, then five links per leg, the inner shank last
    return shanks[..., :3] + rotate(shanks[..., 3:], ANKLE)


def keyframes(height: np.ndarray, command: int) -> list[int]:
    """Return the indices of seven frames of a jump: command, squat, push-off, apex, fall, catch, end.

    height: base height [m], (frames,); command: frame in which the jump is commanded, clamped to the recording.
    """
    command = min(max(command, 0), len(height) - 1)
    apex = command + int(np.argmax(height[command:]))
    squat = command + int(np.argmin(height[command : apex + 1]))
    catch = apex + int(np.argmin(height[apex : apex + 60]))  # lowest base within a second
    push = squat + int(np.argmax(height[squat : apex + 1] >= 0.5 * (height[squat] + height[apex])))
    return [command, squat, push, apex, (apex + catch) // 2, catch, len(height) - 1]


def side_view(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position and target of a camera beside the path from start to end, (3,) each; [m], world frame.

    start, end: (2,). The camera is to the right of the path, farther away from paths longer than 1.5 m.
    """
    path, length = end - start, float(np.linalg.norm(end - start))
    ahead = path / length if length > 1.0e-3 else np.array([1.0, 0.0])
    middle = np.append(start + 0.5 * path, 0.4)
    distance = CAMERA_DISTANCE * max(1.0, length / 1.5)
    return middle + np.array([distance * ahead[1], -distance * ahead[0], 0.35]), middle
