"""The kernel that advances every world by several steps in one launch, a thread a world: the CPU's."""

import warp as wp

from ...actuation.stops import StopRows
from ...scalar import real, vec3
from ...state import BaseState, base_com, leg_coord, leg_dof, load_base, load_motors, store_base, store_motors
from ...terrain.ground import has_block, move_block
from ..base_dynamics import LegSolve
from ..base_motion import moved_base
from ..contact import ContactState, PawContact, block_velocity, push_on_block
from ..drive import Drive, Workspace, applied_torque, base_wrench, load_leg_drive, park
from ..leg_dynamics import PawKinematics
from ..step import Robot, StepSettings, block_law, finite_base
from .world_step import solve_step

wp.set_module_options({"enable_backward": False})


@wp.func
def advance_once(
    robot: Robot, settings: StepSettings, drive: Drive, work: Workspace, world: int, step: int, base: BaseState,
    angles: wp.array(dtype=vec3), rates: wp.array(dtype=vec3), torques: wp.array(dtype=vec3),
    rows: wp.array(dtype=StopRows), pressed: wp.array(dtype=int), legs: wp.array(dtype=LegSolve),
    paws: wp.array(dtype=PawKinematics), contacts: wp.array(dtype=PawContact), ends: wp.array(dtype=vec3),
    peaks: wp.array(dtype=real),
) -> BaseState:  # fmt: skip
    """Advance one world by one step; angles and rates of the legs' motors are updated in place."""
    dt = settings.dt
    last = step == settings.substeps - 1
    for k in range(torques.shape[0]):
        torques[k] = applied_torque(load_leg_drive(drive, world, k), step, angles[k], rates[k])
        if last:
            for j in range(3):
                work.torque[3 * k + j, world] = torques[k][j]
    wrench = base_wrench(drive, world)
    force = vec3(wrench[0], wrench[1], wrench[2])
    moment = vec3(wrench[3], wrench[4], wrench[5])
    block = block_law(robot, world, base, dt)
    solved = solve_step(
        robot, settings, world, base, force, moment, block, work.impulse, angles, rates, torques, rows, pressed, legs,
        paws, contacts, ends,
    )  # fmt: skip
    if has_block(robot.ground, world):
        move_block(robot.ground, world, wp.quat_rotate(base.quat, block_velocity(block, push_on_block(contacts))), dt)
    record_contacts(work, world, base, contacts, solved.contact, dt, last, peaks)
    for k in range(angles.shape[0]):
        rates[k] = ends[k]
        angles[k] += dt * ends[k]
    return moved_base(base, solved.lin, solved.ang, dt)


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
    torques = wp.zeros(shape=(4,), dtype=vec3)
    ends = wp.zeros(shape=(4,), dtype=vec3)
    rows = wp.zeros(shape=(4,), dtype=StopRows)
    pressed = wp.zeros(shape=(4,), dtype=int)
    legs = wp.zeros(shape=(4,), dtype=LegSolve)
    paws = wp.zeros(shape=(4,), dtype=PawKinematics)
    contacts = wp.zeros(shape=(4,), dtype=PawContact)
    work.residual[world] = real(0.0)
    work.sweeps[world] = 0
    work.peak_force[world] = real(0.0)
    peaks = wp.zeros(shape=(4,), dtype=real)
    for step in range(settings.substeps):
        base = advance_once(
            robot, settings, drive, work, world, step, base, angles, rates, torques, rows, pressed, legs, paws,
            contacts, ends, peaks,
        )  # fmt: skip
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
