"""Recording of some worlds of an environment, for films, composite pictures and the Rerun viewer.

Viewer and renderer are imported only when something is recorded.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jumper_warp.evaluation.motion import robot_state, task_state
from jumper_warp.robot.description import LEGS, MOTOR_JOINTS
from jumper_warp.sim.simulation import motor_values
from jumper_warp.utils.progress import phase
from jumper_warp.utils.rotations import CONJUGATE, rotate

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env
    from jumper_warp.evaluation.log import EvaluationLog
    from jumper_warp.robot.grounds import BlockCfg
    from jumper_warp.sim.simulation import Simulation
    from jumper_warp.viz.live_recording import LiveRecording
    from jumper_warp.viz.recording import Recording

SHOWN = 0.7  # [1] Position of the world to show in the picture among the recorded ones, which are ordered by goal
ANKLE = np.array([0.0, 0.0, -0.3])  # [m] Position of the ankle in the shank's frame


class EnvRecorder:
    """Recorder of some worlds of an environment; call the object after every policy step to add a frame."""

    def __init__(
        self,
        env: Env,
        log: EvaluationLog,
        worlds: Sequence[int],
        *,
        ground: Any = "plane",
        block: BlockCfg | None = None,
        notes: Mapping[str, Any] | None = None,
        live: LiveRecording | None = None,
    ) -> None:
        """Prepare an empty recording of worlds (indices, at least one) of the environment.

        log: supplies series, states, commands, labels and goals; ground: as in `build_model`; block: the environment's
        sliding blocks, if any; notes: JSON metadata of the recording, added to those of the log and the robots. live:
        viewer that shows the frames while they are recorded.
        """
        from jumper_warp.robot.model import build_model
        from jumper_warp.viz.recorder import Recorder

        self.env = env
        self.live = live
        self.log = log
        self.worlds = list(worlds)
        spacing = log.spacing if isinstance(ground, str) else 0.0  # robots on a heightfield are not moved apart
        robots = env.sim.descriptions
        robots = [robots[world % len(robots)] for world in worlds] if len(robots) > 1 else robots
        model = build_model(len(worlds), description=robots, ground=ground, device=env.wp_device, mujoco=False)
        labels = log.names(self.worlds)
        own = [env.robots[world % len(env.robots)] for world in worlds] if len(env.robots) > 1 else env.robots
        notes = {"robots": [robot.to_json() for robot in own], **(notes or {}), **log.notes(self.worlds)}
        self.recorder = Recorder(model, range(len(worlds)), spacing=spacing, notes=notes, labels=labels)
        self.frames = 0
        self.block = None if block is None else block.per_world(env.num_envs)
        self.block_positions: list[np.ndarray] = []
        self._robots: list[dict[str, np.ndarray]] = []
        self._tasks: list[dict[str, np.ndarray]] = []

    def begin(self) -> None:
        """Store the task's state before the first policy step, so that `Recording.motion` is kept."""
        self._tasks = [task_state(self.env, self.worlds)]

    def __call__(self) -> None:
        """Append the environment's current state as a frame: link poses, series, ankle positions, paw forces."""
        sim = self.env.sim
        log = self.log
        poses = sim.links()[0][self.worlds]
        series = log.named(log.series(), self.worlds) | self._base_series() | self._motor_series() | self._task_series()
        forces = peak_forces(sim)[self.worlds]
        if self.block is not None:
            self.block_positions.append(block_positions(sim)[self.worlds])
        self.frames += 1
        if self._tasks:
            self._robots.append(robot_state(self.env, self.worlds))
            self._tasks.append(task_state(self.env, self.worlds))
        self.recorder.record(
            self.frames * self.env.step_dt,
            poses.reshape(-1, 7),
            series,
            ankles(poses),
            forces,
            states=log.named(log.states() | self._terminations(), self.worlds),
            commands=self._marks().get("commands"),
        )
        if self.live is not None:
            self.live.update(self.recorder)

    def _marks(self) -> dict[str, np.ndarray]:
        """Return goals, heights and commands of the recorded worlds, which the log's `marks` gives."""
        return {name: values[self.worlds] for name, values in self.log.marks().items()}

    def _motor_series(self) -> dict[str, float]:
        """Return paw forces, and values of each motor, of the first recorded world, to plot, by name of the series.

        Largest force [N] on each paw in any physics step of the policy step; torque [N m], angle [rad], rate [rad/s]
        and action [1] of each motor.
        """
        world = self.worlds[0]
        sim = self.env.sim
        peak = sim.peak_paw_force.numpy()[:, world]
        series = {f"peak paw force/{leg} [N]": peak[i] for i, leg in enumerate(LEGS)}
        values = {
            "torque/{} [N m]": sim.torque.numpy()[:, world],
            "angle/{} [rad]": motor_values(sim.joint_q()[world, 7:]),
            "rate/{} [rad/s]": motor_values(sim.joint_qd()[world, 6:]),
            "action/{} [1]": self.env.action[world].cpu().numpy(),
        }
        return series | {
            key.format(name): each[i] for key, each in values.items() for i, name in enumerate(MOTOR_JOINTS)
        }

    def _base_series(self) -> dict[str, float]:
        """Return velocity [m/s] and angular velocity [rad/s] of the first recorded world's base, body axes, to plot."""
        world = self.worlds[0]
        sim = self.env.sim
        to_body = sim.joint_q()[world, 3:7] * CONJUGATE
        linear = rotate(to_body, sim.base_velocity()[world])
        angular = rotate(to_body, sim.joint_qd()[world, 3:6])
        names = zip(("ahead", "left", "up"), linear, "xyz", angular, strict=True)
        return {
            key: value
            for name, velocity, axis, rate in names
            for key, value in (
                (f"base velocity/{name} [m/s]", velocity), (f"base angular velocity/about {axis} [rad/s]", rate)
            )
        }  # fmt: skip

    def _task_series(self) -> dict[str, float]:
        """Return observations and reward terms of the first recorded world, to plot, by name of the series.

        Observations are those of the newest policy step, as the policy reads them, in a group for each term; an
        environment without rewards, or of several tasks, has none.
        """
        env = self.env
        if len(env.tasks) > 1:
            return {}
        world = self.worlds[0]
        row = env.obs[world].tolist()
        values = {}
        for term, (_, end) in zip(env.task.observations.actor, env.task.layout("actor").values(), strict=True):
            names = term.columns[-term.width :]
            for name, value in zip(names, row[end - term.width : end], strict=True):
                values[f"observation {term.name}/{name.removeprefix(f'{term.name}_')} [1]"] = value
        return values | {f"reward/{name} [1]": float(each[world]) for name, each in env.reward_terms.items()}

    def _terminations(self) -> dict[str, np.ndarray]:
        """Return the termination that ends each world's episode in this policy step, "none" in most, as a state."""
        if len(self.env.tasks) > 1:
            return {}
        names = np.array([*self.env.task.termination_names, "none"])
        return {"termination/{}": names[self.env.episodes.termination.numpy()]}

    def recording(self) -> Recording:
        """Return a recording of all frames so far, with the goals of the log and the blocks."""
        from jumper_warp.viz.props import with_blocks

        marks = self._marks()
        recording = self.recorder.recording(goals=marks.get("goals"), heights=marks.get("heights"))
        frames = [robot | task for robot, task in zip(self._robots, self._tasks, strict=False)]
        motion = {name: np.stack([frame[name] for frame in frames]) for name in (frames[0] if frames else ())}
        recording = replace(recording, motion=motion)
        if self.block is None:
            return recording
        half, height = self.block["half"][self.worlds], self.block["height"][self.worlds]
        return with_blocks(recording, np.stack(self.block_positions), half, height)


