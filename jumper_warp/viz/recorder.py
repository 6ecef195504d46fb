"""Recorder of a running simulation's frames."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.checks import check_finite, check_number, check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.newton_types import Model
from jumper_warp.viz.recording import FARTHEST, SERIES_NAME, Recording
from jumper_warp.viz.rerun import write_rrd
from jumper_warp.viz.shapes import ShapeMesh, shape_meshes


class Recorder:
    """Recorder that collects frames (body poses, series, contact forces) of a running Newton model.

    ```python
    recorder = Recorder(model)
    recorder.record(time, state.body_q, {"base/height [m]": height, "torque/FL_outer [N m]": torque})
    recorder.save_rrd(folder / "jump.rrd")
    ```
    """

    def __init__(
        self, model: Model, worlds: Sequence[int] = (0,), *, spacing: float = 0.0,
        notes: Mapping[str, Any] | None = None, labels: Sequence[str] = (),
    ) -> None:  # fmt: skip
        """Prepare to record some worlds of a Newton model; its bodies and shapes are read here, once.

        spacing: distance [m] along y between the drawings of consecutive worlds; 0 for true positions, required for a
        heightfield. notes: metadata of JSON types, saved with the recording. labels: names of the worlds.
        Raises InputError: an argument of another type or out of range, a world that has no bodies or is given twice,
        labels of another number than the worlds, or a visible shape that cannot be drawn.
        """
        check_type("model", model, Model)
        check_type("worlds", worlds, Sequence[int])
        check_type("labels", labels, Sequence[str])
        check_type("notes", notes, Mapping | None)
        check_number("spacing", spacing, -FARTHEST, FARTHEST, "m")
        if not 0 < len(worlds) == len(set(worlds)) or len(labels) not in (0, len(worlds)):
            raise InputError(
                f"worlds must differ, with a label each or none, got {worlds!r:.60}, labels {labels!r:.60}"
            )
        world_of_body = model.body_world.numpy()
        for world in worlds:
            if world not in world_of_body:
                raise InputError(f"world {world} has no bodies: the model has {model.world_count} worlds")
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
        self._labels = tuple(labels)
        self._times: list[float] = []
        self._poses: list[np.ndarray] = []
        self._names_of_series: list[str] = []
        self._series: list[np.ndarray] = []  # values of each frame; arrays, since an hour has 216,000
        self._contacts: list[tuple[np.ndarray, np.ndarray]] = []
        self._states: list[dict[str, str]] = []
        self._commands: list[np.ndarray] = []

    def record(
        self, time: float, body_poses: wp.array | np.ndarray, series: Mapping[str, float] | None = None,
        contact_points: np.ndarray | None = None, contact_forces: np.ndarray | None = None, *,
        states: Mapping[str, str] | None = None, commands: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Record the current state as a frame; its time stamp [s] must be later than that of the previous frame.

        body_poses: of all bodies of the model, like `state.body_q`: (body_count, 7), position [m] and quaternion xyzw.
        series: values by name, `group/quantity [unit]`, the same names in every frame. contact_points [m] and
        contact_forces [N] on the robot: world frame, (num_worlds, contacts_per_world, 3), or (contacts, 3) for one
        world, the same number in every frame. states: words by name, such as a phase, the same names in every frame.
        commands: commanded velocities ahead, left [m/s] and about z [rad/s], (worlds, 3), in every frame or none.
        Raises InputError: time does not increase, a shape is wrong, or a name is malformed, new or missing.
        """
        check_finite("time", time)
        check_type("series", series, Mapping | None)
        check_type("states", states, Mapping | None)
        if self._times and not time > self._times[-1]:
            raise InputError(f"time must increase, got {time} s after {self._times[-1]} s")
        poses = real_array(body_poses.numpy() if isinstance(body_poses, wp.array) else body_poses, "body_poses")
        if poses.shape != (self._body_count, 7):
            raise InputError(f"body_poses must have shape ({self._body_count}, 7), got {poses.shape}")
        contacts = self._checked_contacts(contact_points, contact_forces)
        rows = None if commands is None else real_array(commands, "commands")
        if rows is not None and rows.shape != (len(self._worlds), 3):
            raise InputError(f"commands must have shape ({len(self._worlds)}, 3), got {rows.shape}")
        self._append_series({} if series is None else series)
        self._times.append(float(time))
        self._poses.append(poses[self._bodies])
        self._contacts.append(contacts)
        self._states.append(dict(states or {}))
        if rows is not None:
            self._commands.append(rows.copy())

    @property
    def frames(self) -> int:
        """Number of recorded frames."""
        return len(self._times)

    def _append_series(self, series: Mapping[str, float]) -> None:
        """Append a frame's values of the series, by name. Raises InputError: a malformed, new or missing name."""
        if not self._series:
            malformed = [name for name in series if not SERIES_NAME.fullmatch(name)]
            if malformed:
                raise InputError(f"series are named 'group/quantity [unit]', got {malformed[0]!r}")
            self._names_of_series = list(series)
        different = set(series) ^ set(self._names_of_series)
        if different:
            raise InputError(f"every frame needs the same series; new or missing: {sorted(different)}")
        self._series.append(np.array([float(series[name]) for name in self._names_of_series]))

    def _checked_contacts(self, points: np.ndarray | None, forces: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Check and copy a frame's contacts, (num_worlds, contacts_per_world, 3) each; no contacts if both are None.

        Raises InputError: only one is given, or a shape is wrong or differs from earlier frames.
        """
        if (points is None) != (forces is None):
            raise InputError("pass contact_points and contact_forces together, or neither")
        if points is None:
            points = forces = np.zeros((len(self._worlds), 0, 3))
        points, forces = (real_array(given, "contacts").copy() for given in (points, forces))
        if points.ndim == 2 and len(self._worlds) == 1:
            points, forces = points[None], forces[None]
        if points.ndim != 3 or points.shape[::2] != (len(self._worlds), 3) or forces.shape != points.shape:
            raise InputError(
                f"contacts must have shape ({len(self._worlds)}, n, 3), got {points.shape}, {forces.shape}"
            )
        if self._contacts and self._contacts[0][0].shape != points.shape:
            raise InputError(f"every frame needs contacts of shape {self._contacts[0][0].shape}, got {points.shape}")
        return points, forces

    def recording(
        self, *, goals: np.ndarray | None = None, heights: np.ndarray | None = None, first: int = 0
    ) -> Recording:
        """Return a recording of all frames recorded so far, from frame `first` on. Raises InputError: there is none.

        goals [m]: on the ground, world frame, (worlds, goals, 3); heights [m]: commanded, (worlds,); NaN: none.
        """
        if not self._times[first:]:
            raise InputError("the recording has no frames")
        marks: Any = {"goals": goals, "heights": heights, "commands": self._commands[first:] or None}
        marks = {name: real_array(values, name) for name, values in marks.items() if values is not None}
        for name, dimensions in (("goals", 3), ("heights", 1)):
            shape = np.shape(marks.get(name, ()))
            fits = len(shape) == dimensions and shape[0] in (0, len(self._worlds)) and shape[2:] in ((), (3,))
            if name in marks and not fits:
                raise InputError(f"{name} must have one row for each of {len(self._worlds)} worlds, got shape {shape}")
        series = np.stack(self._series[first:], axis=1)
        points, forces = (np.stack(part) for part in zip(*self._contacts[first:], strict=True))
        return Recording(
            times=np.array(self._times[first:]),
            worlds=self._worlds,
            bodies=self._names,
            poses=np.stack(self._poses[first:]),
            series=dict(zip(self._names_of_series, series, strict=True)),
            contact_points=points,
            contact_forces=forces,
            spacing=self._spacing,
            shapes=self._shapes,
            notes=self._notes,
            labels=self._labels,
            states={name: [frame[name] for frame in self._states[first:]] for name in self._states[0]},
            **marks,
        )

    def save_npz(self, path: Path) -> Path:
        """Write the recording so far as a NumPy archive, which `load_npz` reads; return its path."""
        return self.recording().save_npz(path)

    def save_rrd(self, path: Path) -> Path:
        """Write the recording as a file of the Rerun viewer; return its path."""
        return write_rrd(self.recording(), Path(path))

    def save_picture(self, path: Path, **options: Any) -> Path:
        """Write a composite picture (.png, .webp or .jpg); return its path; options: those of `write_picture`."""
        from jumper_warp.viz.picture import write_picture

        return write_picture(self.recording(), Path(path), **options)
