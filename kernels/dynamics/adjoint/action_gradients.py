"""Gradients of a physics step, for CPU and GPU kernels: derivatives of its virtual power (see `virtual_power`).

The virtual power is one number: the step's equations times their adjoint multipliers. Its derivative w.r.t. an input x,
with multipliers, end velocities and impulses held constant, is the gradient of the loss w.r.t. x. It has the axes and
the order of x. Legs are 0 to 3: FL, FR, BL, BR; vectors of motors are lateral, outer, inner.
"""

import warp as wp

from ...actuation.joint_forces import JointParams
from ...actuation.springs import LegSpring
from ...actuation.stops import StopParams
from ...kinematics.geometry import LegGeometry
from ...layout import BASE, GRAVITY
from ...scalar import quat, real, vec3
from ...state import BaseState, base_com
from ..contact import SEPARATE
from ..inertia import MassMoments
from ..leg_dynamics import LegMasses
from ..parameters import load_moments, load_spring, load_stops, load_vec3
from ..step import LegParams, RobotModel
from .virtual_power import BaseCotangent, BaseFactors, LegFactors, base_action, leg_action

wp.set_module_options({"enable_backward": False})


@wp.struct
class LegGradient:
    """Gradient of a leg's virtual power in a time step (`leg_action`) w.r.t. each of its inputs.

    The caller sums the gradients w.r.t. base and gravity over legs.
    """

    geometry: LegGeometry
    masses: LegMasses
    joints: JointParams
    spring: LegSpring
    stops: StopParams
    mu: real  # w.r.t. the friction coefficient
    pos: vec3  # w.r.t. the base's position, orientation and angular velocity (body axes)
    quat: quat
    omega: vec3
    gravity: vec3  # w.r.t. gravity in body axes
    angles: vec3  # w.r.t. the motors' angles and rates at the start of the step
    rates: vec3


@wp.struct
class BaseGradient:
    """Gradient of the base's virtual power in a step (`base_action`) w.r.t. each of its inputs, in the same axes."""

    body: MassMoments
    com: vec3
    gravity: vec3
    force: vec3
    moment: vec3
    quat: quat
    lin: vec3
    omega: vec3


@wp.func
def make_base_factors(base: BaseState, end: BaseState, virtual_lin: vec3, virtual_ang: vec3, dt: real) -> BaseFactors:
    """Return the values held constant while the base's virtual power is differentiated: adjoint multipliers and motion.

    The step takes dt [s], from state `base` to `end`. virtual_*: adjoint multipliers, body axes.
    """
    factors = BaseFactors()
    factors.virtual_lin = virtual_lin
    factors.virtual_ang = virtual_ang
    factors.lin = wp.quat_rotate_inv(base.quat, end.lin)
    factors.ang = end.ang
    factors.lin_acc = (factors.lin - wp.quat_rotate_inv(base.quat, base.lin)) / dt
    factors.ang_acc = (factors.ang - base.ang) / dt
    return factors


@wp.func
def make_leg_factors(
    rates: vec3, new_rates: vec3, virtual_rates: vec3, mode: int, pressed: int, impulse: vec3, law: vec3, push: vec3,
    dt: real,
) -> LegFactors:  # fmt: skip
    """Return the values held constant while a leg's virtual power is differentiated: multipliers, motion, contact.

    rates, new_rates [rad/s] of the motors at the start and the end of the step of dt [s]. virtual_rates, law:
    multipliers of the motors' equations and of the contact law. mode: SEPARATE, STICK or SLIDE. pressed: set of pressed
    hard stops. impulse [N s]: on the paw, body axes. push: gradient of the loss w.r.t. the impulse, world axes.
    """
    factors = LegFactors()
    factors.virtual_rates = virtual_rates
    factors.rates = new_rates
    factors.acc = (new_rates - rates) / dt
    factors.mode = mode
    factors.pressed = pressed
    if mode != SEPARATE:
        factors.impulse = impulse
        factors.law = law
        factors.push = push
    return factors


@wp.func
def leg_action_gradient(
    model: RobotModel, params: LegParams, world: int, leg: int, mu: real, base: BaseState, angles: vec3, rates: vec3,
    base_held: BaseFactors, leg_held: LegFactors, dt: real,
) -> LegGradient:  # fmt: skip
    """Return the gradient of a leg's virtual power in a step (`leg_action`) w.r.t. its state and constants.

    leg: 0 to 3. dt: duration of the step [s]. mu: friction coefficient. base, angles [rad], rates [rad/s]: values at
    the start of the step. base_held, leg_held: constants of the differentiation.
    """
    g = wp.quat_rotate_inv(base.quat, load_vec3(model.table, GRAVITY, world))
    gradient = LegGradient()
    (geometry, masses, joints, spring, stops, _ground, mu_adj, pos, quat_adj, omega, g_adj, angles_adj, rates_adj,
     _base_held, _leg_held, _dt) = (
        wp.grad(leg_action)(
            params.geometry, params.masses, params.joints, load_spring(model.table, leg, world),
            load_stops(model.table, leg, world), model.ground, mu, base.pos, base.quat, base.ang, g, angles, rates,
            base_held, leg_held, dt,
        )
    )  # fmt: skip
    gradient.geometry = geometry
    gradient.masses = masses
    gradient.joints = joints
    gradient.spring = spring
    gradient.stops = stops
    gradient.mu = mu_adj
    gradient.pos = pos
    gradient.quat = quat_adj
    gradient.omega = omega
    gradient.gravity = g_adj
    gradient.angles = angles_adj
    gradient.rates = rates_adj
    return gradient


@wp.func
def base_action_gradient(
    model: RobotModel, world: int, force: vec3, moment: vec3, base: BaseState, held: BaseFactors,
    cotangent: BaseCotangent, dt: real,
) -> BaseGradient:  # fmt: skip
    """Return the gradient of the base's virtual power in a step (`base_action`) w.r.t. its state, mass and forces.

    dt: duration of the step [s]. held, cotangent: constants of the differentiation. force [N], moment [N m]: at the
    com, world axes. base: state at the start of the step.
    """
    body, com, gravity, force_adj, moment_adj, quat_adj, lin, omega, _held, _cotangent, _dt = wp.grad(base_action)(
        load_moments(model.table, BASE, world), base_com(model.table, world), load_vec3(model.table, GRAVITY, world),
        force, moment, base.quat, base.lin, base.ang, held, cotangent, dt,
    )  # fmt: skip
    gradient = BaseGradient()
    gradient.body = body
    gradient.com = com
    gradient.gravity = gravity
    gradient.force = force_adj
    gradient.moment = moment_adj
    gradient.quat = quat_adj
    gradient.lin = lin
    gradient.omega = omega
    return gradient
