"""Reader of the URDF subset that the robot uses: hinge trees, inertia tensors, simple shapes, OBJ meshes."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from jumper_warp.robot.parts import Joint, Link, Shape, TriangleMesh

SHAPE_SIZES = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",), "mesh": ()}
"""Attributes [m] by tag of the shape."""


class UrdfReader:
    """Reader of a URDF file's links and joints."""

    def __init__(self, file: Path):
        """Read and parse the file, and the colours of its materials, which shapes name."""
        self.file = file
        self.text = file.read_text(encoding="utf-8")
        self.root = ElementTree.fromstring(self.text)
        self.meshes: dict[str, TriangleMesh] = {}  # by file name
        self.colors = {}  # (red, green, blue) by name of the material
        for material in self.root.findall("material"):
            self.colors[material.get("name")] = tuple(numbers(child(material, "color"), "rgba")[:3])

    def links(self) -> tuple[Link, ...]:
        """Read all links of the URDF, in file order."""
        return tuple(self.link(element) for element in self.root.findall("link"))

    def joints(self) -> tuple[Joint, ...]:
        """Read all joints of the URDF, which are hinges, in file order."""
        return tuple(read_joint(element) for element in self.root.findall("joint"))

    def link(self, element: Element) -> Link:
        """Read a link from its <link> element."""
        inertial = child(element, "inertial")
        moments = child(inertial, "inertia")
        keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        ixx, iyy, izz, ixy, ixz, iyz = (float(moments.attrib[key]) for key in keys)
        inertia = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        visuals = tuple(self.shape(shape) for shape in element.findall("visual"))
        collisions = tuple(self.shape(shape) for shape in element.findall("collision"))
        mass = float(child(inertial, "mass").attrib["value"])
        return Link(element.attrib["name"], mass, placement(inertial)[0], inertia, visuals, collisions)

    def shape(self, element: Element) -> Shape:
        """Read a shape from its <visual> or <collision> element."""
        (geometry,) = child(element, "geometry")
        size = tuple(value for key in SHAPE_SIZES[geometry.tag] for value in numbers(geometry, key))
        mesh = self.mesh(geometry.attrib["filename"]) if geometry.tag == "mesh" else None
        material = element.find("material")
        color = None if material is None else self.colors[material.get("name")]
        return Shape(geometry.tag, size, *placement(element), color, mesh)

    def mesh(self, name: str) -> TriangleMesh:
        """Read a mesh from an OBJ file, named relative to the URDF's folder; each file is read once."""
        if name not in self.meshes:
            self.meshes[name] = read_obj(self.file.parent.resolve() / name)
        return self.meshes[name]


def read_joint(element: Element) -> Joint:
    """Read a hinge from its <joint> element."""
    parent, link = (child(element, tag).attrib["link"] for tag in ("parent", "child"))
    axis = np.array(numbers(child(element, "axis"), "xyz"))
    limit = child(element, "limit")
    limits = (float(limit.attrib[key]) for key in ("lower", "upper", "effort", "velocity"))
    return Joint(element.attrib["name"], parent, link, placement(element)[0], axis, *limits)


def child(element: Element, tag: str) -> Element:
    """Return the only child of an XML element with a tag. Raises ValueError: there is none, or there are several."""
    (found,) = element.findall(tag)
    return found


def numbers(element: Element, attribute: str, default: str = "") -> list[float]:
    """Return an XML attribute as a list of numbers; default: text used if it is missing."""
    return [float(word) for word in element.get(attribute, default).split()]


def placement(element: Element) -> tuple[np.ndarray, np.ndarray]:
    """Return the position (3,) [m] and rotation (4,) xyzw of an element's <origin>."""
    origin = element.find("origin")
    if origin is None:
        return np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    return np.array(numbers(origin, "xyz", "0 0 0")), quat_from_rpy(*numbers(origin, "rpy", "0 0 0"))


def read_obj(file: Path) -> TriangleMesh:
    """Read a triangle mesh from a Wavefront OBJ file of `v` and triangular `f` lines."""
    rows = [line.split() for line in file.read_text(encoding="utf-8").splitlines()]
    vertices = np.array([row[1:] for row in rows if row[:1] == ["v"]], dtype=float)
    triangles = np.array([row[1:] for row in rows if row[:1] == ["f"]], dtype=np.int32) - 1
    return TriangleMesh(vertices, triangles, file)


def quat_from_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Convert a URDF's fixed-axis roll, pitch, yaw [rad] to a quaternion (4,) xyzw."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(0.5 * angle), math.sin(0.5 * angle)) for angle in (roll, pitch, yaw))
    x = sr * cp * cy - cr * sp * sy
    y = cr * sp * cy + sr * cp * sy
    return np.array([x, y, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy])
