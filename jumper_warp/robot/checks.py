"""Checks of a robot description as a whole: the tree, the loops, the legs, and the closed form of a leg's knees."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from jumper_warp.robot.bounds import LENGTH, PAW_RADIUS, Reading, check_bounds, refuse_outside
from jumper_warp.robot.parts import LEGS, MOTOR_JOINTS, Joint, Link, RobotDescription, RobotDescriptionError
from jumper_warp.utils.errors import InputError

TOLERANCE = 1.0e-6
"""Largest deviation of a mirrored leg from the front left one, and of a leg from its planar form [m, kg, rad]."""
INERTIA_TOLERANCE = 1.0e-9
"""The same for moments of inertia [kg m^2]."""


@dataclass(frozen=True)
class LegDimensions:
    """Constants of one leg; `jumper_warp.kernels.kinematics.geometry.LegGeometry` explains the fields."""

    hip: tuple[float, float, float]
    front: float
    side: float
    outer_x: float
    inner_x: float
    plane_y: float
    knee_y: float
    thigh: float
    shank: float
    paw_radius: float


def leg_dimensions(description: RobotDescription, leg: str) -> LegDimensions:
    """Return the dimensions of a leg of a checked description, read off its joint origins."""
    lateral, outer, inner = (description.joint(f"{leg}_{name}").origin for name in ("lateral", "outer", "inner"))
    knee = description.joint(f"{leg}_outer_knee").origin
    return LegDimensions(
        hip=tuple(map(float, lateral)),
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
    """Return outer and inner knee angle [rad] that close the loop, and the height of the ankle [m, housing z].

    The ankle is the intersection of the two shank circles below the knees. Raises ValueError where they do not meet.
    """
    outer_knee = np.array([leg.outer_x + leg.front * leg.thigh * math.sin(outer), -leg.thigh * math.cos(outer)])
    inner_knee = np.array([leg.inner_x - leg.front * leg.thigh * math.sin(inner), -leg.thigh * math.cos(inner)])
    span = outer_knee - inner_knee
    distance = math.hypot(*span)
    if not 1.0e-6 < distance < 2.0 * leg.shank:
        raise InputError(f"the shanks of {leg.shank} m do not meet, the knees are {distance:.4f} m apart")
    rise = math.sqrt(leg.shank**2 - 0.25 * distance**2) / distance
    ankle = 0.5 * (outer_knee + inner_knee) + leg.front * rise * np.array([span[1], -span[0]])
    # tilt of each shank from -z toward +front
    outer_tilt, inner_tilt = (
        math.atan2(leg.front * (ankle - knee)[0], -(ankle - knee)[1]) for knee in (outer_knee, inner_knee)
    )
    return outer - outer_tilt, inner + inner_tilt, float(ankle[1])


def check_description(description: RobotDescription) -> RobotDescription:
    """Return the description with links and joints in tree order. Raises RobotDescriptionError if it is impossible."""
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
    """Return the description with links and joints ordered as the legs are; refuse any other tree."""
    file = description.urdf_path
    links = {link.name: link for link in description.links}
    joints = {joint.name: joint for joint in description.joints}
    parent_joint: dict[str, Joint] = {}
    for joint in description.joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise RobotDescriptionError(file, f"joint {joint.name}", f"unknown link {link!r:.60}")
        if joint.child in parent_joint:
            other = parent_joint[joint.child].name
            raise RobotDescriptionError(
                file, f"link {joint.child}", f"expected one parent joint, found {other}, {joint.name}"
            )
        parent_joint[joint.child] = joint
    roots = [name for name in links if name not in parent_joint]
    if roots != ["body"]:
        raise RobotDescriptionError(file, "", f"expected the one root link body, found {', '.join(roots) or 'a cycle'}")
    expected = tree_layout()
    for name, (parent, child) in expected.items():
        if name not in joints:
            raise RobotDescriptionError(file, f"joint {name}", "missing")
        if (joints[name].parent, joints[name].child) != (parent, child):
            raise RobotDescriptionError(file, f"joint {name}", f"expected to lead from {parent} to {child}")
    unexpected = joints.keys() - expected.keys()
    if unexpected:
        raise RobotDescriptionError(file, f"joint {min(unexpected)}", "expected no joint of this name")
    order = ["body", *(child for _, child in expected.values())]
    ordered_links = tuple(links[name] for name in order)
    return dataclasses.replace(description, links=ordered_links, joints=tuple(joints[name] for name in expected))


def tree_layout() -> dict[str, tuple[str, str]]:
    """Return (parent, child) of every joint, in tree order."""
    layout = {}
    for leg in LEGS:
        layout[f"{leg}_lateral"] = ("body", f"{leg}_housing")
        for bar in ("outer", "inner"):
            layout[f"{leg}_{bar}"] = (f"{leg}_housing", f"{leg}_{bar}_thigh")
            layout[f"{leg}_{bar}_knee"] = (f"{leg}_{bar}_thigh", f"{leg}_{bar}_shank")
    return layout


def check_loops(description: RobotDescription) -> None:
    """Refuse loops that name other links than a leg's shanks, or are anchored off their axis."""
    links = {link.name for link in description.links}
    for leg, loop in zip(LEGS, description.loops, strict=True):
        part = f"loop {loop.name}"
        for link, expected in ((loop.parent, f"{leg}_inner_shank"), (loop.child, f"{leg}_outer_shank")):
            if link not in links:
                raise RobotDescriptionError(description.path, part, f"unknown link {link!r:.60}")
            if link != expected:
                raise RobotDescriptionError(description.path, part, f"expected link {expected}, found {link}")
        length = -loop.parent_anchor[2]
        for anchor in (loop.parent_anchor, loop.child_anchor):
            if length <= 0.0 or np.abs(anchor - (0.0, 0.0, -length)).max() > TOLERANCE:
                problem = f"expected both anchors at the same place on the shanks' -z axes, found {anchor.tolist()}"
                raise RobotDescriptionError(description.path, part, problem)


