"""Record of a few recomputed physics steps, for the reverse pass of a rollout with a thread per leg.

The reverse pass needs values of every step, such as inverse inertias. For a whole rollout they would take too much
memory. Therefore the steps of a few trajectory rows at a time are recomputed and recorded here. A multiplier is a
solution of the step's transposed equations, one number per equation (`step_adjoint`).
"""

import warp as wp

from ...scalar import mat33, real, vec3
from ...state import BaseState
from ..base_dynamics import BaseInverse, LegSolve
from .virtual_power import BaseCotangent

wp.set_module_options({"enable_backward": False})


@wp.struct
class BaseWeights:
    """Solved adjoint multipliers of the base's equations of motion in a step, body axes."""

    lin: vec3  # virtual velocity, see `virtual_power`
    ang: vec3  # virtual angular velocity
    cotangent: BaseCotangent


@wp.struct
class LegWeights:
    """Solved adjoint multipliers of a leg's equations of motion and of its paw's contact law in a step.

    The pass backwards in time computes these multipliers. The kernels of `constants_adjoint` read them, for all steps
    in parallel.
    """

    rates: vec3  # virtual rates of the motors
    law: vec3  # multiplier of the contact law, body axes


@wp.struct
class MotorSlopes:
    """Derivatives of each of a leg's motor torques w.r.t. its own target, angle and rate; lateral, outer, inner."""

    target: vec3  # [N m/rad]
    angle: vec3  # [N m/rad]
    rate: vec3  # [N m s/rad]


@wp.struct
class LegLaw:
    """Contact law of a paw, linearised at the solution of a step, as the reverse pass records it."""

    mode: int  # SEPARATE, STICK or SLIDE
    mu_row: int  # row of the friction coefficient in the parameter table
    mu: real  # friction coefficient
    impulse: vec3  # [N s], body axes
    point: vec3  # [m] where the paw touches, body axes, from the base's origin
    jacobian: mat33  # contact velocity per motor rate [m/rad]
    to_lin: mat33  # change of the base's linear velocity per impulse [1/kg]
    to_ang: mat33  # change of its angular velocity per impulse [1/(kg m)]
    by_velocity: mat33  # derivative of the law w.r.t. the contact velocity, see `contact_laws.PawLaw`


@wp.struct
class LawRow:
    """One paw's row in the inverse of the 12x12 contact-law matrix A^T (`step_adjoint`): a 3x3 block per paw."""

    a: mat33  # FL
    b: mat33  # FR
    c: mat33  # BL
    d: mat33  # BR


@wp.struct
class LegRecord:
    """Record of successive physics steps for the reverse pass: an entry per step, and one for the final state.

    Arrays of the base are (entries, num_worlds), of legs (entries, num_worlds, 4).
    """

    base: wp.array2d(dtype=BaseState)  # at the start of the step
    inverse: wp.array2d(dtype=BaseInverse)  # of the base's equations of motion, a 6x6 matrix
    base_weights: wp.array2d(dtype=BaseWeights)
    angles: wp.array3d(dtype=vec3)  # [rad] lateral, outer, inner
    rates: wp.array3d(dtype=vec3)  # [rad/s]
    solve: wp.array3d(dtype=LegSolve)  # motor accelerations by the base's acceleration
    slopes: wp.array3d(dtype=MotorSlopes)
    law: wp.array3d(dtype=LegLaw)
    law_row: wp.array3d(dtype=LawRow)  # defined only where a paw of the world touches
    weights: wp.array3d(dtype=LegWeights)
    by_filter: wp.array3d(dtype=vec3)  # gradient w.r.t. the angles that the filter reads, where a policy step begins
