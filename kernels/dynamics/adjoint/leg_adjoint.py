"""`step_adjoint` for GPUs: a thread a leg, the base's part made by each of the four, in three parts.

What depends on the motion alone is made for many steps side by side (`replay_leg`), the inverse of the system of
the contact laws' multipliers too. Only what must go from step to step backwards does so (`reverse_leg`). It leaves the
multipliers, from which the gradients by parameters follow, again for many steps side by side (`add_leg_constants`).
"""

import warp as wp

from ...actuation.joint_forces import JointParams
from ...actuation.springs import LegSpring
from ...actuation.stops import StopParams, stop_rates
from ...kinematics.geometry import LegGeometry
from ...lanes import any_world, mat_from_leg, sum_legs, sum_quat, sum_vec, vec_from_leg
from ...layout import BASE, GRAVITY, LEG_ROWS, MU_DYNAMIC, MU_STATIC
from ...scalar import mat33, quat, real, vec3
from ...state import BaseState, base_com
from ..base_dynamics import BaseSystem, add_leg, invert, motor_acceleration, solve_ang, solve_lin, sum_systems
from ..base_motion import integrate_base
from ..contact import SEPARATE, PawContact
from ..contact_laws import PawLaw, contact_at, contact_point, paw_law
from ..inertia import MassMoments
from ..leg_dynamics import LegMasses
from ..parameters import load_moments, load_spring, load_stops, load_vec3
from ..step import LegParams, RobotModel, base_system, hold_base, leg_terms
from ..trajectory import TrajectoryArrays, row_vec3
from .gradients import (
    ThreadSums,
    add_entry,
    add_geometry,
    add_joints,
    add_masses,
    add_spring,
    add_stops,
)
from .leg_record import (
    ANGLES,
    RATES,
    BaseWeights,
    LawRow,
    LegLaw,
    LegRecord,
    LegWeights,
    get_base,
    get_inverse,
    get_law,
    get_law_row,
    get_solve,
    get_vec,
    put_base,
    put_base_weights,
    put_inverse,
    put_law,
    put_law_row,
    put_leg_weights,
    put_solve,
    put_vec,
)
from .virtual_power import BaseFactors, LegFactors, add, base_action, leg_action, rotation_adjoint_scalar

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class LegAdjoint:
    """Gradient by the state of a world as a leg's thread holds it, and what a step adds for its motors and the base."""

    base: BaseState
    angles: vec3
    rates: vec3
    torque: vec3  # by the motors' torques in the step
    force: vec3  # by the wrench on the base, summed over steps as what follows
    moment: vec3
    body: MassMoments  # by the base link's
    com: vec3  # by the base's centre of mass
    gravity: vec3


@wp.func
def leg_law(c: PawContact, law: PawLaw, impulse: vec3, point: vec3) -> LegLaw:
    """Return what is recorded of a paw's law; impulse [N s], point [m]: body axes."""
    found = LegLaw()
    found.mode = law.mode
    found.mu_row = law.mu_row
    found.mu = law.mu
    found.impulse = impulse
    found.point = point
    found.jacobian = c.jacobian
    found.to_lin = c.to_lin
    found.to_ang = c.to_ang
    found.by_velocity = law.by_velocity
    return found


