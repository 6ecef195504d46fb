"""Reverse pass of a rollout on GPUs, with four threads per world, one per leg.

The pass runs over spans, each of some trajectory rows, from the last span to the first. Each span takes four launches:
`replay_legs_kernel` recomputes its steps, all rows in parallel; `reverse_legs_kernel` runs backwards step by step; the
two kernels of `constants_adjoint` add the gradients w.r.t. parameters, all steps in parallel. Spans bound the memory of
the record; `gradients.q` and `gradients.qd` carry the gradient from one span to the next.

A trajectory has a row every `timing.every` physics steps. A cotangent is the gradient of the loss w.r.t. a result.
Kernels launch full warps of eight worlds, whose threads exchange values: threads beyond the last world repeat the last
world.
"""

import warp as wp

from ...actuation.motors import MotorParams
from ...lanes import sync_lanes
from ...layout import BASE, GRAVITY
from ...scalar import quat, real, vec3
from ...state import base_com
from ..step import RobotModel, StepSettings, load_leg
from ..trajectory import (
    Actuation,
    Arrival,
    Commands,
    Timing,
    TrajectoryArrays,
    arrival,
    load_row_base,
    load_world_motor,
    row_vec3,
    store_row_vec3,
)
from . import leg_record, rollout_adjoint
from .command_adjoint import add_targets, filter_gradient, motor_gradient
from .gradients import Gradients, add_com, add_filter, add_moments, add_vec3, thread_sums
from .leg_adjoint import LegAdjoint, replay_leg, reverse_leg
from .leg_record import ANGLES, FILTER, RATES, LegRecord, MotorSlopes
from .rollout_adjoint import RowCotangent, generate_adjoints

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class Span:
    """Range of trajectory rows whose physics steps one kernel launch processes."""

    begin: int  # first row
    end: int  # excluded


@wp.func
def first_entry(timing: Timing, span: Span, row: int) -> int:
    """Return the record entry of the first physics step after a trajectory row.

    Each row takes `every` + 1 entries: one a step, and the state after the last, from which no step starts.
    """
    return (row - span.begin) * (timing.every + 1)


@wp.kernel
def replay_legs_kernel(
    # in
    count: int,
    model: RobotModel,
    settings: StepSettings,
    timing: Timing,
    actuation: Actuation,
    commands: Commands,
    filtered_target: wp.array3d(dtype=real),
    trajectory: TrajectoryArrays,
    span: Span,
    # out
    record: LegRecord,
):
    """Recompute and record the physics steps of a range of trajectory rows (`span`), with a thread per row and leg.

    Launch over (rows of the span, count rounded up to a multiple of 8, 4). count: number of worlds, from
    `settings.first` on. Threads beyond the last world repeat it and write the same bits.
    """
    offset, index, leg = wp.tid()
    world = settings.first + wp.min(index, count - 1)
    row = span.begin + offset
    start_entry = first_entry(timing, span, row)
    first = row * timing.every
    t = first / timing.substeps
    params = load_leg(model, world, leg)
    force = row_vec3(commands.wrench, t, 0, world)
    moment = row_vec3(commands.wrench, t, 3, world)
    leg_record.put_base(record, start_entry, world, load_row_base(trajectory, row, world, base_com(model.table, world)))
    leg_record.put_vec(record, start_entry, ANGLES, world, leg, row_vec3(trajectory.q, row, 7 + 3 * leg, world))
    leg_record.put_vec(record, start_entry, RATES, world, leg, row_vec3(trajectory.qd, row, 6 + 3 * leg, world))
    sync_lanes()
    motors = wp.zeros(shape=(3,), dtype=MotorParams)
    for c in range(motors.shape[0]):
        motors[c] = load_world_motor(actuation, 3 * leg + c, world)
    delay = actuation.latency[world] / settings.dt
    for i in range(timing.every):
        step = first + i
        replay_leg(
            model, params, settings.dt, world, leg, force, moment, commands.impulse, trajectory, step, start_entry + i,
            record,
        )  # fmt: skip
        sync_lanes()
        angles = leg_record.get_vec(record, start_entry + i, ANGLES, world, leg)
        rates = leg_record.get_vec(record, start_entry + i, RATES, world, leg)
        slopes = MotorSlopes()
        for c in range(motors.shape[0]):
            by_motor = motor_gradient(
                motors[c], delay, commands, filtered_target, timing, settings.dt, step, 3 * leg + c, world, angles[c],
                rates[c],
            )  # fmt: skip
            slopes.target[c] = by_motor.target
            slopes.angle[c] = by_motor.angle
            slopes.rate[c] = by_motor.rate
        leg_record.put_slopes(record, start_entry + i, world, leg, slopes)


@wp.func
def load_entries(gradients: Gradients, world: int) -> RowCotangent:
    """Return the gradient w.r.t. the base entries of a trajectory row, read from `gradients.q` and `gradients.qd`."""
    entries = RowCotangent()
    entries.pos = vec3(gradients.q[0, world], gradients.q[1, world], gradients.q[2, world])
    entries.quat = quat(gradients.q[3, world], gradients.q[4, world], gradients.q[5, world], gradients.q[6, world])
    entries.lin = vec3(gradients.qd[0, world], gradients.qd[1, world], gradients.qd[2, world])
    entries.ang = vec3(gradients.qd[3, world], gradients.qd[4, world], gradients.qd[5, world])
    return entries


