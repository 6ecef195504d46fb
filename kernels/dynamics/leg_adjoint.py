"""`step_adjoint` for GPUs: a thread a leg, the base's part made by each of the four."""

import warp as wp

from ..actuation.stops import stop_rows
from ..layout import BASE, GRAVITY, LEG_ROWS
from ..scalar import mat33, real, vec3
from ..state import BaseState, base_com
from .base_dynamics import BaseSystem, add_leg, invert, motor_acceleration, solve_ang, solve_lin
from .base_motion import moved_base
from .contact import SEPARATE, PawContact
from .contact_laws import PawLaw, contact_at, contact_point, paw_law
from .gradients import (
    add_com,
    add_entry,
    add_geometry,
    add_joints,
    add_masses,
    add_moments,
    add_spring,
    add_stops,
    add_vec3,
)
from .lanes import any_world, mat_from_leg, sum_legs, sum_quat, sum_systems, sum_vec, vec_from_leg
from .parameters import load_moments, load_spring, load_stops, load_vec3
from .rollout import Rows, row_vec3
from .step import LegParams, Robot, base_system, hold_base, leg_terms
from .step_adjoint import StepRecord
from .virtual_power import BaseFactors, BaseSeeds, LegFactors, base_action, leg_action, turned

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class LegAdjoint:
    """Gradient by the state of a world as a leg's thread holds it, and what a step adds for its motors and the base."""

    base: BaseState
    angles: vec3
    rates: vec3
    torque: vec3  # by the motors' torques in the step
    force: vec3  # by the wrench on the base
    moment: vec3


@wp.func
def replay_leg(
    robot: Robot, own: LegParams, dt: real, world: int, leg: int, force: vec3, moment: vec3, rows: Rows, step: int,
    i: int, record: StepRecord,
):  # fmt: skip
    """Make a step again from entry i of the record; see `replay_step`. All threads write the base, the same bits."""
    base = record.base[world, i]
    rates = record.rates[world, i, leg]
    angles = record.angles[world, i, leg]
    g = wp.quat_rotate_inv(base.quat, load_vec3(robot.table, GRAVITY, world))
    torque = row_vec3(rows.torque, step, 3 * leg, world)
    stops = stop_rows(load_stops(robot.table, leg, world), angles, dt)
    spring = load_spring(robot.table, leg, world)
    terms = leg_terms(own, spring, angles, rates, torque, stops, int(rows.pressed[step, leg, world]), base.ang, g, dt)
    share = add_leg(BaseSystem(), terms.dynamics, terms.solve)
    system = sum_systems(base_system(robot, world, base, g, force, moment), share)
    inverse = hold_base(robot, world, invert(system))
    solve = terms.solve
    record.legs[world, i, leg] = solve
    record.paws[world, i, leg] = terms.paw
    record.inverse[world, i] = inverse
    push = vec3(real(0.0))
    twist = vec3(real(0.0))
    impulse = wp.quat_rotate_inv(base.quat, rows.impulse[step, leg, world])
    if wp.dot(impulse, impulse) > real(0.0):
        contact = contact_at(robot, leg, base, terms.paw, solve, inverse, impulse)
        joint = wp.transpose(contact.jacobian) * impulse
        point = contact_point(robot, leg, terms.paw, contact)
        push = impulse - wp.transpose(solve.to_lin) * joint
        twist = wp.cross(point, impulse) - wp.transpose(solve.to_ang) * joint
        solve.free += solve.inverse * (joint / dt)
    push = dt * system.force + sum_vec(push)
    twist = dt * system.moment + sum_vec(twist)
    lin = solve_lin(inverse, push, twist)
    ang = solve_ang(inverse, push, twist)
    ahead = rates + dt * motor_acceleration(solve, lin / dt, ang / dt)
    record.rates[world, i + 1, leg] = ahead
    record.angles[world, i + 1, leg] = angles + dt * ahead
    record.base[world, i + 1] = moved_base(base, wp.quat_rotate_inv(base.quat, base.lin) + lin, base.ang + ang, dt)


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
def reduce_vector(b: vec3, factor: mat33, pivot: vec3, j: int, leg: int) -> vec3:
    """Return the right-hand side after elimination with row j."""
    scaled = vec_from_leg(pivot, j)
    if leg == j:
        return scaled
    return b - factor * scaled