@wp.func
def replay_leg(
    model: RobotModel, params: LegParams, dt: real, world: int, leg: int, force: vec3, moment: vec3,
    first_impulse: wp.array2d(dtype=vec3), trajectory: TrajectoryArrays, step: int, i: int, record: LegRecord,
):  # fmt: skip
    """Make a step again from entry i of the record; see `replay_step`. All threads write the base, the same bits."""
    base = get_base(record, i, world)
    rates = get_vec(record, i, RATES, world, leg)
    angles = get_vec(record, i, ANGLES, world, leg)
    g = wp.quat_rotate_inv(base.quat, load_vec3(model.table, GRAVITY, world))
    torque = row_vec3(trajectory.torque, step, 3 * leg, world)
    stops = stop_rates(load_stops(model.table, leg, world), angles, dt)
    spring = load_spring(model.table, leg, world)
    terms = leg_terms(
        params, spring, angles, rates, torque, stops, int(trajectory.pressed[step, leg, world]), base.ang, g, dt
    )
    share = add_leg(BaseSystem(), terms.dynamics, terms.solve)
    system = sum_systems(base_system(model, world, base, g, force, moment), share)
    inverse = hold_base(model, world, invert(system))
    solve = terms.solve
    put_inverse(record, i, world, inverse)
    paw = terms.paw
    c = PawContact()
    push = vec3(real(0.0))
    twist = vec3(real(0.0))
    point = vec3(real(0.0))
    impulse = wp.quat_rotate_inv(base.quat, trajectory.impulse[step, leg, world])
    touches = wp.dot(impulse, impulse) > real(0.0)
    if touches:
        c = contact_at(model, leg, base, paw, solve, inverse, impulse)
        joint = wp.transpose(c.jacobian) * impulse
        point = contact_point(model, leg, paw, c)
        push = impulse - wp.transpose(solve.to_lin) * joint
        twist = wp.cross(point, impulse) - wp.transpose(solve.to_ang) * joint
        solve.free += solve.inverse * (joint / dt)
    put_solve(record, i, world, leg, solve)
    push = dt * system.force + sum_vec(push)
    twist = dt * system.moment + sum_vec(twist)
    lin = solve_lin(inverse, push, twist)
    ang = solve_ang(inverse, push, twist)
    ahead = rates + dt * motor_acceleration(solve, lin / dt, ang / dt)
    put_vec(record, i + 1, RATES, world, leg, ahead)
    put_vec(record, i + 1, ANGLES, world, leg, angles + dt * ahead)
    old_lin = wp.quat_rotate_inv(base.quat, base.lin)
    put_base(record, i + 1, world, integrate_base(base, old_lin + lin, base.ang + ang, dt))
    law = PawLaw()
    if touches:
        old_velocity = old_lin + wp.cross(base.ang, point) + c.jacobian * rates
        velocity = old_lin + lin + wp.cross(base.ang + ang, point) + c.jacobian * ahead
        old_impulse = first_impulse[leg, world]
        if step > 0:
            old_impulse = trajectory.impulse[step - 1, leg, world]
        law = paw_law(model, world, leg, c, old_velocity, velocity, wp.quat_rotate_inv(base.quat, old_impulse))
    if any_world(any_leg(law.mode != SEPARATE)):
        put_law_row(record, i, world, leg, inverted_laws(c, law, leg))
    put_law(record, i, world, leg, leg_law(c, law, impulse, point))


@wp.func
def any_leg(flag: bool) -> bool:
    """Return whether a flag is set for any leg of the world."""
    return sum_legs(wp.where(flag, real(1.0), real(0.0))) > real(0.0)


@wp.func
def law_block(c: PawContact, law: PawLaw, of: PawContact, of_law: PawLaw, leg: int, j: int) -> mat33:
    """Return block (leg, j) of the system of the laws' multipliers; `of`, `of_law`: paw j, sent by its thread."""
    to_lin = mat_from_leg(of.to_lin * wp.transpose(of_law.by_velocity), j)
    to_ang = mat_from_leg(of.to_ang * wp.transpose(of_law.by_velocity), j)
    if law.mode == SEPARATE:
        return wp.where(leg == j, wp.identity(n=3, dtype=real), mat33(real(0.0)))
    if leg == j:
        return c.total * wp.transpose(law.by_velocity) + wp.transpose(law.by_impulse)
    return c.from_lin * to_lin + c.from_ang * to_ang


@wp.func
def reduce_block(block: mat33, factor: mat33, pivot: mat33, j: int, leg: int) -> mat33:
    """Return a block after elimination with row j, whose scaled block is `pivot` in its own thread."""
    scaled = mat_from_leg(pivot, j)
    if leg == j:
        return scaled
    return block - factor * scaled


