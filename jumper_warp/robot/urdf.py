"""Strict reader of the URDF subset that the robot uses: hinge trees, inertia tensors, simple shapes, OBJ meshes."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

from jumper_warp.robot.parts import Joint, Link, RobotDescriptionError, Shape, TriangleMesh, description_error, require
from jumper_warp.utils.files import read_file

MAX_FILE_BYTES = 8 * 2**20
SHAPE_SIZES = {"box": ("size", 3), "cylinder": ("radius length", 1), "sphere": ("radius", 1)}
"""By tag of the shape: its attributes, and the count of numbers [m] in each."""


def read_text(file: Path) -> str:
    """Return the text of a UTF-8 file of at most MAX_FILE_BYTES. Raises RobotDescriptionError."""
    try:
        return read_file(file, "robot description", MAX_FILE_BYTES, description_error).decode("utf-8")
    except UnicodeDecodeError as err:
        raise RobotDescriptionError(file, "", f"expected UTF-8 text ({err.reason} at byte {err.start})") from err


def parse_xml(file: Path, text: str) -> Element:
    """Return the root element of an XML text; file: for messages. Raises RobotDescriptionError, also for a DOCTYPE."""
    builder = TreeBuilder()
    parser = expat.ParserCreate()

    def refuse_doctype(*_: object) -> None:
        raise RobotDescriptionError(file, f"line {parser.CurrentLineNumber}", "expected no document type or entities")

    parser.StartDoctypeDeclHandler = refuse_doctype
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    try:
        parser.Parse(text, True)
        return builder.close()
    except expat.ExpatError as err:
        problem = f"expected well-formed XML ({expat.ErrorString(err.code)})"
        raise RobotDescriptionError(file, f"line {err.lineno}", problem) from err
    except UnicodeError as err:
        raise RobotDescriptionError(file, "", "expected Unicode text") from err


class UrdfReader:
    """Reader of a URDF text's links and joints. Every method raises RobotDescriptionError on bad input.

    Parameters: element, an XML element; part, the place that an error message names, as "link body".
    """

    def __init__(self, file: Path, text: str):
        self.file = file
        self.root = parse_xml(file, text)
        self.require(self.root.tag == "robot", "", f"expected <robot>, found <{self.root.tag}>")
        self.meshes: dict[str, TriangleMesh] = {}  # by file name
        self.colors = {}  # (red, green, blue) by name of the material
        for material in self.root.findall("material"):
            color = self.child(material, "color", "material")
            self.colors[material.get("name")] = tuple(self.numbers(color, "rgba", 4, "material")[:3])

    def require(self, holds: bool, part: str, problem: str) -> None:
        """Raise RobotDescriptionError, which names this URDF file, unless `holds`; problem: text of the message."""
        require(holds, self.file, part, problem)

    def links(self) -> tuple[Link, ...]:
        """Read all links of the URDF, in file order."""
        return tuple(self.link(element) for element in self.named("link"))

    def joints(self) -> tuple[Joint, ...]:
        """Read all joints of the URDF, in file order."""
        return tuple(self.joint(element) for element in self.named("joint"))

    def named(self, tag: str) -> list[Element]:
        """Return the URDF's XML elements with a tag, such as all links; refuse missing or repeated names."""
        elements = self.root.findall(tag)
        for name, count in Counter(element.get("name") for element in elements).items():
            self.require(bool(name), tag, "expected a name")
            self.require(count == 1, f"{tag} {name}", f"expected one, found {count}")
        return elements

    def child(self, element: Element, tag: str, part: str) -> Element:
        """Return the only child of an XML element with a tag; refuse none or several."""
        children = element.findall(tag)
        self.require(len(children) == 1, part, f"expected one <{tag}>, found {len(children)}")
        return children[0]

    def numbers(self, element: Element, attribute: str, count: int, part: str, default: str = "") -> list[float]:
        """Return an XML attribute as a list of `count` finite numbers; default: text used if it is missing."""
        text = element.get(attribute, default)
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        problem = f"expected {count} finite number(s) in {attribute} of <{element.tag}>, found {text[:60]!r}"
        self.require(len(values) == count and all(map(math.isfinite, values)), part, problem)
        return values

    def placement(self, element: Element, part: str, may_rotate: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the position (3,) [m] and rotation (4,) xyzw of an element's <origin>; only shapes may be rotated."""
        if element.find("origin") is None:
            return np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        origin = self.child(element, "origin", part)
        angles = self.numbers(origin, "rpy", 3, part, default="0 0 0")
        self.require(
            may_rotate or not any(angles), part, "expected a frame parallel to its parent's, found rpy not zero"
        )
        self.require(max(map(abs, angles)) <= 2.0 * math.pi, part, f"expected rpy within a turn, found {angles}")
        return np.array(self.numbers(origin, "xyz", 3, part, default="0 0 0")), quat_from_rpy(*angles)

    def link(self, element: Element) -> Link:
        """Read a link from its <link> element, and check mass and inertia."""
        name = element.get("name", "")
        part = f"link {name}"
        inertial = self.child(element, "inertial", part)
        mass = self.numbers(self.child(inertial, "mass", part), "value", 1, part)[0]
        self.require(mass > 0.0, part, f"expected mass > 0, found {mass}")
        moments = self.child(inertial, "inertia", part)
        keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        ixx, iyy, izz, ixy, ixz, iyz = (self.numbers(moments, key, 1, part)[0] for key in keys)
        inertia = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        self.check_inertia(inertia, part)
        com = self.placement(inertial, part, may_rotate=False)[0]
        visuals = tuple(self.shape(shape, part) for shape in element.findall("visual"))
        collisions = tuple(self.shape(shape, part) for shape in element.findall("collision"))
        return Link(name, mass, com, inertia, visuals, collisions)

    def check_inertia(self, inertia: np.ndarray, part: str) -> None:
        """Raise RobotDescriptionError for an inertia tensor (3, 3) [kg m^2] that no mass distribution has."""
        self.require(np.abs(inertia).max() <= 1.0e6, part, "expected moments of inertia below 1e6 kg m^2")
        low, middle, high = np.linalg.eigvalsh(inertia)
        self.require(low > 0.0, part, f"expected a positive inertia, found a moment of {low:.3g}")
        problem = f"expected principal moments within the triangle inequality, found {low:.3g} {middle:.3g} {high:.3g}"
        self.require(low + middle >= high * (1.0 - 1.0e-9), part, problem)

    def joint(self, element: Element) -> Joint:
        """Read a hinge from its <joint> element, and check axis and limits."""
        name = element.get("name", "")
        part = f"joint {name}"
        kind = element.get("type")
        self.require(kind == "revolute", part, f"expected type revolute, found {kind}")
        parent, child = (self.child(element, tag, part).get("link") or "" for tag in ("parent", "child"))
        axis = np.array(self.numbers(self.child(element, "axis", part), "xyz", 3, part))
        length = np.linalg.norm(axis)
        self.require(bool(abs(length - 1.0) < 1.0e-6), part, f"expected an axis of length 1, found {axis.tolist()}")
        limit = self.child(element, "limit", part)
        keys = ("lower", "upper", "effort", "velocity")
        lower, upper, effort, velocity = (self.numbers(limit, key, 1, part)[0] for key in keys)
        self.require(lower < upper, part, f"expected lower < upper limit, found {lower} and {upper}")
        origin = self.placement(element, part, may_rotate=False)[0]
        return Joint(name, parent, child, origin, axis, lower, upper, effort, velocity)

    def shape(self, element: Element, part: str) -> Shape:
        """Read a shape from its <visual> or <collision> element."""
        geometry = self.child(element, "geometry", part)
        known = len(geometry) == 1 and geometry[0].tag in (*SHAPE_SIZES, "mesh")
        self.require(known, part, "expected one box, cylinder, sphere or mesh in <geometry>")
        kind = geometry[0].tag
        size = []
        mesh = None
        if kind == "mesh":
            mesh = self.mesh(geometry[0].get("filename", ""), part)
        else:
            keys, count = SHAPE_SIZES[kind]
            size = [value for key in keys.split() for value in self.numbers(geometry[0], key, count, part)]
        position, rotation = self.placement(element, part, may_rotate=True)
        material = element.find("material")
        color = None
        if material is not None:
            color = self.colors.get(name := material.get("name"))
            self.require(color is not None, part, f"unknown material {name}")
        return Shape(kind, tuple(size), position, rotation, color, mesh)

    def mesh(self, name: str, part: str) -> TriangleMesh:
        """Read a mesh from an OBJ file, named relative to the URDF's folder; each file is read once."""
        if name not in self.meshes:
            file = file_inside(self.file, name, part)
            self.require(file.suffix == ".obj", part, f"expected an .obj mesh, found {name!r}")
            self.meshes[name] = read_obj(file)
        return self.meshes[name]


def file_inside(source: Path, name: str, part: str) -> Path:
    """Return the path of a file that a robot file names, which must be inside the robot file's folder.

    Raises RobotDescriptionError.
    """
    folder = source.parent.resolve()
    try:
        file = (folder / name).resolve()
        exists = file.is_file()
    except (OSError, ValueError, RuntimeError) as err:
        raise RobotDescriptionError(source, part, f"{name!r} is not a file name") from err
    inside = ":" not in name and file.is_relative_to(folder)
    require(inside, source, part, f"expected a file inside {folder}, found {name!r}")
    require(exists, source, part, f"missing file {name!r}")
    return file


def read_obj(file: Path) -> TriangleMesh:
    """Read a triangle mesh from a Wavefront OBJ file of `v` and triangular `f` lines. Raises RobotDescriptionError."""
    vertices = []
    triangles = []
    for number, line in enumerate(read_text(file).splitlines(), start=1):
        word, *values = line.split() or [""]
        try:
            if word == "v":
                x, y, z = map(float, values)
                vertices.append((x, y, z))
            elif word == "f":
                a, b, c = (int(value) - 1 for value in values)
                triangles.append((a, b, c))
        except ValueError as err:
            raise RobotDescriptionError(file, f"line {number}", "expected 'v x y z' or 'f a b c'") from err
    flat = [index for triangle in triangles for index in triangle]
    between = bool(flat) and min(flat) >= 0 and max(flat) < len(vertices)
    require(between, file, "", f"expected triangles between the {len(vertices)} vertices")
    points = np.array(vertices)
    require(bool(np.isfinite(points).all()), file, "", "expected finite vertices")
    return TriangleMesh(points, np.array(triangles, dtype=np.int32), file)


def quat_from_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Convert a URDF's fixed-axis roll, pitch, yaw [rad] to a quaternion (4,) xyzw."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(0.5 * angle), math.sin(0.5 * angle)) for angle in (roll, pitch, yaw))
    x = sr * cp * cy - cr * sp * sy
    y = cr * sp * cy + sr * cp * sy
    return np.array([x, y, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy])
