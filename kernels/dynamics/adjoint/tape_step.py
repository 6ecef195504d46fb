"""Differentiable time step for `wp.Tape`: one kernel solves the step unrecorded, and the tape records two others.

    solve_kernel (not recorded) -> power_kernel -> integrate_kernel

In the reverse pass, `integrate_kernel` passes the gradient w.r.t. the velocities at the end of the step to
`find_multipliers`. `power_kernel` computes the virtual power of the equations of motion, weighted with these
multipliers: its derivatives w.r.t. the inputs of the step are the gradient of the step (see `step_adjoint`).
"""

import warp as wp

from ...layout import BASE, GRAVITY
from ...scalar import mat43, real, vec3
from ...state import base_com, leg_coord, leg_dof, load_base, load_motors, store_base, store_motors
from ..base_motion import integrate_base
from ..contact import BlockLaw, PawContact
from ..drive import Drive, Workspace, base_wrench
from ..parameters import load_joint_params, load_masses, load_moments, load_spring, load_stops, load_vec3
from ..step import LegParams, RobotModel, StepSettings, load_leg
from ..trajectory import TrajectoryArrays, store_row_vec3
from ..world.world_step import LegStep, solve_step
from .multipliers import LegReverse, ReplayedStep, StepRecord, base_factors, find_multipliers, leg_factors, replay_step
from .virtual_power import BaseCotangent, BaseFactors, LegFactors, base_action, leg_action


@wp.struct
class SolvedStep:
    """Solution of a time step on Warp's tape, and multipliers of its reverse pass; arrays by world or (leg, world)."""

    trajectory: TrajectoryArrays  # torques, impulses and pressed stops, shape (1, ..., num_worlds)
    old_impulse: wp.array2d(dtype=vec3)  # [N s] on each paw in the step before, world axes
    lin: wp.array(dtype=vec3)  # [m/s] of the base at the end of the step, in the body axes of its start
    ang: wp.array(dtype=vec3)  # [rad/s] of the base, likewise
    rates: wp.array2d(dtype=vec3)  # [rad/s] of the motors at the end of the step
    base: wp.array(dtype=BaseFactors)
    cotangent: wp.array(dtype=BaseCotangent)
    ang_cotangent: wp.array(dtype=vec3)  # gradient w.r.t. the base's angular velocity at the start
    legs: wp.array2d(dtype=LegFactors)
    rate_cotangent: wp.array2d(dtype=vec3)  # gradient w.r.t. the motors' rates at the start
    mu_row: wp.array2d(dtype=int)  # row of the friction coefficient in the parameter table


@wp.kernel(enable_backward=False)
def solve_kernel(
    # in
    model: RobotModel,
    settings: StepSettings,
    drive: Drive,
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    # in, out
    work: Workspace,
    # out
    solved: SolvedStep,
):
    """Solve a time step of every world, without recording on the tape, and write the solution to `solved` and `work`.

    Blocks are ignored; torques: drive.joint_f.
    """
    world = wp.tid()
    base = load_base(joint_q, joint_qd, base_com(model.table, world), world)
    legs = wp.zeros(shape=(4,), dtype=LegStep)
    contacts = wp.zeros(shape=(4,), dtype=PawContact)
    for k in range(legs.shape[0]):
        torque = load_motors(drive.joint_f, leg_dof(world, k))
        legs[k].angles = load_motors(joint_q, leg_coord(world, k))
        legs[k].rates = load_motors(joint_qd, leg_dof(world, k))
        legs[k].torque = torque
        store_row_vec3(solved.trajectory.torque, 0, 3 * k, world, torque)
        solved.old_impulse[k, world] = work.impulse[k, world]
    wrench = base_wrench(drive.joint_f, drive.body_f, world)
    force = vec3(wrench[0], wrench[1], wrench[2])
    moment = vec3(wrench[3], wrench[4], wrench[5])
    solution = solve_step(model, settings, world, base, force, moment, BlockLaw(), work.impulse, legs, contacts)
    solved.lin[world] = solution.lin
    solved.ang[world] = solution.ang
    for k in range(legs.shape[0]):
        impulse = wp.quat_rotate(base.quat, contacts[k].impulse)
        solved.rates[k, world] = legs[k].new_rates
        solved.trajectory.impulse[0, k, world] = impulse
        solved.trajectory.pressed[0, k, world] = wp.uint8(legs[k].pressed)
        work.impulse[k, world] = impulse
        work.contact_force[k, world] = impulse / settings.dt


@wp.kernel
def power_kernel(
    # in
    model: RobotModel,
    dt: real,
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    joint_f: wp.array(dtype=real),
    body_f: wp.array(dtype=wp.spatial_vector),
    solved: SolvedStep,
    # out
    power: wp.array2d(dtype=real),
):
    """Compute each leg's virtual power in a step, which the tape differentiates in place of the solution of the step.

    power: (4, num_worlds), leg 0 with the base; one thread per (leg, world).
    """
    k, world = wp.tid()
    com = base_com(model.table, world)
    base = load_base(joint_q, joint_qd, com, world)
    gravity = load_vec3(model.table, GRAVITY, world)
    g = wp.quat_rotate_inv(base.quat, gravity)
    base_held = solved.base[world]
    leg = solved.legs[k, world]
    rates = load_motors(joint_qd, leg_dof(world, k))
    total = leg_action(
        model.geometry[k], load_masses(model.table, k, world), load_joint_params(model.table, k, world),
        load_spring(model.table, k, world), load_stops(model.table, k, world), model.ground,
        model.table[solved.mu_row[k, world], world], base.pos, base.quat, base.ang, g,
        load_motors(joint_q, leg_coord(world, k)), rates, base_held, leg, dt,
    )  # fmt: skip
    total += wp.dot(solved.rate_cotangent[k, world], rates)
    total += dt * wp.dot(leg.virtual_rates, load_motors(joint_f, leg_dof(world, k)))
    if k == 0:
        wrench = base_wrench(joint_f, body_f, world)
        force = vec3(wrench[0], wrench[1], wrench[2])
        moment = vec3(wrench[3], wrench[4], wrench[5])
        total += base_action(
            load_moments(model.table, BASE, world), com, gravity, force, moment, base.quat, base.lin, base.ang,
            base_held, solved.cotangent[world], dt,
        )  # fmt: skip
        total += wp.dot(solved.ang_cotangent[world], base.ang)
    power[k, world] = total


