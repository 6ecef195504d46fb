"""`advance` for GPUs: four threads a world, a thread a leg, which exchange what the base and the contacts need.

A thread holds one leg and a copy of the base; the base's equations are sums over the four threads. The contact law is
that of `contact`; here all paws propose their next impulse at once, until none would change its contact velocity by
more than the tolerance. All take it, since paws are coupled through the heavy base only; should the largest change not
shrink so, the paw that would change most takes its own alone from then on. A step whose stops turn out wrong (see
`world_step`) is made again by its world, while the others of a warp go on.
"""

import warp as wp

from ...actuation.stops import (
    MAX_SETS,
    SLACK,
    StopRows,
    beyond_stops,
    change_one,
    one_by_one,
    pressed_stops,
    revised_stops,
    stop_rows,
)
from ...lanes import any_world, first_leg, from_leg, max_legs, sum_legs, sum_vec, sync_lanes
from ...layout import GRAVITY
from ...scalar import real, vec3
from ...state import BaseState, base_com, leg_coord, leg_dof, load_base, load_motors, store_base, store_motors
from ...terrain.ground import move_block
from ..base_dynamics import BaseSystem, add_leg, invert, motor_acceleration, solve_ang, solve_lin, sum_systems
from ..base_motion import moved_base
from ..contact import BlockLaw, PawContact, block_velocity, local_impulse
from ..drive import Drive, LegDrive, Workspace, applied_torque, base_wrench, freeze_diverged_world, load_leg_drive
from ..parameters import load_spring, load_stops, load_vec3
from ..step import (
    LegParams,
    Robot,
    StepSettings,
    base_system,
    block_law,
    finite_base,
    hold_base,
    leg_terms,
    load_leg,
    paw_contact,
)

# largest change of a contact velocity, by that of the time before, with which all paws go on taking theirs at once
SHRINKING = wp.constant(real(0.9))
# [m^2/s^2] square of a change that no proposal reaches
ANY_CHANGE = wp.constant(real(1.0e12))

# division and roots are rounded to 2 units in the last place, as a third of the code
wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class LegState:
    """What a thread carries from step to step."""

    base: BaseState
    angles: vec3  # [rad] of its leg's motors
    rates: vec3  # [rad/s]
    torque: vec3  # [N m] of its motors in the last step
    impulse: vec3  # [N s] of its paw, world frame
    peak_sq: real  # [N^2 s^2] largest impulse on the paw, squared
    total_sq: real  # [N^2 s^2] largest sum of the impulses, squared
    residual: real  # [m/s] of the contact iteration, largest
    rounds: int  # of the contact iteration, most of a step
    step: int  # steps made in this launch
    sets: int  # sets of pressed stops tried for the present step without agreement
    pressed: int  # the leg's next one
    used: int  # the leg's set of pressed stops in the last step


@wp.struct
class PawSolution:
    """The contact problem's solution as one paw sees it."""

    impulse: vec3  # [N s] on the paw, body axes
    lin: vec3  # change of the base's linear velocity [m/s]
    ang: vec3  # change of its angular velocity [rad/s]
    residual: real  # [m/s]
    rounds: int


@wp.func
def solve_paws(c: PawContact, blocks: bool, block: BlockLaw, leg: int, max_rounds: int, tolerance: real) -> PawSolution:
    """Solve the contact problem; `blocks`: whether any world has a block."""
    s = PawSolution()
    s.impulse = c.impulse
    s.lin = sum_vec(c.to_lin * c.impulse)
    s.ang = sum_vec(c.to_ang * c.impulse)
    working, together = bool(True), bool(True)
    before = real(ANY_CHANGE)
    while any_world(working):
        velocity = c.free + c.from_lin * s.lin + c.from_ang * s.ang + c.own * s.impulse
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
        chosen = first_leg(change == most)
        if working:
            s.residual = wp.sqrt(most)
        working = working and s.residual > tolerance and s.rounds < max_rounds
        together = together and most <= SHRINKING * SHRINKING * before
        before = most
        if leg != chosen and not together:
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
class StopTry:
    """The set of pressed stops that a leg tries in a step."""

    rows: StopRows
    pressed: int


@wp.func
def next_try(robot: Robot, world: int, leg: int, old: LegState, dt: real) -> StopTry:
    """Return the leg's stops for the present try."""
    found = StopTry()
    found.pressed = old.pressed
    if found.pressed != 0 or old.sets == 0:
        stops = load_stops(robot.table, leg, world)
        if found.pressed != 0 or beyond_stops(stops, old.angles + dt * old.rates):
            found.rows = stop_rows(stops, old.angles, dt)
            if old.sets == 0:
                found.pressed = pressed_stops(found.rows, old.rates, real(0.0), 0)
    return found


@wp.func
def wanted_stops(
    robot: Robot, settings: StepSettings, world: int, leg: int, angles: vec3, rates: vec3, pressed: int, sets: int
) -> int:
    """Return the set that the rates at the end of the step ask for; loads limits again, which would fill registers."""
    limits = load_stops(robot.table, leg, world)
    wanted = int(0)
    if pressed != 0 or beyond_stops(limits, angles + settings.dt * rates):
        rows = stop_rows(limits, angles, settings.dt)
        wanted = revised_stops(rows, rates, SLACK * settings.tolerance, pressed, sets)
    return wanted


