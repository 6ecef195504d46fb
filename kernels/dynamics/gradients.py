"""Where the reverse pass of a rollout adds up its gradients."""

import warp as wp

from ..actuation.command_filter import FilterParams, Limits
from ..actuation.joint_forces import JointParams
from ..actuation.motors import MotorArrays, MotorParams
from ..kinematics.geometry import LegGeometry
from ..layout import (
    ARMATURE,
    BASE,
    DAMPING,
    FRICTION,
    HOUSING,
    INNER_SHANK,
    INNER_THIGH,
    KNEE_DAMPING,
    KNEE_LIMIT,
    LEG_ROWS,
    LOWER,
    OUTER_SHANK,
    OUTER_THIGH,
    STOP_KD,
    STOP_KE,
    SUM_LOWER,
    SUM_UPPER,
    UPPER,
)
from ..scalar import real, vec3
from .inertia import MassMoments
from .leg_dynamics import LegMasses
from .rollout import FILTER_HORIZON, FILTER_SPEED

wp.set_module_options({"enable_backward": False})

# rows of a leg's geometry: hip (3), then the lengths in the order of `LegGeometry`, its signs left out
GEOMETRY_ROWS = wp.constant(10)


@wp.struct
class Gradients:
    """Gradients of one number by everything that a rollout read, per world; zero them first."""

    q: wp.array2d(dtype=real)  # of row 0, (ROW_COORDS, num_worlds)
    qd: wp.array2d(dtype=real)  # (ROW_RATES, num_worlds)
    target: wp.array3d(dtype=real)  # (T, 12, num_worlds)
    before: wp.array2d(dtype=real)  # (12, num_worlds)
    wrench: wp.array3d(dtype=real)  # (T, 6, num_worlds)
    safe: wp.array3d(dtype=real)  # of the filtered targets, (T, 12, num_worlds)
    motors: MotorArrays  # fades aside
    fade: wp.array2d(dtype=real)  # (2, num_worlds)
    latency: wp.array(dtype=real)  # (num_worlds,)
    limits: wp.array2d(dtype=real)  # (FILTER_ROWS, num_worlds)
    table: wp.array2d(dtype=real)  # (PARAMETER_ROWS, num_worlds)
    geometry: wp.array2d(dtype=real)  # (4 GEOMETRY_ROWS, num_worlds)


@wp.func
def add_entry(table: wp.array2d(dtype=real), row: int, world: int, x: real):
    """Add a number."""
    table[row, world] = table[row, world] + x


@wp.func
def add_vec3(table: wp.array2d(dtype=real), row: int, world: int, v: vec3):
    """Add a vector to three rows."""
    for i in range(3):
        table[row + i, world] = table[row + i, world] + v[i]


@wp.func
def add_moments(table: wp.array2d(dtype=real), row: int, world: int, m: MassMoments):
    """Add the gradient by a link's mass moments."""
    add_entry(table, row, world, m.mass)
    add_vec3(table, row + 1, world, m.first)
    for i in range(6):
        table[row + 4 + i, world] = table[row + 4 + i, world] + m.second[i]


@wp.func
def add_masses(table: wp.array2d(dtype=real), leg: int, world: int, masses: LegMasses):
    """Add the gradient by the mass moments of a leg."""
    row = leg * LEG_ROWS
    add_moments(table, row + HOUSING, world, masses.housing)
    add_moments(table, row + OUTER_THIGH, world, masses.outer_thigh)
    add_moments(table, row + OUTER_SHANK, world, masses.outer_shank)
    add_moments(table, row + INNER_THIGH, world, masses.inner_thigh)
    add_moments(table, row + INNER_SHANK, world, masses.inner_shank)


@wp.func
def add_joints(table: wp.array2d(dtype=real), leg: int, world: int, p: JointParams):
    """Add the gradient by the joint-space parameters of a leg."""
    row = leg * LEG_ROWS
    add_vec3(table, row + ARMATURE, world, p.armature)
    add_vec3(table, row + FRICTION, world, p.friction)
    add_vec3(table, row + DAMPING, world, p.damping)
    add_entry(table, row + KNEE_DAMPING, world, p.knee_damping_outer)
    add_entry(table, row + KNEE_DAMPING + 1, world, p.knee_damping_inner)
    add_entry(table, row + KNEE_LIMIT, world, p.knee_limit_outer)
    add_entry(table, row + KNEE_LIMIT + 1, world, p.knee_limit_inner)
    add_vec3(table, row + LOWER, world, p.lower)
    add_vec3(table, row + UPPER, world, p.upper)
    add_entry(table, row + SUM_LOWER, world, p.sum_lower)
    add_entry(table, row + SUM_UPPER, world, p.sum_upper)
    add_entry(table, row + STOP_KE, world, p.stop_ke)
    add_entry(table, row + STOP_KD, world, p.stop_kd)


@wp.func
def add_geometry(table: wp.array2d(dtype=real), leg: int, world: int, geo: LegGeometry):
    """Add the gradient by a leg's lengths."""
    row = leg * GEOMETRY_ROWS
    add_vec3(table, row, world, geo.hip)
    add_entry(table, row + 3, world, geo.outer_x)
    add_entry(table, row + 4, world, geo.inner_x)
    add_entry(table, row + 5, world, geo.plane_y)
    add_entry(table, row + 6, world, geo.knee_y)
    add_entry(table, row + 7, world, geo.thigh)
    add_entry(table, row + 8, world, geo.shank)
    add_entry(table, row + 9, world, geo.paw_radius)


@wp.func
def add_com(table: wp.array2d(dtype=real), world: int, mass: real, com: vec3, gradient: vec3):
    """Add a gradient by the base's centre of mass [m], the ratio of its first moment and its mass [kg]."""
    add_entry(table, BASE, world, -wp.dot(gradient, com) / mass)
    add_vec3(table, BASE + 1, world, gradient / mass)


@wp.func
def add_motor(gradients: Gradients, motor: int, world: int, scale: real, p: MotorParams):
    """Add `scale` times a gradient by a motor's constants."""
    g = gradients.motors
    add_entry(g.kp, motor, world, scale * p.kp)
    add_entry(g.kd, motor, world, scale * p.kd)
    add_entry(g.saturation, motor, world, scale * p.saturation)
    add_entry(g.peak, motor, world, scale * p.peak)
    add_entry(g.cutoff_speed, motor, world, scale * p.cutoff_speed)
    add_entry(g.no_load_speed, motor, world, scale * p.no_load_speed)
    add_entry(g.offset, motor, world, scale * p.offset)
    add_entry(gradients.fade, 0, world, scale * p.fade_start)
    add_entry(gradients.fade, 1, world, scale * p.fade_end)


@wp.func
def add_limits(table: wp.array2d(dtype=real), row: int, world: int, limits: Limits):
    """Add the gradient by one quantity's limits; hard zones only switch."""
    add_entry(table, row, world, limits.lower)
    add_entry(table, row + 1, world, limits.upper)


@wp.func
def add_filter(table: wp.array2d(dtype=real), world: int, p: FilterParams):
    """Add the gradient by the filter's constants."""
    add_limits(table, 0, world, p.lateral)
    add_limits(table, 4, world, p.transversal)
    add_limits(table, 8, world, p.sum)
    add_entry(table, FILTER_HORIZON, world, p.horizon)
    add_entry(table, FILTER_SPEED, world, p.speed_floor)
