"""One time step of one world, backwards.

The step solves M (v' - v) = dt f + J^T p for the velocities v' at its end, with impulses p that satisfy the contact law
R(p, v') = 0 in modes (separated, sticking, sliding) that are held. For a gradient y of v' and z of p:

    A^T l = -(z + J M^-1 y),   A = dR/dp + dR/dv' J M^-1 J^T     (implicit function theorem)
    m = M^-1 (y + J^T (dR/dv')^T l)

and the gradient with respect to all else, the old velocities aside, is that of m . (dt f + J^T p - M (v' - v)) + l . R
with v', p, m and l held (`virtual_power`). Where a mode changes the motion has a kink; the gradient is that of the mode
which the forward pass found.
"""

import warp as wp

from ...actuation.stops import stop_rows
from ...layout import BASE, GRAVITY
from ...scalar import real, vec3
from ...state import BaseState, base_com
from ..base_dynamics import BaseInverse, LegSolve, add_leg, invert, motor_acceleration, solve_ang, solve_lin
from ..base_motion import moved_base
from ..contact import SEPARATE, PawContact
from ..contact_laws import PawLaw, contact_at, contact_point, paw_law, solve_laws
from ..leg_dynamics import PawKinematics
from ..parameters import load_moments, load_spring, load_stops, load_vec3
from ..step import LegParams, Robot, base_system, hold_base, leg_terms
from ..trajectory import Rows, row_vec3, store_row_vec3
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
from .virtual_power import BaseFactors, BaseSeeds, LegFactors, base_action, leg_action, turned

wp.set_module_options({"enable_backward": False})


@wp.struct
class StepRecord:
    """What the reverse pass needs of the steps between two rows of a rollout, by world, step and leg."""

    base: wp.array2d(dtype=BaseState)  # (num_worlds, steps + 1)
    angles: wp.array3d(dtype=vec3)  # [rad], (num_worlds, steps + 1, 4)
    rates: wp.array3d(dtype=vec3)  # [rad/s], likewise
    inverse: wp.array2d(dtype=BaseInverse)  # (num_worlds, steps)
    legs: wp.array3d(dtype=LegSolve)  # (num_worlds, steps, 4)
    paws: wp.array3d(dtype=PawKinematics)  # likewise


@wp.struct
class Multipliers:
    """Gradients of the base's velocities at the end of a step, and what solving M for them gives; body axes."""

    lin_seed: vec3
    ang_seed: vec3
    lin: vec3
    ang: vec3


@wp.func
def solve_system(
    inverse: BaseInverse, lin_seed: vec3, ang_seed: vec3, legs: wp.array3d(dtype=LegSolve), world: int, step: int,
    rate_seeds: wp.array(dtype=vec3), rates: wp.array(dtype=vec3),
) -> Multipliers:  # fmt: skip
    """Solve M m = seeds; the motors' m is written to `rates`, (4,)."""
    m = Multipliers()
    m.lin_seed = lin_seed
    m.ang_seed = ang_seed
    force = lin_seed
    moment = ang_seed
    for k in range(rates.shape[0]):
        solve = legs[world, step, k]
        force -= wp.transpose(solve.to_lin) * rate_seeds[k]
        moment -= wp.transpose(solve.to_ang) * rate_seeds[k]
    m.lin = solve_lin(inverse, force, moment)
    m.ang = solve_ang(inverse, force, moment)
    for k in range(rates.shape[0]):
        solve = legs[world, step, k]
        rates[k] = solve.inverse * rate_seeds[k] - solve.to_lin * m.lin - solve.to_ang * m.ang
    return m


