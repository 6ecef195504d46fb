"""Writer of a URDF of a given robot, on the text of another one, and of a YAML file with its closed loops."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, TreeBuilder, XMLParser, fromstring, tostring

import numpy as np

from jumper_warp.robot.parts import Joint, Link, RobotDescription

LOOPS_HEADER = """\
# Loops of the robot {name}, which a URDF cannot hold. In each of them two points coincide, as in a ball joint.
# links: the bodies. joints: the URDF joints that move them, of which the loop determines the two knees.
# points: [m], each in the frame of its link, which is the frame of its joint's child in the URDF.
# At joint angles of 0 the loops are open. default_pose: joint angles [rad] that close them, standing.
"""


def urdf(robot: RobotDescription) -> str:
    """Return a description's URDF text with its present masses, inertias, joint origins and limits.

    XML comments are kept, shapes only if the description was made from this text.
    """
    root = fromstring(robot.urdf, XMLParser(target=TreeBuilder(insert_comments=True)))
    for element in root.findall("link"):
        link = robot.link(element.get("name", ""))
        _write_inertial(_child(element, "inertial"), link)
        if robot.table is not None:
            _write_shapes(element, link)
    for element in root.findall("joint"):
        joint = robot.joint(element.get("name", ""))
        _write_limit(_child(element, "limit"), joint)
        if robot.table is not None:
            _child(element, "origin").set("xyz", " ".join(repr(float(x)) for x in joint.origin))
            for end in ("lower", "upper"):
                _child(element, "limit").set(end, repr(float(getattr(joint, end))))
    return f'<?xml version="1.0"?>\n{tostring(root, encoding="unicode")}\n'


def _write_shapes(element: Element, link: Link) -> None:
    """Replace the shapes of a link's element. Those of a robot from a `robot.json` are upright or along x."""
    for shape in [*element.findall("visual"), *element.findall("collision")]:
        element.remove(shape)
    for tag, shapes in (("visual", link.visuals), ("collision", link.collisions)):
        for shape in shapes:
            child = SubElement(element, tag)
            turn = "0 1.5707963267948966 0" if abs(shape.rotation[1]) > 0.1 else "0 0 0"
            SubElement(child, "origin", xyz=" ".join(repr(float(x)) for x in shape.position), rpy=turn)
            names = {"box": ["size"], "cylinder": ["radius", "length"], "sphere": ["radius"]}[shape.kind]
            sizes = [" ".join(map(repr, shape.size))] if shape.kind == "box" else list(map(repr, shape.size))
            geometry = SubElement(child, "geometry")
            SubElement(geometry, shape.kind, dict(zip(names, sizes, strict=True)))


def _child(element: Element, tag: str) -> Element:
    """Return the first element with a tag inside an XML element of a checked URDF."""
    return next(element.iter(tag))


def _write_inertial(inertial: Element, link: Link) -> None:
    """Write a link's mass [kg], centre of mass [m] and moments of inertia [kg m^2] to its <inertial> element."""
    _child(inertial, "mass").set("value", repr(float(link.mass)))
    _child(inertial, "origin").set("xyz", " ".join(repr(float(x)) for x in link.com))
    moments = _child(inertial, "inertia")
    for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"):
        row, column = ("xyz".index(axis) for axis in key[1:])
        moments.set(key, repr(float(link.inertia[row, column])))


def _write_limit(limit: Element, joint: Joint) -> None:
    """Write a joint's torque limit [N m] and speed limit [rad/s] to its <limit> element."""
    limit.set("effort", repr(float(joint.effort)))
    limit.set("velocity", repr(float(joint.velocity)))


def loop_closures(robot: RobotDescription, pose: dict[str, float]) -> str:
    """Return a YAML text with the joints that close the robot's loops, and with its standing pose.

    pose: angle [rad] of each joint in the standing pose, by name.
    """
    moved_by = {joint.child: joint.name for joint in robot.joints}
    lines = [LOOPS_HEADER.format(name=robot.name) + "loops:"]
    for loop in robot.loops:
        lines += [
            f"  - name: {loop.name}",
            f"    links: [{loop.parent}, {loop.child}]",
            f"    joints: [{moved_by[loop.parent]}, {moved_by[loop.child]}]",
            f"    points: [{_numbers(loop.parent_anchor)}, {_numbers(loop.child_anchor)}]",
        ]
    lines += ["default_pose:", *(f"  {name}: {angle:.12g}" for name, angle in pose.items())]
    return "\n".join(lines) + "\n"


def _numbers(values: np.ndarray) -> str:
    """Return an array of numbers as the text of a YAML list."""
    return f"[{', '.join(f'{float(value):.12g}' for value in values)}]"
