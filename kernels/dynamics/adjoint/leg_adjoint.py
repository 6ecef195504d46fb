"""Reverse pass of a time step on GPUs, with a thread per leg; all four threads of a world compute the base's part.

1. `replay_leg` recomputes the motion and inverts the system of the contact laws' multipliers, many steps in parallel.
2. `reverse_leg` goes backwards from step to step and records multipliers.
3. `add_leg_constants` adds the gradients w.r.t. parameters, computed from these, many steps in parallel.

Only the second part is sequential. A cotangent is the gradient of the loss w.r.t. a result of the step; multipliers
("weights") are the solution of the step's transposed equations, see `step_adjoint`. `sum_*` add values of a world's
four threads, `*_from_leg` read the value of another thread. An entry of the record is a physics step. Vectors of motors
are lateral, outer, inner.
"""

import warp as wp

from ...actuation.stops import stop_rates
from ...lanes import any_world, mat_from_leg, sum_legs, sum_quat, sum_vec, vec_from_leg
from ...layout import GRAVITY, LEG_ROWS, MU_DYNAMIC, MU_STATIC
from ...scalar import mat33, real, vec3
from ...state import BaseState
from ..base_dynamics import BaseSystem, add_leg, invert, motor_acceleration, solve_ang, solve_lin, sum_systems
from ..base_motion import integrate_base
from ..contact import SEPARATE, PawContact
from ..contact_laws import PawLaw, contact_at, contact_point, paw_law
from ..inertia import MassMoments
from ..parameters import load_spring, load_stops, load_vec3
from ..step import LegParams, RobotModel, base_system, hold_base, leg_terms
from ..trajectory import TrajectoryArrays, row_vec3
from . import action_gradients, leg_record
from .action_gradients import LegGradient, base_action_gradient, leg_action_gradient, make_base_factors
from .gradients import ThreadSums, add_entry, add_leg_parameters
from .leg_record import ANGLES, RATES, BaseWeights, LawRow, LegLaw, LegRecord, LegWeights
from .virtual_power import BaseFactors, LegFactors, add, rotation_adjoint_scalar

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class LegAdjoint:
    """Gradient of the loss w.r.t. a world's state and inputs: the part that the thread of one leg computes.

    Axes and order as in the value.
    """

    base: BaseState  # w.r.t. the base's state at the start of the step
    angles: vec3  # w.r.t. the motors' angles at the start of the step: lateral, outer, inner
    rates: vec3  # w.r.t. the motors' rates at the start of the step
    torque: vec3  # w.r.t. the motors' torques in the step
    force: vec3  # w.r.t. the wrench on the base at its com, world axes; summed over steps as are the next four
    moment: vec3
    body: MassMoments  # w.r.t. the base link's mass moments
    com: vec3  # w.r.t. the base's centre of mass
    gravity: vec3  # w.r.t. gravity, world axes


@wp.func
def leg_law(c: PawContact, law: PawLaw, impulse: vec3, point: vec3) -> LegLaw:
    """Collect the values of a paw's contact that the reverse pass needs: law, impulse, contact point and Jacobians.

    impulse [N s], point [m] of contact: body axes.
    """
    recorded = LegLaw()
    recorded.mode = law.mode
    recorded.mu_row = law.mu_row
    recorded.mu = law.mu
    recorded.impulse = impulse
    recorded.point = point
    recorded.jacobian = c.jacobian
    recorded.to_lin = c.to_lin
    recorded.to_ang = c.to_ang
    recorded.by_velocity = law.by_velocity
    return recorded


