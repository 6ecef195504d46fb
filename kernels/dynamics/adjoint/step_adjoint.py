"""Reverse pass of one time step of one world, from the gradient w.r.t. its end state to the gradient w.r.t. its inputs.

The step solves M (v' - v) = dt f + J^T p for the velocities v' at its end, with impulses p that satisfy the contact law
R(p, v') = 0 in fixed modes (separated, sticking, sliding). For a gradient y by v' and z by p, the multipliers l, m are

    A^T l = -(z + J M^-1 y),   A = dR/dp + dR/dv' J M^-1 J^T     (implicit function theorem)
    m = M^-1 (y + J^T (dR/dv')^T l)

and the gradient with respect to all else, the old velocities aside, is that of m . (dt f + J^T p - M (v' - v)) + l . R
at constant v', p, m and l (`virtual_power`). Where a mode changes, the motion has a kink; the gradient belongs to the
mode of the forward pass.
"""

from typing import Any

import warp as wp

from ...layout import BASE, GRAVITY
from ...scalar import real, vec3
from ...state import BaseState, base_com
from ..contact import SEPARATE
from ..step import LegParams, RobotModel
from ..trajectory import TrajectoryArrays
from .action_gradients import LegGradient, base_action_gradient, leg_action_gradient
from .gradients import add_com, add_entry, add_leg_parameters, add_moments, add_vec3
from .multipliers import LegReverse, ReplayedStep, StepRecord, base_factors, find_multipliers, leg_factors
from .virtual_power import BaseCotangent, rotation_adjoint_scalar

wp.set_module_options({"enable_backward": False})


@wp.struct
class StepAdjoint:
    """Gradient of the loss w.r.t. the base's state at the start of a step, and w.r.t. the wrench on it."""

    base: BaseState  # axes as those of the state
    force: vec3  # w.r.t. the force at the com, world axes
    moment: vec3


@wp.func
def add_leg_gradient(gradient: LegGradient, k: int, dt: real, legs: wp.array(dtype=LegReverse), sums: Any):
    """Add the gradient of leg k's virtual power w.r.t. its motors to `legs`, and w.r.t. its parameters to `sums`.

    Also writes the gradient w.r.t. the motors' torques to `legs`: dt times the multipliers, since torques enter the
    equations as dt f. dt: duration of the step [s]. legs (4,): scratch. sums (GRADIENT_ROWS,): gradient w.r.t.
    parameters. mu_row: row of the friction coefficient in this step.
    """
    add_leg_parameters(sums, k, gradient)
    if legs[k].law.mode != SEPARATE:
        add_entry(sums, legs[k].law.mu_row, gradient.mu)
    legs[k].angles = legs[k].angles + gradient.angles
    legs[k].rates = legs[k].rates + gradient.rates
    legs[k].torque = dt * legs[k].virtual_rates


@wp.func
def reverse_step(
    model: RobotModel, params: wp.array(dtype=LegParams), at: ReplayedStep, first_impulse: wp.array2d(dtype=vec3),
    trajectory: TrajectoryArrays, cotangent: TrajectoryArrays, record: StepRecord, adj: BaseState,
    legs: wp.array(dtype=LegReverse), sums: Any,
) -> StepAdjoint:  # fmt: skip
    """Backpropagate through one time step of a world: return the gradient w.r.t. the base's state at its start.

    adj: gradient w.r.t. the base's state at the end. legs (4,): gradients w.r.t. `angles` and `rates` at the end are
    replaced by those at the start, `torque` is written, the rest is scratch. sums (GRADIENT_ROWS,): gradient w.r.t.
    parameters, added to. first_impulse: as in `Commands`. trajectory of the rollout; cotangent: gradient w.r.t. the
    trajectory. record: written by `replay_step`.
    """
    dt, world = at.dt, at.world
    base = record.base[world, at.entry]
    # integration of the coordinates
    new_velocity = adj.lin + dt * adj.pos
    quat_adj, ang_cotangent, _dt, _quat_adj = wp.grad(rotation_adjoint_scalar)(
        base.quat, record.base[world, at.entry + 1].ang, dt, adj.quat
    )
    for k in range(legs.shape[0]):
        legs[k].rates = legs[k].rates + dt * legs[k].angles
    m = find_multipliers(
        model, at, first_impulse, trajectory, cotangent, record, wp.quat_rotate_inv(base.quat, new_velocity),
        ang_cotangent + adj.ang, legs,
    )  # fmt: skip
    # the equations of motion
    base_held = base_factors(at, record, m)
    out = StepAdjoint()
    out.base.pos = adj.pos
    out.base.quat = quat_adj
    out.base.ang = m.ang_cotangent
    g_adj = vec3(real(0.0))
    for k in range(legs.shape[0]):
        leg_held = leg_factors(at, k, trajectory, cotangent, record, legs)
        mu = wp.where(legs[k].law.mode != SEPARATE, legs[k].law.mu, real(0.0))
        gradient = leg_action_gradient(
            model, params[k], world, k, mu, base, record.angles[world, at.entry, k], record.rates[world, at.entry, k],
            base_held, leg_held, dt,
        )  # fmt: skip
        add_leg_gradient(gradient, k, dt, legs, sums)
        out.base.pos += gradient.pos
        out.base.quat += gradient.quat
        out.base.ang += gradient.omega
        g_adj += gradient.gravity
    velocities = BaseCotangent()
    velocities.velocity = m.lin_cotangent
    velocities.new_velocity = new_velocity
    velocities.gravity = g_adj
    by_base = base_action_gradient(model, world, at.force, at.moment, base, base_held, velocities, dt)
    add_moments(sums, BASE, by_base.body)
    add_com(sums, model.table[BASE, world], base_com(model.table, world), by_base.com)
    add_vec3(sums, GRAVITY, by_base.gravity)
    out.force = by_base.force
    out.moment = by_base.moment
    out.base.quat += by_base.quat
    out.base.lin = by_base.lin
    out.base.ang += by_base.omega
    return out
