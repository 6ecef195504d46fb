"""Dimensions of a leg, and knee angles that close its loop.

Two thighs and two shanks form a planar loop (five-bar): the motors set both thigh angles, and the knees follow. Thigh
angles are positive away from the other thigh, 0 straight down. The outer thigh is farther from the body's middle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from jumper_warp.robot.parts import LEGS, RobotDescription
from jumper_warp.utils.errors import InputError


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
    shank: float  # [m] inner knee to ankle
    paw_radius: float  # [m]
    outer_shank: float  # [m] outer knee to ankle
    paw_offset: float  # [m] ankle to centre of the paw, along the inner shank
    thigh_radius: float  # [m] of the capsules that collisions are tested with, as the next ones
    shank_radius: float  # [m]
    housing_radius: float  # [m]
    housing_length: float  # [m]
    shell: tuple[float, float, float]  # [1] see `Hull`

    def depth(self, lateral: float, transversal: float) -> float:
        """Return the depth [m] of the paw's lowest point below the hip of a level base; angles [rad] of the motors.

        Raises InputError: the loop cannot be closed.
        """
        paw_y = self.plane_y + self.knee_y
        paw_z = knee_angles(self, transversal, transversal)[2]
        return self.paw_radius - math.cos(lateral) * paw_z - self.side * math.sin(lateral) * paw_y


def leg_dimensions(description: RobotDescription, leg: str) -> LegDimensions:
    """Return the dimensions of one leg ("FL", "FR", "BL" or "BR"), from the origins of its joints."""
    lateral, outer, inner = (description.joint(f"{leg}_{name}").origin for name in ("lateral", "outer", "inner"))
    knee = description.joint(f"{leg}_outer_knee").origin
    loop = description.loops[LEGS.index(leg)]
    paw = description.link(f"{leg}_inner_shank").collisions[0]
    shank = -float(loop.parent_anchor[2])
    return LegDimensions(
        hip=(float(lateral[0]), float(lateral[1]), float(lateral[2])),
        front=math.copysign(1.0, lateral[0]),
        side=math.copysign(1.0, lateral[1]),
        outer_x=float(outer[0]),
        inner_x=float(inner[0]),
        plane_y=float(outer[1]),
        knee_y=float(knee[1]),
        thigh=-float(knee[2]),
        shank=shank,
        paw_radius=paw.size[0],
        outer_shank=-float(loop.child_anchor[2]),
        paw_offset=-float(paw.position[2]) - shank,
        **vars(description.hull),
    )


def knee_angles(leg: LegDimensions, outer: float, inner: float) -> tuple[float, float, float]:
    """Return the outer and inner knee angles [rad] that close a leg's loop at given thigh angles, and the paw's z [m].

    outer, inner: thigh angles [rad]. The ankle is the lower intersection of two circles about the knees, with the
    shanks as radii. z, and points (x, z) [m] below, are in the housing frame (see `LegDimensions`). Raises InputError
    where the circles do not intersect.
    """
    outer_knee = np.array([leg.outer_x + leg.front * leg.thigh * math.sin(outer), -leg.thigh * math.cos(outer)])
    inner_knee = np.array([leg.inner_x - leg.front * leg.thigh * math.sin(inner), -leg.thigh * math.cos(inner)])
    span = outer_knee - inner_knee
    distance = math.hypot(*span)
    if not max(1.0e-6, abs(leg.outer_shank - leg.shank)) < distance < leg.outer_shank + leg.shank:
        shanks = f"shanks of {leg.outer_shank:g} and {leg.shank:g} m"
        raise InputError(f"{shanks} cannot connect knees {distance:.4f} m apart")
    skew = (
        0.5 * (leg.shank**2 - leg.outer_shank**2) / distance**2
    )  # of the ankle from the middle, toward the outer knee
    rise = math.sqrt(leg.shank**2 - (0.25 + skew + skew**2) * distance**2) / distance
    ankle = 0.5 * (outer_knee + inner_knee) + skew * span + leg.front * rise * np.array([span[1], -span[0]])
    paw = ankle + leg.paw_offset / leg.shank * (ankle - inner_knee)
    # tilt of each shank from -z toward +front
    outer_tilt, inner_tilt = (
        math.atan2(leg.front * (ankle - knee)[0], -(ankle - knee)[1]) for knee in (outer_knee, inner_knee)
    )
    return outer - outer_tilt, inner + inner_tilt, float(paw[1])
