"""Momentum of a robot in free flight, and its correction to what it was before some steps.

The step is semi-implicit Euler, whose momentum drifts by an error of first order while legs move. In free flight, with
no paw down and no wrench from outside, the right momentum is known: the angular one about the centre of mass stays, the
linear one grows by m g t. The correction changes the base's twist alone, as an impulse on a robot with locked joints.
"""

import warp as wp

from ..layout import BASE, BODIES, GRAVITY
from ..scalar import real, vec3
from ..state import BaseState, base_com, leg_coord, leg_dof, load_base, load_motors, store_base
from .inertia import MassMoments, inertia_matrix, inertia_mul, inverse_symmetric
from .leg_dynamics import leg_dynamics, leg_pose
from .parameters import load_moments, load_vec3
from .step import Robot, load_leg

wp.set_module_options({"enable_backward": False})


@wp.struct
class Motion:
    """Mass moments and momentum of a robot, body axes."""

    body: MassMoments  # of the whole robot about the base origin
    lin: vec3  # [kg m/s]
    ang: vec3  # [kg m^2/s] about the robot's centre of mass


@wp.struct
class Momenta:
    """Momenta of all worlds, world axes, shape (num_worlds,)."""

    lin: wp.array(dtype=vec3)  # [kg m/s]
    ang: wp.array(dtype=vec3)  # [kg m^2/s] about the robot's centre of mass


@wp.func
def motion_of(
    robot: Robot, world: int, base: BaseState, joint_q: wp.array(dtype=real), joint_qd: wp.array(dtype=real)
) -> Motion:  # fmt: skip
    """Return a robot's mass moments and momentum."""
    motion = Motion()
    body = load_moments(robot.table, BASE, world)
    for k in range(robot.geometry.shape[0]):
        own = load_leg(robot, world, k)
        rates = load_motors(joint_qd, leg_dof(world, k))
        pose = leg_pose(own.geometry, load_motors(joint_q, leg_coord(world, k)))
        leg = leg_dynamics(own.geometry, own.masses, pose, rates, base.ang, vec3(real(0.0)))
        body.mass += leg.body.mass
        body.first += leg.body.first
        body.second += leg.body.second
        motion.lin += leg.coupling_lin * rates
        motion.ang += leg.coupling_ang * rates
    velocity = wp.quat_rotate_inv(base.quat, base.lin)
    motion.body = body
    motion.lin += body.mass * velocity - wp.cross(body.first, base.ang)
    motion.ang += wp.cross(body.first, velocity) + inertia_mul(body.second, base.ang)
    motion.ang -= wp.cross(body.first, motion.lin) / body.mass  # from the origin to the centre of mass
    return motion


@wp.func
def corrected(base: BaseState, motion: Motion, lin: vec3, ang: vec3) -> BaseState:
    """Return the base with the twist that gives the robot a momentum lin [kg m/s], ang [kg m^2/s], world axes."""
    mass = motion.body.mass
    com = motion.body.first / mass
    # about the centre of mass: I - m (c.c 1 - c c^T)
    inertia = inertia_matrix(motion.body.second) - mass * (
        wp.dot(com, com) * wp.identity(n=3, dtype=real) - wp.outer(com, com)
    )
    turn = inverse_symmetric(inertia) * (wp.quat_rotate_inv(base.quat, ang) - motion.ang)
    push = (wp.quat_rotate_inv(base.quat, lin) - motion.lin) / mass
    new = base
    new.ang = base.ang + turn
    new.lin = base.lin + wp.quat_rotate(base.quat, push - wp.cross(turn, com))
    return new


@wp.kernel
def momentum_kernel(
    # in
    first: int,
    robot: Robot,
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    # out
    momenta: Momenta,
):
    """Write the momentum of every robot; one thread per world."""
    world = first + wp.tid()
    base = load_base(joint_q, joint_qd, base_com(robot.table, world), world)
    motion = motion_of(robot, world, base, joint_q, joint_qd)
    momenta.lin[world] = wp.quat_rotate(base.quat, motion.lin)
    momenta.ang[world] = wp.quat_rotate(base.quat, motion.ang)


@wp.kernel
def project_momentum_kernel(
    # in
    first: int,
    robot: Robot,
    momenta: Momenta,
    body_f: wp.array(dtype=wp.spatial_vector),
    peak_force: wp.array(dtype=real),
    invalid: wp.array(dtype=int),
    time: real,
    # in, out
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
):
    """Give robots that flew freely for a time [s] the momentum that theirs of before has become; one thread per world.

    body_f: wrenches of that time. peak_force [N]: largest on the paws in it.
    """
    world = first + wp.tid()
    if invalid[world] != 0 or peak_force[world] > real(0.0) or wp.length_sq(body_f[world * BODIES]) > 0.0:
        return
    if robot.held.shape[0] > 0:
        if robot.held[world] != 0:
            return
    com = base_com(robot.table, world)
    base = load_base(joint_q, joint_qd, com, world)
    motion = motion_of(robot, world, base, joint_q, joint_qd)
    lin = momenta.lin[world] + time * motion.body.mass * load_vec3(robot.table, GRAVITY, world)
    store_base(joint_q, joint_qd, com, world, corrected(base, motion, lin, momenta.ang[world]))
