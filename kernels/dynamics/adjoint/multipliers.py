"""Recomputation of a step, and adjoint multipliers of its equations of motion and contact laws; see `step_adjoint`.

The functions run in one thread per world. A step solves M (v' - v) = dt f + J^T p with contact laws R(p, v') = 0; the
multipliers solve its transposed equations, one number per equation. A cotangent is the gradient of the loss w.r.t. a
result. `legs` is scratch of the thread, (4,), legs FL, FR, BL, BR.
"""

import warp as wp

from ...actuation.stops import stop_rates
from ...layout import GRAVITY
from ...scalar import real, vec3
from ...state import BaseState
from ..base_dynamics import BaseInverse, LegSolve, add_leg, invert, motor_acceleration, solve_ang, solve_lin
from ..base_motion import integrate_base
from ..contact import SEPARATE, PawContact
from ..contact_laws import PawLaw, contact_at, contact_point, paw_law
from ..leg_dynamics import PawKinematics
from ..parameters import load_spring, load_stops, load_vec3
from ..step import LegParams, RobotModel, base_system, hold_base, leg_terms
from ..trajectory import TrajectoryArrays, row_vec3
from .action_gradients import make_base_factors, make_leg_factors
from .virtual_power import BaseFactors, LegFactors

wp.set_module_options({"enable_backward": False})


@wp.struct
class StepRecord:
    """Record of the physics steps between two trajectory rows of a rollout, recomputed for the reverse pass."""

    base: wp.array2d(dtype=BaseState)  # (num_worlds, steps + 1)
    angles: wp.array3d(dtype=vec3)  # [rad], (num_worlds, steps + 1, 4)
    rates: wp.array3d(dtype=vec3)  # [rad/s], likewise
    inverse: wp.array2d(dtype=BaseInverse)  # of the base's system, (num_worlds, steps)
    legs: wp.array3d(dtype=LegSolve)  # `free` includes the paw's impulse, (num_worlds, steps, 4)
    paws: wp.array3d(dtype=PawKinematics)  # (num_worlds, steps, 4)


@wp.struct
class ReplayedStep:
    """Indices of a physics step that is recomputed and differentiated, and the wrench on the base in it."""

    dt: real  # [s]
    world: int
    step: int  # of the rollout
    entry: int  # of the record
    force: vec3  # [N] at the base's com, world axes
    moment: vec3  # [N m], world axes


@wp.struct
class LegReverse:
    """Values of a leg during the reverse pass: gradients w.r.t. its motors, adjoint multipliers, its paw's contact.

    Vectors of motors are lateral, outer, inner.
    """

    angles: vec3  # w.r.t. the angles at the end of the step; after `reverse_step` at its start
    rates: vec3  # w.r.t. the rates at the end of the step; after `reverse_step` at its start
    torque: vec3  # w.r.t. the torques in the step
    virtual_rates: vec3  # multipliers of the motors' equations
    contact: PawContact  # of its paw at the solution
    law: PawLaw  # of its paw at the solution
    multiplier: vec3  # of the paw's law; before `solve_laws` the gradient w.r.t. the paw's impulse


@wp.struct
class Multipliers:
    """Adjoint multipliers of the base's equations of motion in a step, and the gradients they are solved from.

    The multipliers are m, the gradients y in M m = y (M: mass matrix); body axes.
    """

    lin_cotangent: vec3  # y: w.r.t. the base's linear velocity at the end of the step, contact laws included
    ang_cotangent: vec3  # y: w.r.t. the base's angular velocity
    lin: vec3  # m of the linear equations
    ang: vec3  # m of the angular equations


@wp.func
def solve_system(
    record: StepRecord, at: ReplayedStep, lin_cotangent: vec3, ang_cotangent: vec3, legs: wp.array(dtype=LegReverse)
) -> Multipliers:
    """Return the adjoint multipliers of the base's equations of motion, and write the motors' multipliers to `legs`.

    The system is M m = y (`Multipliers`) with y = *_cotangent, `legs[k].rates`. It contains no contact laws.
    """
    m = Multipliers()
    m.lin_cotangent = lin_cotangent
    m.ang_cotangent = ang_cotangent
    force = lin_cotangent
    moment = ang_cotangent
    for k in range(legs.shape[0]):
        solve = record.legs[at.world, at.entry, k]
        force -= wp.transpose(solve.to_lin) * legs[k].rates
        moment -= wp.transpose(solve.to_ang) * legs[k].rates
    inverse = record.inverse[at.world, at.entry]
    m.lin = solve_lin(inverse, force, moment)
    m.ang = solve_ang(inverse, force, moment)
    for k in range(legs.shape[0]):
        solve = record.legs[at.world, at.entry, k]
        legs[k].virtual_rates = solve.inverse * legs[k].rates - solve.to_lin * m.lin - solve.to_ang * m.ang
    return m


