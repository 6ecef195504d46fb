"""`rollout_adjoint` for GPUs: four threads a world, a thread a leg; a few rows at a time, from the last to the first.

Four launches take the steps between these rows: they are made again, each row by threads of its own, run backwards one
by one, and then twice more side by side for the gradients by parameters (`constants_adjoint`).
"""

import warp as wp

from ...actuation.motors import MotorParams
from ...lanes import sync_lanes
from ...layout import BASE, GRAVITY
from ...scalar import quat, real, vec3
from ...state import base_com
from ..step import Robot, StepSettings, load_leg
from ..trajectory import (
    Actuation,
    Arrival,
    Commands,
    Rows,
    Timing,
    arrival,
    load_row_base,
    load_world_motor,
    row_vec3,
    store_row_vec3,
)
from .command_adjoint import add_targets, filter_gradient, motor_gradient
from .gradients import Gradients, add_com, add_filter, add_moments, add_vec3, thread_sums
from .leg_adjoint import LegAdjoint, replay_leg, reverse_leg
from .leg_record import (
    ANGLES,
    FILTER,
    RATES,
    LegRecord,
    MotorSlopes,
    get_base,
    get_slopes,
    get_vec,
    put_base,
    put_slopes,
    put_vec,
)
from .rollout_adjoint import RowSeeds, add_row_seeds, add_wrench, enter_row, generate_adjoints, leave_row

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class Span:
    """The rows whose steps a launch takes."""

    begin: int
    end: int  # excluded


@wp.func
def first_entry(timing: Timing, span: Span, row: int) -> int:
    """Return the record's entry of the first step after a row; that of its end follows the last one."""
    return (row - span.begin) * (timing.every + 1)


@wp.kernel
def replay_legs_kernel(
    # in
    count: int,
    robot: Robot,
    settings: StepSettings,
    timing: Timing,
    actuation: Actuation,
    commands: Commands,
    safe: wp.array3d(dtype=real),
    rows: Rows,
    span: Span,
    # out
    record: LegRecord,
):
    """Make the steps after each row again; launch over (rows of the span, count rounded up to a multiple of 8, 4).

    Threads beyond the last world repeat it, and write the same bits.
    """
    offset, place, leg = wp.tid()
    world = settings.first + wp.min(place, count - 1)
    row = span.begin + offset
    at = first_entry(timing, span, row)
    first = row * timing.every
    t = first / timing.substeps
    own = load_leg(robot, world, leg)
    force = row_vec3(commands.wrench, t, 0, world)
    moment = row_vec3(commands.wrench, t, 3, world)
    put_base(record, at, world, load_row_base(rows, row, world, base_com(robot.table, world)))
    put_vec(record, at, ANGLES, world, leg, row_vec3(rows.q, row, 7 + 3 * leg, world))
    put_vec(record, at, RATES, world, leg, row_vec3(rows.qd, row, 6 + 3 * leg, world))
    sync_lanes()
    motors = wp.zeros(shape=(3,), dtype=MotorParams)
    for c in range(motors.shape[0]):
        motors[c] = load_world_motor(actuation, 3 * leg + c, world)
    late = actuation.latency[world] / settings.dt
    for i in range(timing.every):
        step = first + i
        replay_leg(robot, own, settings.dt, world, leg, force, moment, commands.impulse, rows, step, at + i, record)
        sync_lanes()
        angles = get_vec(record, at + i, ANGLES, world, leg)
        rates = get_vec(record, at + i, RATES, world, leg)
        slopes = MotorSlopes()
        for c in range(motors.shape[0]):
            by_motor = motor_gradient(
                motors[c], late, commands, safe, timing, settings.dt, step, 3 * leg + c, world, angles[c], rates[c]
            )
            slopes.target[c] = by_motor.target
            slopes.angle[c] = by_motor.angle
            slopes.rate[c] = by_motor.rate
        put_slopes(record, at + i, world, leg, slopes)


@wp.func
def load_entries(gradients: Gradients, world: int) -> RowSeeds:
    """Return the gradient by the base's entries of the row after a span."""
    entries = RowSeeds()
    entries.pos = vec3(gradients.q[0, world], gradients.q[1, world], gradients.q[2, world])
    entries.quat = quat(gradients.q[3, world], gradients.q[4, world], gradients.q[5, world], gradients.q[6, world])
    entries.lin = vec3(gradients.qd[0, world], gradients.qd[1, world], gradients.qd[2, world])
    entries.ang = vec3(gradients.qd[3, world], gradients.qd[4, world], gradients.qd[5, world])
    return entries


@wp.func
def store_entries(gradients: Gradients, world: int, leg: int, entries: RowSeeds, adj: LegAdjoint):
    """Write the gradient by a span's first row; leg 0 writes the base's."""
    for i in range(3):
        gradients.q[7 + 3 * leg + i, world] = adj.angles[i]
        gradients.qd[6 + 3 * leg + i, world] = adj.rates[i]
        if leg == 0:
            gradients.q[i, world] = entries.pos[i]
            gradients.qd[i, world] = entries.lin[i]
            gradients.qd[3 + i, world] = entries.ang[i]
    if leg == 0:
        for i in range(4):
            gradients.q[3 + i, world] = entries.quat[i]


