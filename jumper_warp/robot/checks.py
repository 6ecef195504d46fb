"""Checks of a whole robot description (tree, loops, legs, motors, poses), and knee angles that close a leg's loop."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from jumper_warp.robot.bounds import LENGTH, PAW_RADIUS, RangeCheck, check_bounds, refuse_outside
from jumper_warp.robot.parts import LEGS, MOTOR_JOINTS, Joint, RobotDescription, RobotDescriptionError, require
from jumper_warp.utils.errors import InputError

TOLERANCE = 1.0e-6
"""[m, kg, rad] Largest deviation of a mirrored leg from the front left one, and of a leg from its planar form."""
INERTIA_TOLERANCE = 1.0e-9  # [kg m^2] Largest deviation of mirrored moments of inertia


@dataclass(frozen=True)
class LegDimensions:
    """Lengths and positions that define one leg's geometry.

    Housing frame: on the lateral axis, x forward, y left. Names are those of the kernels' `LegGeometry`.
    """

    hip: tuple[float, float, float]  # [m] lateral axis, body frame
    front: float  # +1 front leg, -1 back leg
    side: float  # +1 left leg, -1 right leg
    outer_x: float  # [m] axis of the outer thigh, housing x
    inner_x: float  # [m] axis of the inner thigh, housing x
    plane_y: float  # [m] both thigh axes, housing y
    knee_y: float  # [m] offset of knees, ankle and paw from the thigh plane, along housing y
    thigh: float  # [m] thigh axis to knee
    shank: float  # [m] knee to ankle
    paw_radius: float  # [m] sphere centred at the ankle


def leg_dimensions(description: RobotDescription, leg: str) -> LegDimensions:
    """Return the dimensions of one leg ("FL", "FR", "BL" or "BR") of a checked description, from its joint origins."""
    lateral, outer, inner = (description.joint(f"{leg}_{name}").origin for name in ("lateral", "outer", "inner"))
    knee = description.joint(f"{leg}_outer_knee").origin
    return LegDimensions(
        hip=(float(lateral[0]), float(lateral[1]), float(lateral[2])),
        front=math.copysign(1.0, lateral[0]),
        side=math.copysign(1.0, lateral[1]),
        outer_x=float(outer[0]),
        inner_x=float(inner[0]),
        plane_y=float(outer[1]),
        knee_y=float(knee[1]),
        thigh=-float(knee[2]),
        shank=-float(description.loops[LEGS.index(leg)].parent_anchor[2]),
        paw_radius=description.link(f"{leg}_inner_shank").collisions[0].size[0],
    )


def knee_angles(leg: LegDimensions, outer: float, inner: float) -> tuple[float, float, float]:
    """Return the outer and inner knee angles [rad] that close a leg's loop at given thigh angles, and ankle z [m].

    outer, inner: thigh angles [rad]. The ankle is the lower intersection of two circles of radius `shank` about the
    knees. z, and points (x, z) [m] below, are in the housing frame (see `LegDimensions`). Raises InputError where the
    circles do not intersect.
    """
    outer_knee = np.array([leg.outer_x + leg.front * leg.thigh * math.sin(outer), -leg.thigh * math.cos(outer)])
    inner_knee = np.array([leg.inner_x - leg.front * leg.thigh * math.sin(inner), -leg.thigh * math.cos(inner)])
    span = outer_knee - inner_knee
    distance = math.hypot(*span)
    if not 1.0e-6 < distance < 2.0 * leg.shank:
        raise InputError(f"two shanks of {leg.shank} m cannot connect knees {distance:.4f} m apart")
    rise = math.sqrt(leg.shank**2 - 0.25 * distance**2) / distance
    ankle = 0.5 * (outer_knee + inner_knee) + leg.front * rise * np.array([span[1], -span[0]])
    # tilt of each shank from -z toward +front
    outer_tilt, inner_tilt = (
        math.atan2(leg.front * (ankle - knee)[0], -(ankle - knee)[1]) for knee in (outer_knee, inner_knee)
    )
    return outer - outer_tilt, inner + inner_tilt, float(ankle[1])


def check_description(description: RobotDescription) -> RobotDescription:
    """Check a robot description, and return it with links and joints in tree order. Raises RobotDescriptionError."""
    check_bounds(description)
    description = in_tree_order(description)
    check_loops(description)
    for leg in LEGS:
        check_leg(description, leg)
        check_lengths(description, leg)
        check_mirror(description, leg)
    check_motors(description)
    check_poses(description)
    return description


def in_tree_order(description: RobotDescription) -> RobotDescription:
    """Return a description with links and joints in the order of `tree_layout`; refuse one with another tree."""
    file = description.urdf_path
    links = {link.name: link for link in description.links}
    joints = {joint.name: joint for joint in description.joints}
    parent_joint: dict[str, Joint] = {}
    for joint in description.joints:
        for link in (joint.parent, joint.child):
            require(link in links, file, f"joint {joint.name}", f"unknown link {link!r:.60}")
        first = parent_joint.setdefault(joint.child, joint).name
        problem = f"expected one parent joint, found {first}, {joint.name}"
        require(first == joint.name, file, f"link {joint.child}", problem)
    roots = [name for name in links if name not in parent_joint]
    problem = f"expected the one root link body, found {', '.join(roots) or 'a cycle'}"
    require(roots == ["body"], file, "", problem)
    expected = tree_layout()
    for name, ends in expected.items():
        require(name in joints, file, f"joint {name}", "missing")
        actual = joints[name].parent, joints[name].child
        require(actual == ends, file, f"joint {name}", "expected parent {} and child {}".format(*ends))
    for name in sorted(joints.keys() - expected.keys()):
        raise RobotDescriptionError(file, f"joint {name}", "unknown joint name")
    order = ["body", *(child for _, child in expected.values())]
    ordered_links = tuple(links[name] for name in order)
    return dataclasses.replace(description, links=ordered_links, joints=tuple(joints[name] for name in expected))


def tree_layout() -> dict[str, tuple[str, str]]:
    """Return the links that each joint of the robot's tree connects: (parent, child) by joint, in tree order."""
    layout = {}
    for leg in LEGS:
        layout[f"{leg}_lateral"] = ("body", f"{leg}_housing")
        for bar in ("outer", "inner"):
            layout[f"{leg}_{bar}"] = (f"{leg}_housing", f"{leg}_{bar}_thigh")
            layout[f"{leg}_{bar}_knee"] = (f"{leg}_{bar}_thigh", f"{leg}_{bar}_shank")
    return layout