@wp.func
def replay_step(
    model: RobotModel, params: wp.array(dtype=LegParams), at: ReplayedStep, trajectory: TrajectoryArrays,
    record: StepRecord,
):  # fmt: skip
    """Recompute one physics step of a rollout, for its reverse pass, with the recorded torques, impulses and stops.

    The step starts from its entry of the record. The trajectory has its torques, impulses and pressed stops. The
    function writes the leg and base terms of the step (entry `at.entry`) and the state at its end (the next entry) to
    `record`.
    """
    dt, world, step, i = at.dt, at.world, at.step, at.entry
    base = record.base[world, i]
    g = wp.quat_rotate_inv(base.quat, load_vec3(model.table, GRAVITY, world))
    system = base_system(model, world, base, g, at.force, at.moment)
    for k in range(record.legs.shape[2]):
        torque = row_vec3(trajectory.torque, step, 3 * k, world)
        pressed = int(trajectory.pressed[step, k, world])
        angles = record.angles[world, i, k]
        stops = stop_rates(load_stops(model.table, k, world), angles, dt)
        spring = load_spring(model.table, k, world)
        rates = record.rates[world, i, k]
        terms = leg_terms(params[k], spring, angles, rates, torque, stops, pressed, base.ang, g, dt)
        record.legs[world, i, k] = terms.solve
        record.paws[world, i, k] = terms.paw
        system = add_leg(system, terms.dynamics, terms.solve)
    inverse = hold_base(model, world, invert(system))
    record.inverse[world, i] = inverse
    force_impulse = dt * system.force
    moment_impulse = dt * system.moment
    for k in range(record.legs.shape[2]):
        impulse = wp.quat_rotate_inv(base.quat, trajectory.impulse[step, k, world])
        if wp.dot(impulse, impulse) > real(0.0):
            solve = record.legs[world, i, k]
            paw = record.paws[world, i, k]
            contact = contact_at(model, world, k, base, paw, solve, inverse, impulse)
            joint = wp.transpose(contact.jacobian) * impulse
            force_impulse += impulse - wp.transpose(solve.to_lin) * joint
            moment_impulse += (
                wp.cross(contact_point(model, world, k, paw, contact), impulse) - wp.transpose(solve.to_ang) * joint
            )
            solve.free += solve.inverse * (joint / dt)
            record.legs[world, i, k] = solve
    lin = solve_lin(inverse, force_impulse, moment_impulse)
    ang = solve_ang(inverse, force_impulse, moment_impulse)
    for k in range(record.legs.shape[2]):
        rates = record.rates[world, i, k] + dt * motor_acceleration(record.legs[world, i, k], lin / dt, ang / dt)
        record.rates[world, i + 1, k] = rates
        record.angles[world, i + 1, k] = record.angles[world, i, k] + dt * rates
    record.base[world, i + 1] = integrate_base(base, wp.quat_rotate_inv(base.quat, base.lin) + lin, base.ang + ang, dt)


@wp.func
def solve_linear(a: wp.array2d(dtype=real), b: wp.array(dtype=real), n: int):
    """Solve a linear system a x = b by Gaussian elimination with row pivoting; x replaces b.

    Uses the first n rows and columns, and overwrites a. Used for the contact laws' 3 to 12 equations.
    """
    for col in range(n):
        best = col
        for row in range(col + 1, n):
            if wp.abs(a[row, col]) > wp.abs(a[best, col]):
                best = row
        if best != col:
            for i in range(col, n):
                swap = a[col, i]
                a[col, i] = a[best, i]
                a[best, i] = swap
            swap_b = b[col]
            b[col] = b[best]
            b[best] = swap_b
        scale = real(1.0) / a[col, col]
        for row in range(col + 1, n):
            factor = scale * a[row, col]
            if factor != real(0.0):
                for i in range(col + 1, n):
                    a[row, i] = a[row, i] - factor * a[col, i]
                b[row] = b[row] - factor * b[col]
    for back in range(n):
        row = n - 1 - back
        total = b[row]
        for i in range(row + 1, n):
            total -= a[row, i] * b[i]
        b[row] = total / a[row, row]


