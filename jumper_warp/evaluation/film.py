"""Filming an environment: some of its worlds as a recording for the Rerun viewer, and as strips of pictures.

Nothing of the viewer or the pictures is imported before there is something to film.
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

ANKLE = np.array([0.0, 0.0, -0.3])
"""[m] In the shank's frame."""
EYE_DISTANCE = 2.4
"""[m] From the path to the eye of a picture."""
PICTURE = (400, 320)
"""[px] Of a robot that is seen from beside its path."""


@dataclass(frozen=True)
class Strip:
    """What a filmstrip shows."""

    index: int
    """Of the filmed world."""
    frames: Sequence[int]
    captions: Sequence[str]
    eye: Sequence[float] | np.ndarray
    """[m] Of the camera, world frame."""
    target: Sequence[float] | np.ndarray
    """[m] Where it looks."""
    size: tuple[int, int]
    """[px] Width and height of a picture."""
    name: str = ""
    """Of the file (default: the film's)."""


class Links:
    """Reads all links, from base and motor coordinates; the simulation is left as it is."""

    def __init__(self, env: Env) -> None:
        """Allocate a state of the environment's model."""
        self._sim, self._state = env.sim, env.sim.model.state()

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return pose (num_envs, links, 7) and twist (num_envs, links, 6) of every link; waits for the device."""
        here, there = self._state, self._sim.state
        wp.copy(here.joint_q, there.joint_q)
        wp.copy(here.joint_qd, there.joint_qd)
        self._sim.physics.dynamics.full_state(here.joint_q, here.joint_qd, here.body_q, here.body_qd)
        n = self._sim.num_worlds
        return here.body_q.numpy().reshape(n, -1, 7), here.body_qd.numpy().reshape(n, -1, 6)


class Film:
    """Collects what some worlds of an environment look like; call it after every policy step."""

    def __init__(
        self,
        env: Env,
        series: Callable[[Sequence[int]], Mapping[str, float]],
        worlds: Sequence[int],
        *,
        spacing: float = 1.2,
        ground: Any = "plane",
        block: BlockCfg | None = None,
        notes: Mapping[str, Any] | None = None,
        motors: bool = False,
    ) -> None:
        """Film worlds (at least one) of the environment, together with series of numbers.

        series: returns what to draw of the worlds over time, as `EvaluationLog.series`.

        spacing: [m] along y, by which each world is drawn beside the one before it; 0 on a heightfield. ground: as in
        `build_model`; block: the environment's sliding blocks, if it has any; notes: saved along, must be JSON;
        motors: whether to add torques and actions of the first world.
        """
        from jumper_warp.viz.recorder import Recorder

        self.env, self.series, self.worlds, self.spacing, self.motors = env, series, list(worlds), spacing, motors
        self.links = Links(env)
        self.model = build_model(len(worlds), ground=ground, device=env.wp_device)
        self.recorder = Recorder(self.model, range(len(worlds)), spacing=spacing, notes=notes)
        self.frames = 0
        self.block = None if block is None else block.per_world(env.num_envs)
        self.block_places: list[np.ndarray] = []

    def __call__(self) -> None:
        """Add the environment's state of the moment."""
        sim = self.env.sim
        poses = self.links.read()[0][self.worlds]
        series = {**self.series(self.worlds), **(self._motor_series() if self.motors else {})}
        forces = sim.paw_force.numpy().transpose(1, 0, 2)[self.worlds]
        if self.block is not None:
            self.block_places.append(block_places(sim)[self.worlds])
        self.frames += 1
        self.recorder.record(self.frames * self.env.step_dt, poses.reshape(-1, 7), series, ankles(poses), forces)

    def _motor_series(self) -> dict[str, float]:
        from jumper_warp.robot.description import MOTOR_JOINTS

        world = self.worlds[0]
        torque, action = self.env.sim.torque.numpy()[:, world], self.env.action[world].cpu().numpy()
        series = {f"torque/{name} [N m]": torque[i] for i, name in enumerate(MOTOR_JOINTS)}
        return series | {f"action/{name} [1]": action[i] for i, name in enumerate(MOTOR_JOINTS)}

    def base(self, index: int) -> np.ndarray:
        """Return the base's positions [m], world frame, (frames, 3), of the index-th filmed world."""
        recording = self.recorder.recording()
        return recording.poses[:, index * len(recording.bodies) // len(self.worlds), :3]

    def save_rrd(self, path: Path, goals: np.ndarray | None = None) -> Path:
        """Write the recording; goals [m]: (filmed worlds, goals a world, 3) places to mark, world frame."""
        from jumper_warp.viz.props import with_blocks, with_marks
        from jumper_warp.viz.rerun import write_rrd

        recording = self.recorder.recording()
        if goals is not None:
            recording = with_marks(recording, goals)
        if self.block is not None:
            half, height = self.block["half"][self.worlds], self.block["height"][self.worlds]
            recording = with_blocks(recording, np.stack(self.block_places), half, height)
        return write_rrd(recording, path)

    def save_strip(self, strip: Strip, path: Path) -> None:
        """Write the pictures of a filmstrip side by side."""
        from jumper_warp.viz.snapshot import Camera, contact_sheet

        recording = self.recorder.recording()
        camera = Camera(self.model, tuple(strip.eye), tuple(strip.target), strip.size, world=strip.index)
        state, pictures = self.model.state(), []
        for frame in strip.frames:
            state.body_q.assign(recording.poses[frame])
            pictures.append(camera.picture(state))
        contact_sheet(pictures, path, strip.captions)


def block_places(sim: Simulation) -> np.ndarray:
    """Return the places [m] of the sliding blocks, world frame, (num_worlds, 2); SolverJumper alone has any."""
    assert isinstance(sim.solver, SolverJumper)
    return sim.solver.block_position()


def ankles(poses: np.ndarray) -> np.ndarray:
    """Return the ankles [m], world frame, (num_worlds, 4, 3), from the poses (num_worlds, 21, 7) of all links."""
    shanks = poses[:, 5 * np.arange(1, len(LEGS) + 1)]
    return shanks[..., :3] + rotate(shanks[..., 3:], ANKLE)


def moments(height: np.ndarray, command: int) -> list[int]:
    """Return the frames of a filmstrip: command, squat, push-off, apex, fall, catch, end; height (frames,) [m]."""
    command = min(max(command, 0), len(height) - 1)
    apex = command + int(np.argmax(height[command:]))
    squat = command + int(np.argmin(height[command : apex + 1]))
    catch = apex + int(np.argmin(height[apex : apex + 60]))
    push = squat + int(np.argmax(height[squat : apex + 1] >= 0.5 * (height[squat] + height[apex])))
    return [command, squat, push, apex, (apex + catch) // 2, catch, len(height) - 1]


def beside(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an eye beside the way from start to end (2,), and the point that it looks at, (3,); [m], world frame."""
    way = end - start
    length = float(np.linalg.norm(way))
    ahead = way / length if length > 1.0e-3 else np.array([1.0, 0.0])
    middle = np.append(start + 0.5 * way, 0.4)
    back = EYE_DISTANCE * max(1.0, length / 1.5)
    return middle + np.array([back * ahead[1], -back * ahead[0], 0.35]), middle
