"""The reverse pass of a rollout, all its steps in a launch, a thread a world.

From row to row, backwards: the steps between two rows are made again, with the impulses that the rollout found, and
then run backwards one by one (`step_adjoint`, `virtual_power`).
"""

import warp as wp

from ..actuation.command_filter import FilterParams, filter_leg
from ..actuation.motors import MotorParams, motor_torque
from ..layout import BASE, GRAVITY
from ..scalar import quat, real, vec2, vec3
from ..state import BaseState, base_com
from .base_dynamics import add_leg, invert, motor_acceleration, solve_ang, solve_lin
from .base_motion import moved_base
from .contact import SEPARATE, PawContact
from .gradients import (
    GRADIENT_ROWS,
    LATENCY_GRADIENT,
    MOTOR_GRADIENT,
    Gradients,
    add_com,
    add_entry,
    add_filter,
    add_geometry,
    add_joints,
    add_masses,
    add_moments,
    add_motor,
    add_vec3,
)
from .parameters import load_moments, load_vec3
from .rollout import (
    Actuation,
    Commands,
    Rows,
    Timing,
    arrival,
    commanded,
    load_filter,
    load_row_base,
    load_world_motor,
    row_base,
    row_quat,
    row_vec3,
    store_row_vec3,
)
from .step import LegParams, Robot, StepSettings, base_system, leg_terms, load_leg
from .step_adjoint import (
    PawLaw,
    StepRecord,
    contact_at,
    contact_point,
    paw_law,
    solve_laws,
    solve_system,
)
from .virtual_power import BaseFactors, BaseSeeds, LegFactors, base_action, leg_action, turned

wp.set_module_options({"enable_backward": False})


@wp.func
def wrench_part(commands: Commands, t: int, first: int, world: int) -> vec3:
    """Return force (first = 0) or moment (first = 3) on the base in a policy step, world axes."""
    return row_vec3(commands.wrench, t, first, world)