@wp.func
def solve_laws(legs: wp.array(dtype=LegReverse)):
    """Solve for the adjoint multipliers of all paws' contact laws, one linear system, by Gaussian elimination.

    The system is A^T l = -(gradient w.r.t. the impulses), see `step_adjoint`; paws couple through the base. Before the
    call, `multiplier` of each leg is the gradient w.r.t. the impulse of its paw. After the call, it is the multiplier
    (0 if separated).
    """
    matrix = wp.zeros(shape=(12, 12), dtype=real)
    vector = wp.zeros(shape=(12,), dtype=real)
    row = int(0)
    for k in range(legs.shape[0]):
        if legs[k].law.mode != SEPARATE:
            col = int(0)
            for j in range(legs.shape[0]):
                if legs[j].law.mode != SEPARATE:
                    block = (
                        legs[k].contact.from_lin * legs[j].contact.to_lin
                        + legs[k].contact.from_ang * legs[j].contact.to_ang
                    )
                    if k == j:
                        block = legs[k].contact.total
                    block = block * wp.transpose(legs[j].law.by_velocity)
                    if k == j:
                        block = block + wp.transpose(legs[k].law.by_impulse)
                    for r in range(3):
                        for s in range(3):
                            matrix[row + r, col + s] = block[r, s]
                    col += 3
            for r in range(3):
                vector[row + r] = -legs[k].multiplier[r]
            row += 3
    solve_linear(matrix, vector, row)
    row = int(0)
    for k in range(legs.shape[0]):
        legs[k].multiplier = vec3(real(0.0))
        if legs[k].law.mode != SEPARATE:
            legs[k].multiplier = vec3(vector[row], vector[row + 1], vector[row + 2])
            row += 3


@wp.func
def write_laws(
    model: RobotModel, at: ReplayedStep, first_impulse: wp.array2d(dtype=vec3), trajectory: TrajectoryArrays,
    record: StepRecord, m: Multipliers, cotangent: TrajectoryArrays, legs: wp.array(dtype=LegReverse),
) -> bool:  # fmt: skip
    """Write each paw's contact, contact law and gradient w.r.t. its impulse to `legs`; return whether any paw touches.

    The laws are linearised at the step's solution. m: from `solve_system`. first_impulse: as `Commands.impulse`.
    cotangent: gradient w.r.t. the trajectory.
    """
    world, i = at.world, at.entry
    base = record.base[world, i]
    end = record.base[world, i + 1]
    lin = wp.quat_rotate_inv(base.quat, end.lin)
    ang = end.ang
    old_lin = wp.quat_rotate_inv(base.quat, base.lin)
    touching = bool(False)
    for k in range(legs.shape[0]):
        legs[k].law = PawLaw()
        impulse = wp.quat_rotate_inv(base.quat, trajectory.impulse[at.step, k, world])
        if wp.dot(impulse, impulse) > real(0.0):
            paw = record.paws[world, i, k]
            c = contact_at(model, world, k, base, paw, record.legs[world, i, k], record.inverse[world, i], impulse)
            point = contact_point(model, world, k, paw, c)
            old_velocity = old_lin + wp.cross(base.ang, point) + c.jacobian * record.rates[world, i, k]
            velocity = lin + wp.cross(ang, point) + c.jacobian * record.rates[world, i + 1, k]
            old_impulse = first_impulse[k, world]
            if at.step > 0:
                old_impulse = trajectory.impulse[at.step - 1, k, world]
            old_impulse = wp.quat_rotate_inv(base.quat, old_impulse)
            law = paw_law(model, world, k, c, old_velocity, velocity, old_impulse)
            impulse_cotangent = m.lin + wp.cross(m.ang, point) + c.jacobian * legs[k].virtual_rates
            if cotangent.impulse.shape[0] > 0:
                impulse_cotangent += wp.quat_rotate_inv(base.quat, cotangent.impulse[at.step, k, world])
            legs[k].contact = c
            legs[k].law = law
            legs[k].multiplier = impulse_cotangent
            touching = touching or law.mode != SEPARATE
    return touching


