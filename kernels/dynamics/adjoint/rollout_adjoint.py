"""The reverse pass of a rollout, all its steps in a launch, a thread a world.

From row to row, backwards: the steps between two rows are made again, with the impulses that the rollout found, and
then run backwards one by one (`step_adjoint`, `virtual_power`).
"""

import warp as wp

from ...actuation.motors import MotorParams, motor_torque
from ...layout import BASE
from ...scalar import quat, real, vec3
from ...state import BaseState, base_com
from ..contact import PawContact
from ..contact_laws import PawLaw
from ..parameters import load_moments, load_spring, load_stops
from ..step import LegParams, Robot, StepSettings, load_leg
from ..trajectory import (
    Actuation,
    Commands,
    Rows,
    Timing,
    arrival,
    load_filter,
    load_row_base,
    load_world_motor,
    row_base,
    row_quat,
    row_vec3,
    store_row_vec3,
)
from .command_adjoint import (
    add_motor_constants,
    add_offsets,
    add_targets,
    filter_gradient,
    motor_gradient,
    weighed_filter,
)
from .gradients import GRADIENT_ROWS, Gradients, add_com, add_filter
from .step_adjoint import StepRecord, replay_step, reverse_step
from .virtual_power import BaseFactors, BaseSeeds, LegFactors, base_action, leg_action, turned

wp.set_module_options({"enable_backward": False})


@wp.func
def wrench_part(commands: Commands, t: int, first: int, world: int) -> vec3:
    """Return force (first = 0) or moment (first = 3) on the base in a policy step, world axes."""
    return row_vec3(commands.wrench, t, first, world)


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
    com: vec3  # by the base's centre of mass, of all rows that were passed


@wp.func
def leave_row(rows: Rows, robot: Robot, row: int, world: int, adj: BaseState, com_before: vec3) -> RowSeeds:
    """Return the gradient by a row's entries for that by the base's state which is read from it."""
    com = base_com(robot.table, world)
    pos, orientation, lin, ang, com_adj, _seed = wp.grad(weighed_row)(
        row_vec3(rows.q, row, 0, world), row_quat(rows.q, row, 3, world), row_vec3(rows.qd, row, 0, world),
        row_vec3(rows.qd, row, 3, world), com, adj,
    )  # fmt: skip
    seeds = RowSeeds()
    seeds.pos = pos
    seeds.quat = orientation
    seeds.lin = lin
    seeds.ang = ang
    seeds.com = com_before + com_adj
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


@wp.struct
class RowState:
    """Gradient by the base's state which a row was written from."""

    base: BaseState
    com: vec3  # by the base's centre of mass, of all rows that were passed


@wp.func
def enter_row(robot: Robot, world: int, base: BaseState, seeds: RowSeeds) -> RowState:
    """Return the gradient by the base's state which a row was written from, for that by the row's entries."""
    com = base_com(robot.table, world)
    orientation, lin, ang, com_adj, _lin, _ang = wp.grad(weighed_store)(
        base.quat, base.lin, base.ang, com, seeds.lin, seeds.ang
    )
    adj = RowState()
    adj.base.pos = seeds.pos
    adj.base.quat = seeds.quat + orientation
    adj.base.lin = lin
    adj.base.ang = ang
    adj.com = seeds.com + com_adj
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
            replay_step(robot, params, dt, world, force, moment, rows, first + i, i, record)
        end = enter_row(robot, world, record.base[world, timing.every], entries)
        adj = end.base
        for j in range(timing.every):
            i = timing.every - 1 - j
            adj = reverse_step(
                robot, params, dt, world, t, force, moment, commands.impulse, rows, seeds, first + i, i, record, adj,
                angle_adj, rate_adj, torque_adj, contacts, laws, paw_seeds, matrix, vector, virtual, sums,
                gradients.wrench,
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
                    by_motor = motor_gradient(
                        motors[3 * k + c], late, commands, safe, timing, dt, first + i, 3 * k + c, world, angles[c],
                        rates[c],
                    )  # fmt: skip
                    arrived = arrival(first + i, timing.substeps, late)
                    add_targets(gradients, arrived, 3 * k + c, world, seed * by_motor.target)
                    add_motor_constants(sums, sums, 3 * k + c, seed, by_motor)
                    angle_sum[c] += seed * by_motor.angle
                    rate_sum[c] += seed * by_motor.rate
                angle_adj[k] = angle_sum
                rate_adj[k] = rate_sum
        entries = add_row_seeds(leave_row(rows, robot, row, world, adj, end.com), seeds, row, world)
        for k in range(laws.shape[0]):
            if first == t * timing.substeps:
                by_leg = filter_gradient(
                    commands, actuation, t, k, world, record.angles[world, 0, k], record.rates[world, 0, k], gradients
                )
                store_row_vec3(gradients.target, t, 3 * k, world, by_leg.target)
                add_offsets(sums, k, by_leg.angles)
                add_filter(sums, by_leg.constants)
                angle_adj[k] = angle_adj[k] + by_leg.angles
                rate_adj[k] = rate_adj[k] + by_leg.rates
            if seeds.q.shape[0] > 0:
                angle_adj[k] = angle_adj[k] + row_vec3(seeds.q, row, 7 + 3 * k, world)
            if seeds.qd.shape[0] > 0:
                rate_adj[k] = rate_adj[k] + row_vec3(seeds.qd, row, 6 + 3 * k, world)
    add_com(sums, robot.table[BASE, world], com, entries.com)
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


@wp.func
def everything(
    factors: LegFactors, base: BaseFactors, base_seeds: BaseSeeds, robot: Robot, actuation: Actuation, numbers: Rows,
    state: BaseState, world: int,
) -> real:  # fmt: skip
    """Return the sum of all functions whose gradients the reverse pass takes; see `generate_adjoints`."""
    params = load_leg(robot, world, 0)
    v = row_vec3(numbers.q, 0, 0, world)
    q = row_quat(numbers.q, 0, 3, world)
    x = numbers.q[0, 0, world]
    spring = load_spring(robot.table, 0, world)
    stops = load_stops(robot.table, 0, world)
    leg = leg_action(
        params.geometry, params.masses, params.joints, spring, stops, robot.ground, x, v, q, v, v, v, v, base, factors,
        x,
    )  # fmt: skip
    return (
        leg
        + base_action(load_moments(robot.table, BASE, world), v, v, v, v, q, v, v, base, base_seeds, x)
        + turned(q, v, x, q)
        + motor_torque(x, x, x, load_world_motor(actuation, 0, world))
        + weighed_filter(v, v, v, load_filter(actuation.limits, world), v)
        + weighed_row(v, q, v, v, v, state)
        + weighed_store(q, v, v, v, v, v)
    )


def generate_adjoints(module: str) -> wp.Kernel:
    """Make Warp generate, in a module of kernels, the adjoints of all functions that the reverse pass differentiates.

    `wp.grad` alone leaves out those of functions which something else called first. A kernel with a backward pass has
    them all; it is never launched.
    """

    @wp.kernel(enable_backward=True, module=wp.get_module(module))
    def adjoints_kernel(
        factors: LegFactors, base: BaseFactors, base_seeds: BaseSeeds, robot: Robot, actuation: Actuation,
        numbers: Rows, state: BaseState, sums: wp.array(dtype=real),
    ):  # fmt: skip
        world = wp.tid()
        launched = int(0)  # Warp makes the adjoints anyway, and the compiler drops this kernel's own code
        if launched > 0:
            sums[world] = everything(factors, base, base_seeds, robot, actuation, numbers, state, world)

    return adjoints_kernel


ADJOINTS = generate_adjoints(__name__)
