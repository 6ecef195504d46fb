"""Recorded motions: motor targets, measurements and their noise, from npz or CSV files."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jumper_warp.robot.description import MOTOR_JOINTS
from jumper_warp.utils.arrays import read_npz, real_array, write_npz
from jumper_warp.utils.checks import check_bounds, check_number, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import existing_file, parse_json, read_file, read_json

PER_MOTOR = ("target", "angle", "rate", "torque")
CHANNELS = ("angle", "rate", "torque", "position", "quaternion")
"""Names of measured channels; each is a field of `RecordedMotion`."""
PURPOSE = "recorded motions"
MAX_CSV_BYTES = 64 * 2**20  # Size of the largest CSV file that is read
MAX_ROWS = 1_000_000  # Largest table of a motion, more than an hour at 240 Hz
DEGREES = math.pi / 180.0
UNITS = {
    "time": {"s": 1.0, "ms": 1.0e-3, "us": 1.0e-6, "ns": 1.0e-9},
    "target": {"rad": 1.0, "deg": DEGREES},
    "angle": {"rad": 1.0, "deg": DEGREES},
    "rate": {"rad/s": 1.0, "deg/s": DEGREES},
    "torque": {"N m": 1.0, "Nm": 1.0},
    "current": {"A": 1.0},
    "position": {"m": 1.0, "mm": 1.0e-3},
    "quaternion": {"": 1.0, "1": 1.0},
}
"""Factor of each unit to the first one of its quantity, which is the default."""
LARGEST_PLAUSIBLE = {"target": 13.0, "angle": 13.0, "rate": 300.0, "torque": 1000.0, "position": 100.0}
"""Absolute value [rad, rad/s, N m, m] by channel above which the data are probably in another unit."""
EXAMPLE = (
    "such as time, target/FL_outer, angle/FL_outer [deg], rate/FL_outer, torque/FL_outer, position/x, quaternion/w"
)


NOISE_BOUNDS = {
    "angle": (1.0e-6, 90.0, "deg"), "rate": (1.0e-6, 1.0e4, "deg/s"), "torque": (1.0e-6, 100.0, "N m"),
    "position": (1.0e-6, 1.0e3, "mm"), "orientation": (1.0e-6, 90.0, "deg"),
}  # fmt: skip
"""Smallest and largest standard deviation of the noise by field of `NoiseLevels`, and unit."""


@dataclass(frozen=True)
class NoiseLevels:
    """Standard deviations of the sensor noise of motor angles, rates, torques and the base's pose."""

    angle: float = 0.05  # [deg] Noise of motor angles
    rate: float = 1.0  # [deg/s] Noise of motor rates
    torque: float = 0.3  # [N m] Noise of motor torques
    position: float = 5.0  # [mm] Noise of the base's position
    orientation: float = 0.5  # [deg] Noise of the base's orientation

    def check(self) -> None:
        """Raise InputError for a standard deviation of the noise outside its range in NOISE_BOUNDS."""
        check_bounds("noise", self, NOISE_BOUNDS)


