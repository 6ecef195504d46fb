"""GPU kernels that add a rollout's gradient of the loss w.r.t. leg and motor constants, all steps in parallel.

The kernels read the multipliers that `reverse_legs_kernel` has recorded. With these multipliers, the steps are
independent: a thread takes every n-th step, and the sums of the threads are added. A trajectory has a row every
`timing.every` physics steps; a `Span` is a range of rows, whose steps are in a `LegRecord`, one entry a step.
"""

import warp as wp

from ...actuation.motors import MotorParams
from ...scalar import real, vec3
from ..step import RobotModel, StepSettings, load_leg
from ..trajectory import Actuation, Commands, Timing, TrajectoryArrays, load_world_motor, row_vec3
from .action_gradients import leg_action_gradient
from .command_adjoint import add_motor_constants, add_offsets, motor_gradient
from .gradients import Gradients, thread_sums
from .leg_adjoint import add_leg_constants, base_factors, leg_factors
from .leg_record import ANGLES, FILTER, RATES, LegRecord, get_base, get_base_weights, get_law, get_leg_weights, get_vec
from .rollout_adjoint import generate_adjoints
from .rollout_legs_adjoint import Span, first_entry

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class SpanStep:
    """Physics step that a GPU thread differentiates: index in the rollout, `LegRecord` entry, weight in the sum."""

    step: int  # of the rollout
    entry: int  # of the record
    weight: real  # 1, or 0 where no steps are left and the thread repeats the last one


@wp.func
def steps_per_thread(timing: Timing, span: Span, threads_per_leg: int) -> int:
    """Return how many physics steps of a range of trajectory rows each of a leg's `threads_per_leg` threads handles."""
    return ((span.end - span.begin) * timing.every + threads_per_leg - 1) / threads_per_leg


@wp.func
def span_step(timing: Timing, span: Span, k: int) -> SpanStep:
    """Return physics step k (from 0) of a range of trajectory rows; beyond the range, the last step with weight 0.

    All threads of a warp must take part in its sums, also threads without a step.
    """
    step = SpanStep()
    end = span.end * timing.every
    step.step = span.begin * timing.every + k
    step.weight = wp.where(step.step < end, real(1.0), real(0.0))
    step.step = wp.min(step.step, end - 1)
    row = step.step / timing.every
    step.entry = first_entry(timing, span, row) + step.step - row * timing.every
    return step


@wp.kernel
def leg_constants_kernel(
    # in
    threads_per_leg: int,
    model: RobotModel,
    settings: StepSettings,
    timing: Timing,
    trajectory: TrajectoryArrays,
    cotangent: TrajectoryArrays,
    span: Span,
    record: LegRecord,
    # in, out
    gradients: Gradients,
):
    """Add the gradient of the loss w.r.t. constants of the legs, summed over the steps of a range of trajectory rows.

    Launch over (worlds, threads_per_leg, 4). threads_per_leg: threads that divide the steps of a leg, 8 on a GPU (a
    warp per world) and 1 on a CPU. Worlds count from `settings.first`.
    """
    index, thread, leg = wp.tid()
    world = settings.first + index
    dt = settings.dt
    params = load_leg(model, world, leg)
    sums = thread_sums(gradients, world, thread == 0, True, False)
    for k in range(steps_per_thread(timing, span, threads_per_leg)):
        at = span_step(timing, span, k * threads_per_leg + thread)
        sums.weight = at.weight
        i = at.entry
        base = get_base(record, i, world)
        law = get_law(record, i, world, leg)
        base_held = base_factors(record, world, i, dt, base, get_base_weights(record, i, world))
        weights = get_leg_weights(record, i, world, leg)
        leg_held = leg_factors(record, trajectory, cotangent, world, at.step, i, leg, dt, law, weights)
        gradient = leg_action_gradient(
            model, params, world, leg, law.mu, base, get_vec(record, i, ANGLES, world, leg),
            get_vec(record, i, RATES, world, leg), base_held, leg_held, dt,
        )  # fmt: skip
        add_leg_constants(sums, leg, law, gradient)


@wp.kernel
def motor_constants_kernel(
    # in
    threads_per_leg: int,
    settings: StepSettings,
    timing: Timing,
    actuation: Actuation,
    commands: Commands,
    filtered_target: wp.array3d(dtype=real),
    cotangent: TrajectoryArrays,
    span: Span,
    record: LegRecord,
    # in, out
    gradients: Gradients,
):
    """Add the gradient of the loss w.r.t. constants of the motors, summed over the steps of a range of trajectory rows.

    Launch as `leg_constants_kernel`. The kernels are separate, because one would need more memory per thread than a
    GPU's L1 cache holds.
    """
    index, thread, leg = wp.tid()
    world = settings.first + index
    motors = wp.zeros(shape=(3,), dtype=MotorParams)
    for j in range(motors.shape[0]):
        motors[j] = load_world_motor(actuation, 3 * leg + j, world)
    delay = actuation.latency[world] / settings.dt
    leg_sums = thread_sums(gradients, world, thread == 0, True, False)
    shared_sums = thread_sums(gradients, world, thread == 0 and leg == 0, True, True)
    for k in range(steps_per_thread(timing, span, threads_per_leg)):
        at = span_step(timing, span, k * threads_per_leg + thread)
        leg_sums.weight = at.weight
        shared_sums.weight = at.weight
        angles = get_vec(record, at.entry, ANGLES, world, leg)
        rates = get_vec(record, at.entry, RATES, world, leg)
        torque = settings.dt * get_leg_weights(record, at.entry, world, leg).rates
        if cotangent.torque.shape[0] > 0:
            torque += row_vec3(cotangent.torque, at.step, 3 * leg, world)
        for c in range(motors.shape[0]):
            by_motor = motor_gradient(
                motors[c], delay, commands, filtered_target, timing, settings.dt, at.step, 3 * leg + c, world,
                angles[c], rates[c],
            )  # fmt: skip
            add_motor_constants(leg_sums, shared_sums, 3 * leg + c, torque[c], by_motor)
        by_filter = vec3(real(0.0))
        if actuation.filtered != 0 and at.step - (at.step / timing.substeps) * timing.substeps == 0:
            by_filter = get_vec(record, at.entry, FILTER, world, leg)
        add_offsets(leg_sums, leg, by_filter)


ADJOINTS = generate_adjoints(__name__)
