"""Robot overlays: JSON files with values that replace those of the description, and randomisation ranges.

An identification writes one for each real robot, which differs a little from its description.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.robot import bounds
from jumper_warp.robot.bounds import Range
from jumper_warp.robot.description import RobotDescription
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.arrays import real_array
from jumper_warp.utils.checks import check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import read_json, write_atomically

SCHEMA = "jumper-warp robot overlay 1"
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
SECTIONS = ("schema", "source", "values", "randomization")
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
    """By field of `RobotValues`, its values for one robot, in its unit."""
    randomization: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """By field of `RandomizationCfg`, (lower, upper) in the field's unit and meaning: factor, offset or value."""
    source: str = ""
    """Origin of the values, free text."""

    def __post_init__(self) -> None:
        """Raise InputError for an unknown quantity or range, a wrong number of values, or a value out of range."""
        check_types("robot overlay", self)
        for name in ("values", "randomization"):  # arrays become tuples, which JSON can hold
            pairs = {key: tuple(np.asarray(row).tolist()) if np.ndim(row) == 1 else row
                     for key, row in getattr(self, name).items()}  # fmt: skip
            object.__setattr__(self, name, pairs)
        check_names("quantity", self.values, RANGES)
        check_names("range of randomisation", self.randomization, RANDOMIZED)
        nominal = vars(RobotValues.nominal(1))
        for name, values in self.values.items():
            shape = real_array(values, f"robot overlay: {name}").shape
            if shape != nominal[name].shape[1:]:
                raise InputError(f"robot overlay: {name} needs {nominal[name].shape[1]} values, got shape {shape}")
            check_range(name, values, RANGES[name])
        for name, pair in self.randomization.items():
            if real_array(pair, f"robot overlay: randomization {name}").shape != (2,) or not pair[0] <= pair[1]:
                raise InputError(f"robot overlay: randomization {name!r:.60} must be [lower, upper], got {pair}")
            check_range(f"randomization {name}", pair, RANDOMIZED[name])
        robot = self.robots()
        if not (robot.cutoff_speed < robot.no_load_speed).all():
            raise InputError("robot overlay: each cutoff_speed must be below the no_load_speed")

    def robots(self, description: RobotDescription | None = None) -> RobotValues:
        """Return the complete values of the overlay's one robot; values that it lacks come from the description."""
        robot = RobotValues.nominal(1, description)
        for name, values in self.values.items():
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
        sections = {}
        for section in ("values", "randomization"):
            table = saved.get(section, {})
            if not isinstance(table, dict):
                raise InputError(f"robot overlay: {section} must be an object")
            sections[section] = {name: finite_tuple(f"{section} {name}", values) for name, values in table.items()}
        return cls(**sections, source=str(saved.get("source", "")))

    def save(self, path: Path) -> None:
        """Write the overlay as a JSON file. Raises OSError."""
        write_atomically(path, (json.dumps(self.to_json(), indent=2, allow_nan=False) + "\n").encode())


def check_names(noun: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raise InputError for a name that is not among the known ones; noun: kind of name, for the message."""
    for name in names:
        if name not in known:
            raise InputError(f"robot overlay: unknown {noun} {name!r:.60}; expected one of {', '.join(known)}")


def check_range(name: str, values: tuple[float, ...], allowed: Range) -> None:
    """Raise InputError for a value outside the range `allowed`; name: of the quantity, for the message."""
    low, high, unit = allowed
    hint = " (1: as described)" if allowed is RATIO else ""
    for value in values:
        if not low <= value <= high:
            limits = f"{low:g} to {high:g}{unit and ' '}{unit}{hint}"
            raise InputError(f"robot overlay: {name} must be in {limits}, got {value:.6g}")


def finite_tuple(name: str, values: Any) -> tuple[float, ...]:
    """Convert a list of finite numbers to a tuple. Raises InputError for anything else; name: for the message."""
    if not isinstance(values, list) or any(isinstance(x, bool) or not isinstance(x, int | float) for x in values):
        raise InputError(f"robot overlay: {name!r:.60} must be a list of numbers")
    if not all(math.isfinite(x) for x in values):
        raise InputError(f"robot overlay: {name!r:.60} must be finite")
    return tuple(float(x) for x in values)


def with_springs(stiffness: float, length: float) -> RobotOverlay:
    """Return an overlay with springs of a stiffness [N/m] and rest length [m] between the two knees of each leg.

    Raises InputError: one of them is out of range.
    """
    return RobotOverlay({"spring_stiffness": (float(stiffness),), "spring_length": (float(length),)}, source="springs")


def load_overlay(path: Path) -> RobotOverlay:
    """Read a robot overlay from a JSON file.

    Raises InputError: it cannot be read, or is no overlay.
    """
    content = read_json(path, "robot overlay, as jumper sysid fit writes it")
    try:
        return RobotOverlay.from_json(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def overlay_of(values: RobotValues, quantities: tuple[str, ...], **fields: Any) -> RobotOverlay:
    """Return an overlay with the named quantities of the first robot in `values`; fields: others of `RobotOverlay`."""
    selected = {name: tuple(float(x) for x in np.asarray(getattr(values, name))[0]) for name in quantities}
    return RobotOverlay(selected, **fields)
