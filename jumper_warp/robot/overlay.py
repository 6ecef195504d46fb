"""Robot overlays: JSON files with values that replace those of the description, and randomisation ranges.

An identification writes one for each real robot, which differs a little from its description.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.robot import bounds
from jumper_warp.robot.bounds import Range
from jumper_warp.robot.description import LEGS, RobotDescription, load_description
from jumper_warp.robot.folder import FILE, read_robot, robot_of, stretch, table_of
from jumper_warp.robot.folder import SCHEMA as ROBOT_SCHEMA
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.assets import ASSETS
from jumper_warp.utils.checks import check_type, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, read_json, write_atomically

SCHEMA = "jumper-warp robot overlay 1"
ROBOTS = ASSETS / "robots"  # Folder of the project's robots beside the Jumper, found by their names
RATIO = Range(0.05, 3.0, "times the described value")
RANGES = {
    "base_mass": bounds.LINK_MASS,
    "base_com": bounds.PLACE,
    "base_inertia": RATIO,
    "link_mass": RATIO,
    "armature": bounds.ARMATURE,
    "motor_friction": bounds.MOTOR_FRICTION,
    "kp": RATIO,
    "kd": RATIO,
    "saturation": RATIO,
    "peak": RATIO,
    "no_load_speed": bounds.MOTOR_SPEED,
    "cutoff_speed": bounds.MOTOR_SPEED,
    "offset": Range(-0.5, 0.5, "rad"),
    "knee_damping": bounds.KNEE_DAMPING,
    "paw_friction": Range(0.0, 10.0, ""),
    "latency": Range(0.0, 0.1, "s"),
    "spring_stiffness": bounds.SPRING_STIFFNESS,
    "spring_length": bounds.SPRING_LENGTH,
}
"""Allowed values by field of `RobotValues`."""
LENGTHS = {"thigh_length": ("thigh",), "shank_length": ("outer_shank", "inner_shank")}
"""Quantities of a robot table by length [m] of an overlay, which has one value for all legs, or front and back."""
SECTIONS = ("schema", "source", "robot", "values", "randomization")
RANDOMIZED = {
    "static_friction": RANGES["paw_friction"],
    "dynamic_friction": RANGES["paw_friction"],
    "base_mass": Range(-bounds.LINK_MASS.high, bounds.LINK_MASS.high, "kg"),
    "link_mass": Range(0.0, 10.0, ""),
    "com_shift": bounds.PLACE,
    "gains": Range(0.0, 10.0, ""),
    "damping_gains": Range(0.0, 10.0, ""),
    "no_load_speed": Range(0.0, 10.0, ""),
    "cutoff_speed": Range(0.0, 10.0, ""),
    "motor_friction": bounds.MOTOR_FRICTION,
    "armature": Range(0.0, 10.0, ""),
    "joint_offset": Range(-30.0, 30.0, "deg"),
    "latency": Range(0.0, 100.0, "ms"),
    "observation_latency": Range(0.0, 100.0, "ms"),
    "push_force": Range(-1.0e4, 1.0e4, "N"),
    "push_torque": Range(-1.0e3, 1.0e3, "N m"),
    "push_interval": Range(0.0, 1.0e3, "s"),
}
"""Allowed ends of the ranges that `RobotOverlay.randomization` may have: those of `RandomizationCfg`."""


@dataclass(frozen=True, eq=False)
class RobotOverlay:
    """Values of one robot that replace those of the description, and randomisation ranges around them."""

    values: Mapping[str, tuple[float, ...]]
    """By field of `RobotValues`, its values for one robot, in its unit, and lengths by name in `LENGTHS`."""
    randomization: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """By field of `RandomizationCfg`, (lower, upper) in the field's unit and meaning: factor, offset or value."""
    source: str = ""
    """Origin of the values, free text."""
    robot: Json | None = None
    """Table of the robot that the values differ from, as in the `robot.json` of its folder; None: the Jumper."""

    def __post_init__(self) -> None:
        """Raise InputError for an unknown quantity or range, a wrong number of values, or a value out of range."""
        for name in ("values", "randomization"):  # arrays become tuples, which JSON can hold
            check_type(f"robot overlay: {name}", getattr(self, name), Mapping)
            rows = getattr(self, name)
            arrays = {key: real_array(row, f"robot overlay: {key}", float) for key, row in rows.items()}
            pairs = {key: tuple(array.tolist()) if array.ndim == 1 else rows[key] for key, array in arrays.items()}
            object.__setattr__(self, name, pairs)
        check_types("robot overlay", self)
        check_names("quantity", self.values, (*RANGES, *LENGTHS))
        check_names("range of randomisation", self.randomization, RANDOMIZED)
        for name in LENGTHS:
            values = real_array(self.values.get(name, (0.1,)), f"robot overlay: {name}", float)
            if values.shape not in ((1,), (2,)) or not ((values >= 0.01) & (values <= 1.0)).all():
                raise InputError(f"robot overlay: {name} must be one or two lengths in 0.01 to 1 m, got {values}")
        nominal = vars(RobotValues.nominal(1, self.description))
        for name, values in self.values.items():
            if name in LENGTHS:
                continue
            shape = real_array(values, f"robot overlay: {name}").shape
            if shape != nominal[name].shape[1:]:
                raise InputError(f"robot overlay: {name} needs {nominal[name].shape[1]} values, got shape {shape}")
            # as described: a locked axis has a large armature
            check_range(name, [x for x, own in zip(values, nominal[name][0], strict=True) if x != own], RANGES[name])
        for name, pair in self.randomization.items():
            if real_array(pair, f"robot overlay: randomization {name}").shape != (2,) or not pair[0] <= pair[1]:
                raise InputError(f"robot overlay: randomization {name!r:.60} must be [lower, upper], got {pair}")
            check_range(f"randomization {name}", pair, RANDOMIZED[name])
        robot = self.robots()
        if not (robot.cutoff_speed < robot.no_load_speed).all():
            raise InputError("robot overlay: each cutoff_speed must be below the no_load_speed")

    @functools.cached_property
    def description(self) -> RobotDescription:
        """Description of the robot with the overlay's lengths; its other values are those of `robots`.

        A link of another length keeps its mass; its centre of mass and its inertia grow with the length.
        """
        lengths = {name: self.values[name] for name in LENGTHS if name in self.values}
        described = load_description() if self.robot is None else robot_of(self.robot)
        if not lengths:
            return described
        table = dict(table_of(described, "Jumper") if self.robot is None else self.robot)
        for name, values in lengths.items():
            for section in sorted(table.keys() & {"front", "back", *LEGS}):  # single legs before their end
                end, value = ("back", values[-1]) if section[0] in "Bb" else ("front", values[0])
                table[section] = {**table[end], **table[section]}
                for quantity in LENGTHS[name]:
                    stretch(table[section], quantity, value)
        return robot_of({**table, "name": f"{table['name']} with other lengths"})

    @property
    def is_jumper(self) -> bool:
        """Whether the robot has the Jumper's lengths, so that tasks have the Jumper's numbers."""
        return self.robot is None and not any(name in self.values for name in LENGTHS)

    def robots(self, description: RobotDescription | None = None) -> RobotValues:
        """Return the complete values of the overlay's one robot; values that it lacks come from the description."""
        robot = RobotValues.nominal(1, self.description if description is None else description)
        for name, values in self.values.items():
            if name not in LENGTHS:
                getattr(robot, name)[0] = values
        return robot

    @property
    def latency(self) -> float | None:
        """Delay from a commanded target to its effect on the motor [s]; None if the overlay has no latency."""
        return self.values["latency"][0] if "latency" in self.values else None

    def to_json(self) -> dict[str, Any]:
        """Return the overlay as JSON data, a dict with the keys `SECTIONS`."""
        return {
            "schema": SCHEMA,
            "source": self.source,
            **({} if self.robot is None else {"robot": self.robot}),
            "values": {name: list(values) for name, values in self.values.items()},
            "randomization": {name: list(pair) for name, pair in self.randomization.items()},
        }

    @classmethod
    def from_json(cls, saved: Any) -> RobotOverlay:
        """Read an overlay from the content of its JSON file, written by `to_json`.

        Raises InputError for anything else.
        """
        if not isinstance(saved, dict) or saved.get("schema") != SCHEMA:
            raise InputError(f"not a robot overlay: expected an object with schema {SCHEMA!r}")
        check_names("section", saved, SECTIONS)
        tables = {section: saved.get(section, {}) for section in ("values", "randomization")}
        return cls(**tables, source=str(saved.get("source", "")), robot=saved.get("robot"))

    def save(self, path: Path) -> None:
        """Write the overlay as a JSON file. Raises OSError."""
        write_atomically(path, (json.dumps(self.to_json(), indent=2, allow_nan=False) + "\n").encode())