@wp.func
def replay_step(
    robot: Robot, params: wp.array(dtype=LegParams), dt: real, world: int, force: vec3, moment: vec3, torques: wp.array3d(dtype=real),
    impulses: wp.array3d(dtype=vec3), step: int, i: int, record: StepRecord,
):  # fmt: skip
    """Make a step again from entry i of the record, with known torques and impulses; writes the record."""
    base = record.base[world, i]
    g = wp.quat_rotate_inv(base.quat, load_vec3(robot.table, GRAVITY, world))
    system = base_system(robot, world, base, g, force, moment)
    for k in range(record.legs.shape[2]):
        torque = row_vec3(torques, step, 3 * k, world)
        terms = leg_terms(params[k], record.angles[world, i, k], record.rates[world, i, k], torque, base.ang, g, dt)
        record.legs[world, i, k] = terms.solve
        record.paws[world, i, k] = terms.paw
        system = add_leg(system, terms.dynamics, terms.solve)
    inverse = invert(system)
    record.inverse[world, i] = inverse
    force_impulse = dt * system.force
    moment_impulse = dt * system.moment
    for k in range(record.legs.shape[2]):
        impulse = wp.quat_rotate_inv(base.quat, impulses[step, k, world])
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
    robot: Robot, all_params: wp.array(dtype=LegParams), dt: real, world: int, force: vec3, moment: vec3, impulses: wp.array3d(dtype=vec3), seeds: Rows,
    step: int, i: int, record: StepRecord, adj: BaseState, angle_adj: wp.array(dtype=vec3),
    rate_adj: wp.array(dtype=vec3), torque_adj: wp.array(dtype=vec3), contacts: wp.array(dtype=PawContact),
    laws: wp.array(dtype=PawLaw), paw_seeds: wp.array(dtype=vec3), matrix: wp.array2d(dtype=real),
    vector: wp.array(dtype=real), virtual: wp.array(dtype=vec3), sums: wp.array(dtype=real), gradients: Gradients, t: int,
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
        impulse = wp.quat_rotate_inv(base.quat, impulses[step, k, world])
        if wp.dot(impulse, impulse) > real(0.0):
            paw = record.paws[world, i, k]
            c = contact_at(robot, k, base, paw, record.legs[world, i, k], inverse, impulse)
            point = contact_point(robot, k, paw, c)
            before = old_lin + wp.cross(base.ang, point) + c.jacobian * record.rates[world, i, k]
            velocity = lin + wp.cross(ang, point) + c.jacobian * record.rates[world, i + 1, k]
            old_impulse = vec3(real(0.0))
            if step > 0:
                old_impulse = wp.quat_rotate_inv(base.quat, impulses[step - 1, k, world])
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
        mu = real(0.0)
        if leg.mode != SEPARATE:
            leg.impulse = contacts[k].impulse
            leg.law = paw_seeds[k]
            mu = laws[k].mu
            if pushed_by:
                leg.push = seeds.impulse[step, k, world]
        geo, masses, joints, _ground, mu_adj, pos, turn, omega, g_part, angles, rates, _held, _leg, _step = wp.grad(
            leg_action
        )(params.geometry, params.masses, params.joints, robot.ground, mu, base.pos, base.quat, base.ang, g,
          record.angles[world, i, k], old_rates, held, leg, dt)  # fmt: skip
        add_geometry(sums, k, geo)
        add_masses(sums, k, masses)
        add_joints(sums, k, joints)
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
    body, com, weight, force_adj, moment_adj, turn, lin_adj, omega, _base_held, _seeds, _base_step = wp.grad(base_action)(
        load_moments(robot.table, BASE, world), base_com(robot.table, world), gravity, force, moment, base.quat,
        base.lin, base.ang, held, base_seeds, dt,
    )  # fmt: skip
    add_moments(sums, BASE, body)
    add_com(sums, robot.table[BASE, world], base_com(robot.table, world), com)
    add_vec3(sums, GRAVITY, weight)
    store_row_vec3(gradients.wrench, t, 0, world, row_vec3(gradients.wrench, t, 0, world) + force_adj)
    store_row_vec3(gradients.wrench, t, 3, world, row_vec3(gradients.wrench, t, 3, world) + moment_adj)
    out.quat += turn
    out.lin = lin_adj
    out.ang += omega
    return out


@wp.struct
class FilterSeeds:
    """Gradient by a leg's motor angles and rates through the filter."""

    angles: vec3
    rates: vec3


@wp.func
def add_target(gradients: Gradients, step: int, motor: int, world: int, x: real):
    """Add to the gradient by a motor's filtered target of a policy step, or by what it followed before the first."""
    if step < 0:
        gradients.before[motor, world] = gradients.before[motor, world] + x
    else:
        gradients.safe[step, motor, world] = gradients.safe[step, motor, world] + x


@wp.func
def reverse_motor(
    params: MotorParams, late: real, commands: Commands, safe: wp.array3d(dtype=real), timing: Timing, dt: real, step: int,
    motor: int, world: int, angle: real, rate: real, seed: real, sums: wp.array(dtype=real),
    gradients: Gradients,
) -> vec2:  # fmt: skip
    """Add a motor's gradients for that of its torque, `seed`; return those by its angle and rate."""
    arrived = arrival(step, timing.substeps, late)
    newer = commanded(safe, commands.before, arrived.newer, motor, world)
    older = newer
    target = newer
    if arrived.newer > arrived.older:
        older = commanded(safe, commands.before, arrived.older, motor, world)
        if arrived.weight != real(1.0):
            target = older + arrived.weight * (newer - older)
    by_target, by_angle, by_rate, by_motor = wp.grad(motor_torque)(target, angle, rate, params)
    add_motor(sums, motor, seed, by_motor)
    add_target(gradients, arrived.newer, motor, world, seed * arrived.weight * by_target)
    if arrived.newer > arrived.older:
        add_target(gradients, arrived.older, motor, world, seed * (real(1.0) - arrived.weight) * by_target)
        add_entry(sums, LATENCY_GRADIENT, -seed * by_target * (newer - older) / dt)
    return vec2(seed * by_angle, seed * by_rate)


