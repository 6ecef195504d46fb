"""Films of watched worlds during a training: GIF files in the run's folder, for TensorBoard and Weights & Biases too.

A process of low priority draws each film: `python -m jumper_warp.live.films RECORDING.npz ITERATION [PROJECT]`.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.live.clips import ROLES, Player
from jumper_warp.live.feed import Setup, start_module
from jumper_warp.live.scene import RobotScene
from jumper_warp.viz.recording import Recording, load_npz

FOLDER = "videos"  # in a run's folder; TensorBoard shows it as a run of its own
LENGTH = 300  # [policy steps] of the longest film
SIZE = (480, 270)  # [px]
FPS = 15.0  # [1/s]
EYE = (4.8, -2.0, 2.0)  # [m] camera, from the robots' mean position
SPACING = 1.2  # [m] Distance between robots


class Films:
    """Films of the first run, one for each `Setup.video_every` iterations, of whole episodes that end after it."""

    def __init__(self, setup: Setup) -> None:
        """Prepare to film; the first film is due at the first iteration that is a multiple of `video_every`."""
        self._setup = setup
        self._due: int | None = None  # Iteration of the film to make
        self._count: int | None = None  # Multiples of `video_every` so far
        self._process: subprocess.Popen | None = None

    def update(self, iteration: int, players: list[Player]) -> None:
        """Begin a film if one is due, and each slot's player has a whole episode since then."""
        count = iteration // self._setup.video_every
        if self._count is not None and count > self._count and self._due is None:
            self._due = count * self._setup.video_every
            for player in players:
                player.finished = None
        self._count = count
        busy = self._process is not None and self._process.poll() is None
        if self._due is not None and not busy and all(player.finished for player in players):
            self._draw(self._due, [player.finished.rows for player in players if player.finished])
            self._due = None

    def _draw(self, iteration: int, clips: list[list[np.ndarray]]) -> None:
        """Start the process that draws episodes side by side; a shorter one ends in its last pose."""
        setup = self._setup
        length = min(max(map(len, clips)), LENGTH)
        columns = slice(*setup.layout["joint_q"])
        rows = np.stack([[clip[min(i, len(clip) - 1)][columns] for clip in clips] for i in range(length)])
        recording = side_by_side(setup.scene, rows.view(np.float32), setup.step_dt)
        notes = {"policy": f"iteration {iteration}", "task": setup.titles[0]}
        folder = setup.folders[0] / FOLDER
        folder.mkdir(exist_ok=True)
        path = replace(recording, notes=notes).save_npz(folder / f"iteration_{iteration:06d}.npz")
        project = [] if setup.wandb is None else [setup.wandb]
        self._process = start_module(__name__, str(path), str(iteration), *project)

    def end(self) -> None:
        """Wait for the last film."""
        if self._process is not None:
            self._process.wait()


def side_by_side(scene: RobotScene, joint_q: np.ndarray, step_dt: float) -> Recording:
    """Return a recording of robots in a row, each relative to its start.

    joint_q: (frames, slots, coordinates), as `RobotArrays.joint_q`; step_dt [s]: between frames.
    """
    frames, slots = joint_q.shape[:2]
    poses = scene.link_poses(joint_q)
    poses[..., :2] -= poses[:1, :, :1, :2]
    links = scene.links
    bodies = tuple(f"world_{slot}/{link}" for slot in range(slots) for link in links)
    shapes = [shape for shape in scene.shapes if shape.body < 0]
    robot = [shape for shape in scene.shapes if shape.body >= 0]
    shapes += [replace(shape, body=slot * len(links) + shape.body) for slot in range(slots) for shape in robot]
    none = np.zeros((frames, slots, 0, 3), np.float32)
    return Recording(
        step_dt * np.arange(frames), tuple(range(slots)), bodies, poses.reshape(frames, -1, 7), {}, none, none,
        SPACING, tuple(shapes), labels=ROLES[:slots],
    )  # fmt: skip


def draw(source: Path, iteration: int, project: str | None = None) -> None:
    """Write a recording's film beside its file, which is removed, and report it to TensorBoard and to `project`.

    project: of Weights & Biases; None: no report there.
    """
    from jumper_warp.utils.runtime import init_warp
    from jumper_warp.viz.film import write_film

    init_warp()
    recording = load_npz(source)
    path = write_film(recording, source.with_suffix(".gif"), size=SIZE, fps=FPS, eye=EYE)
    source.unlink()
    report(path, iteration, str(recording.notes.get("task", "")), project)


def report(path: Path, iteration: int, title: str, project: str | None) -> None:
    """Add a film to the events of TensorBoard in its folder, and to a project of Weights & Biases.

    title: of the training.
    """
    from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
    from torch.utils.tensorboard import FileWriter

    image = Summary.Image(height=SIZE[1], width=SIZE[0], colorspace=3, encoded_image_string=path.read_bytes())
    writer = FileWriter(str(path.parent))
    writer.add_summary(Summary(value=[Summary.Value(tag="film", image=image)]), iteration)
    writer.close()
    if project is not None:
        wandb: Any = importlib.import_module("wandb")
        name = f"{title} films"
        with wandb.init(project=project, dir=str(path.parent), name=name, id=name.replace(" ", "-"),
                        resume="allow") as run:  # fmt: skip
            run.log({"film": wandb.Video(str(path), format="gif")}, step=iteration)


if __name__ == "__main__":
    os.nice(19)
    draw(Path(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])
