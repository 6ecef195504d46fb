"""Recordings of rollouts: body poses, named series and contact forces over time, with the shapes to draw them.

A recording is self-contained: it can be shown without the model.
"""

import io
import json
import re
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_atomically
from jumper_warp.viz.shapes import ShapeMesh

FORMAT = "jumper-warp recording"
VERSION = 1
ARRAYS = ("times", "poses", "contact_points", "contact_forces")
SURFACE = ("vertices", "normals", "triangles")
"""Arrays of a recording, and of each of its shapes."""
SERIES_NAME = re.compile(r"[^/\[\]]+/[^/\[\]]+ \[[^\[\]]+\]")
"""Names of series: `group/quantity [unit]`, with 1 as the unit of a pure number."""


class RecordingError(InputError):
    """A file that is not a recording, or not a whole one. The message is one line and names the file."""


@dataclass(frozen=True)
class Recording:
    """One rollout of one or a few worlds, with a fixed set of bodies, series and contacts."""

    times: np.ndarray
    """(num_frames,) float64 [s], increasing."""
    worlds: tuple[int, ...]
    """Indices of the recorded worlds in the model."""
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
    """[m] Distance along y at which worlds are shown side by side; the stored poses are not moved."""
    shapes: tuple[ShapeMesh, ...] = ()
    """Meshes to show; `body` is an index of `bodies`."""
    notes: dict[str, Any] = field(default_factory=dict)
    """Metadata as JSON: seed, gains, commit."""

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
        arrays = {name: getattr(self, name) for name in ARRAYS}
        arrays["header"] = np.array(json.dumps(header))
        arrays["series"] = np.array(list(self.series.values()), dtype=np.float64).reshape(len(self.series), -1)
        for index, shape in enumerate(self.shapes):
            arrays |= {f"shape{index}_{part}": getattr(shape, part) for part in SURFACE}
        data = io.BytesIO()
        np.savez_compressed(data, **arrays)
        write_atomically(Path(path), data.getvalue())
        return Path(path)


def load_npz(path: Path) -> Recording:
    """Return the recording that `Recording.save_npz` wrote.

    Raises RecordingError: the file is missing, damaged, of another kind or of another version.
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
    """Return the recording of a NumPy archive and its parsed header."""
    shapes = tuple(
        ShapeMesh(
            shape["name"], shape["body"], tuple(shape["color"]), *(archive[f"shape{index}_{part}"] for part in SURFACE)
        )
        for index, shape in enumerate(header["shapes"])
    )
    return Recording(
        **{name: archive[name] for name in ARRAYS},
        worlds=tuple(header["worlds"]),
        bodies=tuple(header["bodies"]),
        series=dict(zip(header["series"], archive["series"], strict=True)),
        spacing=header["spacing"],
        shapes=shapes,
        notes=header["notes"],
    )