@wp.func
def replay_leg(
    model: RobotModel, params: LegParams, dt: real, world: int, leg: int, force: vec3, moment: vec3,
    first_impulse: wp.array2d(dtype=vec3), trajectory: TrajectoryArrays, step: int, i: int, record: LegRecord,
):  # fmt: skip
    """Recompute one physics step of a rollout, with a thread per leg, and record its values for the reverse pass.

    Starts from the state in entry i of the record and writes the state at the end of the step to entry i + 1. Entry i
    stores the inverse of the base's system, the leg's elimination and its paw's law. force [N], moment [N m]: on the
    base at its com, world axes. first_impulse: as `Commands.impulse`. All four threads of a world write the same bits
    for the base; see `replay_step`.
    """
    base = leg_record.get_base(record, i, world)
    rates = leg_record.get_vec(record, i, RATES, world, leg)
    angles = leg_record.get_vec(record, i, ANGLES, world, leg)
    g = wp.quat_rotate_inv(base.quat, load_vec3(model.table, GRAVITY, world))
    torque = row_vec3(trajectory.torque, step, 3 * leg, world)
    stops = stop_rates(load_stops(model.table, leg, world), angles, dt)
    spring = load_spring(model.table, leg, world)
    terms = leg_terms(
        params, spring, angles, rates, torque, stops, int(trajectory.pressed[step, leg, world]), base.ang, g, dt
    )
    leg_system = add_leg(BaseSystem(), terms.dynamics, terms.solve)
    system = sum_systems(base_system(model, world, base, g, force, moment), leg_system)
    inverse = hold_base(model, world, invert(system))
    solve = terms.solve
    leg_record.put_inverse(record, i, world, inverse)
    paw = terms.paw
    c = PawContact()
    push = vec3(real(0.0))
    twist = vec3(real(0.0))
    point = vec3(real(0.0))
    impulse = wp.quat_rotate_inv(base.quat, trajectory.impulse[step, leg, world])
    touches = wp.dot(impulse, impulse) > real(0.0)
    if touches:
        c = contact_at(model, world, leg, base, paw, solve, inverse, impulse)
        joint = wp.transpose(c.jacobian) * impulse
        point = contact_point(model, world, leg, paw, c)
        push = impulse - wp.transpose(solve.to_lin) * joint
        twist = wp.cross(point, impulse) - wp.transpose(solve.to_ang) * joint
        solve.free += solve.inverse * (joint / dt)
    leg_record.put_solve(record, i, world, leg, solve)
    push = dt * system.force + sum_vec(push)
    twist = dt * system.moment + sum_vec(twist)
    lin = solve_lin(inverse, push, twist)
    ang = solve_ang(inverse, push, twist)
    new_rates = rates + dt * motor_acceleration(solve, lin / dt, ang / dt)
    leg_record.put_vec(record, i + 1, RATES, world, leg, new_rates)
    leg_record.put_vec(record, i + 1, ANGLES, world, leg, angles + dt * new_rates)
    old_lin = wp.quat_rotate_inv(base.quat, base.lin)
    leg_record.put_base(record, i + 1, world, integrate_base(base, old_lin + lin, base.ang + ang, dt))
    law = PawLaw()
    if touches:
        old_velocity = old_lin + wp.cross(base.ang, point) + c.jacobian * rates
        velocity = old_lin + lin + wp.cross(base.ang + ang, point) + c.jacobian * new_rates
        old_impulse = first_impulse[leg, world]
        if step > 0:
            old_impulse = trajectory.impulse[step - 1, leg, world]
        law = paw_law(model, world, leg, c, old_velocity, velocity, wp.quat_rotate_inv(base.quat, old_impulse))
    if any_world(any_leg(law.mode != SEPARATE)):
        leg_record.put_law_row(record, i, world, leg, inverted_laws(c, law, leg))
    leg_record.put_law(record, i, world, leg, leg_law(c, law, impulse, point))


@wp.func
def any_leg(flag: bool) -> bool:
    """Return whether any of the four threads (legs) of the world sets the flag; all four get the same result."""
    return sum_legs(wp.where(flag, real(1.0), real(0.0))) > real(0.0)


