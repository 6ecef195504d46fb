"""Physics steps on GPUs: four threads per world, one per leg, which exchange sums for the base and the contacts.

A thread holds one leg and a copy of the base; the base's equations are sums over the four threads. The contact law is
the one in `contact`. In each round all paws compute their next impulse at once, and all apply it, which converges
because paws are coupled through the heavy base only; rounds end when no contact velocity changes by more than the
tolerance. If the largest change stops shrinking, each later round applies only the impulse of the paw that changes
most. A step whose set of pressed stops proves wrong (see `world_step`) is repeated by its world, while the other
worlds of a warp continue.

Motors of a leg are lateral, outer, inner. A hard stop limits a motor's angle, or the sum of outer and inner; pressed
stops change a leg's inertia, so that a step must assume a set of them before it is solved. `pressed` is such a set, one
int of two bits per angle, 0: none. `sum_*`, `max_legs`, `first_leg`, `from_leg` exchange values among the four threads
of a world, `any_world` among the threads of a warp. All threads must call them together.

Velocities `lin` and `ang` of the base are in its axes at the start of a step, forces and moments on it in world axes.
"""

import warp as wp

from ...actuation import stops
from ...lanes import any_world, first_leg, from_leg, max_legs, sum_legs, sum_vec, sync_lanes
from ...layout import GRAVITY
from ...scalar import real, vec3
from ...state import BaseState, base_com, leg_coord, leg_dof, load_base, load_motors, store_base, store_motors
from ...terrain.ground import move_block
from ..base_dynamics import BaseSystem, add_leg, invert, motor_acceleration, solve_ang, solve_lin, sum_systems
from ..base_motion import integrate_base
from ..contact import BlockLaw, PawContact, block_velocity, local_impulse
from ..drive import Drive, LegDrive, Workspace, applied_torque, base_wrench, freeze_diverged_world, load_leg_drive
from ..parameters import load_spring, load_stops, load_vec3
from ..step import (
    LegParams,
    RobotModel,
    StepSettings,
    base_system,
    block_law,
    finite_base,
    hold_base,
    leg_terms,
    load_leg,
    paw_contact,
)

SHRINKING = wp.constant(real(0.9))  # largest ratio of successive changes for which all paws move at once
ANY_CHANGE = wp.constant(real(1.0e12))  # [m^2/s^2] square of the change before the first round: larger than any

# fast_math: division and roots are exact to 2 units in the last place and take a third of the code
wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class LegState:
    """State of a thread (leg) between physics steps: motors (lateral, outer, inner), contact, copy of the base.

    `peak_sq`, `total_sq`, `residual` and `rounds` are the largest values over the completed steps of this launch.
    """

    base: BaseState
    angles: vec3  # [rad] of its leg's motors
    rates: vec3  # [rad/s]
    torque: vec3  # [N m] of its motors in the last step
    impulse: vec3  # [N s] on its paw in the last step, world axes
    peak_sq: real  # [N^2 s^2] square of the impulse on this leg's paw in a step
    total_sq: real  # [N^2 s^2] square of the sum of the impulses on the world's four paws in a step
    residual: real  # [m/s] of the contact iteration in a step, see `PawSolution`
    rounds: int  # of the contact iteration in a step
    step: int  # steps completed in this launch
    sets: int  # sets of pressed stops tried for the present step and rejected
    pressed: int  # the leg's set of pressed stops in the last completed step or for the next attempt, see `stops`


@wp.struct
class PawSolution:
    """Solution of the contact problem: impulse on the thread's paw, and the base's change of velocity; body axes."""

    impulse: vec3  # [N s] on the paw, body axes
    lin: vec3  # change of the base's linear velocity [m/s]
    ang: vec3  # change of its angular velocity [rad/s]
    residual: real  # [m/s] largest change of a contact velocity in the last round
    rounds: int  # of the iteration


@wp.func
def solve_paws(c: PawContact, blocks: bool, block: BlockLaw, leg: int, max_rounds: int, tolerance: real) -> PawSolution:
    """Solve a world's contact problem iteratively; in each round, four threads compute their paws' impulses at once.

    See the module; body axes. c: contact of this thread's leg 0 to 3. blocks: whether any world has a block. tolerance
    [m/s]: see the module.
    """
    s = PawSolution()
    s.impulse = c.impulse
    s.lin = sum_vec(c.to_lin * c.impulse)
    s.ang = sum_vec(c.to_ang * c.impulse)
    working, together = bool(True), bool(True)
    previous_change = real(ANY_CHANGE)
    while any_world(working):
        velocity = c.free + c.from_lin * s.lin + c.from_ang * s.ang + c.leg_response * s.impulse
        if blocks:
            push = sum_vec(wp.where(c.on_block != 0, -s.impulse, vec3(real(0.0))))
            if c.on_block != 0:
                velocity -= block_velocity(block, push)
        step = vec3(real(0.0))
        if c.active != 0:
            step = local_impulse(c, s.impulse, velocity) - s.impulse
        across = c.total * step
        change = wp.dot(across, across)
        if not change > real(0.0):  # NaN too
            change, step = real(0.0), vec3(real(0.0))
        most = max_legs(change)
        chosen_leg = first_leg(change == most)
        if working:
            s.residual = wp.sqrt(most)
        working = working and s.residual > tolerance and s.rounds < max_rounds
        together = together and most <= SHRINKING * SHRINKING * previous_change
        previous_change = most
        if leg != chosen_leg and not together:
            step = vec3(real(0.0))
        lin = sum_vec(c.to_lin * step)
        ang = sum_vec(c.to_ang * step)
        if working:
            s.rounds += 1
            s.lin += lin
            s.ang += ang
            s.impulse += step
    return s