@wp.func
def load_motor_entries(gradients: Gradients, world: int, leg: int) -> LegAdjoint:
    """Return the gradient by a leg's entries of the row after a span."""
    m = 3 * leg
    adj = LegAdjoint()
    adj.angles = vec3(gradients.q[7 + m, world], gradients.q[8 + m, world], gradients.q[9 + m, world])
    adj.rates = vec3(gradients.qd[6 + m, world], gradients.qd[7 + m, world], gradients.qd[8 + m, world])
    return adj


@wp.func
def reverse_motors(
    old: LegAdjoint, slopes: MotorSlopes, arrived: Arrival, seeds: Rows, step: int, leg: int, world: int,
    gradients: Gradients, writes: bool,
) -> LegAdjoint:  # fmt: skip
    """Return the gradient with that by the motors' angles and rates; if it `writes`, add those by their targets."""
    adj = old
    seed = adj.torque
    if seeds.torque.shape[0] > 0:
        seed += row_vec3(seeds.torque, step, 3 * leg, world)
    adj.angles += wp.cw_mul(seed, slopes.angle)
    adj.rates += wp.cw_mul(seed, slopes.rate)
    if writes:
        by_target = wp.cw_mul(seed, slopes.target)
        for c in range(wp.static(3)):
            add_targets(gradients, arrived, 3 * leg + c, world, by_target[c])
    return adj


@wp.kernel
def reverse_legs_kernel(
    # in
    count: int,
    robot: Robot,
    settings: StepSettings,
    timing: Timing,
    actuation: Actuation,
    commands: Commands,
    safe: wp.array3d(dtype=real),
    rows: Rows,
    seeds: Rows,
    span: Span,
    # in, out
    record: LegRecord,
    gradients: Gradients,
):
    """Run the steps of a span backwards; launch over (count rounded up to a multiple of 8, 4).

    gradients.q and qd hold the gradient by the row after the span, and then that by its first row. Of those by
    parameters the base's and the filter's are added. Threads beyond the last world repeat it, and write nothing.
    """
    place, leg = wp.tid()
    world = settings.first + wp.min(place, count - 1)
    dt = settings.dt
    own = load_leg(robot, world, leg)
    late = actuation.latency[world] / dt
    entries = load_entries(gradients, world)
    adj = load_motor_entries(gradients, world, leg)
    of_leg = thread_sums(gradients, world, place < count, False, False)
    of_legs = thread_sums(gradients, world, place < count and leg == 0, False, True)
    for back in range(span.end - span.begin):
        row = span.end - 1 - back
        at = first_entry(timing, span, row)
        first = row * timing.every
        t = first / timing.substeps
        force = row_vec3(commands.wrench, t, 0, world)
        moment = row_vec3(commands.wrench, t, 3, world)
        end = enter_row(robot, world, get_base(record, at + timing.every, world), entries)
        adj.base = end.base
        adj.force = vec3(real(0.0))
        adj.moment = vec3(real(0.0))
        for j in range(timing.every):
            i = timing.every - 1 - j
            step = first + i
            adj = reverse_leg(
                robot, own, dt, world, leg, force, moment, rows, seeds, step, at + i, record, adj, place < count
            )
            arrived = arrival(step, timing.substeps, late)
            slopes = get_slopes(record, at + i, world, leg)
            adj = reverse_motors(adj, slopes, arrived, seeds, step, leg, world, gradients, place < count)
        entries = add_row_seeds(leave_row(rows, robot, row, world, adj.base, end.com), seeds, row, world)
        if place < count:
            if leg == 0:
                add_wrench(gradients, t, world, adj.force, adj.moment)
        if first == t * timing.substeps:
            by_filter = filter_gradient(
                commands, actuation, t, leg, world, get_vec(record, at, ANGLES, world, leg),
                get_vec(record, at, RATES, world, leg), gradients,
            )  # fmt: skip
            add_filter(of_legs, by_filter.constants)
            if place < count:
                put_vec(record, at, FILTER, world, leg, by_filter.angles)
                store_row_vec3(gradients.target, t, 3 * leg, world, by_filter.target)
            adj.angles += by_filter.angles
            adj.rates += by_filter.rates
        if seeds.q.shape[0] > 0:
            adj.angles += row_vec3(seeds.q, row, 7 + 3 * leg, world)
        if seeds.qd.shape[0] > 0:
            adj.rates += row_vec3(seeds.qd, row, 6 + 3 * leg, world)
    if place < count:
        store_entries(gradients, world, leg, entries, adj)
        if leg == 0:
            add_moments(of_leg, BASE, adj.body)
            add_com(of_leg, robot.table[BASE, world], base_com(robot.table, world), adj.com + entries.com)
            add_vec3(of_leg, GRAVITY, adj.gravity)


ADJOINTS = generate_adjoints(__name__)