@wp.func
def inverted_laws(c: PawContact, law: PawLaw, leg: int) -> LawRow:
    """Return a row of the inverse of the multipliers' system: Gauss-Jordan by blocks in place, a row a thread."""
    eye = wp.identity(n=3, dtype=real)
    none = mat33(real(0.0))
    a0 = law_block(c, law, c, law, leg, 0)
    a1 = law_block(c, law, c, law, leg, 1)
    a2 = law_block(c, law, c, law, leg, 2)
    a3 = law_block(c, law, c, law, leg, 3)
    scale = wp.inverse(wp.where(leg == 0, a0, eye))
    a1 = reduce_block(a1, a0, scale * a1, 0, leg)
    a2 = reduce_block(a2, a0, scale * a2, 0, leg)
    a3 = reduce_block(a3, a0, scale * a3, 0, leg)
    a0 = reduce_block(none, a0, scale, 0, leg)
    scale = wp.inverse(wp.where(leg == 1, a1, eye))
    a0 = reduce_block(a0, a1, scale * a0, 1, leg)
    a2 = reduce_block(a2, a1, scale * a2, 1, leg)
    a3 = reduce_block(a3, a1, scale * a3, 1, leg)
    a1 = reduce_block(none, a1, scale, 1, leg)
    scale = wp.inverse(wp.where(leg == 2, a2, eye))
    a0 = reduce_block(a0, a2, scale * a0, 2, leg)
    a1 = reduce_block(a1, a2, scale * a1, 2, leg)
    a3 = reduce_block(a3, a2, scale * a3, 2, leg)
    a2 = reduce_block(none, a2, scale, 2, leg)
    scale = wp.inverse(wp.where(leg == 3, a3, eye))
    found = LawRow()
    found.a = reduce_block(a0, a3, scale * a0, 3, leg)
    found.b = reduce_block(a1, a3, scale * a1, 3, leg)
    found.c = reduce_block(a2, a3, scale * a2, 3, leg)
    found.d = reduce_block(none, a3, scale, 3, leg)
    return found


@wp.func
def multiplier(row: LawRow, impulse_cotangent: vec3) -> vec3:
    """Return the multiplier of a paw's law for the gradients by all paws' impulses; seed: 0 where separated."""
    found = row.a * vec_from_leg(impulse_cotangent, 0) + row.b * vec_from_leg(impulse_cotangent, 1)
    return -(found + row.c * vec_from_leg(impulse_cotangent, 2) + row.d * vec_from_leg(impulse_cotangent, 3))


@wp.func
def base_factors(record: LegRecord, world: int, i: int, dt: real, base: BaseState, weights: BaseWeights) -> BaseFactors:
    """Return what is held of the base in a step."""
    ahead = get_base(record, i + 1, world)
    base_held = BaseFactors()
    base_held.virtual_lin = weights.lin
    base_held.virtual_ang = weights.ang
    base_held.lin = wp.quat_rotate_inv(base.quat, ahead.lin)
    base_held.ang = ahead.ang
    base_held.lin_acc = (base_held.lin - wp.quat_rotate_inv(base.quat, base.lin)) / dt
    base_held.ang_acc = (base_held.ang - base.ang) / dt
    return base_held


@wp.func
def leg_factors(
    record: LegRecord, trajectory: TrajectoryArrays, cotangent: TrajectoryArrays, world: int, step: int, i: int,
    leg: int, dt: real, law: LegLaw, weights: LegWeights,
) -> LegFactors:  # fmt: skip
    """Return what is held of a leg in a step."""
    base_held = LegFactors()
    base_held.virtual_rates = weights.rates
    base_held.rates = get_vec(record, i + 1, RATES, world, leg)
    base_held.acc = (base_held.rates - get_vec(record, i, RATES, world, leg)) / dt
    base_held.mode = law.mode
    base_held.pressed = int(trajectory.pressed[step, leg, world])
    if law.mode != SEPARATE:
        base_held.impulse = law.impulse
        base_held.law = weights.law
        if cotangent.impulse.shape[0] > 0:
            base_held.push = cotangent.impulse[step, leg, world]
    return base_held


