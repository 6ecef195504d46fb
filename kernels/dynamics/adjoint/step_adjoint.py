"""One time step of one world, backwards.

The step solves M (v' - v) = dt f + J^T p for the velocities v' at its end, with impulses p that satisfy the contact law
R(p, v') = 0 in modes (separated, sticking, sliding) that are held. For a gradient y of v' and z of p:

    A^T l = -(z + J M^-1 y),   A = dR/dp + dR/dv' J M^-1 J^T     (implicit function theorem)
    m = M^-1 (y + J^T (dR/dv')^T l)

and the gradient with respect to all else, the old velocities aside, is that of m . (dt f + J^T p - M (v' - v)) + l . R
with v', p, m and l held (`virtual_power`). Where a mode changes the motion has a kink; the gradient is that of the mode
which the forward pass found.
"""

import warp as wp

from ...layout import BASE, GRAVITY
from ...scalar import quat, real, vec3
from ...state import BaseState, base_com
from ..contact import SEPARATE, PawContact
from ..parameters import load_moments, load_spring, load_stops, load_vec3
from ..step import LegParams, RobotModel
from ..trajectory import TrajectoryArrays
from .gradients import (
    add_com,
    add_entry,
    add_geometry,
    add_joints,
    add_masses,
    add_moments,
    add_spring,
    add_stops,
    add_vec3,
)
from .multipliers import LegReverse, ReplayedStep, StepRecord, base_factors, find_multipliers, leg_factors
from .virtual_power import BaseCotangent, BaseFactors, LegFactors, base_action, leg_action, rotation_adjoint_scalar

wp.set_module_options({"enable_backward": False})


@wp.struct
class BaseGradient:
    """A leg's part of the gradient by the base's state at the start of a step, and by gravity in body axes."""

    pos: vec3
    quat: quat
    omega: vec3
    gravity: vec3


@wp.func
def reverse_leg_equations(
    model: RobotModel, params: LegParams, at: ReplayedStep, k: int, record: StepRecord, g: vec3, base: BaseFactors,
    leg_held: LegFactors, legs: wp.array(dtype=LegReverse), sums: wp.array(dtype=real),
) -> BaseGradient:  # fmt: skip
    """Add the gradients of a leg's weighed equations to those by its motors and its parameters."""
    world, i = at.world, at.entry
    start = record.base[world, i]
    law = legs[k].law
    mu = real(0.0)
    if law.mode != SEPARATE:
        mu = law.mu
    (geo, masses, joints, spring, stops, _ground, mu_adj, pos, quat_adj, omega, g_part, angles, rates, _held, _leg,
     _step) = (
        wp.grad(leg_action)(
            params.geometry, params.masses, params.joints, load_spring(model.table, k, world),
            load_stops(model.table, k, world), model.ground, mu, start.pos, start.quat, start.ang, g,
            record.angles[world, i, k], record.rates[world, i, k], base, leg_held, at.dt,
        )
    )  # fmt: skip
    add_geometry(sums, k, geo)
    add_masses(sums, k, masses)
    add_joints(sums, k, joints)
    add_spring(sums, k, spring)
    add_stops(sums, k, stops)
    if law.mode != SEPARATE:
        add_entry(sums, law.mu_row, mu_adj)
    legs[k].angles = legs[k].angles + angles
    legs[k].rates = legs[k].rates + rates
    legs[k].torque = at.dt * legs[k].virtual_rates
    gradient = BaseGradient()
    gradient.pos = pos
    gradient.quat = quat_adj
    gradient.omega = omega
    gradient.gravity = g_part
    return gradient


@wp.struct
class StepAdjoint:
    """Gradient by the base's state at the start of a step, and by the wrench on it."""

    base: BaseState
    force: vec3
    moment: vec3


@wp.func
def reverse_step(
    model: RobotModel, params: wp.array(dtype=LegParams), at: ReplayedStep, first_impulse: wp.array2d(dtype=vec3),
    trajectory: TrajectoryArrays, cotangent: TrajectoryArrays, record: StepRecord, adj: BaseState,
    legs: wp.array(dtype=LegReverse), contacts: wp.array(dtype=PawContact), matrix: wp.array2d(dtype=real),
    vector: wp.array(dtype=real), sums: wp.array(dtype=real),
) -> StepAdjoint:  # fmt: skip
    """Run a step backwards: from the gradient by the state at its end to that by the state at its start.

    adj: gradient by the base's state; `angles` and `rates` of the legs are replaced in place, and `torque` is written.
    """
    dt, world = at.dt, at.world
    base = record.base[world, at.entry]
    ahead = record.base[world, at.entry + 1]
    # integration of the coordinates
    new_velocity = adj.lin + dt * adj.pos
    quat_adj, ang_cotangent, _dt, _quat_adj = wp.grad(rotation_adjoint_scalar)(base.quat, ahead.ang, dt, adj.quat)
    for k in range(legs.shape[0]):
        legs[k].rates = legs[k].rates + dt * legs[k].angles
    m = find_multipliers(
        model, at, first_impulse, trajectory, cotangent, record, wp.quat_rotate_inv(base.quat, new_velocity),
        ang_cotangent + adj.ang, legs, contacts, matrix, vector,
    )  # fmt: skip
    # the equations of motion
    base_held = base_factors(at, record, m)
    gravity = load_vec3(model.table, GRAVITY, world)
    g = wp.quat_rotate_inv(base.quat, gravity)
    out = StepAdjoint()
    out.base.pos = adj.pos
    out.base.quat = quat_adj
    out.base.ang = m.ang_cotangent
    g_adj = vec3(real(0.0))
    for k in range(legs.shape[0]):
        leg_held = leg_factors(at, k, trajectory, cotangent, record, legs, contacts)
        gradient = reverse_leg_equations(model, params[k], at, k, record, g, base_held, leg_held, legs, sums)
        out.base.pos += gradient.pos
        out.base.quat += gradient.quat
        out.base.ang += gradient.omega
        g_adj += gradient.gravity
    weights = BaseCotangent()
    weights.velocity = m.lin_cotangent
    weights.new_velocity = new_velocity
    weights.gravity = g_adj
    body, com, weight, force_adj, moment_adj, quat_adj, lin_adj, omega, _base, _cotangent, _dt_base = wp.grad(
        base_action
    )(load_moments(model.table, BASE, world), base_com(model.table, world), gravity, at.force, at.moment, base.quat,
        base.lin, base.ang, base_held, weights, dt,
    )  # fmt: skip
    add_moments(sums, BASE, body)
    add_com(sums, model.table[BASE, world], base_com(model.table, world), com)
    add_vec3(sums, GRAVITY, weight)
    out.force = force_adj
    out.moment = moment_adj
    out.base.quat += quat_adj
    out.base.lin = lin_adj
    out.base.ang += omega
    return out
