"""Kernel for CPUs that advances every world by several steps in one launch, with one thread per world.

On one CPU core `advance_legs`, with a thread per leg, takes 4.1 to 4.8 times as long per policy step (64 and 512
worlds, standing and jumping). Vectors of motors are lateral, outer, inner, legs FL, FR, BL, BR; `lin` and `ang` of the
base are in the body axes at the start of a step.
"""

import warp as wp

from ...scalar import real, vec3
from ...state import BaseState, base_com, leg_coord, leg_dof, load_base, load_motors, store_base, store_motors
from ...terrain.ground import has_block, move_block
from ..base_motion import integrate_base
from ..contact import ContactState, PawContact, block_velocity, push_on_block
from ..drive import Drive, Workspace, applied_torque, base_wrench, freeze_diverged_world, load_leg_drive
from ..step import RobotModel, StepSettings, block_law, finite_base
from .world_step import LegStep, solve_step

wp.set_module_options({"enable_backward": False})


@wp.func
def advance_once(
    model: RobotModel, settings: StepSettings, drive: Drive, work: Workspace, world: int, step: int, base: BaseState,
    legs: wp.array(dtype=LegStep), contacts: wp.array(dtype=PawContact),
) -> BaseState:  # fmt: skip
    """Advance one world by one physics step, motors, contacts and block included; return the new base state.

    The step takes `settings.dt`; `legs` and `contacts` are overwritten. step: number of the step in the launch, from 0;
    the last step writes torques and paw forces to `work`. legs, contacts (4,): scratch of the thread, see `solve_step`.
    `angles` and `rates` of the legs are input, and are replaced by their values at the end of the step. The function
    also moves the block of the world in `model.ground`, and updates impulses and peak values in `work`.
    """
    dt = settings.dt
    last = step == settings.substeps - 1
    for k in range(legs.shape[0]):
        torque = applied_torque(load_leg_drive(drive, world, k), step, legs[k].angles, legs[k].rates)
        legs[k].torque = torque
        if last:
            for j in range(3):
                work.torque[3 * k + j, world] = torque[j]
    wrench = base_wrench(drive.joint_f, drive.body_f, world)
    force = vec3(wrench[0], wrench[1], wrench[2])
    moment = vec3(wrench[3], wrench[4], wrench[5])
    block = block_law(model, world, base, dt)
    solved = solve_step(model, settings, world, base, force, moment, block, work.impulse, legs, contacts)
    if has_block(model.ground, world):
        push = push_on_block(contacts)
        move_block(model.ground, world, wp.quat_rotate(base.quat, block_velocity(block, push)), dt)
    record_contacts(work, world, base, contacts, solved.contact, dt, last, legs)
    for k in range(legs.shape[0]):
        end = legs[k].new_rates
        legs[k].rates = end
        legs[k].angles = legs[k].angles + dt * end
    return integrate_base(base, solved.lin, solved.ang, dt)


@wp.func
def record_contacts(
    work: Workspace, world: int, base: BaseState, contacts: wp.array(dtype=PawContact), solved: ContactState, dt: real,
    last: bool, legs: wp.array(dtype=LegStep),
):  # fmt: skip
    """Write the paws' impulses [N s] and, in the launch's last step, forces [N] to `work`, and update the peak values.

    World axes. solved: statistics of the step dt [s]. The peak of each paw goes to `legs`, all other peaks to `work`.
    The impulses in `work` are the first guess of the next step; peaks show impacts between two policy steps.
    """
    total = vec3(real(0.0))
    for k in range(contacts.shape[0]):
        impulse = wp.quat_rotate(base.quat, contacts[k].impulse)
        work.impulse[k, world] = impulse
        force = impulse / dt
        if last:
            work.contact_force[k, world] = force
        legs[k].peak_sq = wp.max(legs[k].peak_sq, wp.dot(contacts[k].impulse, contacts[k].impulse))
        total += force
    work.peak_force[world] = wp.max(work.peak_force[world], wp.length(total))
    work.sweeps[world] = wp.max(work.sweeps[world], solved.sweeps)
    work.residual[world] = wp.max(work.residual[world], solved.change)


@wp.kernel
def advance_kernel(
    # in
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
    """Advance every world by `settings.substeps` physics steps; one thread per world, from `settings.first` on.

    Writes the base and motor coordinates; `full_state_kernel` completes the passive ones.
    """
    world = settings.first + wp.tid()
    if work.diverged[world] != 0:
        freeze_diverged_world(model, work, world, joint_q_out, joint_qd_out)
        return
    com = base_com(model.table, world)
    base = load_base(joint_q, joint_qd, com, world)
    legs = wp.zeros(shape=(4,), dtype=LegStep)
    contacts = wp.zeros(shape=(4,), dtype=PawContact)
    for k in range(legs.shape[0]):
        legs[k].angles = load_motors(joint_q, leg_coord(world, k))
        legs[k].rates = load_motors(joint_qd, leg_dof(world, k))
    work.residual[world] = real(0.0)
    work.sweeps[world] = 0
    work.peak_force[world] = real(0.0)
    for step in range(settings.substeps):
        base = advance_once(model, settings, drive, work, world, step, base, legs, contacts)
    total = real(0.0)
    for k in range(legs.shape[0]):
        angles = legs[k].angles
        rates = legs[k].rates
        work.peak_paw_force[k, world] = wp.sqrt(legs[k].peak_sq) / settings.dt
        store_motors(joint_q_out, leg_coord(world, k), angles)
        store_motors(joint_qd_out, leg_dof(world, k), rates)
        total += wp.dot(angles, angles) + wp.dot(rates, rates)
    store_base(joint_q_out, joint_qd_out, com, world, base)
    if not (finite_base(base) and wp.isfinite(total)):
        work.diverged[world] = 1
        freeze_diverged_world(model, work, world, joint_q_out, joint_qd_out)