@wp.struct
class LegGradient:
    """Gradient of a leg's part of the weighed equations."""

    geometry: LegGeometry
    masses: LegMasses
    joints: JointParams
    spring: LegSpring
    stops: StopParams
    mu: real
    pos: vec3  # by the base's state
    quat: quat
    omega: vec3
    gravity: vec3  # body axes
    angles: vec3
    rates: vec3


@wp.func
def leg_gradient(
    model: RobotModel, params: LegParams, dt: real, world: int, leg: int, trajectory: TrajectoryArrays,
    cotangent: TrajectoryArrays, step: int, i: int, record: LegRecord, base: BaseState, law: LegLaw,
    base_held: BaseFactors, weights: LegWeights,
) -> LegGradient:  # fmt: skip
    """Return the gradient of `leg_action` in a step."""
    leg_held = leg_factors(record, trajectory, cotangent, world, step, i, leg, dt, law, weights)
    g = wp.quat_rotate_inv(base.quat, load_vec3(model.table, GRAVITY, world))
    angles = get_vec(record, i, ANGLES, world, leg)
    rates = get_vec(record, i, RATES, world, leg)
    (geo, masses, joints, spring, stops, _ground, mu, pos, quat, omega, g_adj, angle_adj, rate_adj, _held, _leg,
     _step) = (
        wp.grad(leg_action)(
            params.geometry, params.masses, params.joints, load_spring(model.table, leg, world),
            load_stops(model.table, leg, world), model.ground, law.mu, base.pos, base.quat, base.ang, g, angles, rates,
            base_held, leg_held, dt,
        )
    )  # fmt: skip
    found = LegGradient()
    found.geometry = geo
    found.masses = masses
    found.joints = joints
    found.spring = spring
    found.stops = stops
    found.mu = mu
    found.pos = pos
    found.quat = quat
    found.omega = omega
    found.gravity = g_adj
    found.angles = angle_adj
    found.rates = rate_adj
    return found


@wp.struct
class StepWeights:
    """What a step's equations are weighed with, and the gradients by the velocities at its start that this leaves."""

    base: BaseWeights
    leg: LegWeights
    lin: vec3
    ang: vec3
    rates: vec3


@wp.func
def find_weights(
    record: LegRecord, world: int, leg: int, cotangent: TrajectoryArrays, step: int, i: int, base: BaseState,
    law: LegLaw, lin_cotangent: vec3, ang_cotangent: vec3, rate_cotangent: vec3,
) -> StepWeights:  # fmt: skip
    """Return the multipliers of a step for the gradients by the velocities at its end; see `find_multipliers`."""
    inverse = get_inverse(record, i, world)
    solve = get_solve(record, i, world, leg)
    found = StepWeights()
    found.lin = lin_cotangent
    found.ang = ang_cotangent
    found.rates = rate_cotangent
    push = lin_cotangent - sum_vec(wp.transpose(solve.to_lin) * rate_cotangent)
    twist = ang_cotangent - sum_vec(wp.transpose(solve.to_ang) * rate_cotangent)
    found.base.lin = solve_lin(inverse, push, twist)
    found.base.ang = solve_ang(inverse, push, twist)
    found.leg.rates = solve.inverse * rate_cotangent - solve.to_lin * found.base.lin - solve.to_ang * found.base.ang
    touches = law.mode != SEPARATE
    impulse_cotangent = vec3(real(0.0))
    if touches:
        impulse_cotangent = found.base.lin + wp.cross(found.base.ang, law.point) + law.jacobian * found.leg.rates
        if cotangent.impulse.shape[0] > 0:
            impulse_cotangent += wp.quat_rotate_inv(base.quat, cotangent.impulse[step, leg, world])
    if any_world(any_leg(touches)):
        y = vec3(real(0.0))
        found.leg.law = multiplier(get_law_row(record, i, world, leg), impulse_cotangent)
        if touches:
            y = wp.transpose(law.by_velocity) * found.leg.law
        joint = wp.transpose(law.jacobian) * y
        law_lin = sum_vec(law.to_lin * y)
        law_ang = sum_vec(law.to_ang * y)
        found.lin += sum_vec(y)
        found.ang += sum_vec(wp.cross(law.point, y))
        found.rates += joint
        found.leg.rates += solve.inverse * joint - solve.to_lin * law_lin - solve.to_ang * law_ang
        found.base.lin += law_lin
        found.base.ang += law_ang
    return found