@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """Recorded targets and measurements of one motion, n rows. NaN: not measured in a row; None: channel not measured.

    The 12 motors are ordered by leg FL, FR, BL, BR, each lateral, outer, inner.
    """

    name: str  # Name of the file without suffix
    time: np.ndarray  # (n,) [s], rising
    target: np.ndarray  # (n, 12) [rad] Sent to the motors (after the command filter), each held until the next row
    angle: np.ndarray | None = None  # (n, 12) [rad] Readings of the motors' angle sensors, including their offsets
    rate: np.ndarray | None = None  # (n, 12) [rad/s] Motor rates
    torque: np.ndarray | None = None
    """(n, 12) [N m] At the joints: measured, or current times torque constant times gear ratio."""
    position: np.ndarray | None = None  # (n, 3) [m] Of the base link's origin, world frame, the ground at z = 0
    quaternion: np.ndarray | None = None  # (n, 4) xyzw, base to world
    base: Literal["free", "fixed"] = "free"
    """"free": the robot stands or jumps on the ground; "fixed": it hangs from a stand, paws in the air."""
    gains: Literal["jumping", "walking"] = "jumping"
    """Set of the robot description's motor gains that the controllers used."""
    torque_limit: float = 18.0  # [N m] Limit on the controllers' torque
    notes: Mapping[str, Any] = field(default_factory=dict)  # Free-form metadata, saved with the motion

    def __post_init__(self) -> None:
        """Raise InputError for a measured channel of wrong shape, not finite or out of range, or an invalid setting."""
        where = f"motion {self.name}"
        for name in ("time", *PER_MOTOR, "position", "quaternion"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, real_array(getattr(self, name), f"{where}: {name}", np.float64))
        n = self.time.size
        if not 3 <= n <= MAX_ROWS or self.time.ndim != 1:
            raise InputError(f"{where}: time must be one column of 3 to {MAX_ROWS} rows, got shape {self.time.shape}")
        if not np.isfinite(self.time).all() or not (np.diff(self.time) > 0.0).all():
            row = int(np.argmin(np.concatenate([[1.0], np.nan_to_num(np.diff(self.time), nan=-1.0)]) > 0.0))
            raise InputError(f"{where}: time must be finite and rise, it does not in row {row}")
        if (step := float(np.median(np.diff(self.time)))) > 1.0:
            raise InputError(f"{where}: time rises by {step:.4g} s a row: give its unit, such as [ms]")
        for name, width in (*((name, 12) for name in PER_MOTOR), ("position", 3), ("quaternion", 4)):
            values = getattr(self, name)
            if values is None:
                continue
            if values.shape != (n, width):
                raise InputError(f"{where}: {name} must have shape ({n}, {width}), got {values.shape}")
            if np.isinf(values).any() or (name == "target" and np.isnan(values).any()):
                row = int(np.argwhere(~np.isfinite(values) if name == "target" else np.isinf(values))[0][0])
                raise InputError(f"{where}: {name} is not finite in row {row}")
            largest = np.nanmax(np.abs(values)) if not np.isnan(values).all() else 0.0
            if largest > LARGEST_PLAUSIBLE.get(name, math.inf):
                unit = next(iter(UNITS[name]))
                raise InputError(f"{where}: {name} reaches {largest:.4g} {unit}: give its unit, such as [deg]")
        self._check_settings()

    def _check_settings(self) -> None:
        """Raise InputError if nothing is measured, quaternions are not of length 1, or a setting is out of range."""
        where = f"motion {self.name}"
        if self.quaternion is not None:
            size = np.linalg.norm(self.quaternion, axis=1)
            if (np.abs(size[np.isfinite(size)] - 1.0) > 1.0e-2).any():
                raise InputError(f"{where}: quaternions must have length 1")
        if all(getattr(self, name) is None for name in CHANNELS):
            raise InputError(f"{where}: nothing is measured; expected one of {', '.join(CHANNELS)}")
        check_types(where, self)
        check_number(f"{where}: torque_limit", self.torque_limit, 0.1, 1000.0, "N m")

    @property
    def duration(self) -> float:
        """Duration of the recorded motion, from the first row to the last [s]."""
        return float(self.time[-1] - self.time[0])

    def columns(self) -> dict[str, Any]:
        """Return all array fields of the motion by name: time, target and the measured channels."""
        return {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), np.ndarray)}

    def save(self, path: Path) -> None:
        """Write the motion as npz for `load_motion`. Raises OSError."""
        settings = {name: getattr(self, name) for name in ("base", "gains", "torque_limit")}
        settings["notes"] = dict(self.notes)
        write_npz(path, settings=np.array(json.dumps(settings)), **self.columns())


def check_distinct(motions: Sequence[RecordedMotion]) -> None:
    """Raise InputError unless there are motions and each is another recording, as the same data twice halves variances.

    Two are the same if their targets and the channels that both measured agree to rounding; time may begin elsewhere.
    """
    if not motions:
        raise InputError("there must be at least one motion")
    for (i, one), (j, other) in itertools.combinations(enumerate(motions, 1), 2):
        both = one.columns()
        columns = other.columns()
        names = [name for name in both if name in columns and name != "time"]
        if len(names) > 1 and all(_agree(both[name], columns[name]) for name in names):
            raise InputError(f"motions {i} ({one.name}) and {j} ({other.name}) are the same recording: give it once")


