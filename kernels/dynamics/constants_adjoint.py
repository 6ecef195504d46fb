"""Gradients of a rollout by constants of legs and motors, for GPUs: steps side by side, once run backwards."""

import warp as wp

from ..actuation.motors import MotorParams
from ..scalar import real, vec3
from ..state import BaseState
from .command_adjoint import add_motor_constants, add_offsets, motor_gradient
from .gradients import Gradients, ThreadSums
from .leg_adjoint import add_leg_constants, held_base, leg_gradient
from .leg_record import ANGLES, FILTER, RATES, LegRecord, get_base, get_base_weights, get_law, get_leg_weights, get_vec
from .rollout import Actuation, Commands, Rows, Timing, load_world_motor, row_vec3
from .rollout_adjoint import everything
from .rollout_legs_adjoint import Span, first_entry
from .step import Robot, StepSettings, load_leg
from .virtual_power import BaseFactors, BaseSeeds, LegFactors

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.kernel
def constants_kernel(
    # in
    turns: int,
    robot: Robot,
    settings: StepSettings,
    timing: Timing,
    actuation: Actuation,
    commands: Commands,
    safe: wp.array3d(dtype=real),
    rows: Rows,
    seeds: Rows,
    span: Span,
    record: LegRecord,
    # in, out
    gradients: Gradients,
):
    """Add the gradients by constants of legs and motors of the steps of a span; launch over (worlds, turns, 4).

    turns: threads that share the steps of a leg, 8 on a GPU, with a warp a world, and 1 on a CPU.
    """
    place, turn, leg = wp.tid()
    world = settings.first + place
    dt = settings.dt
    own = load_leg(robot, world, leg)
    motors = wp.zeros(shape=(3,), dtype=MotorParams)
    for j in range(motors.shape[0]):
        motors[j] = load_world_motor(actuation, 3 * leg + j, world)
    late = actuation.latency[world] / dt
    of_leg = ThreadSums()
    of_leg.parameters = gradients.parameters
    of_leg.world = world
    of_leg.adds = turn == 0
    of_leg.turns = True
    of_legs = of_leg
    of_legs.adds = turn == 0 and leg == 0
    of_legs.legs = True
    begin = span.begin * timing.every
    end = span.end * timing.every
    for number in range((end - begin + turns - 1) / turns):
        step = begin + number * turns + turn
        of_leg.weight = wp.where(step < end, real(1.0), real(0.0))
        of_legs.weight = of_leg.weight
        step = wp.min(step, end - 1)
        row = step / timing.every
        i = first_entry(timing, span, row) + step - row * timing.every
        base = get_base(record, i, world)
        law = get_law(record, i, world, leg)
        held = held_base(record, world, i, dt, base, get_base_weights(record, i, world))
        weights = get_leg_weights(record, i, world, leg)
        found = leg_gradient(robot, own, dt, world, leg, rows, seeds, step, i, record, base, law, held, weights)
        add_leg_constants(of_leg, leg, law, found)
        angles = get_vec(record, i, ANGLES, world, leg)
        rates = get_vec(record, i, RATES, world, leg)
        torque = dt * weights.rates
        if seeds.torque.shape[0] > 0:
            torque += row_vec3(seeds.torque, step, 3 * leg, world)
        for c in range(motors.shape[0]):
            by_motor = motor_gradient(
                motors[c], late, commands, safe, timing, dt, step, 3 * leg + c, world, angles[c], rates[c]
            )
            add_motor_constants(of_leg, of_legs, 3 * leg + c, torque[c], by_motor)
        by_filter = vec3(real(0.0))
        if actuation.filtered != 0 and step - (step / timing.substeps) * timing.substeps == 0:
            by_filter = get_vec(record, i, FILTER, world, leg)
        add_offsets(of_leg, leg, by_filter)


@wp.kernel(enable_backward=True)
def adjoints_kernel(
    factors: LegFactors, base: BaseFactors, base_seeds: BaseSeeds, robot: Robot, actuation: Actuation, numbers: Rows,
    state: BaseState, sums: wp.array(dtype=real),
):  # fmt: skip
    """Never launched: a kernel with a backward pass makes Warp generate the adjoints of all that it calls."""
    world = wp.tid()
    sums[world] = everything(factors, base, base_seeds, robot, actuation, numbers, state, world)