@wp.func
def reverse_leg(
    model: RobotModel, params: LegParams, dt: real, world: int, leg: int, force: vec3, moment: vec3,
    trajectory: TrajectoryArrays, cotangent: TrajectoryArrays, step: int, i: int, record: LegRecord, adj: LegAdjoint,
    keeps: bool,
) -> LegAdjoint:  # fmt: skip
    """Run a step backwards, see `reverse_step`; if it `keeps`, it records what its equations are weighed with."""
    base = get_base(record, i, world)
    law = get_law(record, i, world, leg)
    new_velocity = adj.base.lin + dt * adj.base.pos
    quat_adj, ang_cotangent, _dt, _quat_adj = wp.grad(rotation_adjoint_scalar)(
        base.quat, row_vec3(record.base, i + 1, 10, world), dt, adj.base.quat
    )
    weights = find_weights(
        record, world, leg, cotangent, step, i, base, law, wp.quat_rotate_inv(base.quat, new_velocity),
        ang_cotangent + adj.base.ang, adj.rates + dt * adj.angles,
    )  # fmt: skip
    base_weights = weights.base
    # the equations of motion
    base_held = base_factors(record, world, i, dt, base, base_weights)
    found = leg_gradient(
        model, params, dt, world, leg, trajectory, cotangent, step, i, record, base, law, base_held, weights.leg
    )
    base_weights.cotangent.velocity = weights.lin
    base_weights.cotangent.new_velocity = new_velocity
    base_weights.cotangent.gravity = sum_vec(found.gravity)
    gravity = load_vec3(model.table, GRAVITY, world)
    body, com, weight, force_adj, moment_adj, base_quat, lin_adj, base_omega, _base, _cotangent, _base_step = wp.grad(
        base_action
    )(load_moments(model.table, BASE, world), base_com(model.table, world), gravity, force, moment, base.quat,
      base.lin, base.ang, base_held, base_weights.cotangent, dt)  # fmt: skip
    if keeps:
        put_base_weights(record, i, world, base_weights)
        put_leg_weights(record, i, world, leg, weights.leg)
    out = LegAdjoint()
    out.base.pos = adj.base.pos + sum_vec(found.pos)
    out.base.quat = quat_adj + base_quat + sum_quat(found.quat)
    out.base.lin = lin_adj
    out.base.ang = weights.ang + base_omega + sum_vec(found.omega)
    out.angles = adj.angles + found.angles
    out.rates = weights.rates + found.rates
    out.torque = dt * weights.leg.rates
    out.force = adj.force + force_adj
    out.moment = adj.moment + moment_adj
    out.body = add(adj.body, body)
    out.com = adj.com + com
    out.gravity = adj.gravity + weight
    return out


@wp.func
def add_leg_constants(sums: ThreadSums, leg: int, law: LegLaw, found: LegGradient):
    """Add a step's gradients by the parameters of a leg."""
    add_geometry(sums, leg, found.geometry)
    add_masses(sums, leg, found.masses)
    add_joints(sums, leg, found.joints)
    add_spring(sums, leg, found.spring)
    add_stops(sums, leg, found.stops)
    for row in range(2):  # one of the two coefficients
        mu_row = leg * LEG_ROWS + wp.where(row == 0, int(MU_STATIC), int(MU_DYNAMIC))
        add_entry(sums, mu_row, wp.where(law.mode != SEPARATE and law.mu_row == mu_row, found.mu, real(0.0)))
