"""Parts of a physics step that CPU (`advance`) and GPU (`advance_legs`) share: equations of leg and base, contact.

The step is semi-implicit Euler: forces and Jacobians are taken at its start, and positions move with the velocities at
its end. Legs and paws k are 0 to 3 (FL, FR, BL, BR); vectors of motors are lateral, outer, inner. Body axes (x ahead, y
left, z up) are taken at the start of the step. Quaternions are xyzw, body to world. Normals point out of the ground,
impulses act on the paw.
"""

import warp as wp

from ..actuation.joint_forces import JointParams, joint_forces
from ..actuation.springs import LegSpring, spring_torque
from ..actuation.stops import StopRates
from ..kinematics.geometry import LegGeometry, leg_of
from ..layout import BASE, GRAVITY, LEG_ROWS, MU_DYNAMIC, MU_STATIC
from ..scalar import real, vec3
from ..state import BaseState, base_com
from ..terrain.ground import Ground, block_distance, block_normal, floor_distance, floor_normal, has_block
from .base_dynamics import BaseInverse, BaseSystem, LegSolve, base_link_system, eliminate_leg
from .base_motion import external_wrench
from .contact import (
    CONTACT_MARGIN,
    STICK_SPEED,
    BlockLaw,
    PawContact,
    add_block,
    contact_jacobian,
    couple_contact,
    target_normal_velocity,
)
from .leg_dynamics import LegDynamics, LegMasses, PawKinematics, leg_dynamics, leg_pose, paw_kinematics
from .parameters import load_joint_params, load_masses, load_moments

wp.set_module_options({"enable_backward": False})


@wp.struct
class RobotModel:
    """Parameters of the robots and their ground in every world; constant during a launch, except sliding blocks."""

    geometry: wp.array(dtype=LegGeometry)  # (4 robots,), see `leg_of`
    table: wp.array2d(dtype=real)  # (PARAMETER_ROWS, num_worlds), rows as in `layout`
    ground: Ground
    held: wp.array(dtype=int)  # (num_worlds,), not 0: the base keeps its twist (suspended); empty: none held


@wp.struct
class StepSettings:
    """Numerical settings of time steps: step size, number of steps, contact tolerance."""

    dt: real  # [s]
    substeps: int  # steps of a launch
    max_sweeps: int  # of the contact iteration
    tolerance: real  # [m/s], of the contact iteration
    first: int  # world of the first thread of a launch


@wp.struct
class LegParams:
    """Geometry, masses and joint constants of one leg of one world."""

    geometry: LegGeometry
    masses: LegMasses
    joints: JointParams


@wp.struct
class LegTerms:
    """Contribution of one leg to a step's equations of motion: dynamics, solution for its motors, paw kinematics."""

    dynamics: LegDynamics
    solve: LegSolve
    paw: PawKinematics


@wp.func
def load_leg(model: RobotModel, world: int, k: int) -> LegParams:
    """Return the geometry, masses and joint constants of leg k of a world."""
    params = LegParams()
    params.geometry = leg_of(model.geometry, world, k)
    params.masses = load_masses(model.table, k, world)
    params.joints = load_joint_params(model.table, k, world)
    return params


@wp.func
def leg_terms(
    params: LegParams, spring: LegSpring, angles: vec3, rates: vec3, torque: vec3, stop_rates: StopRates, pressed: int,
    omega: vec3, g: vec3, dt: real,
) -> LegTerms:  # fmt: skip
    """Return a leg's contribution to a step's equations of motion: dynamics, solution for its motors, paw kinematics.

    In body axes; passive forces and pressed stops are included. angles [rad], rates [rad/s], torque [N m] of the
    motors: lateral, outer, inner, at the start of the step dt [s]. omega [rad/s], g [m/s^2]: rotation of the base and
    gravity, body axes. stop_rates, pressed: see `stops`.
    """
    geo = params.geometry
    joints = params.joints
    pose = leg_pose(geo, angles)
    dynamics = leg_dynamics(geo, params.masses, pose, rates, omega, g)
    passive = joint_forces(joints, pose.loop, geo.front, rates, stop_rates, pressed, dt)
    total = torque + passive.torque
    if spring.stiffness != real(0.0):
        total += spring_torque(spring, pose.loop)
    terms = LegTerms()
    terms.dynamics = dynamics
    terms.solve = eliminate_leg(dynamics, passive.inertia + wp.diag(joints.armature), total)
    terms.paw = paw_kinematics(geo, pose)
    return terms


@wp.struct
class Touch:
    """Point of a surface that is nearest to a paw: its gap, normal and velocity."""

    gap: real  # [m] between surface and paw, negative inside
    normal: vec3  # unit, out of the surface, body axes
    velocity: vec3  # of the surface [m/s], body axes


@wp.func
def block_law(model: RobotModel, world: int, base: BaseState, dt: real) -> BlockLaw:
    """Return the constants of a sliding block's motion in a step dt [s], body axes; zero in a world without one.

    The contact laws of the paws, which may push it, are in body axes too. `weight` is m g dt, an impulse.
    """
    law = BlockLaw()
    if model.ground.blocks.shape[0] > 0:
        block = model.ground.blocks[world]
        law.velocity = wp.quat_rotate_inv(base.quat, vec3(block.velocity[0], block.velocity[1], real(0.0)))
        law.up = wp.quat_rotate_inv(base.quat, vec3(real(0.0), real(0.0), real(1.0)))
        law.mass = block.mass
        law.friction = block.friction
        law.weight = -dt * block.mass * model.table[GRAVITY + 2, world]
    return law