def check_names(noun: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raise InputError for a name that is not among the known ones; noun: kind of name, for the message."""
    for name in names:
        if name not in known:
            raise InputError(f"robot overlay: unknown {noun} {name!r:.60}; expected one of {', '.join(known)}")


def check_range(name: str, values: Sequence[float], allowed: Range) -> None:
    """Raise InputError for a value outside the range `allowed`; name: of the quantity, for the message."""
    low, high, unit = allowed
    hint = " (1: as described)" if allowed is RATIO else ""
    for value in values:
        if not low <= value <= high:
            limits = f"{low:g} to {high:g}{unit and ' '}{unit}{hint}"
            raise InputError(f"robot overlay: {name} must be in {limits}, got {value:.6g}")


def robots_of(robot: RobotOverlay | Sequence[RobotOverlay] | None) -> list[RobotOverlay]:
    """Return the robots of an argument `robot`, which worlds take in turn. Raises InputError: of another type."""
    check_type("robot (see load_overlay)", robot, RobotOverlay | Sequence[RobotOverlay] | None)
    if robot is None:
        return []
    return [robot] if isinstance(robot, RobotOverlay) else list(robot)


def load_overlay(path: Path | None) -> RobotOverlay:
    """Read a robot: its folder or `robot.json`, an overlay, or an overlay whose `robot` is the folder beside it.

    None: the Jumper. Raises InputError: it cannot be read, or is neither.
    """
    if path is None:
        return RobotOverlay({})
    if not Path(path).exists() and (ROBOTS / path / FILE).is_file():
        path = ROBOTS / path
    if Path(path).is_dir():
        return RobotOverlay({}, robot=read_robot(Path(path)))
    content = read_json(path, "robot overlay, as jumper sysid fit writes it")
    if isinstance(content, dict) and content.get("schema") == ROBOT_SCHEMA:
        return RobotOverlay({}, robot=read_robot(Path(path)))
    try:
        if isinstance(content, dict) and isinstance(content.get("robot"), str):
            content["robot"] = read_robot(Path(path).parent / content["robot"])
        return RobotOverlay.from_json(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def overlay_of(values: RobotValues, quantities: tuple[str, ...], **fields: Any) -> RobotOverlay:
    """Return an overlay with the named quantities of the first robot in `values`; fields: others of `RobotOverlay`."""
    selected = {name: tuple(float(x) for x in np.asarray(getattr(values, name))[0]) for name in quantities}
    return RobotOverlay(selected, **fields)