def check_loops(description: RobotDescription) -> None:
    """Raise RobotDescriptionError for a loop that does not join a leg's shanks at one point of their -z axes."""
    file = description.path
    links = {link.name for link in description.links}
    for leg, loop in zip(LEGS, description.loops, strict=True):
        part = f"loop {loop.name}"
        for link, expected in ((loop.parent, f"{leg}_inner_shank"), (loop.child, f"{leg}_outer_shank")):
            require(link in links, file, part, f"unknown link {link!r:.60}")
            require(link == expected, file, part, f"expected link {expected}, found {link}")
        length = -loop.parent_anchor[2]
        for anchor in (loop.parent_anchor, loop.child_anchor):
            on_axis = length > 0.0 and close(anchor, (0.0, 0.0, -length))
            problem = f"expected both anchors at the same place on the shanks' -z axes, found {anchor.tolist()}"
            require(on_axis, file, part, problem)


def close(actual: Any, expected: Any, tolerance: float = TOLERANCE) -> bool:
    """Return whether two arrays are equal within `tolerance` in every entry; their shapes broadcast."""
    return bool(np.abs(np.asarray(actual) - expected).max() <= tolerance)


def check_leg(description: RobotDescription, leg: str) -> None:
    """Raise RobotDescriptionError for a leg that is no planar five-bar with expected axes and a paw at the ankle."""
    file = description.urdf_path
    front = 1.0 if leg[0] == "F" else -1.0
    side = 1.0 if leg[1] == "L" else -1.0
    names = ("lateral", "outer", "inner", "outer_knee", "inner_knee")
    lateral, outer, inner, outer_knee, inner_knee = (description.joint(f"{leg}_{name}") for name in names)
    axes = {lateral: (side, 0, 0), outer: (0, -front, 0), inner: (0, front, 0)}
    axes |= {outer_knee: (0, front, 0), inner_knee: (0, -front, 0)}
    for joint, axis in axes.items():
        problem = f"expected axis {axis}, found {joint.axis.tolist()}"
        require(close(joint.axis, axis), file, f"joint {joint.name}", problem)
    in_quarter = front * lateral.origin[0] > 0.0 and side * lateral.origin[1] > 0.0
    outer_farther = front * (outer.origin[0] - inner.origin[0]) > 0.0
    in_housing_plane = abs(outer.origin[2]) <= TOLERANCE and close(outer.origin[1:], inner.origin[1:])
    knee = outer_knee.origin
    on_axis = knee[2] < 0.0 and abs(knee[0]) <= TOLERANCE and close(knee, inner_knee.origin)
    for joint, holds, problem in (
        (lateral, in_quarter, "expected the hip in the leg's own quadrant of the body"),
        (outer, outer_farther, "expected the outer axis farther from the body centre than the inner one"),
        (inner, in_housing_plane, "expected both transversal axes at one y and at z 0"),
        (outer_knee, on_axis, "expected both knees at one distance along the thighs' -z axes"),
    ):
        require(holds, file, f"joint {joint.name}", problem)
    loop = description.loops[LEGS.index(leg)]
    for link in description.links:
        count = 1 if link.name == f"{leg}_inner_shank" else 0
        counted = not link.name.startswith(leg) or len(link.collisions) == count
        require(counted, file, f"link {link.name}", f"expected {count} collision shape(s)")
    paw = description.link(loop.parent).collisions[0]
    at_ankle = paw.kind == "sphere" and close(paw.position, loop.parent_anchor)
    require(at_ankle, file, f"link {loop.parent}", "expected the paw's collision sphere at the ankle")
    require(not description.link("body").collisions, file, "link body", "expected no collision shape")


