"""Recordings of rollouts: body poses, named series and contact forces over time, with the shapes to draw them.

A recording is self-contained: it can be drawn without the Newton model.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.utils.arrays import read_npz, write_npz
from jumper_warp.utils.checks import check_type, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, parse_json
from jumper_warp.viz.shapes import ShapeMesh, packed_shapes, unpacked_shapes

FORMAT = "jumper-warp recording"
VERSION = 2
ARRAYS = "times", "poses", "contact_points", "contact_forces", "goals", "heights", "commands"  # fields of `Recording`
HEADER = "worlds", "bodies", "labels", "spacing", "notes", "states"  # fields of `Recording` that the header contains
MOTION = "motion/"  # Begin of the names of the file's arrays that `Recording.motion` holds
FARTHEST = 1.0e6  # [m] Largest coordinate of a body in the first frame of a file, and largest spacing
SERIES_NAME = re.compile(r"[^/\[\]]+/[^/\[\]]+ \[[^\[\]]+\]")
"""Pattern of a series' name, `group/quantity [unit]`; the unit of a dimensionless quantity is 1."""


class RecordingError(InputError):
    """Error: a file is not a complete recording. The message is one line and names the file."""


@dataclass(frozen=True)
class Recording:
    """Recorded rollout of one or several worlds, with a fixed set of bodies, series and contacts."""

    times: np.ndarray  # (num_frames,) float64 [s], increasing
    worlds: tuple[int, ...]  # indices of the recorded worlds in the model
    bodies: tuple[str, ...]  # names of the recorded bodies, `world_<i>/<link>`, one world after the other
    poses: np.ndarray  # (num_frames, num_bodies, 7) float32: origin [m] and quaternion xyzw, body to world
    series: dict[str, np.ndarray]  # (num_frames,) float64 by name, `group/quantity [unit]`
    contact_points: np.ndarray  # (num_frames, num_worlds, contacts_per_world, 3) float32 [m], world frame
    contact_forces: np.ndarray
    """Contact force on the robot [N], world frame, (num_frames, num_worlds, contacts_per_world, 3) float32."""
    spacing: float = 0.0  # [m] Distance along y between the drawings of consecutive worlds; the data are not moved
    shapes: tuple[ShapeMesh, ...] = ()  # meshes to draw; their `body` is an index of `bodies`, -1 for the world
    notes: Json = field(default_factory=dict)  # metadata of JSON types, such as seed, gains and commit
    labels: tuple[str, ...] = ()  # names of the worlds to show, such as their goals; default `world_<i>`
    states: dict[str, list[str]] = field(default_factory=dict)  # by name, a text for each frame, such as a phase
    goals: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))
    """Goals [m], world frame, (num_worlds, goals, 3), drawn on the surface under them; NaN or no worlds: no goals."""
    heights: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    """Commanded heights of the base at the apex [m], above z = 0, (num_worlds,); NaN or no worlds: none."""
    commands: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))
    """Commanded velocity ahead, to the left [m/s] and about z [rad/s], (num_frames, num_worlds, 3); no frames: none."""
    motion: dict[str, np.ndarray] = field(default_factory=dict)
    """Complete states by name, from which rewards can be evaluated (`jumper_warp.evaluation.motion`): after the policy
    step of each frame `robot.<array>` and `termination`, before it `state.<field>`; (num_frames, num_worlds, ...)."""

    def label(self, rank: int) -> str:
        """Return the name of the rank-th recorded world."""
        return self.labels[rank] if self.labels else f"world_{self.worlds[rank]}"

    def heading(self, ranks: Sequence[int]) -> str:
        """Return the title of a picture or film: that in `notes`, else policy and task, and the world if only one."""
        if "title" in self.notes:
            return str(self.notes["title"])
        policy, task = (str(self.notes.get(key, "")) for key in ("policy", "task"))
        same = not policy or policy.replace("_", "-") == task
        words = [policy or task if same else f"{policy} ({task})", *(map(self.label, ranks) if len(ranks) == 1 else ())]
        return "   ".join(filter(None, words))

    def body_poses(self, rank: int) -> np.ndarray:
        """Return the poses of the rank-th recorded world's bodies, (num_frames, bodies, 7), the base first."""
        return self.poses[:, self.body_indices(rank)]

    def body_indices(self, rank: int) -> list[int]:
        """Return the indices in `bodies` of a world's bodies by its rank. Raises InputError: no such rank."""
        check_type("rank", rank, int)
        if not 0 <= rank < len(self.worlds):
            raise InputError(f"rank must be in 0 to {len(self.worlds) - 1}, got {rank}")
        prefix = f"world_{self.worlds[rank]}/"
        return [i for i, body in enumerate(self.bodies) if body.startswith(prefix)]

    def save_npz(self, path: Path) -> Path:
        """Write the recording atomically to one NumPy archive without pickles; return its path. Raises OSError."""
        entries, meshes = packed_shapes(self.shapes)
        header = {"format": FORMAT, "version": VERSION, "series": list(self.series), "shapes": entries}
        header |= {name: getattr(self, name) for name in HEADER}
        arrays = {name: getattr(self, name) for name in ARRAYS}
        arrays["header"] = np.array(json.dumps(header))
        series = np.array(list(self.series.values()), dtype=np.float64)
        arrays |= {MOTION + name: values for name, values in self.motion.items()}
        arrays["series"] = series.reshape(len(self.series), -1 if self.series else 0)
        write_npz(Path(path), **arrays, **meshes)
        return Path(path)


