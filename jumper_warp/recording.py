"""Recordings of rollouts: body poses, named series and contact forces over time, with the shapes to draw them.

A recording stands on its own: what was seen can be drawn without the model that made it.
"""

import json
import os
import re
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp

from jumper_warp.rerun_file import write_rrd
from jumper_warp.shapes import ShapeMesh, shape_meshes

FORMAT = "jumper-warp recording"
VERSION = 1
SERIES_NAME = re.compile(r"[^/\[\]]+/[^/\[\]]+ \[[^\[\]]+\]")
"""Names of series: `group/quantity [unit]`, with 1 as the unit of a pure number."""


class RecordingError(ValueError):
    """A file that is not a recording, or not a whole one. The message is one line and names the file."""


@dataclass(frozen=True)
class Recording:
    """One rollout of one or a few worlds, with a fixed set of bodies, series and contacts."""

    times: np.ndarray
    """(num_frames,) float64 [s], increasing."""
    worlds: tuple[int, ...]
    """Which of the model's worlds these are."""
    bodies: tuple[str, ...]
    """Names of the recorded bodies, `world_<i>/<link>`, one world after the other."""
    poses: np.ndarray
    """(num_frames, num_bodies, 7) float32: origin [m] and quaternion xyzw, body to world."""
    series: dict[str, np.ndarray]
    """`group/quantity [unit]` to (num_frames,) float64."""
    contact_points: np.ndarray
    """(num_frames, num_worlds, contacts_per_world, 3) float32 [m], world frame."""
    contact_forces: np.ndarray
    """The same shape, float32 [N], world frame, on the robot."""
    spacing: float = 0.0
    """Distance along y by which each world is drawn beside the one before it [m]; the data are not moved."""
    shapes: tuple[ShapeMesh, ...] = ()
    """What to draw; `body` is here an index of `bodies`."""
    notes: dict[str, Any] = field(default_factory=dict)
    """Anything that JSON holds: seed, gains, commit."""

    def save_npz(self, path: Path) -> Path:
        """Write the recording to one NumPy archive without pickles, whole or not at all; return its path."""
        header = {
            "format": FORMAT,
            "version": VERSION,
            "worlds": self.worlds,
            "bodies": self.bodies,
            "series": list(self.series),
            "shapes": [{"name": shape.name, "body": shape.body, "color": shape.color} for shape in self.shapes],
            "spacing": self.spacing,
            "notes": self.notes,
        }
        arrays = {
            "header": np.array(json.dumps(header)),
            "times": self.times,
            "poses": self.poses,
            "series": np.array(list(self.series.values()), dtype=np.float64).reshape(len(self.series), -1),
            "contact_points": self.contact_points,
            "contact_forces": self.contact_forces,
        }
        for index, shape in enumerate(self.shapes):
            arrays[f"shape{index}_vertices"] = shape.vertices
            arrays[f"shape{index}_normals"] = shape.normals
            arrays[f"shape{index}_triangles"] = shape.triangles
        path = Path(path)
        aside = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            with aside.open("wb") as file:
                np.savez_compressed(file, **arrays)
            os.replace(aside, path)
        finally:
            aside.unlink(missing_ok=True)
        return path

    def save_rrd(self, path: Path) -> Path:
        """Write the recording for the Rerun viewer, see `jumper_warp.rerun_file`; return its path."""
        return write_rrd(self, Path(path))