@wp.func
def stepped(
    old: LegState, base: BaseState, angles: vec3, rates: vec3, torque: vec3, solved: PawSolution, total: vec3,
    pressed: int,
) -> LegState:  # fmt: skip
    """Return the state after a step; total [N s]: sum of the paws' impulses."""
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
    new.used = pressed
    new.sets = 0
    new.pressed = 0
    return new


@wp.func
def tried(old: LegState, pressed: int, wanted: int, chosen: bool) -> LegState:
    """Return the state with the next set to try for the same step; chosen: this leg's changes where only one may."""
    new = old
    new.sets = old.sets + 1
    new.pressed = pressed
    if not one_by_one(new.sets):
        new.pressed = wanted
    elif chosen:
        new.pressed = change_one(pressed, wanted)
    return new


@wp.func
def advance_leg(
    robot: Robot, settings: StepSettings, drive: Drive, own: LegParams, motors: LegDrive, world: int, leg: int,
    old: LegState, writes: bool,
) -> LegState:  # fmt: skip
    """Return the thread's state after a step, or the old one with another set of stops to try for the same step.

    writes: whether the thread is the one that moves its world's block. A world that has made its steps stays.
    """
    dt = settings.dt
    blocks = robot.ground.blocks.shape[0] > 0
    base = old.base
    g = wp.quat_rotate_inv(base.quat, load_vec3(robot.table, GRAVITY, world))
    torque = applied_torque(motors, old.step, old.angles, old.rates)
    stops = next_try(robot, world, leg, old, dt)
    pressed = stops.pressed
    spring = load_spring(robot.table, leg, world)
    terms = leg_terms(own, spring, old.angles, old.rates, torque, stops.rows, pressed, base.ang, g, dt)
    wrench = base_wrench(drive.joint_f, drive.body_f, world)
    force = vec3(wrench[0], wrench[1], wrench[2])
    moment = vec3(wrench[3], wrench[4], wrench[5])
    share = add_leg(BaseSystem(), terms.dynamics, terms.solve)
    system = sum_systems(base_system(robot, world, base, g, force, moment), share)
    inverse = hold_base(robot, world, invert(system))
    lin_acc = solve_lin(inverse, system.force, system.moment)
    ang_acc = solve_ang(inverse, system.force, system.moment)
    lin = wp.quat_rotate_inv(base.quat, base.lin) + dt * lin_acc
    ang = base.ang + dt * ang_acc
    rates = old.rates + dt * motor_acceleration(terms.solve, lin_acc, ang_acc)
    block = block_law(robot, world, base, dt)
    contact = paw_contact(
        robot, world, leg, base, lin, ang, rates, old.rates, old.impulse, pressed, terms.paw, terms.solve, inverse,
        block, dt,
    )  # fmt: skip
    solved = solve_paws(contact, blocks, block, leg, 4 * settings.max_sweeps, settings.tolerance)
    solve = terms.solve
    rates += solve.inverse * (wp.transpose(contact.jacobian) * solved.impulse)
    rates -= solve.to_lin * solved.lin + solve.to_ang * solved.ang
    total = sum_vec(solved.impulse)
    sets = old.sets + 1
    wanted = wanted_stops(robot, settings, world, leg, old.angles, rates, pressed, sets)
    first = first_leg(wanted != pressed)
    agreed = from_leg(wp.where(wanted != pressed, real(1.0), real(0.0)), first) == real(0.0)
    done = old.step < settings.substeps and (agreed or sets >= MAX_SETS)
    if blocks:
        push = sum_vec(wp.where(contact.on_block != 0, -solved.impulse, vec3(real(0.0))))
        if writes and done and robot.ground.blocks[world].exists != 0:
            move_block(robot.ground, world, wp.quat_rotate(base.quat, block_velocity(block, push)), dt)
        sync_lanes()
    if done:
        moved = moved_base(base, lin + solved.lin, ang + solved.ang, dt)
        return stepped(old, moved, old.angles + dt * rates, rates, torque, solved, total, pressed)
    return tried(old, pressed, wanted, leg == first)


@wp.kernel
def advance_legs_kernel(
    # in
    count: int,
    robot: Robot,
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
    """Advance every world by `settings.substeps` steps; launch over (count rounded up to a multiple of 8, 4).

    count: worlds, from `settings.first` on.

    Does what `advance_kernel` does, to the contact tolerance.
    """
    place, leg = wp.tid()
    world = settings.first + wp.min(place, count - 1)  # threads beyond the last world repeat it, and write nothing
    com = base_com(robot.table, world)
    s = LegState()
    s.base = load_base(joint_q, joint_qd, com, world)
    s.angles = load_motors(joint_q, leg_coord(world, leg))
    s.rates = load_motors(joint_qd, leg_dof(world, leg))
    s.impulse = work.impulse[leg, world]
    own = load_leg(robot, world, leg)
    motors = load_leg_drive(drive, world, leg)
    while any_world(s.step < settings.substeps):
        s = advance_leg(robot, settings, drive, own, motors, world, leg, s, leg == 0 and place < count)
    total = sum_legs(wp.dot(s.angles, s.angles) + wp.dot(s.rates, s.rates))
    broken = work.invalid[world] != 0 or not (finite_base(s.base) and wp.isfinite(total))
    if place >= count:
        return
    if broken:
        if leg == 0:
            work.invalid[world] = 1
            freeze_diverged_world(robot, work, world, joint_q_out, joint_qd_out)
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
