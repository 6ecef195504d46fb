"""Export of the robot to files for other simulators: MJCF, USD, or URDF with a YAML file of the closed loops."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.mjcf import mjcf
from jumper_warp.robot.model import standing_configuration
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.robot.parts import mesh_files
from jumper_warp.robot.urdf_writer import loop_closures, urdf
from jumper_warp.robot.usd import write_usd
from jumper_warp.robot.values import RobotValues, described
from jumper_warp.utils.checks import check_type
from jumper_warp.utils.files import write_atomically

RobotFormat = Literal["mjcf", "urdf", "usd"]
LOST = {
    "mjcf": ("offset", "latency", "no_load_speed", "cutoff_speed"),
    "urdf": ("offset", "latency", "cutoff_speed", "kp", "kd", "armature", "motor_friction", "knee_damping",
             "paw_friction", "spring_stiffness", "spring_length"),
    "usd": ("offset", "latency", "cutoff_speed", "spring_stiffness", "spring_length"),
    "robot.json": ("offset", "latency", "saturation", "paw_friction"),
}  # fmt: skip
"""Quantities of an overlay that a format has no place for, by format of `export_robot`, and of a robot's folder."""


def export_robot(
    kind: RobotFormat, folder: Path, overlay: RobotOverlay | None = None, description: RobotDescription | None = None
) -> Path:
    """Export the robot as MJCF, URDF or USD, with the files that belong to it, and return the main file's path.

    Existing files are replaced. overlay: values that replace those of the description, by default the project's.
    Raises InputError: another format, USD without the package `usd-core`; OSError: the folder cannot be written.
    """
    check_type("kind", kind, RobotFormat)
    folder = Path(folder)
    if description is None:
        description = load_description() if overlay is None else overlay.description
    values = RobotValues.nominal(1, description) if overlay is None else overlay.robots(description)
    robot = described(values, description)
    if kind == "usd":
        return write_usd(folder / "jumper.usda", robot, float(values.paw_friction[0, 0]))
    meshes = folder / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    for file in mesh_files(robot):
        write_atomically(meshes / file.name, file.read_bytes())
    if kind == "mjcf":
        path = folder / "jumper.xml"
        text = mjcf(description, values)
    else:
        path = folder / "jumper.urdf"
        text = description.urdf if overlay is None and description.table is None else urdf(robot)
        write_atomically(folder / "loop_closures.yaml", loop_closures(robot, standing_angles(robot)).encode())
    write_atomically(path, text.encode())
    return path


def standing_angles(robot: RobotDescription) -> dict[str, float]:
    """Return the angle [rad] of each joint in the standing default pose, by name."""
    angles = standing_configuration(robot)[7 : 7 + len(robot.joints)]
    return {joint.name: float(angle) for joint, angle in zip(robot.joints, angles, strict=True)}