@wp.func
def weighed_filter(target: vec3, angles: vec3, rates: vec3, params: FilterParams, seed: vec3) -> real:
    """Return the weighed sum of a leg's filtered targets."""
    return wp.dot(seed, filter_leg(target, angles, rates, params))


@wp.func
def reverse_filter(
    commands: Commands, actuation: Actuation, step: int, leg: int, world: int, angles: vec3, rates: vec3,
    sums: wp.array(dtype=real), gradients: Gradients,
) -> FilterSeeds:  # fmt: skip
    """Carry the gradient by a leg's filtered targets on to its targets; return those by its motor angles and rates."""
    m = 3 * leg
    seed = row_vec3(gradients.safe, step, m, world)
    found = FilterSeeds()
    by_target = seed
    if actuation.filtered != 0:
        offset = actuation.motors.offset
        read = angles + vec3(offset[m, world], offset[m + 1, world], offset[m + 2, world])
        target = row_vec3(commands.target, step, m, world)
        by_target, by_angles, by_rates, by_params, _seed = wp.grad(weighed_filter)(
            target, read, rates, load_filter(actuation.limits, world), seed
        )
        found.angles = by_angles
        found.rates = by_rates
        add_vec3(sums, MOTOR_GRADIENT + 72 + m, by_angles)
        add_filter(sums, by_params)
    store_row_vec3(gradients.target, step, m, world, by_target)
    return found


@wp.func
def weighed_row(pos: vec3, orientation: quat, com_lin: vec3, ang: vec3, com: vec3, seed: BaseState) -> real:
    """Return the weighed state of the base that a row holds."""
    base = row_base(pos, orientation, com_lin, ang, com)
    return (
        wp.dot(seed.pos, base.pos)
        + wp.dot(seed.quat, base.quat)
        + wp.dot(seed.lin, base.lin)
        + wp.dot(seed.ang, base.ang)
    )


@wp.func
def weighed_store(orientation: quat, lin: vec3, omega: vec3, com: vec3, lin_seed: vec3, ang_seed: vec3) -> real:
    """Return the weighed velocities that a row holds of a state of the base."""
    ang = wp.quat_rotate(orientation, omega)
    return wp.dot(ang_seed, ang) + wp.dot(lin_seed, lin + wp.cross(ang, wp.quat_rotate(orientation, com)))


@wp.struct
class RowSeeds:
    """Gradient by the base's entries of a row."""

    pos: vec3
    quat: quat
    lin: vec3
    ang: vec3


@wp.func
def leave_row(rows: Rows, robot: Robot, row: int, world: int, adj: BaseState, sums: wp.array(dtype=real)) -> RowSeeds:
    """Return the gradient by a row's entries for that by the base's state which is read from it."""
    com = base_com(robot.table, world)
    pos, orientation, lin, ang, com_adj, _seed = wp.grad(weighed_row)(
        row_vec3(rows.q, row, 0, world), row_quat(rows.q, row, 3, world), row_vec3(rows.qd, row, 0, world),
        row_vec3(rows.qd, row, 3, world), com, adj,
    )  # fmt: skip
    add_com(sums, robot.table[BASE, world], com, com_adj)
    seeds = RowSeeds()
    seeds.pos = pos
    seeds.quat = orientation
    seeds.lin = lin
    seeds.ang = ang
    return seeds