def _agree(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two arrays have one shape and equal values, within 1e-6 [SI]; NaN equals NaN."""
    return one.shape == other.shape and np.allclose(one, other, rtol=0.0, atol=1.0e-6, equal_nan=True)


def load_motions(data: Sequence[Path], **settings: Any) -> list[RecordedMotion]:
    """Read recorded motions from files; a folder stands for all its npz and CSV files, sorted by name.

    settings: keyword arguments of `load_motion`. Raises InputError as `load_motion`, and if there is no file.
    """
    files: list[Path] = []
    for path in map(Path, data):
        files += sorted(file for file in path.iterdir() if file.suffix in READERS) if path.is_dir() else [path]
    if not files:
        raise InputError(f"no npz or csv file in {', '.join(map(str, data))}")
    return [load_motion(file, **settings) for file in files]


def load_motion(
    path: Path, *, base: str = "", gains: str = "", torque_limit: float = 0.0, torque_constant: float = 0.0
) -> RecordedMotion:
    """Read a recorded motion from an npz or CSV file.

    base, gains and torque_limit [N m] override the file's settings unless "" or 0. npz: arrays named as the fields of
    `RecordedMotion`, settings as JSON in `settings`. CSV: columns named `time`, `target/FL_lateral`,
    `position/x`, `quaternion/w` and so on, each with its unit in brackets if it is not the default: `angle/FL_outer
    [deg]`. Settings of a table are in a JSON file of the same name in its folder. torque_constant [N m/A]: torque at
    the joint per current, for tables with `current` instead of `torque`.

    Raises InputError: the file or a channel is missing, of another shape or unit, or not finite; the message names it.
    OSError: the file cannot be read.
    """
    path = existing_file(path, PURPOSE)
    if path.suffix not in READERS:
        raise InputError(f"{path}: expected a file of {', '.join(READERS)}")
    channels, settings = READERS[path.suffix](path)
    for name, value in (("base", base), ("gains", gains), ("torque_limit", torque_limit)):
        if value:
            settings[name] = value
    if "current" in channels:
        if not torque_constant > 0.0:
            raise InputError(f"{path}: current needs the torque constant of the joint [N m/A]")
        channels["torque"] = torque_constant * channels.pop("current")
    known = {f.name for f in fields(RecordedMotion)} - {"name", *channels}
    unknown = set(settings) - known
    if unknown:
        raise InputError(f"{path}: unknown setting {min(unknown)!r:.60}; expected one of {', '.join(sorted(known))}")
    try:
        return RecordedMotion(name=path.stem, **channels, **settings)
    except (InputError, TypeError) as error:
        raise InputError(f"{path}: {error}") from None


def read_motion(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read arrays by channel [SI] and settings by name from a motion's npz file. Raises InputError."""
    arrays = read_npz(path, PURPOSE)
    settings = parse_settings(path, str(arrays.pop("settings", "{}")))
    known = ("time", *PER_MOTOR, "current", "position", "quaternion")
    for name in arrays:
        if name not in known:
            raise InputError(f"{path}: unknown channel {name!r:.60}; expected one of {', '.join(known)}")
    for name in ("time", "target"):
        if name not in arrays:
            raise InputError(f"{path}: array {name} is missing")
    if any(values.dtype.kind not in "fiu" for values in arrays.values()):
        raise InputError(f"{path}: all arrays must hold numbers")
    return {name: values.astype(np.float64) for name, values in arrays.items()}, settings


def parse_settings(path: Path, text: str) -> dict[str, Any]:
    """Parse a motion's settings from a JSON text; path: file named in errors. Raises InputError: not a JSON object."""
    settings = parse_json(text, f"{path}: settings")
    if not isinstance(settings, dict):
        raise InputError(f"{path}: settings must be a JSON object")
    return settings


def csv_rows(path: Path, purpose: str = PURPOSE) -> list[list[str]]:
    """Return the cells of a CSV file as text, by row; purpose: for messages. Raises InputError: it is no CSV file."""
    try:
        text = read_file(path, purpose, MAX_CSV_BYTES).decode()
        rows = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: expected CSV text ({error})") from None
    if not text.endswith(("\n", "\r")):
        raise InputError(f"{path}: the last line has no end: add a newline if the file is complete")
    return rows


def read_csv(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read arrays by channel [SI] and settings by name from a motion's CSV file. Raises InputError or OSError."""
    rows = csv_rows(path)
    if len(rows) < 2:
        raise InputError(f"{path}: expected a line of names and rows of numbers")
    names = [name.strip() for name in rows[0]]
    columns = []
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(names):
            raise InputError(f"{path} line {number}: expected {len(names)} values, found {len(row)}")
        try:
            columns.append([cell_number(cell) for cell in row])
        except ValueError as error:
            raise InputError(f"{path} line {number}: {error}") from None
    return channels_of(path, names, np.array(columns)), sidecar_settings(path)


def cell_number(cell: str) -> float:
    """Return the number in a cell of a CSV file, NaN if it is empty. Raises ValueError: no number, such as 1_0."""
    try:
        return float(cell.replace("_", "x")) if cell.strip() else math.nan
    except ValueError:
        raise ValueError(f"expected numbers, found {cell!r:.40}") from None


def sidecar_settings(path: Path) -> dict[str, Any]:
    """Return the settings of a motion in the JSON file next to its table, `walk.json` for `walk.csv`.

    Empty if it does not exist. Raises InputError or OSError.
    """
    file = path.with_suffix(".json")
    if not os.path.lexists(file):
        return {}
    settings = read_json(file, "settings of a recorded motion")
    if not isinstance(settings, dict):
        raise InputError(f"{file}: settings must be a JSON object")
    return settings


def channels_of(path: Path, names: list[str], table: np.ndarray) -> dict[str, np.ndarray]:
    """Convert the columns of a recorded table to arrays by measured channel, in SI units.

    Arrays: (n,) for time, else (n, 3, 4 or 12); unmeasured columns are NaN. names: of the columns, such as
    `angle/FL_outer [deg]`. table: (n, columns). Raises InputError: an unknown name or unit, a column twice, or time or
    targets that are missing.
    """
    parts = {
        "time": [""], "position": list("xyz"), "quaternion": list("xyzw"),
        **{channel: list(MOTOR_JOINTS) for channel in (*PER_MOTOR, "current")},
    }  # fmt: skip
    channels: dict[str, np.ndarray] = {}
    for i, name in enumerate(names):
        match = re.fullmatch(r"(\w+)(?:/(\w+))?\s*(?:\[([^\]]*)\])?", name)
        channel, part, unit = match.groups() if match else ("", None, None)
        if channel not in parts or (part or "") not in parts[channel]:
            raise InputError(f"{path}: unknown column {name!r:.60}; expected names {EXAMPLE}")
        factors = UNITS[channel]
        unit = next(iter(factors)) if unit is None else unit
        if unit not in factors:
            raise InputError(f"{path}: column {name!r:.60}: expected a unit of {', '.join(factors)}")
        values = channels.setdefault(channel, np.full((len(table), len(parts[channel])), math.nan))
        at = parts[channel].index(part or "")
        if not np.isnan(values[:, at]).all():
            raise InputError(f"{path}: column {channel}/{part} occurs twice")
        values[:, at] = factors[unit] * table[:, i]
    for name in ("time", "target"):
        if name not in channels:
            raise InputError(f"{path}: column {name} is missing; expected names {EXAMPLE}")
    for i, joint in enumerate(MOTOR_JOINTS):
        if np.isnan(channels["target"][:, i]).any():
            raise InputError(f"{path}: column target/{joint} is missing or has gaps")
    channels["time"] = channels["time"][:, 0]
    return channels


READERS = {".npz": read_motion, ".csv": read_csv}
"""Reader by suffix of the file: returns channels and settings of a path."""