@wp.func
def law_block(c: PawContact, law: PawLaw, leg: int, j: int) -> mat33:
    """Return the 3x3 block (paw `leg`, paw j) of the matrix from which the contact-law multipliers are solved.

    The matrix is A^T of `step_adjoint`. With R_k the contact law of paw k and p_k its impulse, its blocks are

        (k, k): W_kk (dR_k/dv_k)^T + (dR_k/dp_k)^T,    (k, j): W_kj (dR_j/dv_j)^T for j != k.

    W_kj is the change of contact velocity v_k per impulse on paw j. It is `total` of paw k for k = j, else
    G_k S^-1 G_j^T (see `contact`): G_k is `from_lin`, `from_ang` of paw k, and S^-1 G_j^T is `to_lin`, `to_ang` of paw
    j. A's block (j, k) has W_jk; transposing A gives W_jk^T, which is W_kj since the mass matrix is symmetric. A
    separated paw has R = p, so that its diagonal block is the identity and its row is 0 elsewhere.

    c, law: contact and linearised law of this thread's paw `leg`. j: same in all threads; thread j sends its part.
    """
    to_lin = mat_from_leg(c.to_lin * wp.transpose(law.by_velocity), j)
    to_ang = mat_from_leg(c.to_ang * wp.transpose(law.by_velocity), j)
    if law.mode == SEPARATE:
        return wp.where(leg == j, wp.identity(n=3, dtype=real), mat33(real(0.0)))
    if leg == j:
        return c.total * wp.transpose(law.by_velocity) + wp.transpose(law.by_impulse)
    return c.from_lin * to_lin + c.from_ang * to_ang


@wp.func
def reduce_block(block: mat33, factor: mat33, pivot: mat33, j: int, leg: int) -> mat33:
    """Return a 3x3 block of this thread's matrix row after a step of block Gauss-Jordan elimination, with pivot row j.

    factor: this row's block in column j. pivot: in thread j, the block of row j scaled by the inverse diagonal block.
    """
    scaled = mat_from_leg(pivot, j)
    if leg == j:
        return scaled
    return block - factor * scaled


@wp.func
def inverted_laws(c: PawContact, law: PawLaw, leg: int) -> LawRow:
    """Invert the contact-law matrix by block Gauss-Jordan elimination over four threads, and return row `leg`.

    The matrix is A^T (12x12) of `step_adjoint`; each thread holds a row of 3x3 blocks.
    """
    eye = wp.identity(n=3, dtype=real)
    none = mat33(real(0.0))
    a0 = law_block(c, law, leg, 0)
    a1 = law_block(c, law, leg, 1)
    a2 = law_block(c, law, leg, 2)
    a3 = law_block(c, law, leg, 3)
    scale = wp.inverse(wp.where(leg == 0, a0, eye))
    a1 = reduce_block(a1, a0, scale * a1, 0, leg)
    a2 = reduce_block(a2, a0, scale * a2, 0, leg)
    a3 = reduce_block(a3, a0, scale * a3, 0, leg)
    a0 = reduce_block(none, a0, scale, 0, leg)
    scale = wp.inverse(wp.where(leg == 1, a1, eye))
    a0 = reduce_block(a0, a1, scale * a0, 1, leg)
    a2 = reduce_block(a2, a1, scale * a2, 1, leg)
    a3 = reduce_block(a3, a1, scale * a3, 1, leg)
    a1 = reduce_block(none, a1, scale, 1, leg)
    scale = wp.inverse(wp.where(leg == 2, a2, eye))
    a0 = reduce_block(a0, a2, scale * a0, 2, leg)
    a1 = reduce_block(a1, a2, scale * a1, 2, leg)
    a3 = reduce_block(a3, a2, scale * a3, 2, leg)
    a2 = reduce_block(none, a2, scale, 2, leg)
    scale = wp.inverse(wp.where(leg == 3, a3, eye))
    row = LawRow()
    row.a = reduce_block(a0, a3, scale * a0, 3, leg)
    row.b = reduce_block(a1, a3, scale * a1, 3, leg)
    row.c = reduce_block(a2, a3, scale * a2, 3, leg)
    row.d = reduce_block(none, a3, scale, 3, leg)
    return row


@wp.func
def multiplier(row: LawRow, impulse_cotangent: vec3) -> vec3:
    """Return the multiplier of the contact law of this thread's paw, from the gradient w.r.t. all paws' impulses.

    impulse_cotangent: gradient w.r.t. this paw's impulse. row: see `inverted_laws`; this paw's row of A^-T, one 3x3
    block per paw. Threads of separated paws must pass 0.
    """
    total = row.a * vec_from_leg(impulse_cotangent, 0) + row.b * vec_from_leg(impulse_cotangent, 1)
    return -(total + row.c * vec_from_leg(impulse_cotangent, 2) + row.d * vec_from_leg(impulse_cotangent, 3))