@wp.func
def add_row_seeds(into: RowSeeds, seeds: Rows, row: int, world: int) -> RowSeeds:
    """Return the gradient by a row's entries with that of the number itself added."""
    s = into
    if seeds.q.shape[0] > 0:
        s.pos += row_vec3(seeds.q, row, 0, world)
        s.quat += row_quat(seeds.q, row, 3, world)
    if seeds.qd.shape[0] > 0:
        s.lin += row_vec3(seeds.qd, row, 0, world)
        s.ang += row_vec3(seeds.qd, row, 3, world)
    return s


@wp.func
def enter_row(robot: Robot, world: int, base: BaseState, seeds: RowSeeds, sums: wp.array(dtype=real)) -> BaseState:
    """Return the gradient by the base's state which a row was written from, for that by the row's entries."""
    com = base_com(robot.table, world)
    orientation, lin, ang, com_adj, _lin, _ang = wp.grad(weighed_store)(
        base.quat, base.lin, base.ang, com, seeds.lin, seeds.ang
    )
    add_com(sums, robot.table[BASE, world], com, com_adj)
    adj = BaseState()
    adj.pos = seeds.pos
    adj.quat = seeds.quat + orientation
    adj.lin = lin
    adj.ang = ang
    return adj


@wp.kernel
def reverse_kernel(
    # in
    robot: Robot,
    settings: StepSettings,
    timing: Timing,
    actuation: Actuation,
    commands: Commands,
    safe: wp.array3d(dtype=real),
    rows: Rows,
    seeds: Rows,
    # out
    record: StepRecord,
    gradients: Gradients,
):
    """Add the gradient of a number, given that by the trajectory in `seeds`, to `gradients`; one thread per world."""
    world = settings.first + wp.tid()
    dt = settings.dt
    angle_adj = wp.zeros(shape=(4,), dtype=vec3)
    rate_adj = wp.zeros(shape=(4,), dtype=vec3)
    torque_adj = wp.zeros(shape=(4,), dtype=vec3)
    virtual = wp.zeros(shape=(4,), dtype=vec3)
    paw_seeds = wp.zeros(shape=(4,), dtype=vec3)
    contacts = wp.zeros(shape=(4,), dtype=PawContact)
    laws = wp.zeros(shape=(4,), dtype=PawLaw)
    matrix = wp.zeros(shape=(12, 12), dtype=real)
    vector = wp.zeros(shape=(12,), dtype=real)
    sums = wp.zeros(shape=(GRADIENT_ROWS,), dtype=real)
    params = wp.zeros(shape=(4,), dtype=LegParams)
    motors = wp.zeros(shape=(12,), dtype=MotorParams)
    for k in range(params.shape[0]):
        params[k] = load_leg(robot, world, k)
    for i in range(motors.shape[0]):
        motors[i] = load_world_motor(actuation, i, world)
    late = actuation.latency[world] / dt
    last = timing.steps * timing.substeps / timing.every
    entries = add_row_seeds(RowSeeds(), seeds, last, world)
    for k in range(laws.shape[0]):
        if seeds.q.shape[0] > 0:
            angle_adj[k] = row_vec3(seeds.q, last, 7 + 3 * k, world)
        if seeds.qd.shape[0] > 0:
            rate_adj[k] = row_vec3(seeds.qd, last, 6 + 3 * k, world)
    com = base_com(robot.table, world)
    for back in range(last):
        row = last - 1 - back
        first = row * timing.every
        t = first / timing.substeps
        force = wrench_part(commands, t, 0, world)
        moment = wrench_part(commands, t, 3, world)
        record.base[world, 0] = load_row_base(rows, row, world, com)
        for k in range(laws.shape[0]):
            record.angles[world, 0, k] = row_vec3(rows.q, row, 7 + 3 * k, world)
            record.rates[world, 0, k] = row_vec3(rows.qd, row, 6 + 3 * k, world)
        for i in range(timing.every):
            replay_step(robot, params, dt, world, force, moment, rows.torque, rows.impulse, first + i, i, record)
        adj = enter_row(robot, world, record.base[world, timing.every], entries, sums)
        for j in range(timing.every):
            i = timing.every - 1 - j
            adj = reverse_step(
                robot, params, dt, world, force, moment, rows.impulse, seeds, first + i, i, record, adj, angle_adj, rate_adj,
                torque_adj, contacts, laws, paw_seeds, matrix, vector, virtual, sums, gradients, t,
            )  # fmt: skip
            for k in range(laws.shape[0]):
                angles = record.angles[world, i, k]
                rates = record.rates[world, i, k]
                angle_sum = angle_adj[k]
                rate_sum = rate_adj[k]
                for c in range(wp.static(3)):
                    seed = torque_adj[k][c]
                    if seeds.torque.shape[0] > 0:
                        seed += seeds.torque[first + i, 3 * k + c, world]
                    by_state = reverse_motor(
                        motors[3 * k + c], late, commands, safe, timing, dt, first + i, 3 * k + c, world, angles[c],
                        rates[c], seed, sums, gradients,
                    )  # fmt: skip
                    angle_sum[c] += by_state[0]
                    rate_sum[c] += by_state[1]
                angle_adj[k] = angle_sum
                rate_adj[k] = rate_sum
        entries = add_row_seeds(leave_row(rows, robot, row, world, adj, sums), seeds, row, world)
        for k in range(laws.shape[0]):
            if first == t * timing.substeps:
                by_leg = reverse_filter(
                    commands,
                    actuation,
                    t,
                    k,
                    world,
                    record.angles[world, 0, k],
                    record.rates[world, 0, k],
                    sums,
                    gradients,
                )
                angle_adj[k] = angle_adj[k] + by_leg.angles
                rate_adj[k] = rate_adj[k] + by_leg.rates
            if seeds.q.shape[0] > 0:
                angle_adj[k] = angle_adj[k] + row_vec3(seeds.q, row, 7 + 3 * k, world)
            if seeds.qd.shape[0] > 0:
                rate_adj[k] = rate_adj[k] + row_vec3(seeds.qd, row, 6 + 3 * k, world)
    for i in range(sums.shape[0]):
        gradients.parameters[i, world] = sums[i]
    for i in range(3):
        gradients.q[i, world] = entries.pos[i]
        gradients.qd[i, world] = entries.lin[i]
        gradients.qd[3 + i, world] = entries.ang[i]
    for i in range(4):
        gradients.q[3 + i, world] = entries.quat[i]
    for k in range(4):
        for i in range(3):
            gradients.q[7 + 3 * k + i, world] = angle_adj[k][i]
            gradients.qd[6 + 3 * k + i, world] = rate_adj[k][i]


@wp.kernel(enable_backward=True)
def adjoints_kernel(
    factors: LegFactors, base: BaseFactors, base_seeds: BaseSeeds, robot: Robot, actuation: Actuation, numbers: Rows,
    state: BaseState, sums: wp.array(dtype=real),
):  # fmt: skip
    """Never launched: a kernel with a backward pass makes Warp generate the adjoints of all that it calls.

    `wp.grad` alone leaves out those of functions which something else called first.
    """
    world = wp.tid()
    params = load_leg(robot, world, 0)
    v = row_vec3(numbers.q, 0, 0, world)
    q = row_quat(numbers.q, 0, 3, world)
    x = numbers.q[0, 0, world]
    sums[world] = (
        leg_action(params.geometry, params.masses, params.joints, robot.ground, x, v, q, v, v, v, v, base, factors, x)
        + base_action(load_moments(robot.table, BASE, world), v, v, v, v, q, v, v, base, base_seeds, x)
        + turned(q, v, x, q)
        + motor_torque(x, x, x, load_world_motor(actuation, 0, world))
        + weighed_filter(v, v, v, load_filter(actuation.limits, world), v)
        + weighed_row(v, q, v, v, v, state)
        + weighed_store(q, v, v, v, v, v)
    )
