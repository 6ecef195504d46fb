"""Helpers of all tasks to sample start states: foot positions, inverse kinematics of a leg, orientations.

A foot position is the ankle (the paw's centre) unless stated otherwise. Legs are FL, FR, BL, BR; body axes x ahead,
y left, z up. Motors are lateral (positive outward), outer and inner (positive away from the leg's other thigh).
"""

import warp as wp

from ..kinematics.geometry import LegGeometry
from ..kinematics.inverse import LegLimits, clamped_closed_form
from ..kinematics.leg import leg_forward_kinematics, leg_inverse_velocity
from .random import RngStream, uniform_range

wp.set_module_options({"enable_backward": False})

MAX_FOOT_ERROR = wp.constant(1.0e-4)  # [m] distance of a reachable foot from its requested position
MAX_LEG_SPEED = wp.constant(30.0)  # [rad/s] norm of the three motor rates of a leg
MIN_LINK_DISTANCE = wp.constant(0.005)  # [m] between links, and between links and the ground

PAW_X, PAW_Y = 20, 24  # Indices in the stream of an attempt, each the first of four: one a leg


@wp.struct
class LegSample:
    """Sampled motor angles and rates of one leg, and whether the sample is valid."""

    angles: wp.vec3  # [rad] of the lateral, outer and inner motor
    rates: wp.vec3  # [rad/s]
    reachable: bool  # whether angles and rates are within limits


@wp.func
def leg_ik(geo: LegGeometry, limits: LegLimits, ankle: wp.vec3) -> LegSample:
    """Return the motor angles, at rest, that bring a leg's ankle to a position (inverse kinematics).

    ankle [m]: position from the base origin, body axes.
    """
    sample = LegSample()
    angles = clamped_closed_form(geo, limits, ankle - geo.hip)
    sample.angles = angles
    sample.reachable = wp.length(leg_forward_kinematics(geo, angles[0], angles[1], angles[2]) - ankle) <= MAX_FOOT_ERROR
    return sample


@wp.func
def with_foot_velocity(geo: LegGeometry, leg: LegSample, ankle_vel: wp.vec3) -> LegSample:
    """Return `leg` with motor rates that move its ankle at `ankle_vel` [m/s] relative to the base (body axes)."""
    sample = leg
    sample.rates = leg_inverse_velocity(geo, leg.angles, ankle_vel)
    sample.reachable = leg.reachable and wp.length(sample.rates) <= MAX_LEG_SPEED
    return sample


@wp.func
def sample_foot_offset(
    rng: RngStream, leg: int, front_x: wp.vec2, front_y: wp.vec2, back_x: wp.vec2, back_y: wp.vec2
) -> wp.vec3:  # fmt: skip
    """Return a sampled foot position [m] of leg `leg` relative to the middle of the stance: x ahead, y left, z = 0.

    front_x, front_y, back_x, back_y [m]: ranges (lower, upper) of |x| and |y| of front and back legs.
    """
    x = uniform_range(rng, PAW_X + leg, front_x)
    y = uniform_range(rng, PAW_Y + leg, front_y)
    if leg >= 2:
        x = -uniform_range(rng, PAW_X + leg, back_x)
        y = uniform_range(rng, PAW_Y + leg, back_y)
    if leg % 2 == 1:
        y = -y
    return wp.vec3(x, y, 0.0)


@wp.func
def quat_from_ypr(yaw: float, pitch: float, roll: float) -> wp.quat:
    """Return the orientation (xyzw, body to world) of yaw, pitch and roll [rad]: Rz(yaw) Ry(pitch) Rx(roll).

    A positive pitch lowers the nose, a positive roll raises the left side.
    """
    return (
        wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
        * wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), pitch)
        * wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), roll)
    )