@wp.func
def add_laws(
    model: RobotModel, at: ReplayedStep, record: StepRecord, multipliers: Multipliers, legs: wp.array(dtype=LegReverse),
) -> Multipliers:  # fmt: skip
    """Add the contribution of the paws' contact laws to the adjoint multipliers of the equations of motion.

    The multiplier of a law acts like a gradient y w.r.t. the velocity of the contact point, and is passed to base and
    motors. The function returns the multipliers of the base, and updates the multipliers of the motors in `legs`, which
    also has the laws.
    """
    m = multipliers
    law_lin = vec3(real(0.0))
    law_ang = vec3(real(0.0))
    for k in range(legs.shape[0]):
        if legs[k].law.mode != SEPARATE:
            c = legs[k].contact
            y = wp.transpose(legs[k].law.by_velocity) * legs[k].multiplier
            joint = wp.transpose(c.jacobian) * y
            law_lin += c.to_lin * y
            law_ang += c.to_ang * y
            m.lin_cotangent += y
            m.ang_cotangent += wp.cross(contact_point(model, at.world, k, record.paws[at.world, at.entry, k], c), y)
            legs[k].rates = legs[k].rates + joint
            legs[k].virtual_rates = legs[k].virtual_rates + record.legs[at.world, at.entry, k].inverse * joint
    m.lin += law_lin
    m.ang += law_ang
    for k in range(legs.shape[0]):
        solve = record.legs[at.world, at.entry, k]
        legs[k].virtual_rates = legs[k].virtual_rates - solve.to_lin * law_lin - solve.to_ang * law_ang
    return m


@wp.func
def find_multipliers(
    model: RobotModel, at: ReplayedStep, first_impulse: wp.array2d(dtype=vec3), trajectory: TrajectoryArrays,
    cotangent: TrajectoryArrays, record: StepRecord, lin_cotangent: vec3, ang_cotangent: vec3,
    legs: wp.array(dtype=LegReverse),
) -> Multipliers:  # fmt: skip
    """Return adjoint multipliers of a step's motion and contact equations, from gradients w.r.t. its end velocities.

    See `step_adjoint`. lin_cotangent, ang_cotangent: gradients w.r.t. the velocities of the base, body axes. legs:
    `rates` are the gradients w.r.t. the rates of the motors, to which the function adds the part of the contact laws.
    It writes multipliers, contacts and laws.
    """
    m = solve_system(record, at, lin_cotangent, ang_cotangent, legs)
    if write_laws(model, at, first_impulse, trajectory, record, m, cotangent, legs):
        solve_laws(legs)
        m = add_laws(model, at, record, m, legs)
    return m


@wp.func
def base_factors(at: ReplayedStep, record: StepRecord, m: Multipliers) -> BaseFactors:
    """Return the values held constant while the base's virtual power in the step `at` is differentiated.

    m: from `find_multipliers`.
    """
    base = record.base[at.world, at.entry]
    return make_base_factors(base, record.base[at.world, at.entry + 1], m.lin, m.ang, at.dt)


@wp.func
def leg_factors(
    at: ReplayedStep, k: int, trajectory: TrajectoryArrays, cotangent: TrajectoryArrays, record: StepRecord,
    legs: wp.array(dtype=LegReverse),
) -> LegFactors:  # fmt: skip
    """Return the values held constant while a leg's virtual power in the step `at` is differentiated.

    k: leg 0 to 3. Needs the results of `find_multipliers`.
    """
    push = vec3(real(0.0))
    if cotangent.impulse.shape[0] > 0:
        push = cotangent.impulse[at.step, k, at.world]
    return make_leg_factors(
        record.rates[at.world, at.entry, k], record.rates[at.world, at.entry + 1, k], legs[k].virtual_rates,
        legs[k].law.mode, int(trajectory.pressed[at.step, k, at.world]), legs[k].contact.impulse, legs[k].multiplier,
        push, at.dt,
    )  # fmt: skip