@wp.func
def load_motor_entries(gradients: Gradients, world: int, leg: int) -> LegAdjoint:
    """Return the gradient w.r.t. a leg's motor angles and rates, read from `gradients.q` and `qd`; all else is 0."""
    m = 3 * leg
    adj = LegAdjoint()
    adj.angles = vec3(gradients.q[7 + m, world], gradients.q[8 + m, world], gradients.q[9 + m, world])
    adj.rates = vec3(gradients.qd[6 + m, world], gradients.qd[7 + m, world], gradients.qd[8 + m, world])
    return adj


@wp.func
def reverse_motors(
    old: LegAdjoint, slopes: MotorSlopes, arrived: Arrival, cotangent: TrajectoryArrays, step: int, leg: int,
    world: int, gradients: Gradients, writes: bool,
) -> LegAdjoint:  # fmt: skip
    """Return `old` plus the gradient w.r.t. a leg's angles and rates through its motor torques in a physics step.

    old.torque and cotangent.torque: gradient w.r.t. the torques, through the motion and directly. slopes: derivatives
    of the torques. arrived: which two policy targets each motor interpolated. writes: whether this thread adds the
    gradient w.r.t. the targets to `gradients`.
    """
    adj = old
    torque_cotangent = adj.torque
    if cotangent.torque.shape[0] > 0:
        torque_cotangent += row_vec3(cotangent.torque, step, 3 * leg, world)
    adj.angles += wp.cw_mul(torque_cotangent, slopes.angle)
    adj.rates += wp.cw_mul(torque_cotangent, slopes.rate)
    if writes:
        by_target = wp.cw_mul(torque_cotangent, slopes.target)
        for c in range(wp.static(3)):
            add_targets(gradients, arrived, 3 * leg + c, world, by_target[c])
    return adj


@wp.kernel
def reverse_legs_kernel(
    # in
    count: int,
    model: RobotModel,
    settings: StepSettings,
    timing: Timing,
    actuation: Actuation,
    commands: Commands,
    filtered_target: wp.array3d(dtype=real),
    trajectory: TrajectoryArrays,
    cotangent: TrajectoryArrays,
    span: Span,
    # in, out
    record: LegRecord,
    gradients: Gradients,
):
    """Backpropagate through the physics steps of a range of trajectory rows (`span`), with a thread per leg.

    Launch over (count rounded up to a multiple of 8, 4). Before the launch, gradients.q and gradients.qd have the
    gradient w.r.t. the row after the span; after the launch, w.r.t. its first row. The kernel also adds the gradients
    w.r.t. the parameters of base, gravity and filter. count: number of worlds, from `settings.first` on; threads beyond
    the last world repeat it and write nothing.
    """
    index, leg = wp.tid()
    world = settings.first + wp.min(index, count - 1)
    dt = settings.dt
    params = load_leg(model, world, leg)
    delay = actuation.latency[world] / dt
    entries = load_entries(gradients, world)
    adj = load_motor_entries(gradients, world, leg)
    leg_sums = thread_sums(gradients, world, index < count, False, False)
    shared_sums = thread_sums(gradients, world, index < count and leg == 0, False, True)
    for back in range(span.end - span.begin):
        row = span.end - 1 - back
        start_entry = first_entry(timing, span, row)
        first = row * timing.every
        t = first / timing.substeps
        force = row_vec3(commands.wrench, t, 0, world)
        moment = row_vec3(commands.wrench, t, 3, world)
        end = rollout_adjoint.store_row_base_adjoint(
            model, world, leg_record.get_base(record, start_entry + timing.every, world), entries
        )
        adj.base = end.base
        adj.force = vec3(real(0.0))
        adj.moment = vec3(real(0.0))
        for j in range(timing.every):
            i = timing.every - 1 - j
            step = first + i
            adj = reverse_leg(
                model, params, dt, world, leg, force, moment, trajectory, cotangent, step, start_entry + i, record, adj,
                index < count,
            )  # fmt: skip
            arrived = arrival(step, timing.substeps, delay)
            slopes = leg_record.get_slopes(record, start_entry + i, world, leg)
            adj = reverse_motors(adj, slopes, arrived, cotangent, step, leg, world, gradients, index < count)
        entries = rollout_adjoint.add_row_cotangent(
            rollout_adjoint.load_row_base_adjoint(trajectory, model, row, world, adj.base, end.com), cotangent, row,
            world,
        )  # fmt: skip
        if index < count and leg == 0:
            rollout_adjoint.add_wrench(gradients, t, world, adj.force, adj.moment)
        if first == t * timing.substeps:
            by_filter = filter_gradient(
                commands, actuation, t, leg, world, leg_record.get_vec(record, start_entry, ANGLES, world, leg),
                leg_record.get_vec(record, start_entry, RATES, world, leg), gradients,
            )  # fmt: skip
            add_filter(shared_sums, by_filter.constants)
            if index < count:
                leg_record.put_vec(record, start_entry, FILTER, world, leg, by_filter.angles)
                store_row_vec3(gradients.target, t, 3 * leg, world, by_filter.target)
            adj.angles += by_filter.angles
            adj.rates += by_filter.rates
        if cotangent.q.shape[0] > 0:
            adj.angles += row_vec3(cotangent.q, row, 7 + 3 * leg, world)
        if cotangent.qd.shape[0] > 0:
            adj.rates += row_vec3(cotangent.qd, row, 6 + 3 * leg, world)
    if index < count:
        rollout_adjoint.store_motor_entries(gradients, world, leg, adj.angles, adj.rates)
        if leg == 0:
            rollout_adjoint.store_base_entries(gradients, world, entries)
            add_moments(leg_sums, BASE, adj.body)
            add_com(leg_sums, model.table[BASE, world], base_com(model.table, world), adj.com + entries.com)
            add_vec3(leg_sums, GRAVITY, adj.gravity)


ADJOINTS = generate_adjoints(__name__)