def load_npz(path: Path) -> Recording:
    """Read what `Recording.save_npz` wrote.

    Raises:
        RecordingError: The file is missing, damaged, of another kind or of another version.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(str(archive["header"]))
            if header["format"] != FORMAT or header["version"] != VERSION:
                raise RecordingError(f"{path}: expected a {FORMAT} of version {VERSION}")
            return _from_archive(header, archive)
    except RecordingError:
        raise
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise RecordingError(f"{path}: cannot be read as a recording ({type(error).__name__}: {error})") from error


def _from_archive(header: dict[str, Any], archive: Mapping[str, np.ndarray]) -> Recording:
    shapes = [
        ShapeMesh(
            shape["name"],
            shape["body"],
            tuple(shape["color"]),
            archive[f"shape{index}_vertices"],
            archive[f"shape{index}_normals"],
            archive[f"shape{index}_triangles"],
        )
        for index, shape in enumerate(header["shapes"])
    ]
    return Recording(
        times=archive["times"],
        worlds=tuple(header["worlds"]),
        bodies=tuple(header["bodies"]),
        poses=archive["poses"],
        series=dict(zip(header["series"], archive["series"], strict=True)),
        contact_points=archive["contact_points"],
        contact_forces=archive["contact_forces"],
        spacing=header["spacing"],
        shapes=tuple(shapes),
        notes=header["notes"],
    )


class Recorder:
    """Collects the frames of a rollout of a Newton model.

    ```python
    recorder = Recorder(model)
    recorder.record(time, state.body_q, {"base/height [m]": height, "torque/FL_outer [N m]": torque})
    recorder.save_rrd(folder / "jump.rrd")
    ```
    """

    def __init__(
        self,
        model: newton.Model,
        worlds: Sequence[int] = (0,),
        *,
        spacing: float = 0.0,
        notes: Mapping[str, Any] | None = None,
    ) -> None:
        """Record some worlds of a model.

        Args:
            model: Where the bodies and shapes are read from, once.
            worlds: Indices of the worlds to record.
            spacing: Distance [m] along y by which each world is drawn beside the one before it. Zero keeps the true
                positions, as a heightfield needs.
            notes: Saved along; must be JSON.

        Raises:
            ValueError: A world has no bodies, or a visible shape cannot be drawn.
        """
        world_of_body = model.body_world.numpy()
        for world in worlds:
            if world not in world_of_body:
                raise ValueError(f"world {world} has no bodies: the model has {model.world_count} worlds")
        self._worlds = tuple(worlds)
        self._spacing = spacing
        self._body_count = model.body_count
        self._bodies = np.concatenate([np.flatnonzero(world_of_body == world) for world in worlds])
        self._names = tuple(f"world_{world_of_body[b]}/{model.body_label[b].split('/')[-1]}" for b in self._bodies)
        index = {int(body): position for position, body in enumerate(self._bodies)} | {-1: -1}
        self._shapes = tuple(
            ShapeMesh(s.name, index[s.body], s.color, s.vertices, s.normals, s.triangles)
            for s in shape_meshes(model, self._worlds)
        )
        self._notes = dict(notes or {})
        self._times: list[float] = []
        self._poses: list[np.ndarray] = []
        self._series: dict[str, list[float]] | None = None
        self._contacts: list[tuple[np.ndarray, np.ndarray]] = []

    def record(
        self,
        time: float,
        body_poses: wp.array | np.ndarray,
        series: Mapping[str, float] | None = None,
        contact_points: np.ndarray | None = None,
        contact_forces: np.ndarray | None = None,
    ) -> None:
        """Add a frame.

        Args:
            time: [s], later than the frame before.
            body_poses: Poses of all bodies of the model, as in `state.body_q`: (body_count, 7), pos [m] and quat xyzw.
            series: `group/quantity [unit]` to value; the same names in every frame.
            contact_points: [m], world frame, (num_worlds, contacts_per_world, 3) or (contacts, 3) for one world; the
                same number in every frame.
            contact_forces: [N] on the robot, same shape and frame.

        Raises:
            ValueError: Time does not increase, a shape is wrong, or a name is malformed, new or missing.
        """
        if self._times and not time > self._times[-1]:
            raise ValueError(f"time must increase, got {time} s after {self._times[-1]} s")
        poses = np.asarray(body_poses.numpy() if isinstance(body_poses, wp.array) else body_poses, dtype=np.float32)
        if poses.shape != (self._body_count, 7):
            raise ValueError(f"body_poses must have shape ({self._body_count}, 7), got {poses.shape}")
        contacts = self._checked_contacts(contact_points, contact_forces)
        self._append_series({} if series is None else series)
        self._times.append(float(time))
        self._poses.append(poses[self._bodies])
        self._contacts.append(contacts)

    def _append_series(self, series: Mapping[str, float]) -> None:
        values = {name: float(value) for name, value in series.items()}
        if self._series is None:
            malformed = [name for name in series if not SERIES_NAME.fullmatch(name)]
            if malformed:
                raise ValueError(f"series are named 'group/quantity [unit]', got {malformed[0]!r}")
            self._series = {name: [] for name in series}
        different = set(values) ^ set(self._series)
        if different:
            raise ValueError(f"every frame needs the same series; new or missing: {sorted(different)}")
        for name, value in values.items():
            self._series[name].append(value)

    def _checked_contacts(self, points: np.ndarray | None, forces: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return copies of a frame's contacts, (num_worlds, contacts_per_world, 3) each."""
        if (points is None) != (forces is None):
            raise ValueError("contact_points and contact_forces come together")
        if points is None:
            points = forces = np.zeros((len(self._worlds), 0, 3))
        points, forces = (np.array(given, dtype=np.float32) for given in (points, forces))
        if points.ndim == 2 and len(self._worlds) == 1:
            points, forces = points[None], forces[None]
        if points.ndim != 3 or points.shape[::2] != (len(self._worlds), 3) or forces.shape != points.shape:
            raise ValueError(
                f"contacts must have shape ({len(self._worlds)}, n, 3), got {points.shape}, {forces.shape}"
            )
        if self._contacts and self._contacts[0][0].shape != points.shape:
            raise ValueError(f"every frame needs contacts of shape {self._contacts[0][0].shape}, got {points.shape}")
        return points, forces

    def recording(self) -> Recording:
        """Return what was recorded so far.

        Raises:
            ValueError: There is no frame.
        """
        if not self._times:
            raise ValueError("nothing was recorded")
        return Recording(
            times=np.array(self._times),
            worlds=self._worlds,
            bodies=self._names,
            poses=np.stack(self._poses),
            series={name: np.array(values) for name, values in self._series.items()},
            contact_points=np.stack([points for points, _ in self._contacts]),
            contact_forces=np.stack([forces for _, forces in self._contacts]),
            spacing=self._spacing,
            shapes=self._shapes,
            notes=self._notes,
        )

    def save_npz(self, path: Path) -> Path:
        """Write what was recorded so far as a NumPy archive; `load_npz` reads it."""
        return self.recording().save_npz(path)

    def save_rrd(self, path: Path) -> Path:
        """Write what was recorded so far for the Rerun viewer."""
        return self.recording().save_rrd(path)
