"""What the values of a robot description may be at most and at least: slips of unit or exponent lie outside.

The ranges are wide: they hold every legged robot from a toy to one that carries a person.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jumper_warp.robot.parts import Joint, Link, Motor, RobotDescription, RobotDescriptionError, Shape


class Range(NamedTuple):
    """A closed range of a quantity."""

    low: float
    high: float
    unit: str


LINK_MASS = Range(1.0e-3, 100.0, "kg")
"""From a bracket to the trunk of a robot that carries a person."""
PLACE = Range(-2.0, 2.0, "m")
"""Any coordinate of a point in its link's frame: no leg is longer."""
LENGTH = Range(1.0e-3, 2.0, "m")
"""Thighs, shanks, distances of axes: below a millimetre the closed form of the leg loses its digits."""
PAW_RADIUS = Range(1.0e-3, 0.2, "m")
SHAPE_SIZE = Range(1.0e-4, 2.0, "m")
"""From the thickness of a decal to the length of a trunk."""
SMALLEST_GYRATION = Range(1.0e-3, 2.0, "m")
"""Radius of gyration of the smallest moment of inertia: a steel wire of 4 mm has 1 mm."""
GYRATION_OF_REACH = Range(0.1, 1.5, "of the link's reach")
"""Radius of gyration of the largest moment over the farthest distance of the link's joints and shapes from its centre
of mass: 1 with all mass at the rim, 0.6 for a rod; more room for links whose shapes are left out."""
STOP = Range(-2.0 * math.pi, 2.0 * math.pi, "rad")
"""A hinge of a leg does not turn more than once."""
JOINT_EFFORT = Range(0.1, 1.0e4, "N m")
"""Of any joint, the passive ones included, whose limit is only nominal."""
JOINT_SPEED = Range(0.1, 1.0e4, "rad/s")
PEAK_TORQUE = Range(0.1, 1.0e3, "N m")
MOTOR_SPEED = Range(0.1, 1.0e3, "rad/s")
"""At the output of the gear; 1000 rad/s are 9500 rpm."""
GEAR_RATIO = Range(1.0, 1.0e3, "")
ROTOR_INERTIA = Range(1.0e-8, 1.0e-2, "kg m^2")
"""From a rotor of a gram and 3 mm radius to one of 2 kg and 0.1 m."""
ARMATURE = Range(1.0e-6, 1.0, "kg m^2")
"""Behind the gear; 1 kg m^2 is ten times a whole stretched leg."""
MOTOR_FRICTION = Range(0.0, 10.0, "N m")
PROPORTIONAL_GAIN = Range(0.1, 1.0e4, "N m/rad")
"""Below, no motor moves a leg in time; above, it is nearly as hard as the stops."""
DERIVATIVE_GAIN = Range(1.0e-2, 1.0e2, "N m s/rad")
KNEE_DAMPING = Range(1.0e-6, 10.0, "N m s/rad")
KNEE_DAMPING_LIMIT = Range(1.0e-3, 1.0e3, "N m")
SPRING_STIFFNESS = Range(0.0, 1.0e4, "N/m")
"""Ten times that of the authors' springs, a third of the swing that the step of 1/480 s follows."""
SPRING_LENGTH = Range(0.0, 1.0, "m")
COLOR = Range(0.0, 1.0, "")


class Reading(NamedTuple):
    """One value of a description, its name, and the range that it must lie in."""

    name: str
    value: float
    range: Range


def check_bounds(description: RobotDescription) -> None:
    """Raise RobotDescriptionError for a value that no legged robot has. The tree and the legs need not be checked."""
    anchors: dict[str, list[np.ndarray]] = {link.name: [np.zeros(3)] for link in description.links}
    for joint in description.joints:
        anchors.get(joint.parent, []).append(joint.origin)
        refuse_outside(description.urdf_path, f"joint {joint.name}", of_joint(joint))
    for loop in description.loops:
        for link, anchor in ((loop.parent, loop.parent_anchor), (loop.child, loop.child_anchor)):
            anchors.get(link, []).append(anchor)
            refuse_outside(description.path, f"loop {loop.name}", of_place(f"anchor on {link}", anchor))
    for link in description.links:
        refuse_outside(description.urdf_path, f"link {link.name}", of_link(link, anchors[link.name]))
    for motor in dict.fromkeys(description.motors):
        refuse_outside(description.path, f"motor type {motor.type}", of_motor(motor))
    refuse_outside(description.path, "", of_knees(description))


def refuse_outside(file: Path, part: str, readings: Iterable[Reading]) -> None:
    """Raise RobotDescriptionError for the first value outside its range, or that is not a number."""
    for name, value, (low, high, unit) in readings:
        if not low <= value <= high:
            problem = f"expected {name} in {low:.4g} to {high:.4g}{unit and ' '}{unit}, found {value:.6g}"
            raise RobotDescriptionError(file, part, problem)