def save_recording(recording: Recording, folder: Path, name: str, **picture: Any) -> Path:
    """Write a recording as `<name>.rrd` (Rerun) and `<name>.png` (picture of one world); return the .rrd path.

    A recording with a `motion` is also written as `<name>.npz`, for `jumper rescore`. picture: options of
    `write_picture`.
    """
    from jumper_warp.viz.picture import write_picture
    from jumper_warp.viz.rerun import write_rrd

    with phase(f"writing {name}.rrd"):
        path = write_rrd(recording, folder / f"{name}.rrd")
    if recording.motion:
        recording.save_npz(folder / f"{name}.npz")
    write_picture(recording, folder / f"{name}.png", rank=round(SHOWN * (len(recording.worlds) - 1)), **picture)
    return path


def block_positions(sim: Simulation) -> np.ndarray:
    """Return the positions x, y [m] of sliding blocks, (num_worlds, 2), world frame; only SolverJumper has blocks."""
    from jumper_warp.sim.solver import SolverJumper

    assert isinstance(sim.solver, SolverJumper)
    return sim.solver.block_position()


def peak_forces(sim: Simulation) -> np.ndarray:
    """Return the largest force on each paw in the last policy step [N], (num_worlds, 4, 3), world axes.

    Paws are in the order of LEGS. A force's direction is that of the last physics step; upward if the paw was then in
    the air.
    """
    force = sim.paw_force.numpy().transpose(1, 0, 2).astype(float)
    size = np.linalg.norm(force, axis=2, keepdims=True)
    direction = np.where(size > 0.0, force / np.where(size > 0.0, size, 1.0), [0.0, 0.0, 1.0])
    return direction * sim.peak_paw_force.numpy().T[..., None]


def ankles(poses: np.ndarray) -> np.ndarray:
    """Return ankle positions [m], (num_worlds, 4, 3), world frame, legs FL, FR, BL, BR; poses: (num_worlds, 21, 7)."""
    shanks = poses[:, 5 * np.arange(1, len(LEGS) + 1)]  # the base, then five links per leg, the inner shank last
    return shanks[..., :3] + rotate(shanks[..., 3:], ANKLE)
