"""Drawn starts of an episode, as attempts: what a leg must do, what may not touch, and which attempt is taken.

Threads of a world share legs and attempts, see `attempts`; each writes to coordinates of its own until one is taken.
"""

import warp as wp

from ..collision.robot import leg_collisions
from ..kinematics.geometry import LegGeometry
from ..kinematics.inverse import LegLimits, clamped_closed_form
from ..kinematics.leg import leg_forward_kinematics, leg_inverse_velocity
from ..layout import COORDS, DOFS
from ..state import leg_coord, leg_dof, load_motors, store_motors
from ..terrain.ground import Ground
from .attempts import ATTEMPTS, all_legs, first_leg, leg_step, meet_attempts, of_leg, taken_first
from .random import Draw, within

wp.set_module_options({"enable_backward": False})

MISS = wp.constant(1.0e-4)  # [m] by which a paw may miss its place
FASTEST = wp.constant(30.0)  # [rad/s] norm of a leg's motor rates
APART = wp.constant(0.005)  # [m] least between links


@wp.struct
class LegDraw:
    """A drawn leg."""

    angles: wp.vec3  # [rad] of the motors
    rates: wp.vec3  # [rad/s]
    possible: bool  # whether it can be so


@wp.func
def leg_to(geo: LegGeometry, limits: LegLimits, ankle: wp.vec3) -> LegDraw:
    """Return the leg at rest with its ankle in a place [m], body axes."""
    found = LegDraw()
    angles = clamped_closed_form(geo, limits, ankle - geo.hip)
    found.angles = angles
    found.possible = wp.length(leg_forward_kinematics(geo, angles[0], angles[1], angles[2]) - ankle) <= MISS
    return found


@wp.func
def leg_over_ground(geo: LegGeometry, leg: LegDraw, ankle_vel: wp.vec3) -> LegDraw:
    """Return a leg whose ankle moves relative to the base [m/s], body axes."""
    found = leg
    found.rates = leg_inverse_velocity(geo, leg.angles, ankle_vel)
    found.possible = leg.possible and wp.length(found.rates) <= FASTEST
    return found


@wp.func
def place_beside(
    draw: Draw, leg: int, front_x: wp.vec2, front_y: wp.vec2, back_x: wp.vec2, back_y: wp.vec2
) -> wp.vec3:  # fmt: skip
    """Return a paw's place [m] relative to the spot that the paws surround, z = 0; ranges of absolute values."""
    x = within(draw, 20 + leg, front_x)
    y = within(draw, 24 + leg, front_y)
    if leg >= 2:
        x = -within(draw, 20 + leg, back_x)
        y = within(draw, 24 + leg, back_y)
    if leg % 2 == 1:
        y = -y
    return wp.vec3(x, y, 0.0)


@wp.func
def turn_of(yaw: float, pitch: float, roll: float) -> wp.quat:
    """Return an orientation (xyzw), body to world: roll first, yaw last [rad]."""
    return (
        wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
        * wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), pitch)
        * wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), roll)
    )


@wp.func
def store_base(
    pos: wp.vec3, quat: wp.quat, com_vel: wp.vec3, ang_vel: wp.vec3, joint_q: wp.array(dtype=float),
    joint_qd: wp.array(dtype=float),
):  # fmt: skip
    """Write the base's pose, and the velocity of its COM [m/s] and its angular velocity [rad/s], world axes."""
    for j in range(3):
        joint_q[j] = pos[j]
        joint_qd[j] = com_vel[j]
        joint_qd[3 + j] = ang_vel[j]
    for j in range(4):
        joint_q[3 + j] = quat[j]


@wp.func
def store_leg(leg: int, drawn: LegDraw, joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float)):
    """Write a leg."""
    store_motors(joint_q, leg_coord(0, leg), drawn.angles)
    store_motors(joint_qd, leg_dof(0, leg), drawn.rates)


@wp.func
def legs_fit(
    geometry: wp.array(dtype=LegGeometry), ground: Ground, draw: Draw, own: LegDraw, possible: bool,
    joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
) -> bool:  # fmt: skip
    """Return whether an attempt can be taken, and complete its coordinates by the legs of other threads.

    own: the leg that a thread has drawn, if it is one of several; possible: whether its legs can be so.
    """
    fits = all_legs(draw, possible)
    if draw.lanes == 1 and not fits:
        return False  # several threads go on together
    if draw.lanes > 1:
        other = LegDraw()
        for leg in range(geometry.shape[0]):
            other.angles = of_leg(draw, own.angles, leg)
            other.rates = of_leg(draw, own.rates, leg)
            store_leg(leg, other, joint_q, joint_qd)
    flags = int(0)
    for turn in range(first_leg(draw), geometry.shape[0], leg_step(draw)):
        flags = flags | leg_collisions(geometry, ground, joint_q, 0, turn, APART)
    return all_legs(draw, fits and flags == 0)


@wp.func
def keep_first(
    geometry: wp.array(dtype=LegGeometry), draw: Draw, taken: int, own_q: wp.array(dtype=float),
    own_qd: wp.array(dtype=float), joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
) -> bool:  # fmt: skip
    """Write the first attempt that could be taken to the coordinates of all worlds; returns whether there is one.

    taken: by this thread, `ATTEMPTS` if none.
    """
    first = taken_first(draw, taken)
    if taken == first and first < ATTEMPTS and first_leg(draw) == 0:
        for i in range(7):
            joint_q[draw.world * COORDS + i] = own_q[i]
        for i in range(6):
            joint_qd[draw.world * DOFS + i] = own_qd[i]
        for leg in range(geometry.shape[0]):
            store_motors(joint_q, leg_coord(draw.world, leg), load_motors(own_q, leg_coord(0, leg)))
            store_motors(joint_qd, leg_dof(draw.world, leg), load_motors(own_qd, leg_dof(0, leg)))
    meet_attempts(draw)
    return first < ATTEMPTS