def check_leg(description: RobotDescription, leg: str) -> None:
    """Refuse a leg that is not a planar five-bar with the documented axes and a paw at its ankle."""
    file = description.urdf_path
    front, side = (1.0 if leg[0] == "F" else -1.0), (1.0 if leg[1] == "L" else -1.0)
    names = ("lateral", "outer", "inner", "outer_knee", "inner_knee")
    lateral, outer, inner, outer_knee, inner_knee = (description.joint(f"{leg}_{name}") for name in names)
    axes = {lateral: (side, 0, 0), outer: (0, -front, 0), inner: (0, front, 0)}
    axes |= {outer_knee: (0, front, 0), inner_knee: (0, -front, 0)}
    for joint, axis in axes.items():
        if np.abs(joint.axis - axis).max() > TOLERANCE:
            raise RobotDescriptionError(
                file, f"joint {joint.name}", f"expected axis {axis}, found {joint.axis.tolist()}"
            )
    if front * lateral.origin[0] <= 0.0 or side * lateral.origin[1] <= 0.0:
        raise RobotDescriptionError(file, f"joint {lateral.name}", "expected the hip in its own quarter of the body")
    if front * (outer.origin[0] - inner.origin[0]) <= 0.0:
        raise RobotDescriptionError(file, f"joint {outer.name}", "expected farther from the body centre than its twin")
    if abs(outer.origin[2]) > TOLERANCE or np.abs((outer.origin - inner.origin)[1:]).max() > TOLERANCE:
        raise RobotDescriptionError(file, f"joint {inner.name}", "expected both transversal axes at one y and at z 0")
    knee = outer_knee.origin
    if knee[2] >= 0.0 or abs(knee[0]) > TOLERANCE or np.abs(knee - inner_knee.origin).max() > TOLERANCE:
        raise RobotDescriptionError(
            file, f"joint {outer_knee.name}", "expected both knees alike, on the thighs' -z axes"
        )
    loop = description.loops[LEGS.index(leg)]
    for link in description.links:
        expected = 1 if link.name == f"{leg}_inner_shank" else 0
        if link.name.startswith(leg) and len(link.collisions) != expected:
            raise RobotDescriptionError(file, f"link {link.name}", f"expected {expected} collision shape(s)")
    paw = description.link(loop.parent).collisions[0]
    if paw.kind != "sphere" or np.abs(paw.position - loop.parent_anchor).max() > TOLERANCE:
        raise RobotDescriptionError(file, f"link {loop.parent}", "expected its collision sphere, the paw, at the ankle")
    if description.link("body").collisions:
        raise RobotDescriptionError(file, "link body", "expected no collision shape")