@wp.func
def base_factors(record: LegRecord, world: int, i: int, dt: real, base: BaseState, weights: BaseWeights) -> BaseFactors:
    """Return the values held constant while the base's virtual power in a recorded step is differentiated.

    i: entry of the step, of dt [s], in the record; base: state at its start.
    """
    return make_base_factors(base, leg_record.get_base(record, i + 1, world), weights.lin, weights.ang, dt)


@wp.func
def leg_factors(
    record: LegRecord, trajectory: TrajectoryArrays, cotangent: TrajectoryArrays, world: int, step: int, i: int,
    leg: int, dt: real, law: LegLaw, weights: LegWeights,
) -> LegFactors:  # fmt: skip
    """Return the values held constant while a leg's virtual power in a recorded step is differentiated.

    The acceleration of the motors follows from the rates of this entry and the next. step: number of the step in the
    rollout; dt [s]; i: entry of the step in the record.
    """
    push = vec3(real(0.0))
    if cotangent.impulse.shape[0] > 0:
        push = cotangent.impulse[step, leg, world]
    return action_gradients.make_leg_factors(
        leg_record.get_vec(record, i, RATES, world, leg), leg_record.get_vec(record, i + 1, RATES, world, leg),
        weights.rates, law.mode, int(trajectory.pressed[step, leg, world]), law.impulse, weights.law, push, dt,
    )  # fmt: skip


@wp.struct
class StepWeights:
    """Adjoint multipliers of a step's motion equations and contact laws, and part of its start velocities' gradients.

    `lin`, `ang`, `rates` are M m of `step_adjoint`: the part of these gradients at constant forces. `reverse_leg` adds
    the derivative of the virtual power, which completes them. Body axes at the start of the step.
    """

    base: BaseWeights  # of the base's equations of motion; `find_weights` leaves `cotangent` at 0
    leg: LegWeights  # of this thread's leg and its paw's contact law
    lin: vec3  # w.r.t. the base's linear velocity
    ang: vec3  # w.r.t. the base's angular velocity
    rates: vec3  # w.r.t. the rates of the leg's motors


@wp.func
def find_weights(
    record: LegRecord, world: int, leg: int, cotangent: TrajectoryArrays, step: int, i: int, base: BaseState,
    law: LegLaw, lin_cotangent: vec3, ang_cotangent: vec3, rate_cotangent: vec3,
) -> StepWeights:  # fmt: skip
    """Return adjoint multipliers of a step's motion and contact equations, from gradients w.r.t. its end velocities.

    The function equals `find_multipliers`, with a thread per leg. lin_cotangent, ang_cotangent: gradients w.r.t. the
    velocities of the base, in the body axes at the start of the step. rate_cotangent: gradient w.r.t. the rates of the
    motors. i: entry of the step in the record.
    """
    inverse = leg_record.get_inverse(record, i, world)
    solve = leg_record.get_solve(record, i, world, leg)
    weights = StepWeights()
    weights.lin = lin_cotangent
    weights.ang = ang_cotangent
    weights.rates = rate_cotangent
    push = lin_cotangent - sum_vec(wp.transpose(solve.to_lin) * rate_cotangent)
    twist = ang_cotangent - sum_vec(wp.transpose(solve.to_ang) * rate_cotangent)
    weights.base.lin = solve_lin(inverse, push, twist)
    weights.base.ang = solve_ang(inverse, push, twist)
    weights.leg.rates = (
        solve.inverse * rate_cotangent - solve.to_lin * weights.base.lin - solve.to_ang * weights.base.ang
    )
    touches = law.mode != SEPARATE
    impulse_cotangent = vec3(real(0.0))
    if touches:
        impulse_cotangent = weights.base.lin + wp.cross(weights.base.ang, law.point) + law.jacobian * weights.leg.rates
        if cotangent.impulse.shape[0] > 0:
            impulse_cotangent += wp.quat_rotate_inv(base.quat, cotangent.impulse[step, leg, world])
    if any_world(any_leg(touches)):
        y = vec3(real(0.0))
        weights.leg.law = multiplier(leg_record.get_law_row(record, i, world, leg), impulse_cotangent)
        if touches:
            y = wp.transpose(law.by_velocity) * weights.leg.law
        joint = wp.transpose(law.jacobian) * y
        law_lin = sum_vec(law.to_lin * y)
        law_ang = sum_vec(law.to_ang * y)
        weights.lin += sum_vec(y)
        weights.ang += sum_vec(wp.cross(law.point, y))
        weights.rates += joint
        weights.leg.rates += solve.inverse * joint - solve.to_lin * law_lin - solve.to_ang * law_ang
        weights.base.lin += law_lin
        weights.base.ang += law_ang
    return weights