def of_place(name: str, point: np.ndarray) -> Iterator[Reading]:
    """Return the coordinates of a point in its link's frame."""
    return (Reading(f"{axis} of {name}", float(value), PLACE) for axis, value in zip("xyz", point, strict=True))


def of_joint(joint: Joint) -> Iterator[Reading]:
    """Return the values of a joint."""
    yield from of_place("origin", joint.origin)
    yield Reading("lower", joint.lower, STOP)
    yield Reading("upper", joint.upper, STOP)
    yield Reading("effort", joint.effort, JOINT_EFFORT)
    yield Reading("velocity", joint.velocity, JOINT_SPEED)


def of_link(link: Link, anchors: list[np.ndarray]) -> Iterator[Reading]:
    """Return the values of a link; anchors: where its own frame and its joints lie [m], link frame."""
    yield Reading("mass", link.mass, LINK_MASS)
    yield from of_place("centre of mass", link.com)
    for shape in (*link.visuals, *link.collisions):
        yield from of_shape(shape)
    smallest, _, largest = np.sqrt(np.linalg.eigvalsh(link.inertia) / link.mass)
    corners = [corner for shape in (*link.visuals, *link.collisions) for corner in shape_corners(shape)]
    reach = np.linalg.norm(np.array([*anchors, *corners]) - link.com, axis=1).max()
    yield Reading("reach", float(reach), LENGTH)
    yield Reading("smallest radius of gyration", float(smallest), SMALLEST_GYRATION)
    yield Reading("largest radius of gyration", float(largest / reach), GYRATION_OF_REACH)


def of_shape(shape: Shape) -> Iterator[Reading]:
    """Return the values of a shape."""
    yield from of_place(f"{shape.kind} position", shape.position)
    for size in shape.size:
        yield Reading(f"{shape.kind} size", size, SHAPE_SIZE)
    if shape.mesh is not None:
        yield Reading("smallest mesh coordinate", float(shape.mesh.vertices.min()), PLACE)
        yield Reading("largest mesh coordinate", float(shape.mesh.vertices.max()), PLACE)
    for channel in shape.color or ():
        yield Reading("color", channel, COLOR)


def shape_corners(shape: Shape) -> np.ndarray:
    """Return the corners (8, 3) [m], link frame, of the box along the shape's own axes that encloses it."""
    if shape.mesh is not None:
        low, high = shape.mesh.vertices.min(axis=0), shape.mesh.vertices.max(axis=0)
    else:
        radius, *length = shape.size
        high = np.array([radius, radius, 0.5 * length[0] if length else radius])
        if shape.kind == "box":
            high = 0.5 * np.array(shape.size)
        low = -high
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
    *axis, w = shape.rotation / np.linalg.norm(shape.rotation)
    return shape.position + corners + 2.0 * np.cross(axis, np.cross(axis, corners) + w * corners)


def of_motor(motor: Motor) -> Iterator[Reading]:
    """Return the constants of a motor type."""
    yield Reading("gear_ratio", motor.gear_ratio, GEAR_RATIO)
    yield Reading("rotor_inertia", motor.rotor_inertia, ROTOR_INERTIA)
    yield Reading("rotor_inertia behind the gear", motor.armature, ARMATURE)
    yield Reading("peak_torque", motor.peak_torque, PEAK_TORQUE)
    yield Reading("cutoff speed", motor.cutoff_speed, MOTOR_SPEED)
    yield Reading("no-load speed", motor.no_load_speed, MOTOR_SPEED)
    yield Reading("coulomb_friction", motor.coulomb_friction, MOTOR_FRICTION)
    yield Reading("coulomb_friction", motor.coulomb_friction, Range(0.0, motor.peak_torque, "N m, its peak_torque"))
    for use, gains in (("jumping", motor.jumping), ("walking", motor.walking)):
        yield Reading(f"{use} kp", gains.kp, PROPORTIONAL_GAIN)
        yield Reading(f"{use} kd", gains.kd, DERIVATIVE_GAIN)


def of_knees(description: RobotDescription) -> Iterator[Reading]:
    """Return the values that all legs share."""
    yield Reading("knee_damping", description.knee_damping, KNEE_DAMPING)
    yield Reading("knee_damping_limit", description.knee_damping_limit, KNEE_DAMPING_LIMIT)
    for name, angle in zip(("lower", "upper"), description.transversal_sum, strict=True):
        yield Reading(f"{name} transversal_sum", angle, Range(2.0 * STOP.low, 2.0 * STOP.high, STOP.unit))