@wp.func
def solve_leg_laws(c: PawContact, law: PawLaw, seed: vec3, leg: int) -> vec3:
    """Return the multiplier of a paw's law: Gauss-Jordan by blocks, a row of blocks a thread."""
    a0 = law_block(c, law, c, law, leg, 0)
    a1 = law_block(c, law, c, law, leg, 1)
    a2 = law_block(c, law, c, law, leg, 2)
    a3 = law_block(c, law, c, law, leg, 3)
    b = -seed
    if law.mode == SEPARATE:
        b = vec3(real(0.0))
    scale = wp.inverse(wp.where(leg == 0, a0, wp.identity(n=3, dtype=real)))
    b = reduce_vector(b, a0, scale * b, 0, leg)
    a1 = reduce_block(a1, a0, scale * a1, 0, leg)
    a2 = reduce_block(a2, a0, scale * a2, 0, leg)
    a3 = reduce_block(a3, a0, scale * a3, 0, leg)
    scale = wp.inverse(wp.where(leg == 1, a1, wp.identity(n=3, dtype=real)))
    b = reduce_vector(b, a1, scale * b, 1, leg)
    a2 = reduce_block(a2, a1, scale * a2, 1, leg)
    a3 = reduce_block(a3, a1, scale * a3, 1, leg)
    scale = wp.inverse(wp.where(leg == 2, a2, wp.identity(n=3, dtype=real)))
    b = reduce_vector(b, a2, scale * b, 2, leg)
    a3 = reduce_block(a3, a2, scale * a3, 2, leg)
    scale = wp.inverse(wp.where(leg == 3, a3, wp.identity(n=3, dtype=real)))
    return reduce_vector(b, a3, scale * b, 3, leg)