@wp.struct
class StopAttempt:
    """Set of hard joint stops assumed pressed in an attempted step of a leg, and rates beyond which stops press."""

    stop_rates: stops.StopRates  # zero where no stop is near
    pressed: int


@wp.func
def stop_attempt(model: RobotModel, world: int, leg: int, old: LegState, dt: real) -> StopAttempt:
    """Return the set of hard joint stops to assume pressed in a leg's next attempt at a step of dt [s] from `old`.

    The first attempt assumes the set of the preceding step, since stops often stay pressed for many steps. After a
    rejected attempt, the set is the one that this attempt required; both are in `old.pressed`. If the preceding step
    had no pressed stops, the first attempt assumes the stops that the leg would pass at its present rates. Most legs
    are far from all stops: limits are read only if a stop may matter.
    """
    attempt = StopAttempt()
    attempt.pressed = old.pressed
    if attempt.pressed != 0 or old.sets == 0:
        limits = load_stops(model.table, leg, world)
        if attempt.pressed != 0 or stops.beyond_stops(limits, old.angles + dt * old.rates):
            attempt.stop_rates = stops.stop_rates(limits, old.angles, dt)
            if old.pressed == 0:
                attempt.pressed = stops.pressed_stops(attempt.stop_rates, old.rates, real(0.0), 0)
    return attempt


@wp.func
def required_stops(
    model: RobotModel, settings: StepSettings, world: int, leg: int, angles: vec3, rates: vec3, pressed: int, sets: int
) -> int:
    """Return which hard joint stops a leg must press, given the motor rates at which an attempted step ended.

    The attempt is valid if it assumed the same set. It assumed the set `pressed` and ended at `rates` [rad/s]. angles
    [rad]: at the start of the step. sets: number of sets tried. The limits are reloaded to save registers.
    """
    limits = load_stops(model.table, leg, world)
    required = int(0)
    if pressed != 0 or stops.beyond_stops(limits, angles + settings.dt * rates):
        bounds = stops.stop_rates(limits, angles, settings.dt)
        required = stops.revised_stops(bounds, rates, stops.SLACK * settings.tolerance, pressed, sets)
    return required


@wp.func
def completed_step(
    old: LegState, base: BaseState, angles: vec3, rates: vec3, torque: vec3, solved: PawSolution, total: vec3,
    pressed: int,
) -> LegState:  # fmt: skip
    """Return a thread's state after a completed physics step, from its state `old` before it and the step's results.

    base, angles [rad], rates [rad/s]: values at the end. torque [N m] of the motors in the step. total [N s]: sum of
    the paws' impulses. pressed: set of hard stops that the leg presses.
    """
    new = old
    new.base = base
    new.angles = angles
    new.rates = rates
    new.torque = torque
    new.impulse = wp.quat_rotate(old.base.quat, solved.impulse)
    new.peak_sq = wp.max(old.peak_sq, wp.dot(solved.impulse, solved.impulse))
    new.total_sq = wp.max(old.total_sq, wp.dot(total, total))
    new.residual = wp.max(old.residual, solved.residual)
    new.rounds = wp.max(old.rounds, solved.rounds)
    new.step = old.step + 1
    new.sets = 0
    new.pressed = pressed
    return new


@wp.func
def next_attempt(old: LegState, pressed: int, required: int, changes: bool) -> LegState:
    """Return a thread's state to try the same physics step again with another set of pressed joint stops.

    The new attempt starts from the state `old`, with the set `required` or with one change toward it. pressed: set of
    the last attempt. changes: whether this leg may change if only one leg may (`one_by_one`).
    """
    new = old
    new.sets = old.sets + 1
    new.pressed = pressed
    if not stops.one_by_one(new.sets):
        new.pressed = required
    elif changes:
        new.pressed = stops.change_one(pressed, required)
    return new


