"""The kernel that advances every world by several steps in one launch."""

import warp as wp

from ..actuation.motors import MotorArrays
from ..layout import BODIES, COORDS, DOFS, GRAVITY
from ..scalar import real, vec3
from ..state import BaseState, base_com, leg_coord, leg_dof, load_base, load_motors, store_base, store_motors
from ..terrain.ground import has_block, move_block, rest_block
from .base_dynamics import BaseInverse, LegSolve, invert, motor_acceleration, solve_ang, solve_lin
from .base_motion import moved_base
from .contact import BlockLaw, ContactState, PawContact, block_velocity, on_block, solve_contacts
from .leg_dynamics import PawKinematics
from .parameters import load_vec3
from .step import (
    Robot,
    StepSettings,
    base_system,
    block_law,
    drive_torque,
    finite_base,
    leg_terms,
    paw_contact,
    touch_block,
    touch_floor,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class Drive:
    """What acts on the robot: motor targets, joint forces and a wrench on the base, held over the launch."""

    closed_loop: int  # 1: the motors follow `target`; 0: only `joint_f` acts
    motors: MotorArrays
    target: wp.array2d(dtype=real)  # [rad], (12, num_worlds)
    previous: wp.array2d(dtype=real)  # [rad], (12, num_worlds), followed before the target arrives
    delay: wp.array(dtype=int)  # steps until it does, (num_worlds,); empty: none
    joint_f: wp.array(dtype=real)  # [N m] and, for the base, world wrench at its com; Newton's layout
    body_f: wp.array(dtype=wp.spatial_vector)  # world wrench at the com of each body; the base's is used


@wp.struct
class Workspace:
    """The solver's own arrays, per world."""

    impulse: wp.array2d(dtype=vec3)  # [N s] of each paw in the last step, world frame, (4, num_worlds)
    contact_force: wp.array2d(dtype=vec3)  # [N] on each paw in the last step, world frame, (4, num_worlds)
    peak_force: wp.array(dtype=real)  # [N] largest total paw force of the launch
    peak_paw_force: wp.array2d(dtype=real)  # [N] largest on each paw in the launch, (4, num_worlds)
    torque: wp.array2d(dtype=real)  # [N m] of each motor in the last step, (12, num_worlds)
    residual: wp.array(dtype=real)  # [m/s] of the contact iteration, largest of the launch
    sweeps: wp.array(dtype=int)  # of the contact iteration, most of the launch
    invalid: wp.array(dtype=int)  # 1: the world became non-finite and waits for a reset
    reference_q: wp.array(dtype=real)  # joint_q where invalid worlds are parked


@wp.func
def park(robot: Robot, work: Workspace, world: int, joint_q: wp.array(dtype=real), joint_qd: wp.array(dtype=real)):
    """Put a world at rest in its reference pose, its block at rest at its start."""
    rest_block(robot.ground, world)
    for i in range(int(COORDS)):
        joint_q[world * COORDS + i] = work.reference_q[world * COORDS + i]
    for i in range(int(DOFS)):
        joint_qd[world * DOFS + i] = real(0.0)
    for k in range(4):
        work.impulse[k, world] = vec3(real(0.0))
        work.contact_force[k, world] = vec3(real(0.0))


@wp.func
def applied_torque(
    drive: Drive, world: int, k: int, step: int, last: bool, angles: vec3, rates: vec3, torque: wp.array2d(dtype=real)
) -> vec3:
    """Return leg k's motor-space torque [N m]; that of the last step is written to `torque`."""
    motor = vec3(real(0.0))
    if drive.closed_loop != 0:
        target = vec3(drive.target[3 * k, world], drive.target[3 * k + 1, world], drive.target[3 * k + 2, world])
        if drive.delay.shape[0] > 0:
            if step < drive.delay[world]:
                target = vec3(
                    drive.previous[3 * k, world], drive.previous[3 * k + 1, world], drive.previous[3 * k + 2, world]
                )
        motor = drive_torque(drive.motors, k, world, target, angles, rates)
    total = motor + load_motors(drive.joint_f, leg_dof(world, k))
    if last:
        for j in range(3):
            torque[3 * k + j, world] = total[j]
    return total


@wp.func
def base_wrench(drive: Drive, world: int) -> wp.spatial_vector:
    """Return the external wrench on the base at its com, world axes (force [N], moment [N m])."""
    w = drive.body_f[world * BODIES]
    i = world * DOFS
    return w + wp.spatial_vector(
        float(drive.joint_f[i]), float(drive.joint_f[i + 1]), float(drive.joint_f[i + 2]),
        float(drive.joint_f[i + 3]), float(drive.joint_f[i + 4]), float(drive.joint_f[i + 5]),
    )  # fmt: skip


@wp.func
def load_contact(
    robot: Robot, work: Workspace, world: int, k: int, base: BaseState, lin: vec3, ang: vec3, rates: vec3,
    old_rates: vec3, paw: PawKinematics, leg: LegSolve, inverse: BaseInverse, block: BlockLaw, dt: real,
    contacts: wp.array(dtype=PawContact),
):  # fmt: skip
    """Write paw k's contact problem, with floor or block, whichever is nearer, to `contacts`; see `paw_contact`."""
    guess = work.impulse[k, world]
    touch = touch_floor(robot, k, base, paw)
    contacts[k] = paw_contact(robot, world, k, base, lin, ang, rates, old_rates, guess, paw, leg, inverse, touch, dt)
    if has_block(robot.ground, world):
        above = touch_block(robot, world, k, base, paw, block)
        if above.gap < touch.gap:
            contact = paw_contact(
                robot, world, k, base, lin, ang, rates, old_rates, guess, paw, leg, inverse, above, dt
            )  # fmt: skip
            contacts[k] = on_block(contact, block)


@wp.func
def advance_once(
    robot: Robot, settings: StepSettings, drive: Drive, work: Workspace, world: int, step: int, base: BaseState,
    angles: wp.array(dtype=vec3), rates: wp.array(dtype=vec3), legs: wp.array(dtype=LegSolve),
    paws: wp.array(dtype=PawKinematics), contacts: wp.array(dtype=PawContact), peaks: wp.array(dtype=real),
) -> BaseState:  # fmt: skip
    """Advance one world by one step; angles and rates of the legs' motors are updated in place."""
    dt = settings.dt
    last = step == settings.substeps - 1
    g = wp.quat_rotate_inv(base.quat, load_vec3(robot.table, GRAVITY, world))
    wrench = base_wrench(drive, world)
    force = vec3(real(wrench[0]), real(wrench[1]), real(wrench[2]))
    moment = vec3(real(wrench[3]), real(wrench[4]), real(wrench[5]))
    system = base_system(robot, world, base, g, force, moment)
    for k in range(legs.shape[0]):
        torque = applied_torque(drive, world, k, step, last, angles[k], rates[k], work.torque)
        system = leg_terms(robot, world, k, angles[k], rates[k], torque, base.ang, g, dt, system, legs, paws)
    inverse = invert(system)
    lin_acc = solve_lin(inverse, system.force, system.moment)
    ang_acc = solve_ang(inverse, system.force, system.moment)
    lin = wp.quat_rotate_inv(base.quat, base.lin) + dt * lin_acc
    ang = base.ang + dt * ang_acc
    block = block_law(robot, world, base, dt)
    for k in range(legs.shape[0]):
        old = rates[k]
        rates[k] = old + dt * motor_acceleration(legs[k], lin_acc, ang_acc)
        load_contact(
            robot, work, world, k, base, lin, ang, rates[k], old, paws[k], legs[k], inverse, block, dt, contacts
        )
    change = solve_contacts(contacts, block, settings.max_sweeps, settings.tolerance)
    if has_block(robot.ground, world):
        move_block(robot.ground, world, wp.quat_rotate(base.quat, block_velocity(block, contacts)), dt)
    record_contacts(work, world, base, contacts, change, dt, last, peaks)
    for k in range(legs.shape[0]):
        push = legs[k].inverse * (wp.transpose(contacts[k].jacobian) * contacts[k].impulse)
        rates[k] += push - legs[k].to_lin * change.lin - legs[k].to_ang * change.ang
        angles[k] += dt * rates[k]
    return moved_base(base, lin + change.lin, ang + change.ang, dt)


@wp.func
def record_contacts(
    work: Workspace, world: int, base: BaseState, contacts: wp.array(dtype=PawContact), solved: ContactState, dt: real,
    last: bool, peaks: wp.array(dtype=real),
):  # fmt: skip
    """Write the paws' impulses, forces in the last step, and keep the largest; peaks [N]: on each paw."""
    total = vec3(real(0.0))
    for k in range(contacts.shape[0]):
        impulse = wp.quat_rotate(base.quat, contacts[k].impulse)
        work.impulse[k, world] = impulse
        force = impulse / dt
        if last:
            work.contact_force[k, world] = force
        peaks[k] = wp.max(peaks[k], wp.dot(contacts[k].impulse, contacts[k].impulse))
        total += force
    work.peak_force[world] = wp.max(work.peak_force[world], wp.length(total))
    work.sweeps[world] = wp.max(work.sweeps[world], solved.sweeps)
    work.residual[world] = wp.max(work.residual[world], solved.change)


@wp.kernel
def advance_kernel(
    # in
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
    """Advance every world by `settings.substeps` steps; one thread per world.

    Writes the base and motor coordinates; the passive ones follow in `full_state`.
    """
    world = settings.first + wp.tid()
    if work.invalid[world] != 0:
        park(robot, work, world, joint_q_out, joint_qd_out)
        return
    com = base_com(robot.table, world)
    base = load_base(joint_q, joint_qd, com, world)
    angles = wp.zeros(shape=(4,), dtype=vec3)
    rates = wp.zeros(shape=(4,), dtype=vec3)
    for k in range(angles.shape[0]):
        angles[k] = load_motors(joint_q, leg_coord(world, k))
        rates[k] = load_motors(joint_qd, leg_dof(world, k))
    legs = wp.zeros(shape=(4,), dtype=LegSolve)
    paws = wp.zeros(shape=(4,), dtype=PawKinematics)
    contacts = wp.zeros(shape=(4,), dtype=PawContact)
    work.residual[world] = real(0.0)
    work.sweeps[world] = 0
    work.peak_force[world] = real(0.0)
    peaks = wp.zeros(shape=(4,), dtype=real)
    for step in range(settings.substeps):
        base = advance_once(robot, settings, drive, work, world, step, base, angles, rates, legs, paws, contacts, peaks)
    total = real(0.0)
    for k in range(angles.shape[0]):
        work.peak_paw_force[k, world] = wp.sqrt(peaks[k]) / settings.dt
        store_motors(joint_q_out, leg_coord(world, k), angles[k])
        store_motors(joint_qd_out, leg_dof(world, k), rates[k])
        total += wp.dot(angles[k], angles[k]) + wp.dot(rates[k], rates[k])
    store_base(joint_q_out, joint_qd_out, com, world, base)
    if not (finite_base(base) and wp.isfinite(total)):
        work.invalid[world] = 1
        park(robot, work, world, joint_q_out, joint_qd_out)