def load_npz(path: Path) -> Recording:
    """Load a recording from a file written by `Recording.save_npz`.

    path: of the archive, or of the .rrd file beside it. Raises RecordingError (an InputError): the file is missing,
    damaged, of another kind or of another version, or an entry has another type or shape.
    """
    path = Path(path).with_suffix(".npz") if Path(path).suffix == ".rrd" else Path(path)
    archive = read_npz(path, "recording", RecordingError)
    try:
        header = parse_json(str(archive["header"]), "header")
        if header["format"] != FORMAT or header["version"] != VERSION:
            raise RecordingError(f"expected a {FORMAT} of version {VERSION}")
        recording = _from_archive(header, archive)
        check_types("recording", recording)
        _check_arrays(recording)
        return recording
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        reason = f"{type(error).__name__}: {error!s:.200}"
        raise RecordingError(f"{path}: cannot be read as a recording ({reason})") from error


def _from_archive(header: Json, archive: Mapping[str, np.ndarray]) -> Recording:
    """Build a recording, without checks, from a NumPy archive; header: its decoded JSON entry `header`."""
    series = dict(zip(header["series"], archive["series"], strict=True))
    motion = {name.removeprefix(MOTION): values for name, values in archive.items() if name.startswith(MOTION)}
    values: Json = {name: header[name] for name in HEADER} | {name: tuple(header[name]) for name in HEADER[:3]}
    values |= {name: archive[name] for name in ARRAYS}
    return Recording(**values, series=series, shapes=unpacked_shapes(header["shapes"], archive), motion=motion)


def _check(name: str, valid: Any) -> None:
    """Raise RecordingError, with the name of an entry, unless it is valid."""
    if not valid:
        raise RecordingError(f"{name} is of another type or shape, or out of range")


def _check_arrays(recording: Recording) -> None:
    """Raise RecordingError for an array of another type or shape, or times that do not rise."""
    frames, worlds, bodies = (len(part) for part in (recording.times, recording.worlds, recording.bodies))
    contacts, goals = recording.contact_points.shape[2:3], recording.goals.shape[1:2]
    for name, *shapes in (
        ("times", (frames,)),
        ("poses", (frames, bodies, 7)),
        ("contact_points", (frames, worlds, *contacts, 3)),
        ("contact_forces", (frames, worlds, *contacts, 3)),
        ("goals", (worlds, *goals, 3), (0, *goals, 3)),
        ("heights", (worlds,), (0,)),
        ("commands", (frames, worlds, 3), (0, *recording.commands.shape[1:2], 3)),
    ):
        values = getattr(recording, name)
        _check(name, values.dtype.kind in "fiu" and values.shape in shapes)
    for values in recording.motion.values():
        _check("motion", values.dtype.kind in "biuf" and values.shape[:2] == (frames, worlds))
    for values in recording.series.values():
        _check("series", values.dtype.kind in "fiu" and values.shape == (frames,))
    for words in recording.states.values():
        _check("states", len(words) == frames)
    for shape in recording.shapes:
        check_types(f"shape {shape.name!r:.40}", shape)
        points, normals, triangles = shape.vertices, shape.normals, shape.triangles
        _check("vertices", points.dtype.kind == "f" and points.shape[1:] == (3,) and np.isfinite(points).all())
        _check("normals", normals.dtype.kind == "f" and normals.shape == points.shape)
        _check("triangles", triangles.dtype.kind in "iu" and triangles.shape[1:] == (3,))
        _check("triangles", not triangles.size or 0 <= triangles.min() <= triangles.max() < len(points))
        _check("body of a shape", -1 <= shape.body < bodies)
    times = recording.times
    _check("times", frames > 0 and np.isfinite(times).all() and (np.diff(times) > 0.0).all())