@wp.func
def reverse_leg(
    model: RobotModel, params: LegParams, dt: real, world: int, leg: int, force: vec3, moment: vec3,
    trajectory: TrajectoryArrays, cotangent: TrajectoryArrays, step: int, i: int, record: LegRecord, adj: LegAdjoint,
    writes_record: bool,
) -> LegAdjoint:  # fmt: skip
    """Backpropagate through one time step, a thread per leg: return the gradient of the loss w.r.t. its start state.

    adj: gradient w.r.t. the state at the end. See `reverse_step`. i: the step's entry in the record, step: its number
    in the rollout. force [N], moment [N m]: on the base at its com, world axes. writes_record: whether this thread
    writes the step's multipliers to the record.
    """
    base = leg_record.get_base(record, i, world)
    law = leg_record.get_law(record, i, world, leg)
    new_velocity = adj.base.lin + dt * adj.base.pos
    quat_adj, ang_cotangent, _dt, _quat_adj = wp.grad(rotation_adjoint_scalar)(
        base.quat, row_vec3(record.base, i + 1, 10, world), dt, adj.base.quat
    )
    weights = find_weights(
        record, world, leg, cotangent, step, i, base, law, wp.quat_rotate_inv(base.quat, new_velocity),
        ang_cotangent + adj.base.ang, adj.rates + dt * adj.angles,
    )  # fmt: skip
    base_weights = weights.base
    # the equations of motion
    base_held = base_factors(record, world, i, dt, base, base_weights)
    leg_held = leg_factors(record, trajectory, cotangent, world, step, i, leg, dt, law, weights.leg)
    gradient = leg_action_gradient(
        model, params, world, leg, law.mu, base, leg_record.get_vec(record, i, ANGLES, world, leg),
        leg_record.get_vec(record, i, RATES, world, leg), base_held, leg_held, dt,
    )  # fmt: skip
    base_weights.cotangent.velocity = weights.lin
    base_weights.cotangent.new_velocity = new_velocity
    base_weights.cotangent.gravity = sum_vec(gradient.gravity)
    by_base = base_action_gradient(model, world, force, moment, base, base_held, base_weights.cotangent, dt)
    if writes_record:
        leg_record.put_base_weights(record, i, world, base_weights)
        leg_record.put_leg_weights(record, i, world, leg, weights.leg)
    out = LegAdjoint()
    out.base.pos = adj.base.pos + sum_vec(gradient.pos)
    out.base.quat = quat_adj + by_base.quat + sum_quat(gradient.quat)
    out.base.lin = by_base.lin
    out.base.ang = weights.ang + by_base.omega + sum_vec(gradient.omega)
    out.angles = adj.angles + gradient.angles
    out.rates = weights.rates + gradient.rates
    out.torque = dt * weights.leg.rates
    out.force = adj.force + by_base.force
    out.moment = adj.moment + by_base.moment
    out.body = add(adj.body, by_base.body)
    out.com = adj.com + by_base.com
    out.gravity = adj.gravity + by_base.gravity
    return out


@wp.func
def add_leg_constants(sums: ThreadSums, leg: int, law: LegLaw, gradient: LegGradient):
    """Add a step's gradient of the loss w.r.t. all constants of a leg, friction coefficients included, to `sums`.

    The function adds to both rows of friction, to one of them 0, since all threads of a warp must make the same calls.
    """
    add_leg_parameters(sums, leg, gradient)
    for row in range(2):  # the step depends on one of the two coefficients
        mu_row = leg * LEG_ROWS + wp.where(row == 0, int(MU_STATIC), int(MU_DYNAMIC))
        add_entry(sums, mu_row, wp.where(law.mode != SEPARATE and law.mu_row == mu_row, gradient.mu, real(0.0)))
