"""Momentum of a robot, and correction of its base's velocity in free flight that restores the exact momentum.

Semi-implicit Euler has a first-order drift of momentum while legs move. In free flight, with no paw down and no
external wrench, the exact momentum is known: angular momentum about the centre of mass is constant, linear momentum
grows by m g t. The correction changes the base's twist only, like an impulse on a robot with locked joints.
"""

import warp as wp

from ..layout import BASE, BODIES, GRAVITY
from ..scalar import real, vec3
from ..state import BaseState, base_com, leg_coord, leg_dof, load_base, load_motors, store_base
from .inertia import MassMoments, inertia_matrix, inertia_mul, inverse_symmetric
from .leg_dynamics import leg_dynamics, leg_pose
from .parameters import load_moments, load_vec3
from .step import RobotModel, load_leg

wp.set_module_options({"enable_backward": False})


@wp.struct
class RobotMomentum:
    """Mass, moments of mass, and linear and angular momentum of a robot, body axes."""

    body: MassMoments  # of the whole robot about the base origin
    lin: vec3  # [kg m/s]
    ang: vec3  # [kg m^2/s] about the robot's centre of mass


@wp.struct
class Momenta:
    """Linear and angular momentum of every robot, world axes, arrays (num_worlds,)."""

    lin: wp.array(dtype=vec3)  # [kg m/s]
    ang: wp.array(dtype=vec3)  # [kg m^2/s] about the robot's centre of mass


@wp.func
def robot_momentum(
    model: RobotModel, world: int, base: BaseState, joint_q: wp.array(dtype=real), joint_qd: wp.array(dtype=real)
) -> RobotMomentum:  # fmt: skip
    """Return a robot's mass moments and momentum, body axes; joint_q, joint_qd: Newton's, flat over worlds."""
    momentum = RobotMomentum()
    body = load_moments(model.table, BASE, world)
    legs = wp.int32(4)
    for k in range(legs):
        params = load_leg(model, world, k)
        rates = load_motors(joint_qd, leg_dof(world, k))
        pose = leg_pose(params.geometry, load_motors(joint_q, leg_coord(world, k)))
        leg = leg_dynamics(params.geometry, params.masses, pose, rates, base.ang, vec3(real(0.0)))
        body.mass += leg.body.mass
        body.first += leg.body.first
        body.second += leg.body.second
        momentum.lin += leg.coupling_lin * rates
        momentum.ang += leg.coupling_ang * rates
    velocity = wp.quat_rotate_inv(base.quat, base.lin)
    momentum.body = body
    momentum.lin += body.mass * velocity - wp.cross(body.first, base.ang)
    momentum.ang += wp.cross(body.first, velocity) + inertia_mul(body.second, base.ang)
    momentum.ang -= wp.cross(body.first, momentum.lin) / body.mass  # from the origin to the centre of mass
    return momentum


@wp.func
def base_with_momentum(base: BaseState, momentum: RobotMomentum, lin: vec3, ang: vec3) -> BaseState:
    """Return the base state with its twist corrected so that the robot's momentum becomes lin, ang (world axes).

    momentum: momentum of the robot before the correction. lin [kg m/s], ang [kg m^2/s] about the robot's centre of
    mass; the rates of the motors stay unchanged. With locked joints, the robot is one rigid body: its angular velocity
    changes by the missing angular momentum over its inertia. Then the linear velocity changes by the missing velocity
    of the centre of mass.
    """
    mass = momentum.body.mass
    com = momentum.body.first / mass
    # about the centre of mass: I - m (c.c 1 - c c^T)
    inertia = inertia_matrix(momentum.body.second) - mass * (
        wp.dot(com, com) * wp.identity(n=3, dtype=real) - wp.outer(com, com)
    )
    ang_change = inverse_symmetric(inertia) * (wp.quat_rotate_inv(base.quat, ang) - momentum.ang)
    lin_change = (wp.quat_rotate_inv(base.quat, lin) - momentum.lin) / mass
    corrected = base
    corrected.ang = base.ang + ang_change
    corrected.lin = base.lin + wp.quat_rotate(base.quat, lin_change - wp.cross(ang_change, com))
    return corrected


@wp.kernel
def momentum_kernel(
    # in
    first: int,
    model: RobotModel,
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    # out
    momenta: Momenta,
):
    """Write the momentum of every robot, world axes; one thread per world, from world `first` on."""
    world = first + wp.tid()
    base = load_base(joint_q, joint_qd, base_com(model.table, world), world)
    momentum = robot_momentum(model, world, base, joint_q, joint_qd)
    momenta.lin[world] = wp.quat_rotate(base.quat, momentum.lin)
    momenta.ang[world] = wp.quat_rotate(base.quat, momentum.ang)


@wp.kernel
def project_momentum_kernel(
    # in
    first: int,
    model: RobotModel,
    momenta: Momenta,
    body_f: wp.array(dtype=wp.spatial_vector),
    peak_force: wp.array(dtype=real),
    diverged: wp.array(dtype=int),
    time: real,
    # in, out
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
):
    """Correct the base twist of robots in free flight to the conserved momentum; one thread per world from `first`.

    momenta: at the start of an interval of `time` [s]. For that interval, body_f: external wrenches; peak_force [N]:
    largest total paw force, 0 in flight. The kernel skips held worlds and worlds with diverged != 0.
    """
    world = first + wp.tid()
    if diverged[world] != 0 or peak_force[world] > real(0.0) or wp.length_sq(body_f[world * BODIES]) > 0.0:
        return
    if model.held.shape[0] > 0:
        if model.held[world] != 0:
            return
    com = base_com(model.table, world)
    base = load_base(joint_q, joint_qd, com, world)
    momentum = robot_momentum(model, world, base, joint_q, joint_qd)
    lin = momenta.lin[world] + time * momentum.body.mass * load_vec3(model.table, GRAVITY, world)
    store_base(joint_q, joint_qd, com, world, base_with_momentum(base, momentum, lin, momenta.ang[world]))
