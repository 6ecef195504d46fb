"""Reading of the robot description: a URDF of the tree, and a JSON file of loops, motors and poses.

Angles of the legs: lateral positive swings the paw outward; outer and inner thigh positive move the thigh tip away
from its twin. Quaternions are xyzw.
"""

from __future__ import annotations

import functools
import json
import math
from types import MappingProxyType
from typing import Any

import numpy as np

from jumper_warp.robot.legs import knee_angles, leg_dimensions
from jumper_warp.robot.parts import LEGS, MOTOR_JOINTS, Gains, Loop, Motor, RobotDescription, make_read_only
from jumper_warp.robot.urdf import UrdfReader
from jumper_warp.utils.assets import ASSETS

__all__ = ["LEGS", "MOTOR_JOINTS", "RobotDescription", "knee_angles", "leg_dimensions", "load_description"]

FOLDER = ASSETS / "jumper"  # Folder of the description
RAD_PER_S_PER_RPM = 2.0 * math.pi / 60.0


@functools.cache
def load_description() -> RobotDescription:
    """Read the project's robot description: a JSON file and the URDF that it names.

    Each is read once. Their values are not checked here; tests check the project's files.
    """
    table = json.loads((FOLDER / "jumper.json").read_text(encoding="utf-8"))
    urdf = UrdfReader(FOLDER / table["urdf"])
    types = {name: motor_type(name, constants) for name, constants in table["motor_types"].items()}
    loops = (
        Loop(
            f"{leg}_ankle", loop["parent"], loop["child"], np.array(loop["parent_anchor"], dtype=float),
            np.array(loop["child_anchor"], dtype=float),
        )
        for leg in LEGS
        for loop in [table["loops"][f"{leg}_ankle"]]
    )  # fmt: skip
    lower, upper = table["transversal_sum_deg"]
    poses = {
        name: (math.radians(pose["lateral_deg"]), math.radians(pose["transversal_deg"]))
        for name, pose in table["poses"].items()
    }
    description = RobotDescription(
        urdf=urdf.text,
        links=urdf.links(),
        joints=urdf.joints(),
        loops=tuple(loops),
        motors=tuple(types[table["motors"][joint]] for joint in MOTOR_JOINTS),
        knee_damping=table["knee_damping"],
        knee_damping_limit=table["knee_damping_limit"],
        transversal_sum=(math.radians(lower), math.radians(upper)),
        poses=MappingProxyType(poses),
    )
    make_read_only(description)
    return description


def motor_type(name: str, table: dict[str, Any]) -> Motor:
    """Return the constants of a motor type; table: its JSON object, whose speeds are in rpm."""
    return Motor(
        type=name,
        gear_ratio=float(table["gear_ratio"]),
        rotor_inertia=table["rotor_inertia"],
        peak_torque=table["peak_torque"],
        cutoff_speed=RAD_PER_S_PER_RPM * table["cutoff_speed_rpm"],
        no_load_speed=RAD_PER_S_PER_RPM * table["no_load_speed_rpm"],
        coulomb_friction=table["coulomb_friction"],
        jumping=Gains(**table["gains"]["jumping"]),
        walking=Gains(**table["gains"]["walking"]),
    )