def check_lengths(description: RobotDescription, leg: str) -> None:
    """Refuse a leg of no size, in which what has to be divided by vanishes."""
    dimensions = leg_dimensions(description, leg)
    axes = abs(dimensions.outer_x - dimensions.inner_x)
    refuse_outside(
        description.urdf_path,
        f"joint {leg}_lateral",
        [Reading(f"hip {axis}", abs(dimensions.hip[i]), LENGTH) for i, axis in enumerate("xy")],
    )
    refuse_outside(
        description.urdf_path, f"joint {leg}_outer", [Reading("distance from its twin's axis", axes, LENGTH)]
    )
    refuse_outside(
        description.urdf_path, f"joint {leg}_outer_knee", [Reading("thigh length", dimensions.thigh, LENGTH)]
    )
    refuse_outside(description.path, f"loop {leg}_ankle", [Reading("shank length", dimensions.shank, LENGTH)])
    refuse_outside(
        description.urdf_path,
        f"link {leg}_inner_shank",
        [Reading("paw radius", dimensions.paw_radius, PAW_RADIUS)],
    )


def check_mirror(description: RobotDescription, leg: str) -> None:
    """Refuse a leg that does not mirror the front left one (hips may differ in y between front and back)."""
    flip = np.array([1.0 if leg[0] == "F" else -1.0, 1.0 if leg[1] == "L" else -1.0, 1.0])
    file = description.urdf_path

    def differ(found: np.ndarray, expected: np.ndarray, tolerance: float = TOLERANCE) -> bool:
        return bool(np.abs(np.asarray(found) - expected).max() > tolerance)

    for link in (link for link in description.links if link.name.startswith(leg)):
        twin: Link = description.link(f"FL{link.name[2:]}")
        moved = differ(link.mass, twin.mass) or differ(link.com, flip * twin.com)
        if moved or differ(link.inertia, np.outer(flip, flip) * twin.inertia, INERTIA_TOLERANCE):
            raise RobotDescriptionError(file, f"link {link.name}", f"expected mass, com, inertia to mirror {twin.name}")
    for joint in (joint for joint in description.joints if joint.name.startswith(leg)):
        twin_joint: Joint = description.joint(f"FL{joint.name[2:]}")
        origin = twin_joint.origin.copy()
        if joint.name.endswith("lateral"):
            origin[1] = description.joint(f"{leg[0]}L_lateral").origin[1]
        stops, twin_stops = ([j.lower, j.upper, j.effort, j.velocity] for j in (joint, twin_joint))
        if differ(joint.origin, flip * origin) or differ(stops, twin_stops):
            raise RobotDescriptionError(file, f"joint {joint.name}", f"expected to mirror {twin_joint.name}")
    found, expected = (leg_dimensions(description, name) for name in (leg, "FL"))
    if differ([found.shank, found.paw_radius], [expected.shank, expected.paw_radius]):
        raise RobotDescriptionError(file, f"link {leg}_inner_shank", "expected ankle and paw to mirror the FL leg")


def check_motors(description: RobotDescription) -> None:
    """Refuse motors that differ between legs, or from the effort and velocity limits of their joints."""
    for index, (name, motor) in enumerate(zip(MOTOR_JOINTS, description.motors, strict=True)):
        if motor.type != description.motors[index % 3].type:
            problem = f"expected {description.motors[index % 3].type} as on the FL leg, found {motor.type}"
            raise RobotDescriptionError(description.path, f"motor {name}", problem)
        joint = description.joint(name)
        for word, limit, constant in (
            ("effort", joint.effort, motor.peak_torque),
            ("velocity", joint.velocity, motor.no_load_speed),
        ):
            if abs(limit - constant) > 1.0e-3 * constant:
                problem = f"expected {word} {constant:.4g} as of motor {motor.type}, found {limit:.4g}"
                raise RobotDescriptionError(description.urdf_path, f"joint {name}", problem)


def check_poses(description: RobotDescription) -> None:
    """Refuse poses outside the stops or where a loop cannot close, and a description without the default pose."""
    if "default" not in description.poses:
        raise RobotDescriptionError(description.path, "poses", "expected a pose named default")
    leg = leg_dimensions(description, "FL")
    for name, (lateral, transversal) in description.poses.items():
        part = f"pose {name}"
        for joint, angle in (("FL_lateral", lateral), ("FL_outer", transversal), ("FL_inner", transversal)):
            stops = description.joint(joint)
            if not stops.lower <= angle <= stops.upper:
                raise RobotDescriptionError(
                    description.path, part, f"expected {joint} within its stops, found {angle:.4f}"
                )
        if not description.transversal_sum[0] <= 2.0 * transversal <= description.transversal_sum[1]:
            raise RobotDescriptionError(description.path, part, "expected the transversal sum within its stops")
        try:
            knee_angles(leg, transversal, transversal)
        except ValueError as err:
            raise RobotDescriptionError(description.path, part, f"the loop FL_ankle cannot close: {err}") from err
