"""Reading of the robot description: a URDF of the tree, and a JSON file of loops, motors and poses.

Angles of the legs: lateral positive swings the paw outward; outer and inner thigh positive move the thigh tip away
from its twin. Quaternions are xyzw.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from jumper_warp.robot.checks import check_description, knee_angles, leg_dimensions
from jumper_warp.robot.parts import (
    LEGS,
    MOTOR_JOINTS,
    Gains,
    Loop,
    Motor,
    RobotDescription,
    RobotDescriptionError,
    description_error,
    make_read_only,
    require,
)
from jumper_warp.robot.urdf import UrdfReader, file_inside, read_text
from jumper_warp.utils.assets import ASSETS
from jumper_warp.utils.files import parse_json

__all__ = [
    "DEFAULT_DESCRIPTION", "LEGS", "MOTOR_JOINTS", "RobotDescription", "RobotDescriptionError", "knee_angles",
    "leg_dimensions", "load_description",
]  # fmt: skip

DEFAULT_DESCRIPTION = ASSETS / "jumper" / "jumper.json"

RAD_PER_S_PER_RPM = 2.0 * math.pi / 60.0


def load_description(path: Path | None = None) -> RobotDescription:
    """Read and check a robot description, by default the project's own, which is read once and cached.

    Raises RobotDescriptionError for anything missing, malformed or implausible.
    """
    return _cached_description(DEFAULT_DESCRIPTION) if path is None else _read_description(Path(path))


def _read_description(path: Path) -> RobotDescription:
    """Read and check a robot description: a JSON file and the URDF that it names."""
    reader = JsonReader(path)
    urdf_file = file_inside(path, reader.get(reader.root, "urdf", "", str), "urdf")
    urdf_text = read_text(urdf_file)
    urdf = UrdfReader(urdf_file, urdf_text)
    description = RobotDescription(
        path=path,
        urdf_path=urdf_file,
        urdf=urdf_text,
        links=urdf.links(),
        joints=urdf.joints(),
        loops=reader.loops(),
        motors=reader.motors(),
        knee_damping=reader.positive(reader.root, "knee_damping", ""),
        knee_damping_limit=reader.positive(reader.root, "knee_damping_limit", ""),
        transversal_sum=reader.range_deg("transversal_sum_deg"),
        poses=MappingProxyType(reader.poses()),
    )
    make_read_only(description)
    return check_description(description)


_cached_description = functools.cache(_read_description)


class JsonReader:
    """Reader of a robot description's JSON file. Every method raises RobotDescriptionError on bad input.

    Parameters: table, a JSON object; key, its entry; part, the place that an error message names ("" for the root).
    """

    def __init__(self, file: Path):
        self.file = file
        self.root = parse_json(read_text(file), str(file), description_error)
        self.require(isinstance(self.root, dict), "", "expected a JSON object")

    def require(self, holds: bool, part: str, problem: str) -> None:
        """Raise RobotDescriptionError, which names this file, unless `holds`; problem: text of the message."""
        require(holds, self.file, part, problem)

    def get(self, table: dict, key: str, part: str, kind: type) -> Any:
        """Return an entry of a JSON object; refuse one that is missing or not of the Python type `kind`."""
        value = table.get(key)
        found = "nothing" if value is None else type(value).__name__
        self.require(isinstance(value, kind), part, f"expected {key} to be a {kind.__name__}, found {found}")
        return value

    def number(self, value: Any, key: str, part: str) -> float:
        """Return a JSON value as a float; refuse anything but a number below 1e9 in magnitude."""
        finite = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1.0e9
        self.require(finite, part, f"expected {key} to be a finite number, found {value!r:.60}")
        return float(value)

    def positive(self, table: dict, key: str, part: str) -> float:
        """Return an entry of a JSON object that must be a finite number above 0, in the unit of the file."""
        number = self.number(table.get(key), key, part)
        self.require(number > 0.0, part, f"expected {key} > 0, found {number}")
        return number

    def vector(self, table: dict, key: str, count: int, part: str) -> list[float]:
        """Return an entry of a JSON object that must be a list of `count` finite numbers."""
        values = self.get(table, key, part, list)
        self.require(len(values) == count, part, f"expected {count} numbers in {key}, found {len(values)}")
        return [self.number(value, key, part) for value in values]

    def range_deg(self, key: str) -> tuple[float, float]:
        """Return an angle range of the description in radians, from the entry `key` [lower, upper] in degrees."""
        lower, upper = self.vector(self.root, key, 2, "")
        self.require(lower < upper, key, f"expected lower < upper, found {lower} and {upper}")
        return math.radians(lower), math.radians(upper)

    def motors(self) -> tuple[Motor, ...]:
        """Return the robot's 12 motors from the JSON file, in motor order."""
        types = {
            name: self.motor_type(name, self.get(self.root["motor_types"], name, "motor_types", dict))
            for name in self.get(self.root, "motor_types", "", dict)
        }
        table = self.table_of("motor", MOTOR_JOINTS)
        motors = []
        for joint in MOTOR_JOINTS:
            name = self.get(table, joint, "motors", str)
            self.require(name in types, f"motor {joint}", f"unknown motor type {name!r:.60}")
            motors.append(types[name])
        return tuple(motors)

    def table_of(self, noun: str, names: Sequence[str]) -> dict:
        """Return the JSON object that lists motors or loops by name; refuse names that are not in `names`.

        noun: "motor" or "loop".
        """
        table = self.get(self.root, f"{noun}s", "", dict)
        for name in table:
            self.require(name in names, f"{noun} {name}", f"expected one of {', '.join(names)}")
        return table

    def motor_type(self, name: str, table: dict) -> Motor:
        """Read the constants of a motor type from its JSON object, whose speeds are in rpm."""
        part = f"motor type {name}"
        gains = self.get(table, "gains", part, dict)
        motor = Motor(
            type=name,
            gear_ratio=self.positive(table, "gear_ratio", part),
            rotor_inertia=self.positive(table, "rotor_inertia", part),
            peak_torque=self.positive(table, "peak_torque", part),
            cutoff_speed=RAD_PER_S_PER_RPM * self.positive(table, "cutoff_speed_rpm", part),
            no_load_speed=RAD_PER_S_PER_RPM * self.positive(table, "no_load_speed_rpm", part),
            coulomb_friction=self.positive(table, "coulomb_friction", part),
            jumping=self.gains(gains, "jumping", part),
            walking=self.gains(gains, "walking", part),
        )
        slower = motor.cutoff_speed < motor.no_load_speed
        self.require(slower, part, "expected cutoff_speed_rpm < no_load_speed_rpm")
        return motor

    def gains(self, table: dict, use: str, part: str) -> Gains:
        """Read a motor's position gains kp [N m/rad] and kd [N m s/rad] for a use, "jumping" or "walking"."""
        gains = self.get(table, use, part, dict)
        return Gains(self.positive(gains, "kp", f"{part} {use}"), self.positive(gains, "kd", f"{part} {use}"))

    def loops(self) -> tuple[Loop, ...]:
        """Return the four loops that close the legs at the ankles, in leg order, anchors (3,) [m]."""
        names = [f"{leg}_ankle" for leg in LEGS]
        table = self.table_of("loop", names)
        loops = []
        for name in names:
            loop = self.get(table, name, "loops", dict)
            anchors = (np.array(self.vector(loop, f"{side}_anchor", 3, f"loop {name}")) for side in ("parent", "child"))
            parent, child = (self.get(loop, side, f"loop {name}", str) for side in ("parent", "child"))
            loops.append(Loop(name, parent, child, *anchors))
        return tuple(loops)

    def poses(self) -> dict[str, tuple[float, float]]:
        """Return the standing poses by name, each (lateral, transversal) angle [rad] of every leg."""
        poses = {}
        for name in self.get(self.root, "poses", "", dict):
            pose = self.get(self.root["poses"], name, "poses", dict)
            degrees = (self.number(pose.get(key), key, f"pose {name}") for key in ("lateral_deg", "transversal_deg"))
            poses[name] = tuple(map(math.radians, degrees))
        return poses