@wp.func
def touch_floor(model: RobotModel, world: int, k: int, base: BaseState, paw: PawKinematics) -> Touch:
    """Return gap and normal of the point of the floor that is nearest to paw k; the floor is at rest."""
    centre = base.pos + wp.quat_rotate(base.quat, paw.position)
    touch = Touch()
    touch.gap = floor_distance(model.ground, centre) - leg_of(model.geometry, world, k).paw_radius
    touch.normal = wp.quat_rotate_inv(base.quat, floor_normal(model.ground, centre))
    return touch


@wp.func
def touch_block(model: RobotModel, world: int, k: int, base: BaseState, paw: PawKinematics, law: BlockLaw) -> Touch:
    """Return gap, normal and velocity of the point of the world's block nearest to paw k; law: see `block_law`."""
    centre = base.pos + wp.quat_rotate(base.quat, paw.position)
    block = model.ground.blocks[world]
    touch = Touch()
    touch.gap = block_distance(block, centre) - leg_of(model.geometry, world, k).paw_radius
    touch.normal = wp.quat_rotate_inv(base.quat, block_normal(block, centre))
    touch.velocity = law.velocity
    return touch


@wp.func
def friction_row(k: int, velocity: vec3, impulse: vec3, normal: vec3) -> int:
    """Return the parameter-table row of paw k's friction coefficient: static if it stuck before the step, else dynamic.

    velocity [m/s] of the contact point relative to the ground at the start of the step; impulse [N s]: in the preceding
    step; normal: unit; all in the same axes.
    """
    slip = velocity - wp.dot(velocity, normal) * normal
    if wp.dot(slip, slip) < STICK_SPEED * STICK_SPEED and wp.dot(impulse, normal) > real(0.0):
        return k * LEG_ROWS + MU_STATIC
    return k * LEG_ROWS + MU_DYNAMIC


@wp.func
def paw_contact(
    model: RobotModel, world: int, k: int, base: BaseState, lin: vec3, ang: vec3, rates: vec3, old_rates: vec3,
    impulse: vec3, pressed: int, paw: PawKinematics, leg: LegSolve, inverse: BaseInverse, block: BlockLaw, dt: real,
) -> PawContact:  # fmt: skip
    """Return the contact problem of paw k in a step, with floor or block, whichever is nearer.

    lin [m/s], ang [rad/s], rates [rad/s]: base twist (body axes) and motor rates at the end of the step dt [s] without
    contact; old_rates, base: values at its start; impulse [N s] of the preceding step, world axes, is the first guess;
    pressed: the leg's pressed stops.
    """
    contact = PawContact()
    touch = touch_floor(model, world, k, base, paw)
    on_block = bool(False)
    if has_block(model.ground, world):
        above = touch_block(model, world, k, base, paw, block)
        if above.gap < touch.gap:
            touch = above
            on_block = True
    gap = touch.gap
    normal = touch.normal
    arm = -leg_of(model.geometry, world, k).paw_radius * normal
    point = paw.position + arm
    contact.jacobian = contact_jacobian(paw, arm)
    contact.normal = normal
    contact.free = lin + wp.cross(ang, point) + contact.jacobian * rates
    if gap + dt * wp.min(wp.dot(contact.free - touch.velocity, normal), real(0.0)) > CONTACT_MARGIN:
        return contact
    contact.active = 1
    contact.goal = target_normal_velocity(gap, pressed, dt)
    contact.impulse = wp.quat_rotate_inv(base.quat, impulse)
    old_velocity = wp.quat_rotate_inv(base.quat, base.lin) + wp.cross(base.ang, point) + contact.jacobian * old_rates
    contact.mu_row = friction_row(k, old_velocity - touch.velocity, contact.impulse, normal)
    contact.mu = model.table[contact.mu_row, world]
    contact = couple_contact(contact, point, leg, inverse)
    if on_block:
        contact = add_block(contact, block)
    return contact


@wp.func
def base_system(model: RobotModel, world: int, base: BaseState, g: vec3, force: vec3, moment: vec3) -> BaseSystem:
    """Return the equations of motion of the base without its legs, under gravity and an external wrench.

    g [m/s^2]: body axes; force [N], moment [N m]: external, at com, world axes.
    """
    wrench = external_wrench(base, base_com(model.table, world), force, moment)
    return base_link_system(load_moments(model.table, BASE, world), base.ang, g, wrench.force, wrench.moment)


@wp.func
def hold_base(model: RobotModel, world: int, inverse: BaseInverse) -> BaseInverse:
    """Return `inverse`, or zeros if the world's base is held (suspended), so that it cannot accelerate.

    A base with zero inverse inertia is infinitely heavy; its legs still move.
    """
    if model.held.shape[0] > 0:
        if model.held[world] != 0:
            return BaseInverse()
    return inverse


@wp.func
def finite_base(base: BaseState) -> bool:
    """Return whether all values of a base state are finite; a sum that contains NaN or infinity is not."""
    q = base.quat
    total = wp.dot(base.pos, base.pos) + wp.dot(base.lin, base.lin) + wp.dot(base.ang, base.ang)
    return wp.isfinite(total + q[0] + q[1] + q[2] + q[3])