@wp.struct
class EndVelocities:
    """Velocities at the end of a step: of the base, in the body axes at its start, and of the motors of each leg."""

    lin: vec3  # [m/s]
    ang: vec3  # [rad/s]
    rates: mat43  # [rad/s]


@wp.func
def end_velocities(
    model: RobotModel, dt: real, joint_q: wp.array(dtype=real), joint_qd: wp.array(dtype=real),
    joint_f: wp.array(dtype=real), body_f: wp.array(dtype=wp.spatial_vector), solved: SolvedStep, record: StepRecord,
    power: wp.array2d(dtype=real), world: int,
) -> EndVelocities:  # fmt: skip
    """Return the solved velocities at the end of a step, whose reverse pass is the custom `adj_end_velocities`.

    The arguments other than `solved` and `world` are for that reverse pass.
    """
    end = EndVelocities()
    end.lin = solved.lin[world]
    end.ang = solved.ang[world]
    for k in range(4):
        end.rates[k] = solved.rates[k, world]
    return end


@wp.func_grad(end_velocities)
def adj_end_velocities(
    model: RobotModel, dt: real, joint_q: wp.array(dtype=real), joint_qd: wp.array(dtype=real),
    joint_f: wp.array(dtype=real), body_f: wp.array(dtype=wp.spatial_vector), solved: SolvedStep, record: StepRecord,
    power: wp.array2d(dtype=real), world: int, adj_ret: EndVelocities,
):  # fmt: skip
    """Adjoint of `end_velocities`: solve for the multipliers of the step, for the reverse pass of `power_kernel`.

    Writes them to `solved` and adds 1 to the adjoint of `power`; adj_ret: gradient w.r.t. the end velocities.
    """
    params = wp.zeros(shape=(4,), dtype=LegParams)
    legs = wp.zeros(shape=(4,), dtype=LegReverse)
    wrench = base_wrench(joint_f, body_f, world)
    at = ReplayedStep()
    at.dt = dt
    at.world = world
    at.force = vec3(wrench[0], wrench[1], wrench[2])
    at.moment = vec3(wrench[3], wrench[4], wrench[5])
    record.base[world, 0] = load_base(joint_q, joint_qd, base_com(model.table, world), world)
    for k in range(legs.shape[0]):
        params[k] = load_leg(model, world, k)
        record.angles[world, 0, k] = load_motors(joint_q, leg_coord(world, k))
        record.rates[world, 0, k] = load_motors(joint_qd, leg_dof(world, k))
        legs[k].rates = vec3(adj_ret.rates[k, 0], adj_ret.rates[k, 1], adj_ret.rates[k, 2])
    replay_step(model, params, at, solved.trajectory, record)
    m = find_multipliers(
        model, at, solved.old_impulse, solved.trajectory, TrajectoryArrays(), record, adj_ret.lin, adj_ret.ang, legs,
    )  # fmt: skip
    cotangent = BaseCotangent()
    cotangent.velocity = m.lin_cotangent
    solved.base[world] = base_factors(at, record, m)
    solved.cotangent[world] = cotangent
    solved.ang_cotangent[world] = m.ang_cotangent
    for k in range(legs.shape[0]):
        solved.legs[k, world] = leg_factors(at, k, solved.trajectory, TrajectoryArrays(), record, legs)
        solved.rate_cotangent[k, world] = legs[k].rates
        solved.mu_row[k, world] = legs[k].law.mu_row
        wp.adjoint[power][k, world] += real(1.0)


@wp.kernel
def integrate_kernel(
    # in
    model: RobotModel,
    dt: real,
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    joint_f: wp.array(dtype=real),
    body_f: wp.array(dtype=wp.spatial_vector),
    solved: SolvedStep,
    record: StepRecord,
    power: wp.array2d(dtype=real),
    # out
    joint_q_out: wp.array(dtype=real),
    joint_qd_out: wp.array(dtype=real),
):
    """Integrate the robots' coordinates over a step dt [s] with the velocities at its end; one thread per world."""
    world = wp.tid()
    com = base_com(model.table, world)
    base = load_base(joint_q, joint_qd, com, world)
    end = end_velocities(model, dt, joint_q, joint_qd, joint_f, body_f, solved, record, power, world)
    store_base(joint_q_out, joint_qd_out, com, world, integrate_base(base, end.lin, end.ang, dt))
    for k in range(4):
        rates = vec3(end.rates[k, 0], end.rates[k, 1], end.rates[k, 2])
        angles = load_motors(joint_q, leg_coord(world, k)) + dt * rates
        store_motors(joint_q_out, leg_coord(world, k), angles)
        store_motors(joint_qd_out, leg_dof(world, k), rates)
