"""Range checks of a robot description's values, to detect wrong units; robots may be large enough to carry a person."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jumper_warp.robot.parts import Joint, Link, Motor, RobotDescription, RobotDescriptionError, Shape


class Range(NamedTuple):
    """Closed interval [low, high] of values that are plausible for a quantity."""

    low: float  # in the unit
    high: float  # in the unit
    unit: str  # for messages; "" if dimensionless


LINK_MASS = Range(1.0e-3, 100.0, "kg")  # From a bracket to the trunk of a robot that carries a person
PLACE = Range(-2.0, 2.0, "m")  # Coordinate of a point in its link's frame; no leg is longer
LENGTH = Range(1.0e-3, 2.0, "m")
"""Thighs, shanks, distances of axes; below a millimetre the closed form of the leg loses precision."""
PAW_RADIUS = Range(1.0e-3, 0.2, "m")
SHAPE_SIZE = Range(1.0e-4, 2.0, "m")  # From the thickness of a decal to the length of a trunk
SMALLEST_GYRATION = Range(1.0e-3, 2.0, "m")
"""Radius of gyration of the smallest moment of inertia: a steel wire of 4 mm has 1 mm."""
GYRATION_OF_REACH = Range(0.1, 1.5, "of the link's reach")
"""Radius of gyration of the largest moment over the farthest distance of the link's joints and shapes from its centre
of mass: 1 with all mass at the rim, 0.6 for a rod; more room for links whose shapes are left out."""
STOP = Range(-2.0 * math.pi, 2.0 * math.pi, "rad")  # Hinges of a leg turn at most once
JOINT_EFFORT = Range(0.1, 1.0e4, "N m")  # Any joint, also the passive ones, whose limit is only nominal
JOINT_SPEED = Range(0.1, 1.0e4, "rad/s")
PEAK_TORQUE = Range(0.1, 1.0e3, "N m")
MOTOR_SPEED = Range(0.1, 1.0e3, "rad/s")  # At the output of the gear; 1000 rad/s are 9500 rpm
GEAR_RATIO = Range(1.0, 1.0e3, "")
ROTOR_INERTIA = Range(1.0e-8, 1.0e-2, "kg m^2")  # From a rotor of a gram and 3 mm radius to one of 2 kg and 0.1 m
ARMATURE = Range(1.0e-6, 1.0, "kg m^2")  # At the gear's output; 1 kg m^2 is ten times the inertia of a stretched leg
MOTOR_FRICTION = Range(0.0, 10.0, "N m")
PROPORTIONAL_GAIN = Range(0.1, 1.0e4, "N m/rad")
"""Lower gains are too weak to move a leg; higher gains are nearly as stiff as the hard stops."""
DERIVATIVE_GAIN = Range(1.0e-2, 1.0e2, "N m s/rad")
KNEE_DAMPING = Range(1.0e-6, 10.0, "N m s/rad")
KNEE_DAMPING_LIMIT = Range(1.0e-3, 1.0e3, "N m")
SPRING_STIFFNESS = Range(0.0, 1.0e4, "N/m")
"""Upper end: ten times the authors' springs; they swing at a third of the highest stable frequency at 1/480 s."""
SPRING_LENGTH = Range(0.0, 1.0, "m")
COLOR = Range(0.0, 1.0, "")


class RangeCheck(NamedTuple):
    """A value of a robot description to check, with its name and its range of plausible values."""

    name: str  # for messages
    value: float  # in the range's unit
    range: Range


def check_bounds(description: RobotDescription) -> None:
    """Raise RobotDescriptionError for a value outside its plausible range; tree and legs need not be valid yet."""
    # by link name: origins of its frame and joints, and loop anchors on it, each (3,) [m], link frame
    anchors: dict[str, list[np.ndarray]] = {link.name: [np.zeros(3)] for link in description.links}
    for joint in description.joints:
        anchors.get(joint.parent, []).append(joint.origin)
        refuse_outside(description.urdf_path, f"joint {joint.name}", joint_checks(joint))
    for loop in description.loops:
        for link, anchor in ((loop.parent, loop.parent_anchor), (loop.child, loop.child_anchor)):
            anchors.get(link, []).append(anchor)
            refuse_outside(description.path, f"loop {loop.name}", point_checks(f"anchor on {link}", anchor))
    for link in description.links:
        refuse_outside(description.urdf_path, f"link {link.name}", link_checks(link, anchors[link.name]))
    for motor in dict.fromkeys(description.motors):
        refuse_outside(description.path, f"motor type {motor.type}", motor_checks(motor))
    refuse_outside(description.path, "", common_checks(description))


def refuse_outside(file: Path, part: str, checks: Iterable[RangeCheck]) -> None:
    """Raise RobotDescriptionError, which names file and part, for the first value that is NaN or outside its range."""
    for name, value, (low, high, unit) in checks:
        if not low <= value <= high:
            problem = f"{name} must be between {low:.4g} and {high:.4g}{unit and ' '}{unit}, got {value:.6g}"
            raise RobotDescriptionError(file, part, problem)