@wp.func
def advance_leg(
    model: RobotModel, settings: StepSettings, drive: Drive, params: LegParams, motors: LegDrive, world: int, leg: int,
    old: LegState, writes: bool,
) -> LegState:  # fmt: skip
    """Attempt a physics step of a world, a thread per leg; return the new state, or `old` with other stops for a retry.

    A world that has completed all its steps keeps its state, but computes the step, since all threads of a warp must
    exchange values. params, motors: constants of this thread's leg. writes: whether this thread moves its world's
    block.
    """
    dt = settings.dt
    blocks = model.ground.blocks.shape[0] > 0
    base = old.base
    g = wp.quat_rotate_inv(base.quat, load_vec3(model.table, GRAVITY, world))
    torque = applied_torque(motors, old.step, old.angles, old.rates)
    attempt = stop_attempt(model, world, leg, old, dt)
    pressed = attempt.pressed
    spring = load_spring(model.table, leg, world)
    terms = leg_terms(params, spring, old.angles, old.rates, torque, attempt.stop_rates, pressed, base.ang, g, dt)
    wrench = base_wrench(drive.joint_f, drive.body_f, world)
    force = vec3(wrench[0], wrench[1], wrench[2])
    moment = vec3(wrench[3], wrench[4], wrench[5])
    leg_system = add_leg(BaseSystem(), terms.dynamics, terms.solve)
    system = sum_systems(base_system(model, world, base, g, force, moment), leg_system)
    inverse = hold_base(model, world, invert(system))
    lin_acc = solve_lin(inverse, system.force, system.moment)
    ang_acc = solve_ang(inverse, system.force, system.moment)
    lin = wp.quat_rotate_inv(base.quat, base.lin) + dt * lin_acc
    ang = base.ang + dt * ang_acc
    rates = old.rates + dt * motor_acceleration(terms.solve, lin_acc, ang_acc)
    block = block_law(model, world, base, dt)
    contact = paw_contact(
        model, world, leg, base, lin, ang, rates, old.rates, old.impulse, pressed, terms.paw, terms.solve, inverse,
        block, dt,
    )  # fmt: skip
    solved = solve_paws(contact, blocks, block, leg, 2 * settings.max_sweeps, settings.tolerance)
    solve = terms.solve
    rates += solve.inverse * (wp.transpose(contact.jacobian) * solved.impulse)
    rates -= solve.to_lin * solved.lin + solve.to_ang * solved.ang
    total = sum_vec(solved.impulse)
    sets = old.sets + 1
    required = required_stops(model, settings, world, leg, old.angles, rates, pressed, sets)
    first = first_leg(required != pressed)  # that needs another set; if none does, any leg
    agreed = from_leg(wp.where(required != pressed, real(1.0), real(0.0)), first) == real(0.0)
    done = old.step < settings.substeps and (agreed or sets >= stops.MAX_SETS)
    if blocks:
        push = sum_vec(wp.where(contact.on_block != 0, -solved.impulse, vec3(real(0.0))))
        if writes and done and model.ground.blocks[world].exists != 0:
            move_block(model.ground, world, wp.quat_rotate(base.quat, block_velocity(block, push)), dt)
        sync_lanes()
    if done:
        moved = integrate_base(base, lin + solved.lin, ang + solved.ang, dt)
        return completed_step(old, moved, old.angles + dt * rates, rates, torque, solved, total, pressed)
    return next_attempt(old, pressed, required, leg == first)


@wp.kernel
def advance_legs_kernel(
    # in
    count: int,
    model: RobotModel,
    settings: StepSettings,
    drive: Drive,
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    # in, out
    work: Workspace,
    # out
    joint_q_out: wp.array(dtype=real),
    joint_qd_out: wp.array(dtype=real),
):
    """Advance every world by `settings.substeps` physics steps on a GPU, with a thread per leg.

    Launch over (count rounded up to a multiple of 8, 4). count: number of worlds, from `settings.first` on. Equals
    `advance_kernel` up to the contact tolerance.
    """
    index, leg = wp.tid()
    world = settings.first + wp.min(index, count - 1)  # threads beyond the last world repeat it, and write nothing
    com = base_com(model.table, world)
    s = LegState()
    s.base = load_base(joint_q, joint_qd, com, world)
    s.angles = load_motors(joint_q, leg_coord(world, leg))
    s.rates = load_motors(joint_qd, leg_dof(world, leg))
    s.impulse = work.impulse[leg, world]
    params = load_leg(model, world, leg)
    motors = load_leg_drive(drive, world, leg)
    while any_world(s.step < settings.substeps):
        s = advance_leg(model, settings, drive, params, motors, world, leg, s, leg == 0 and index < count)
    total = sum_legs(wp.dot(s.angles, s.angles) + wp.dot(s.rates, s.rates))
    broken = work.diverged[world] != 0 or not (finite_base(s.base) and wp.isfinite(total))
    if index >= count:
        return
    if broken:
        if leg == 0:
            work.diverged[world] = 1
            freeze_diverged_world(model, work, world, joint_q_out, joint_qd_out)
        return
    for j in range(3):
        work.torque[3 * leg + j, world] = s.torque[j]
    work.impulse[leg, world] = s.impulse
    work.contact_force[leg, world] = s.impulse / settings.dt
    work.peak_paw_force[leg, world] = wp.sqrt(s.peak_sq) / settings.dt
    store_motors(joint_q_out, leg_coord(world, leg), s.angles)
    store_motors(joint_qd_out, leg_dof(world, leg), s.rates)
    if leg == 0:
        store_base(joint_q_out, joint_qd_out, com, world, s.base)
        work.peak_force[world] = wp.sqrt(s.total_sq) / settings.dt
        work.residual[world] = s.residual
        work.sweeps[world] = s.rounds
