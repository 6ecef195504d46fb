"""Data classes of a robot description, and the error for a bad one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.utils.errors import InputError

LEGS = ("FL", "FR", "BL", "BR")
"""Legs in the order of every array: front left, front right, back left, back right."""

MOTOR_JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("lateral", "outer", "inner"))
"""The 12 motor joints in motor order: index 3 * leg + {0 lateral, 1 outer, 2 inner}."""


class RobotDescriptionError(InputError):
    """A robot description that cannot be used. The message is one line: file, part, what was expected."""

    def __init__(self, file: Path, part: str, problem: str):
        place = f"{file}: {part}" if part else f"{file}"
        super().__init__(" ".join(f"{place}: {problem}".split()))


def require(holds: bool, file: Path, part: str, problem: str) -> None:
    """Raise RobotDescriptionError unless a condition holds."""
    if not holds:
        raise RobotDescriptionError(file, part, problem)


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh: vertices [m] (n, 3) and indices (m, 3)."""

    vertices: np.ndarray
    triangles: np.ndarray


@dataclass(frozen=True, eq=False)
class Shape:
    """A piece of geometry fixed to a link."""

    kind: str
    """"box", "cylinder", "sphere" or "mesh"."""
    size: tuple[float, ...]
    """[m] box: full edges; cylinder (axis z): radius, length; sphere: radius; mesh: empty."""
    position: np.ndarray
    """[m] (3,), link frame."""
    rotation: np.ndarray
    """(4,) xyzw, shape to link frame."""
    color: tuple[float, float, float] | None = None
    mesh: TriangleMesh | None = None


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid body."""

    name: str
    mass: float
    """[kg]"""
    com: np.ndarray
    """[m] (3,), link frame."""
    inertia: np.ndarray
    """[kg m^2] (3, 3), about the centre of mass, axes of the link frame."""
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]


@dataclass(frozen=True, eq=False)
class Joint:
    """A hinge. The child link's frame sits at `origin` and is parallel to the parent's at angle zero."""

    name: str
    parent: str
    child: str
    origin: np.ndarray
    """[m] (3,), parent link frame."""
    axis: np.ndarray
    """(3,) unit vector, parent link frame."""
    lower: float
    """[rad]"""
    upper: float
    """[rad]"""
    effort: float
    """[N m]"""
    velocity: float
    """[rad/s]"""


@dataclass(frozen=True, eq=False)
class Loop:
    """A joint that closes a loop: the two anchor points coincide."""

    name: str
    parent: str
    child: str
    parent_anchor: np.ndarray
    """[m] (3,), parent link frame."""
    child_anchor: np.ndarray
    """[m] (3,), child link frame."""


@dataclass(frozen=True)
class Gains:
    """Gains of a motor's position control."""

    kp: float
    """[N m/rad]"""
    kd: float
    """[N m s/rad]"""


@dataclass(frozen=True)
class Motor:
    """Constants of one motor type, at the output of its gear."""

    type: str
    gear_ratio: float
    rotor_inertia: float
    """[kg m^2], before the gear."""
    peak_torque: float
    """[N m]"""
    cutoff_speed: float
    """[rad/s] Speed up to which full torque is available."""
    no_load_speed: float
    """[rad/s] Speed at which the torque has fallen linearly to 0."""
    coulomb_friction: float
    """[N m]"""
    jumping: Gains
    walking: Gains

    @property
    def armature(self) -> float:
        """Rotor inertia reflected through the gear [kg m^2]."""
        return self.rotor_inertia * self.gear_ratio**2


@dataclass(frozen=True, eq=False)
class RobotDescription:
    """Robot independent of a simulator: links, joints, loops, motors and poses; `dataclasses.replace` modifies it."""

    path: Path
    """The description file."""
    urdf_path: Path
    urdf: str
    """Text of the tree's URDF."""
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    loops: tuple[Loop, ...]
    motors: tuple[Motor, ...]
    """12, in motor order."""
    knee_damping: float
    """[N m s/rad], every knee."""
    knee_damping_limit: float
    """[N m] Largest torque of a knee's damping."""
    transversal_sum: tuple[float, float]
    """[rad] Stops of outer plus inner angle of a leg."""
    poses: Mapping[str, tuple[float, float]]
    """Named poses: lateral and transversal angle [rad], the same for every leg."""

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
        """Return the 12 motor angles [rad] of a named pose. Raises KeyError."""
        lateral, transversal = self.poses[name]
        return np.tile([lateral, transversal, transversal], 4)


def make_read_only(part: Any) -> None:
    """Make the arrays of a description, or of a part of it, read-only."""
    if isinstance(part, np.ndarray):
        part.setflags(write=False)
    elif isinstance(part, tuple):
        for each in part:
            make_read_only(each)
    elif is_dataclass(part):
        make_read_only(tuple(vars(part).values()))
