"""Data classes of a robot description: one for each element of the URDF, and for loops and motors, which it lacks.

Link frames are parallel to the body's (x ahead, y left, z up) when all joint angles are 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

LEGS = ("FL", "FR", "BL", "BR")  # Legs in the order of every array: front left, front right, back left, back right

MOTOR_JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("lateral", "outer", "inner"))
"""The 12 motor joints in motor order: index 3 * leg + {0 lateral, 1 outer, 2 inner}."""


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangle mesh that an OBJ file holds."""

    vertices: np.ndarray  # (n, 3) [m], shape frame
    triangles: np.ndarray  # (m, 3) int32, indices of vertices
    file: Path  # OBJ file


@dataclass(frozen=True, eq=False)
class Shape:
    """Geometric shape fixed to a link, for viewers or for collision."""

    kind: str  # "box", "cylinder", "sphere" or "mesh"
    size: tuple[float, ...]  # [m] box: three full edges; cylinder (axis z): radius, length; sphere: radius; mesh: empty
    position: np.ndarray  # [m] (3,), link frame
    rotation: np.ndarray  # (4,) xyzw, shape to link frame
    color: tuple[float, float, float] | None = None  # red, green, blue, 0 to 1
    mesh: TriangleMesh | None = None


@dataclass(frozen=True, eq=False)
class Link:
    """Rigid body of the robot, with its mass and shapes."""

    name: str
    mass: float  # [kg]
    com: np.ndarray  # [m] (3,), link frame
    inertia: np.ndarray  # [kg m^2] (3, 3), about the centre of mass, axes of the link frame
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]  # a paw, on the inner shank alone


@dataclass(frozen=True, eq=False)
class Joint:
    """Hinge between two links. The child link's frame is at `origin` and parallel to the parent's at angle zero."""

    name: str
    parent: str  # name of the link
    child: str  # name of the link
    origin: np.ndarray  # [m] (3,), parent link frame
    axis: np.ndarray  # (3,) unit vector, parent link frame
    lower: float  # [rad] hard stop
    upper: float  # [rad] hard stop
    effort: float  # [N m] limit
    velocity: float  # [rad/s] limit


@dataclass(frozen=True, eq=False)
class Loop:
    """Joint that closes a kinematic loop of the robot: the two anchor points coincide."""

    name: str
    parent: str  # name of the link
    child: str  # name of the link
    parent_anchor: np.ndarray  # [m] (3,), parent link frame
    child_anchor: np.ndarray  # [m] (3,), child link frame


@dataclass(frozen=True)
class Gains:
    """Proportional and derivative gain of a motor's position control."""

    kp: float  # [N m/rad]
    kd: float  # [N m s/rad]


@dataclass(frozen=True)
class Motor:
    """Torque limits, speeds, friction, inertia and gains of one motor type, at the output of its gear."""

    type: str  # name, as "AK70-10"
    gear_ratio: float  # [1] rotor speed over output speed
    rotor_inertia: float  # [kg m^2], before the gear
    peak_torque: float  # [N m]
    cutoff_speed: float  # [rad/s] Speed up to which full torque is available
    no_load_speed: float  # [rad/s] Speed at which the torque has fallen linearly to 0
    coulomb_friction: float  # [N m]
    jumping: Gains  # for the jump tasks
    walking: Gains  # for the velocity tasks

    @property
    def armature(self) -> float:
        """Rotor inertia reflected through the gear [kg m^2]."""
        return self.rotor_inertia * self.gear_ratio**2


@dataclass(frozen=True)
class Hull:
    """Sizes of the capsules and the shell that collisions of links are tested with; the defaults are the Jumper's."""

    thigh_radius: float = 0.019  # [m]
    shank_radius: float = 0.012  # [m]
    housing_radius: float = 0.048  # [m]
    housing_length: float = 0.19  # [m] from the hip outward along the lateral axis
    shell: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """[1] Length, width and height of the body's shell as factors on the Jumper's."""


@dataclass(frozen=True, eq=False)
class RobotDescription:
    """Description of a robot: links, joints, loops, motors and poses; `dataclasses.replace` returns a changed copy."""

    urdf: str  # text of the URDF
    links: tuple[Link, ...]  # 21, body first, then leg by leg
    joints: tuple[Joint, ...]  # 20 hinges, leg by leg
    loops: tuple[Loop, ...]  # 4, in leg order
    motors: tuple[Motor, ...]  # 12, in motor order
    knee_damping: float
    """[N m s/rad], every knee."""
    knee_damping_limit: float
    """[N m] Largest torque of a knee's damping."""
    transversal_sum: tuple[float, float]
    """[rad] Lower and upper stop of the sum outer + inner angle of a leg."""
    poses: Mapping[str, tuple[float, float]]
    """(lateral, transversal) angle [rad] of every leg by name of the pose; outer and inner are both transversal."""
    name: str = "Jumper"
    spring: tuple[float, float] = (0.0, 0.0)
    """Stiffness [N/m], 0: none, and rest length [m] of a spring between the knees of each leg."""
    hull: Hull = Hull()
    table: Mapping[str, Any] | None = None
    """Content of the file `robot.json` that the description was made from; None: of a URDF."""

    @property
    def mass(self) -> float:
        """Total mass [kg]."""
        return math.fsum(link.mass for link in self.links)

    def link(self, name: str) -> Link:
        """Return a link by name. Raises KeyError."""
        return {link.name: link for link in self.links}[name]

    def joint(self, name: str) -> Joint:
        """Return a tree joint by name. Raises KeyError."""
        return {joint.name: joint for joint in self.joints}[name]

    def pose(self, name: str) -> np.ndarray:
        """Return the motor angles (12,) [rad] of a named pose, in motor order. Raises KeyError."""
        lateral, transversal = self.poses[name]
        return np.tile([lateral, transversal, transversal], 4)


def mesh_files(robot: RobotDescription) -> set[Path]:
    """Return the paths of all mesh files that a robot's visual shapes use."""
    return {shape.mesh.file for link in robot.links for shape in link.visuals if shape.mesh is not None}


def make_read_only(part: Any) -> None:
    """Make all arrays in a description, or in a part of it, read-only, in place."""
    if isinstance(part, np.ndarray):
        part.setflags(write=False)
    elif isinstance(part, tuple):
        for member in part:
            make_read_only(member)
    elif is_dataclass(part):
        make_read_only(tuple(vars(part).values()))
