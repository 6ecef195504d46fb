"""Solution of one physics step of a world for its end velocities: base, legs, contacts and hard stops together.

A pressed hard stop adds stiffness to its leg, and so changes inertia and contact; whether it is pressed depends on the
rates at the end. The step is therefore solved with an assumed set of pressed stops (active set), and again with the set
that the resulting rates require, until both agree. A set is an int of two bits per angle of a leg, see `stops`.
"""

import warp as wp

from ...actuation import stops
from ...layout import GRAVITY
from ...scalar import real, vec3
from ...state import BaseState
from ..base_dynamics import LegSolve, add_leg, invert, motor_acceleration, solve_ang, solve_lin
from ..contact import BlockLaw, ContactState, PawContact, solve_contacts
from ..leg_dynamics import PawKinematics
from ..parameters import load_spring, load_stops, load_vec3
from ..step import RobotModel, StepSettings, base_system, hold_base, leg_terms, load_leg, paw_contact

wp.set_module_options({"enable_backward": False})


@wp.struct
class LegStep:
    """Inputs and results of one leg in the solution of a physics step (`solve_step`); motors: lateral, outer, inner."""

    angles: vec3  # in: [rad] at the start of the step
    rates: vec3  # in: [rad/s] at the start of the step
    torque: vec3  # in: [N m] of the motors
    new_rates: vec3  # out: [rad/s] at the end of the step
    stop_rates: stops.StopRates  # out: motor rates [rad/s] beyond which hard stops press, and damping [N m s/rad]
    pressed: int  # in, out: set of pressed hard stops in the preceding step, and in this step; see `stops`
    solve: LegSolve  # out: motor accelerations as a function of the base's acceleration, stops included
    paw: PawKinematics  # out: position [m] and Jacobians [m/rad] of the paw's centre at `angles`, body axes
    peak_sq: real  # not of `solve_step`: [N^2 s^2] square of the largest impulse on the paw, over the steps of a launch


@wp.struct
class StepSolution:
    """Solution of a step: end velocities of the base, in the body axes at its start, and statistics of iterations."""

    lin: vec3  # [m/s]
    ang: vec3  # [rad/s]
    contact: ContactState  # of the last solution
    sets: int  # number of sets of pressed stops that were tried


@wp.func
def solve_with_stops(
    model: RobotModel, settings: StepSettings, world: int, base: BaseState, force: vec3, moment: vec3, block: BlockLaw,
    impulse: wp.array2d(dtype=vec3), legs: wp.array(dtype=LegStep), contacts: wp.array(dtype=PawContact),
) -> StepSolution:  # fmt: skip
    """Solve a physics step of a world for its end velocities, with a fixed active set of hard stops for each leg.

    The sets are `legs[k].pressed`; arguments and results as in `solve_step`.
    """
    dt = settings.dt
    g = wp.quat_rotate_inv(base.quat, load_vec3(model.table, GRAVITY, world))
    system = base_system(model, world, base, g, force, moment)
    for k in range(legs.shape[0]):
        params = load_leg(model, world, k)
        spring = load_spring(model.table, k, world)
        terms = leg_terms(
            params, spring, legs[k].angles, legs[k].rates, legs[k].torque, legs[k].stop_rates, legs[k].pressed,
            base.ang, g, dt,
        )  # fmt: skip
        legs[k].solve = terms.solve
        legs[k].paw = terms.paw
        system = add_leg(system, terms.dynamics, terms.solve)
    inverse = hold_base(model, world, invert(system))
    lin_acc = solve_lin(inverse, system.force, system.moment)
    ang_acc = solve_ang(inverse, system.force, system.moment)
    lin = wp.quat_rotate_inv(base.quat, base.lin) + dt * lin_acc
    ang = base.ang + dt * ang_acc
    for k in range(legs.shape[0]):
        end = legs[k].rates + dt * motor_acceleration(legs[k].solve, lin_acc, ang_acc)
        legs[k].new_rates = end
        contacts[k] = paw_contact(
            model, world, k, base, lin, ang, end, legs[k].rates, impulse[k, world], legs[k].pressed, legs[k].paw,
            legs[k].solve, inverse, block, dt,
        )  # fmt: skip
    change = solve_contacts(contacts, block, settings.max_sweeps, settings.tolerance)
    for k in range(legs.shape[0]):
        solve = legs[k].solve
        push = solve.inverse * (wp.transpose(contacts[k].jacobian) * contacts[k].impulse)
        legs[k].new_rates = legs[k].new_rates + (push - solve.to_lin * change.lin - solve.to_ang * change.ang)
    solution = StepSolution()
    solution.lin = lin + change.lin
    solution.ang = ang + change.ang
    solution.contact = change
    return solution


@wp.func
def revise_stops(legs: wp.array(dtype=LegStep), slack: real, sets: int) -> bool:
    """Replace each leg's active set of hard stops by the set that its rates require; return whether any set changed.

    After many tries (`one_by_one`) only one stop of one leg changes. slack: a stop changes only if a rate exceeds it
    [rad/s]; sets: number of sets tried in this step.
    """
    changed = bool(False)
    for k in range(legs.shape[0]):
        pressed = legs[k].pressed
        required = stops.revised_stops(legs[k].stop_rates, legs[k].new_rates, slack, pressed, sets)
        if required != pressed and not (changed and stops.one_by_one(sets)):
            if stops.one_by_one(sets):
                required = stops.change_one(pressed, required)
            legs[k].pressed = required
            changed = True
    return changed


@wp.func
def solve_step(
    model: RobotModel, settings: StepSettings, world: int, base: BaseState, force: vec3, moment: vec3, block: BlockLaw,
    impulse: wp.array2d(dtype=vec3), legs: wp.array(dtype=LegStep), contacts: wp.array(dtype=PawContact),
) -> StepSolution:  # fmt: skip
    """Solve a physics step of a world for its end velocities, with contacts and the active set of hard joint stops.

    Writes every leg's pressed stops, contact and motor rates at the end of the step. force [N], moment [N m]: external,
    at the base's com, world axes. impulse: first guess [N s], world axes, (4, num_worlds). legs, contacts: local to the
    thread, (4,); `angles`, `rates`, `torque` and `pressed` of the legs are read, and all else but `peak_sq` is written.
    The first set is the set of the preceding step or, if it is empty, the stops that the rates at the start would
    press.
    """
    dt = settings.dt
    for k in range(legs.shape[0]):
        bounds = stops.stop_rates(load_stops(model.table, k, world), legs[k].angles, dt)
        legs[k].stop_rates = bounds
        if legs[k].pressed == 0:
            legs[k].pressed = stops.pressed_stops(bounds, legs[k].rates, real(0.0), 0)
    slack = stops.SLACK * settings.tolerance
    solution = StepSolution()
    sets = int(0)
    working = bool(True)
    while working:
        solution = solve_with_stops(model, settings, world, base, force, moment, block, impulse, legs, contacts)
        sets += 1
        working = sets < stops.MAX_SETS and revise_stops(legs, slack, sets)
    solution.sets = sets
    return solution