@wp.func
def replay_step(
    robot: Robot, params: wp.array(dtype=LegParams), dt: real, world: int, force: vec3, moment: vec3, rows: Rows,
    step: int, i: int, record: StepRecord,
):  # fmt: skip
    """Make a step again from entry i of the record, with known torques and impulses; writes the record."""
    base = record.base[world, i]
    g = wp.quat_rotate_inv(base.quat, load_vec3(robot.table, GRAVITY, world))
    system = base_system(robot, world, base, g, force, moment)
    for k in range(record.legs.shape[2]):
        torque = row_vec3(rows.torque, step, 3 * k, world)
        pressed = int(rows.pressed[step, k, world])
        angles = record.angles[world, i, k]
        stops = stop_rows(load_stops(robot.table, k, world), angles, dt)
        spring = load_spring(robot.table, k, world)
        rates = record.rates[world, i, k]
        terms = leg_terms(params[k], spring, angles, rates, torque, stops, pressed, base.ang, g, dt)
        record.legs[world, i, k] = terms.solve
        record.paws[world, i, k] = terms.paw
        system = add_leg(system, terms.dynamics, terms.solve)
    inverse = hold_base(robot, world, invert(system))
    record.inverse[world, i] = inverse
    force_impulse = dt * system.force
    moment_impulse = dt * system.moment
    for k in range(record.legs.shape[2]):
        impulse = wp.quat_rotate_inv(base.quat, rows.impulse[step, k, world])
        if wp.dot(impulse, impulse) > real(0.0):
            solve = record.legs[world, i, k]
            paw = record.paws[world, i, k]
            contact = contact_at(robot, k, base, paw, solve, inverse, impulse)
            joint = wp.transpose(contact.jacobian) * impulse
            force_impulse += impulse - wp.transpose(solve.to_lin) * joint
            moment_impulse += (
                wp.cross(contact_point(robot, k, paw, contact), impulse) - wp.transpose(solve.to_ang) * joint
            )
            solve.free += solve.inverse * (joint / dt)
            record.legs[world, i, k] = solve
    lin = solve_lin(inverse, force_impulse, moment_impulse)
    ang = solve_ang(inverse, force_impulse, moment_impulse)
    for k in range(record.legs.shape[2]):
        rates = record.rates[world, i, k] + dt * motor_acceleration(record.legs[world, i, k], lin / dt, ang / dt)
        record.rates[world, i + 1, k] = rates
        record.angles[world, i + 1, k] = record.angles[world, i, k] + dt * rates
    record.base[world, i + 1] = moved_base(base, wp.quat_rotate_inv(base.quat, base.lin) + lin, base.ang + ang, dt)