@wp.func
def reverse_leg(
    robot: Robot, own: LegParams, dt: real, world: int, leg: int, force: vec3, moment: vec3,
    first_impulse: wp.array2d(dtype=vec3), rows: Rows, seeds: Rows, step: int, i: int, record: StepRecord,
    adj: LegAdjoint, sums: wp.array(dtype=real),
) -> LegAdjoint:  # fmt: skip
    """Run a step backwards, see `reverse_step`; `sums`: of this leg, as if it were the first, and of the base."""
    base = record.base[world, i]
    ahead = record.base[world, i + 1]
    inverse = record.inverse[world, i]
    solve = record.legs[world, i, leg]
    paw = record.paws[world, i, leg]
    old_rates = record.rates[world, i, leg]
    rates = record.rates[world, i + 1, leg]
    lin = wp.quat_rotate_inv(base.quat, ahead.lin)
    ang = ahead.ang
    old_lin = wp.quat_rotate_inv(base.quat, base.lin)
    new_velocity = adj.base.lin + dt * adj.base.pos
    quat_adj, ang_seed, _dt, _seed = wp.grad(turned)(base.quat, ang, dt, adj.base.quat)
    rate_seed = adj.rates + dt * adj.angles
    lin_seed = wp.quat_rotate_inv(base.quat, new_velocity)
    ang_seed += adj.base.ang
    push = lin_seed - sum_vec(wp.transpose(solve.to_lin) * rate_seed)
    twist = ang_seed - sum_vec(wp.transpose(solve.to_ang) * rate_seed)
    virtual_lin = solve_lin(inverse, push, twist)
    virtual_ang = solve_ang(inverse, push, twist)
    virtual = solve.inverse * rate_seed - solve.to_lin * virtual_lin - solve.to_ang * virtual_ang
    # contact
    c = PawContact()
    law = PawLaw()
    seed = vec3(real(0.0))
    point = vec3(real(0.0))
    pushed = vec3(real(0.0))
    impulse = wp.quat_rotate_inv(base.quat, rows.impulse[step, leg, world])
    if wp.dot(impulse, impulse) > real(0.0):
        c = contact_at(robot, leg, base, paw, solve, inverse, impulse)
        point = contact_point(robot, leg, paw, c)
        before = old_lin + wp.cross(base.ang, point) + c.jacobian * old_rates
        velocity = lin + wp.cross(ang, point) + c.jacobian * rates
        old_impulse = first_impulse[leg, world]
        if step > 0:
            old_impulse = rows.impulse[step - 1, leg, world]
        law = paw_law(robot, world, leg, c, before, velocity, wp.quat_rotate_inv(base.quat, old_impulse))
        seed = virtual_lin + wp.cross(virtual_ang, point) + c.jacobian * virtual
        if seeds.impulse.shape[0] > 0:
            pushed = seeds.impulse[step, leg, world]
            seed += wp.quat_rotate_inv(base.quat, pushed)
    multiplier = vec3(real(0.0))
    touching = sum_legs(wp.where(law.mode != SEPARATE, real(1.0), real(0.0))) > real(0.0)
    if any_world(touching):
        multiplier = solve_leg_laws(c, law, seed, leg)
        y = wp.transpose(law.by_velocity) * multiplier
        joint = wp.transpose(c.jacobian) * y
        more_lin = sum_vec(c.to_lin * y)
        more_ang = sum_vec(c.to_ang * y)
        lin_seed += sum_vec(y)
        ang_seed += sum_vec(wp.cross(point, y))
        rate_seed += joint
        virtual += solve.inverse * joint - solve.to_lin * more_lin - solve.to_ang * more_ang
        virtual_lin += more_lin
        virtual_ang += more_ang
    # the equations of motion
    held = BaseFactors()
    held.virtual_lin = virtual_lin
    held.virtual_ang = virtual_ang
    held.lin_acc = (lin - old_lin) / dt
    held.ang_acc = (ang - base.ang) / dt
    held.lin = lin
    held.ang = ang
    factors = LegFactors()
    factors.virtual_rates = virtual
    factors.rates = rates
    factors.acc = (rates - old_rates) / dt
    factors.mode = law.mode
    factors.pressed = int(rows.pressed[step, leg, world])
    if law.mode != SEPARATE:
        factors.impulse = c.impulse
        factors.law = multiplier
        factors.push = pushed
    gravity = load_vec3(robot.table, GRAVITY, world)
    g = wp.quat_rotate_inv(base.quat, gravity)
    (geo, masses, joints, spring, stops, _ground, mu_adj, pos, turn, omega, g_adj, angle_adj, rate_adj, _held, _leg,
     _step) = (
        wp.grad(leg_action)(
            own.geometry, own.masses, own.joints, load_spring(robot.table, leg, world),
            load_stops(robot.table, leg, world), robot.ground, law.mu, base.pos, base.quat, base.ang, g,
            record.angles[world, i, leg], old_rates, held, factors, dt,
        )
    )  # fmt: skip
    add_geometry(sums, 0, geo)
    add_masses(sums, 0, masses)
    add_joints(sums, 0, joints)
    add_spring(sums, 0, spring)
    add_stops(sums, 0, stops)
    if law.mode != SEPARATE:
        add_entry(sums, law.mu_row - leg * LEG_ROWS, mu_adj)
    base_seeds = BaseSeeds()
    base_seeds.velocity = lin_seed
    base_seeds.new_velocity = new_velocity
    base_seeds.gravity = sum_vec(g_adj)
    com = base_com(robot.table, world)
    body, com_adj, weight, force_adj, moment_adj, base_turn, lin_adj, base_omega, _base, _seeds, _base_step = wp.grad(
        base_action
    )(load_moments(robot.table, BASE, world), com, gravity, force, moment, base.quat, base.lin, base.ang, held,
      base_seeds, dt)  # fmt: skip
    add_moments(sums, BASE, body)
    add_com(sums, robot.table[BASE, world], com, com_adj)
    add_vec3(sums, GRAVITY, weight)
    out = LegAdjoint()
    out.base.pos = adj.base.pos + sum_vec(pos)
    out.base.quat = quat_adj + base_turn + sum_quat(turn)
    out.base.lin = lin_adj
    out.base.ang = ang_seed + base_omega + sum_vec(omega)
    out.angles = adj.angles + angle_adj
    out.rates = rate_seed + rate_adj
    out.torque = dt * virtual
    out.force = force_adj
    out.moment = moment_adj
    return out