def check_lengths(description: RobotDescription, leg: str) -> None:
    """Raise RobotDescriptionError for a leg with a length [m] outside `LENGTH` or a paw radius outside `PAW_RADIUS`."""
    dimensions = leg_dimensions(description, leg)
    urdf = description.urdf_path
    axes = abs(dimensions.outer_x - dimensions.inner_x)
    for file, part, name, value, limits in (
        (urdf, f"joint {leg}_lateral", "hip x", abs(dimensions.hip[0]), LENGTH),
        (urdf, f"joint {leg}_lateral", "hip y", abs(dimensions.hip[1]), LENGTH),
        (urdf, f"joint {leg}_outer", "distance from the inner axis", axes, LENGTH),
        (urdf, f"joint {leg}_outer_knee", "thigh length", dimensions.thigh, LENGTH),
        (description.path, f"loop {leg}_ankle", "shank length", dimensions.shank, LENGTH),
        (urdf, f"link {leg}_inner_shank", "paw radius", dimensions.paw_radius, PAW_RADIUS),
    ):
        refuse_outside(file, part, [RangeCheck(name, value, limits)])


def check_mirror(description: RobotDescription, leg: str) -> None:
    """Raise RobotDescriptionError for a leg that is no mirror image of the front left one; y of the hips may differ."""
    flip = np.array([1.0 if leg[0] == "F" else -1.0, 1.0 if leg[1] == "L" else -1.0, 1.0])  # signs of x, y, z
    file = description.urdf_path
    for link in (link for link in description.links if link.name.startswith(leg)):
        twin = description.link(f"FL{link.name[2:]}")
        mirrored = close(link.mass, twin.mass) and close(link.com, flip * twin.com)
        mirrored &= close(link.inertia, np.outer(flip, flip) * twin.inertia, INERTIA_TOLERANCE)
        require(mirrored, file, f"link {link.name}", f"expected mass, com, inertia to mirror {twin.name}")
    for joint in (joint for joint in description.joints if joint.name.startswith(leg)):
        twin = description.joint(f"FL{joint.name[2:]}")
        origin = twin.origin.copy()
        if joint.name.endswith("lateral"):
            origin[1] = description.joint(f"{leg[0]}L_lateral").origin[1]
        stops, twin_stops = ([j.lower, j.upper, j.effort, j.velocity] for j in (joint, twin))
        mirrored = close(joint.origin, flip * origin) and close(stops, twin_stops)
        require(mirrored, file, f"joint {joint.name}", f"expected to mirror {twin.name}")
    lengths, expected = (leg_dimensions(description, name) for name in (leg, "FL"))
    mirrored = close([lengths.shank, lengths.paw_radius], [expected.shank, expected.paw_radius])
    require(mirrored, file, f"link {leg}_inner_shank", "expected ankle and paw to mirror the FL leg")


def check_motors(description: RobotDescription) -> None:
    """Raise RobotDescriptionError for motor types that differ by leg, or joint limits over 0.1 % off the motor's."""
    for index, (name, motor) in enumerate(zip(MOTOR_JOINTS, description.motors, strict=True)):
        kind = description.motors[index % 3].type
        problem = f"expected {kind} as on the FL leg, found {motor.type}"
        require(motor.type == kind, description.path, f"motor {name}", problem)
        joint = description.joint(name)
        limits = (("effort", joint.effort, motor.peak_torque), ("velocity", joint.velocity, motor.no_load_speed))
        for word, limit, constant in limits:
            problem = f"expected {word} {constant:.4g} of motor {motor.type}, found {limit:.4g}"
            require(abs(limit - constant) <= 1.0e-3 * constant, description.urdf_path, f"joint {name}", problem)


def check_poses(description: RobotDescription) -> None:
    """Check that poses are within the joint stops and close all loops, and that one is named default.

    Raises RobotDescriptionError.
    """
    file = description.path
    leg = leg_dimensions(description, "FL")
    require("default" in description.poses, file, "poses", "expected a pose named default")
    for name, (lateral, transversal) in description.poses.items():
        part = f"pose {name}"
        for joint, angle in (("FL_lateral", lateral), ("FL_outer", transversal), ("FL_inner", transversal)):
            stops = description.joint(joint)
            inside = stops.lower <= angle <= stops.upper
            require(inside, file, part, f"expected {joint} within its stops, found {angle:.4f}")
        inside = description.transversal_sum[0] <= 2.0 * transversal <= description.transversal_sum[1]
        require(inside, file, part, "expected the transversal sum within its stops")
        try:
            knee_angles(leg, transversal, transversal)
        except ValueError as err:
            raise RobotDescriptionError(file, part, f"the loop FL_ankle cannot close: {err}") from err