@wp.func
def reverse_step(
    robot: Robot, all_params: wp.array(dtype=LegParams), dt: real, world: int, t: int, force: vec3, moment: vec3,
    first_impulse: wp.array2d(dtype=vec3), rows: Rows, seeds: Rows, step: int, i: int, record: StepRecord,
    adj: BaseState, angle_adj: wp.array(dtype=vec3), rate_adj: wp.array(dtype=vec3), torque_adj: wp.array(dtype=vec3),
    contacts: wp.array(dtype=PawContact), laws: wp.array(dtype=PawLaw), paw_seeds: wp.array(dtype=vec3),
    matrix: wp.array2d(dtype=real), vector: wp.array(dtype=real), virtual: wp.array(dtype=vec3),
    sums: wp.array(dtype=real), wrench_adj: wp.array3d(dtype=real),
) -> BaseState:  # fmt: skip
    """Run a step backwards: from the gradient by the state at its end to that by the state at its start.

    adj, angle_adj, rate_adj: gradient by the base's state and the motors'; the latter are replaced in place.
    torque_adj (4,): gradient by the motors' torques, which is written.
    """
    base = record.base[world, i]
    ahead = record.base[world, i + 1]
    inverse = record.inverse[world, i]
    lin = wp.quat_rotate_inv(base.quat, ahead.lin)
    ang = ahead.ang
    old_lin = wp.quat_rotate_inv(base.quat, base.lin)
    # integration of the coordinates
    new_velocity = adj.lin + dt * adj.pos
    quat_adj, ang_seed, _dt, _seed = wp.grad(turned)(base.quat, ang, dt, adj.quat)
    for k in range(laws.shape[0]):
        rate_adj[k] = rate_adj[k] + dt * angle_adj[k]
    m = solve_system(
        inverse, wp.quat_rotate_inv(base.quat, new_velocity), ang_seed + adj.ang, record.legs, world, i, rate_adj,
        virtual,
    )  # fmt: skip
    # contact
    pushed_by = seeds.impulse.shape[0] > 0
    touching = bool(False)
    for k in range(laws.shape[0]):
        laws[k] = PawLaw()
        impulse = wp.quat_rotate_inv(base.quat, rows.impulse[step, k, world])
        if wp.dot(impulse, impulse) > real(0.0):
            paw = record.paws[world, i, k]
            c = contact_at(robot, k, base, paw, record.legs[world, i, k], inverse, impulse)
            point = contact_point(robot, k, paw, c)
            before = old_lin + wp.cross(base.ang, point) + c.jacobian * record.rates[world, i, k]
            velocity = lin + wp.cross(ang, point) + c.jacobian * record.rates[world, i + 1, k]
            old_impulse = first_impulse[k, world]
            if step > 0:
                old_impulse = rows.impulse[step - 1, k, world]
            old_impulse = wp.quat_rotate_inv(base.quat, old_impulse)
            law = paw_law(robot, world, k, c, before, velocity, old_impulse)
            seed = m.lin + wp.cross(m.ang, point) + c.jacobian * virtual[k]
            if pushed_by:
                seed += wp.quat_rotate_inv(base.quat, seeds.impulse[step, k, world])
            contacts[k] = c
            laws[k] = law
            paw_seeds[k] = seed
            touching = touching or law.mode != SEPARATE
    if touching:
        solve_laws(contacts, laws, paw_seeds, matrix, vector)
        more_lin = vec3(real(0.0))
        more_ang = vec3(real(0.0))
        for k in range(laws.shape[0]):
            if laws[k].mode != SEPARATE:
                c = contacts[k]
                y = wp.transpose(laws[k].by_velocity) * paw_seeds[k]
                joint = wp.transpose(c.jacobian) * y
                more_lin += c.to_lin * y
                more_ang += c.to_ang * y
                m.lin_seed += y
                m.ang_seed += wp.cross(contact_point(robot, k, record.paws[world, i, k], c), y)
                rate_adj[k] = rate_adj[k] + joint
                virtual[k] = virtual[k] + record.legs[world, i, k].inverse * joint
        m.lin += more_lin
        m.ang += more_ang
        for k in range(laws.shape[0]):
            solve = record.legs[world, i, k]
            virtual[k] = virtual[k] - solve.to_lin * more_lin - solve.to_ang * more_ang
    # the equations of motion
    held = BaseFactors()
    held.virtual_lin = m.lin
    held.virtual_ang = m.ang
    held.lin_acc = (lin - old_lin) / dt
    held.ang_acc = (ang - base.ang) / dt
    held.lin = lin
    held.ang = ang
    gravity = load_vec3(robot.table, GRAVITY, world)
    g = wp.quat_rotate_inv(base.quat, gravity)
    out = BaseState()
    out.pos = adj.pos
    out.quat = quat_adj
    out.ang = m.ang_seed
    g_adj = vec3(real(0.0))
    for k in range(laws.shape[0]):
        params = all_params[k]
        old_rates = record.rates[world, i, k]
        leg = LegFactors()
        leg.virtual_rates = virtual[k]
        leg.rates = record.rates[world, i + 1, k]
        leg.acc = (leg.rates - old_rates) / dt
        leg.mode = laws[k].mode
        leg.pressed = int(rows.pressed[step, k, world])
        mu = real(0.0)
        if leg.mode != SEPARATE:
            leg.impulse = contacts[k].impulse
            leg.law = paw_seeds[k]
            mu = laws[k].mu
            if pushed_by:
                leg.push = seeds.impulse[step, k, world]
        (geo, masses, joints, spring, stops, _ground, mu_adj, pos, turn, omega, g_part, angles, rates, _held, _leg,
         _step) = (
            wp.grad(leg_action)(
                params.geometry, params.masses, params.joints, load_spring(robot.table, k, world),
                load_stops(robot.table, k, world), robot.ground, mu, base.pos, base.quat, base.ang, g,
                record.angles[world, i, k], old_rates, held, leg, dt,
            )
        )  # fmt: skip
        add_geometry(sums, k, geo)
        add_masses(sums, k, masses)
        add_joints(sums, k, joints)
        add_spring(sums, k, spring)
        add_stops(sums, k, stops)
        if leg.mode != SEPARATE:
            add_entry(sums, laws[k].mu_row, mu_adj)
        out.pos += pos
        out.quat += turn
        out.ang += omega
        g_adj += g_part
        angle_adj[k] = angle_adj[k] + angles
        rate_adj[k] = rate_adj[k] + rates
        torque_adj[k] = dt * virtual[k]
    base_seeds = BaseSeeds()
    base_seeds.velocity = m.lin_seed
    base_seeds.new_velocity = new_velocity
    base_seeds.gravity = g_adj
    body, com, weight, force_adj, moment_adj, turn, lin_adj, omega, _base, _seeds, _dt_base = wp.grad(
        base_action
    )(load_moments(robot.table, BASE, world), base_com(robot.table, world), gravity, force, moment, base.quat,
        base.lin, base.ang, held, base_seeds, dt,
    )  # fmt: skip
    add_moments(sums, BASE, body)
    add_com(sums, robot.table[BASE, world], base_com(robot.table, world), com)
    add_vec3(sums, GRAVITY, weight)
    store_row_vec3(wrench_adj, t, 0, world, row_vec3(wrench_adj, t, 0, world) + force_adj)
    store_row_vec3(wrench_adj, t, 3, world, row_vec3(wrench_adj, t, 3, world) + moment_adj)
    out.quat += turn
    out.lin = lin_adj
    out.ang += omega
    return out