def point_checks(name: str, point: np.ndarray) -> Iterator[RangeCheck]:
    """Return the range checks of the coordinates of a point (3,) [m] in its link's frame; name: of the point."""
    return (RangeCheck(f"{axis} of {name}", float(value), PLACE) for axis, value in zip("xyz", point, strict=True))


def joint_checks(joint: Joint) -> Iterator[RangeCheck]:
    """Yield the range checks of a joint's origin [m], stops [rad], effort [N m] and speed [rad/s]."""
    yield from point_checks("origin", joint.origin)
    yield RangeCheck("lower", joint.lower, STOP)
    yield RangeCheck("upper", joint.upper, STOP)
    yield RangeCheck("effort", joint.effort, JOINT_EFFORT)
    yield RangeCheck("velocity", joint.velocity, JOINT_SPEED)


def link_checks(link: Link, anchors: list[np.ndarray]) -> Iterator[RangeCheck]:
    """Yield the range checks of a link's mass, shapes, size and inertia.

    anchors: points (3,) [m], link frame, at which joints and loops attach to the link.
    """
    yield RangeCheck("mass", link.mass, LINK_MASS)
    yield from point_checks("centre of mass", link.com)
    for shape in (*link.visuals, *link.collisions):
        yield from shape_checks(shape)
    smallest, _, largest = np.sqrt(np.linalg.eigvalsh(link.inertia) / link.mass)
    corners = [corner for shape in (*link.visuals, *link.collisions) for corner in shape_corners(shape)]
    reach = np.linalg.norm(np.array([*anchors, *corners]) - link.com, axis=1).max()
    yield RangeCheck("reach", float(reach), LENGTH)
    yield RangeCheck("smallest radius of gyration", float(smallest), SMALLEST_GYRATION)
    yield RangeCheck("largest radius of gyration", float(largest / reach), GYRATION_OF_REACH)


def shape_checks(shape: Shape) -> Iterator[RangeCheck]:
    """Yield the range checks of a shape's position, sizes, mesh coordinates [m] and color channels."""
    yield from point_checks(f"{shape.kind} position", shape.position)
    for size in shape.size:
        yield RangeCheck(f"{shape.kind} size", size, SHAPE_SIZE)
    if shape.mesh is not None:
        yield RangeCheck("smallest mesh coordinate", float(shape.mesh.vertices.min()), PLACE)
        yield RangeCheck("largest mesh coordinate", float(shape.mesh.vertices.max()), PLACE)
    for channel in shape.color or ():
        yield RangeCheck("color", channel, COLOR)


def shape_corners(shape: Shape) -> np.ndarray:
    """Return the corners (8, 3) [m], in the link frame, of a shape's bounding box along the shape's own axes."""
    if shape.mesh is not None:
        low = shape.mesh.vertices.min(axis=0)
        high = shape.mesh.vertices.max(axis=0)
    else:
        radius, *length = shape.size
        high = np.array([radius, radius, 0.5 * length[0] if length else radius])
        if shape.kind == "box":
            high = 0.5 * np.array(shape.size)
        low = -high
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
    *axis, w = shape.rotation / np.linalg.norm(shape.rotation)
    return shape.position + corners + 2.0 * np.cross(axis, np.cross(axis, corners) + w * corners)


def motor_checks(motor: Motor) -> Iterator[RangeCheck]:
    """Yield the range checks of a motor type's constants, and of its gains for jumping and walking."""
    yield RangeCheck("gear_ratio", motor.gear_ratio, GEAR_RATIO)
    yield RangeCheck("rotor_inertia", motor.rotor_inertia, ROTOR_INERTIA)
    yield RangeCheck("rotor_inertia behind the gear", motor.armature, ARMATURE)
    yield RangeCheck("peak_torque", motor.peak_torque, PEAK_TORQUE)
    yield RangeCheck("cutoff speed", motor.cutoff_speed, MOTOR_SPEED)
    yield RangeCheck("no-load speed", motor.no_load_speed, MOTOR_SPEED)
    yield RangeCheck("coulomb_friction", motor.coulomb_friction, MOTOR_FRICTION)
    yield RangeCheck("coulomb_friction", motor.coulomb_friction, Range(0.0, motor.peak_torque, "N m (peak_torque)"))
    for use, gains in (("jumping", motor.jumping), ("walking", motor.walking)):
        yield RangeCheck(f"{use} kp", gains.kp, PROPORTIONAL_GAIN)
        yield RangeCheck(f"{use} kd", gains.kd, DERIVATIVE_GAIN)


def common_checks(description: RobotDescription) -> Iterator[RangeCheck]:
    """Yield the range checks of what all legs share: knee damping, and stops of the sum outer + inner thigh angle."""
    yield RangeCheck("knee_damping", description.knee_damping, KNEE_DAMPING)
    yield RangeCheck("knee_damping_limit", description.knee_damping_limit, KNEE_DAMPING_LIMIT)
    for name, angle in zip(("lower", "upper"), description.transversal_sum, strict=True):
        yield RangeCheck(f"{name} transversal_sum", angle, Range(2.0 * STOP.low, 2.0 * STOP.high, STOP.unit))
