"""`rollout_adjoint` for GPUs: four threads a world, a thread a leg."""

import warp as wp

from ..actuation.motors import MotorParams
from ..layout import BASE, GRAVITY, LEG_ROWS
from ..scalar import real
from ..state import BaseState, base_com
from .command_adjoint import reverse_filter, reverse_motor
from .gradients import FADE_GRADIENT, GEOMETRY_GRADIENT, GEOMETRY_ROWS, GRADIENT_ROWS, MOTOR_GRADIENT, Gradients
from .lanes import sum_legs
from .leg_adjoint import LegAdjoint, replay_leg, reverse_leg
from .rollout import Actuation, Commands, Rows, Timing, load_row_base, load_world_motor, row_vec3, store_row_vec3
from .rollout_adjoint import RowSeeds, add_row_seeds, enter_row, everything, leave_row
from .step import Robot, StepSettings, load_leg
from .step_adjoint import StepRecord
from .virtual_power import BaseFactors, BaseSeeds, LegFactors

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func
def store_sums(sums: wp.array(dtype=real), leg: int, world: int, parameters: wp.array2d(dtype=real)):
    """Write the gradients by parameters: a leg's by its thread, the base's by the first, the others summed up.

    sums: rows of the first leg for all: so the threads of a warp add to the same rows, which lie side by side.
    """
    for i in range(LEG_ROWS):
        parameters[leg * LEG_ROWS + i, world] = sums[i]
    for i in range(7):
        for j in range(3):
            row = MOTOR_GRADIENT + 12 * i + j
            parameters[row + 3 * leg, world] = sums[row]
    for i in range(GEOMETRY_ROWS):
        row = GEOMETRY_GRADIENT + i
        parameters[row + leg * GEOMETRY_ROWS, world] = sums[row]
    if leg == 0:
        for i in range(int(BASE), int(GRAVITY) + 3):
            parameters[i, world] = sums[i]


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
    # out
    record: StepRecord,
    gradients: Gradients,
):
    """Do what `reverse_kernel` does; launch over (count rounded up to a multiple of 8, 4).

    Threads beyond the last world repeat it, and write only what it writes to the record, the same bits.
    """
    place, leg = wp.tid()
    world = settings.first + wp.min(place, count - 1)
    dt = settings.dt
    own = load_leg(robot, world, leg)
    motors = wp.zeros(shape=(3,), dtype=MotorParams)
    for j in range(motors.shape[0]):
        motors[j] = load_world_motor(actuation, 3 * leg + j, world)
    sums = wp.zeros(shape=(GRADIENT_ROWS,), dtype=real)
    late = actuation.latency[world] / dt
    last = timing.steps * timing.substeps / timing.every
    entries = add_row_seeds(RowSeeds(), seeds, last, world)
    adj = LegAdjoint()
    if seeds.q.shape[0] > 0:
        adj.angles = row_vec3(seeds.q, last, 7 + 3 * leg, world)
    if seeds.qd.shape[0] > 0:
        adj.rates = row_vec3(seeds.qd, last, 6 + 3 * leg, world)
    com = base_com(robot.table, world)
    for back in range(last):
        row = last - 1 - back
        first = row * timing.every
        t = first / timing.substeps
        force = row_vec3(commands.wrench, t, 0, world)
        moment = row_vec3(commands.wrench, t, 3, world)
        record.base[world, 0] = load_row_base(rows, row, world, com)
        record.angles[world, 0, leg] = row_vec3(rows.q, row, 7 + 3 * leg, world)
        record.rates[world, 0, leg] = row_vec3(rows.qd, row, 6 + 3 * leg, world)
        for i in range(timing.every):
            replay_leg(robot, own, dt, world, leg, force, moment, rows, first + i, i, record)
        adj.base = enter_row(robot, world, record.base[world, timing.every], entries, sums)
        for j in range(timing.every):
            i = timing.every - 1 - j
            step = first + i
            adj = reverse_leg(
                robot, own, dt, world, leg, force, moment, commands.impulse, rows, seeds, step, i, record, adj, sums
            )
            if place < count:
                if leg == 0:
                    store_row_vec3(gradients.wrench, t, 0, world, row_vec3(gradients.wrench, t, 0, world) + adj.force)
                    store_row_vec3(gradients.wrench, t, 3, world, row_vec3(gradients.wrench, t, 3, world) + adj.moment)
                angles = record.angles[world, i, leg]
                rates = record.rates[world, i, leg]
                angle_sum = adj.angles
                rate_sum = adj.rates
                for c in range(motors.shape[0]):
                    motor = 3 * leg + c
                    seed = adj.torque[c]
                    if seeds.torque.shape[0] > 0:
                        seed += seeds.torque[step, motor, world]
                    by_state = reverse_motor(
                        motors[c], late, commands, safe, timing, dt, step, motor, world, angles[c], rates[c], seed,
                        c, sums, gradients,
                    )  # fmt: skip
                    angle_sum[c] += by_state[0]
                    rate_sum[c] += by_state[1]
                adj.angles = angle_sum
                adj.rates = rate_sum
        entries = add_row_seeds(leave_row(rows, robot, row, world, adj.base, sums), seeds, row, world)
        if place < count and first == t * timing.substeps:
            by_leg = reverse_filter(
                commands, actuation, t, leg, world, record.angles[world, 0, leg], record.rates[world, 0, leg], 0,
                sums, gradients,
            )  # fmt: skip
            adj.angles += by_leg.angles
            adj.rates += by_leg.rates
        if seeds.q.shape[0] > 0:
            adj.angles += row_vec3(seeds.q, row, 7 + 3 * leg, world)
        if seeds.qd.shape[0] > 0:
            adj.rates += row_vec3(seeds.qd, row, 6 + 3 * leg, world)
    shared = GEOMETRY_GRADIENT - FADE_GRADIENT
    for i in range(shared):  # over-speed protection, latency and filter: all legs add to them
        total = sum_legs(sums[FADE_GRADIENT + i])
        if leg == 0 and place < count:
            gradients.parameters[FADE_GRADIENT + i, world] = total
    if place >= count:
        return
    store_sums(sums, leg, world, gradients.parameters)
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


@wp.kernel(enable_backward=True)
def adjoints_kernel(
    factors: LegFactors, base: BaseFactors, base_seeds: BaseSeeds, robot: Robot, actuation: Actuation, numbers: Rows,
    state: BaseState, sums: wp.array(dtype=real),
):  # fmt: skip
    """Never launched: a kernel with a backward pass makes Warp generate the adjoints of all that it calls."""
    world = wp.tid()
    sums[world] = everything(factors, base, base_seeds, robot, actuation, numbers, state, world)
