"""Record of a few recomputed physics steps, for the reverse pass of a rollout with a thread per leg.

The reverse pass needs values of every step, such as inverse inertias. For a whole rollout they would take too much
memory. Therefore the steps of a few trajectory rows at a time are recomputed and recorded here. `get_*` and `put_*`
read and write the fields of one entry (a step) and world; indices of world and leg come last for coalesced access. A
multiplier is a solution of the step's transposed equations, one number per equation (`step_adjoint`).
"""

import warp as wp

from ...scalar import mat33, real, vec3
from ...state import BaseState
from ..base_dynamics import BaseInverse, LegSolve
from ..contact import SEPARATE
from ..trajectory import row_quat, row_vec3, store_row_vec3
from .virtual_power import BaseCotangent

wp.set_module_options({"enable_backward": False})

# fields of the base: 0 to 12 are those of `BaseState`, then
BASE_INVERSE = wp.constant(13)  # 3 x 9: `BaseInverse`
BASE_WEIGHTS = wp.constant(40)  # 5 x 3: `BaseWeights`
BASE_FIELDS = wp.constant(55)

# fields of a leg
ANGLES = wp.constant(0)  # 3: [rad] lateral, outer, inner
RATES = wp.constant(3)  # 3: [rad/s]
SOLVE = wp.constant(6)  # 3 x 9: `LegSolve` without `free`
SLOPES = wp.constant(33)  # 3 x 3: `MotorSlopes`
MODE = wp.constant(42)  # this and the next two: as in `LegLaw`
MU_ROW = wp.constant(43)
MU = wp.constant(44)
LEG_WEIGHTS = wp.constant(45)  # 2 x 3: `LegWeights`
PUSH = wp.constant(51)  # 2 x 3: `LegLaw.impulse`, `LegLaw.point`
PAW = wp.constant(57)  # 4 x 9: `LegLaw.jacobian`, `to_lin`, `to_ang`, `by_velocity`
LAWS = wp.constant(93)  # 4 x 9: `LawRow`
FILTER = wp.constant(129)  # gradient w.r.t. the angles that the filter reads, where a policy step begins
LEG_FIELDS = wp.constant(132)


@wp.struct
class LegRecord:
    """Record of successive physics steps for the reverse pass: an entry per step, and one for the final state."""

    base: wp.array3d(dtype=real)  # (entries, BASE_FIELDS, num_worlds)
    legs: wp.array4d(dtype=real)  # (entries, LEG_FIELDS, num_worlds, 4)


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


@wp.func
def get_vec(record: LegRecord, entry: int, field: int, world: int, leg: int) -> vec3:
    """Read a vector of a leg from the record: three fields, from `field` on."""
    return vec3(
        record.legs[entry, field, world, leg],
        record.legs[entry, field + 1, world, leg],
        record.legs[entry, field + 2, world, leg],
    )


@wp.func
def put_vec(record: LegRecord, entry: int, field: int, world: int, leg: int, v: vec3):
    """Write a vector of a leg to the record: three fields, from `field` on."""
    for i in range(3):
        record.legs[entry, field + i, world, leg] = v[i]


@wp.func
def get_mat(record: LegRecord, entry: int, field: int, world: int, leg: int) -> mat33:
    """Read a 3x3 matrix of a leg from the record: nine fields, from `field` on, row by row."""
    return wp.matrix_from_rows(
        get_vec(record, entry, field, world, leg),
        get_vec(record, entry, field + 3, world, leg),
        get_vec(record, entry, field + 6, world, leg),
    )


@wp.func
def put_mat(record: LegRecord, entry: int, field: int, world: int, leg: int, m: mat33):
    """Write a 3x3 matrix of a leg to the record: nine fields, from `field` on, row by row."""
    for i in range(3):
        for j in range(3):
            record.legs[entry, field + 3 * i + j, world, leg] = m[i, j]


@wp.func
def get_base_mat(record: LegRecord, entry: int, field: int, world: int) -> mat33:
    """Read a 3x3 matrix of the base from the record: nine fields, from `field` on, row by row."""
    return wp.matrix_from_rows(
        row_vec3(record.base, entry, field, world),
        row_vec3(record.base, entry, field + 3, world),
        row_vec3(record.base, entry, field + 6, world),
    )


@wp.func
def put_base_mat(record: LegRecord, entry: int, field: int, world: int, m: mat33):
    """Write a 3x3 matrix of the base to the record: nine fields, from `field` on, row by row."""
    for i in range(3):
        for j in range(3):
            record.base[entry, field + 3 * i + j, world] = m[i, j]


@wp.func
def get_base(record: LegRecord, entry: int, world: int) -> BaseState:
    """Return the recorded state of the base at the start of a step."""
    base = BaseState()
    base.pos = row_vec3(record.base, entry, 0, world)
    base.quat = row_quat(record.base, entry, 3, world)
    base.lin = row_vec3(record.base, entry, 7, world)
    base.ang = row_vec3(record.base, entry, 10, world)
    return base


@wp.func
def put_base(record: LegRecord, entry: int, world: int, base: BaseState):
    """Write the base's state at the start of a step to the record."""
    store_row_vec3(record.base, entry, 0, world, base.pos)
    for i in range(4):
        record.base[entry, 3 + i, world] = base.quat[i]
    store_row_vec3(record.base, entry, 7, world, base.lin)
    store_row_vec3(record.base, entry, 10, world, base.ang)


@wp.func
def get_inverse(record: LegRecord, entry: int, world: int) -> BaseInverse:
    """Return the recorded inverse of the base's equations of motion in a step (a 6x6 matrix)."""
    inverse = BaseInverse()
    inverse.lin = get_base_mat(record, entry, BASE_INVERSE, world)
    inverse.cross = get_base_mat(record, entry, BASE_INVERSE + 9, world)
    inverse.ang = get_base_mat(record, entry, BASE_INVERSE + 18, world)
    return inverse


@wp.func
def put_inverse(record: LegRecord, entry: int, world: int, inverse: BaseInverse):
    """Write the inverse of the base's equations of motion in a step (a 6x6 matrix) to the record."""
    put_base_mat(record, entry, BASE_INVERSE, world, inverse.lin)
    put_base_mat(record, entry, BASE_INVERSE + 9, world, inverse.cross)
    put_base_mat(record, entry, BASE_INVERSE + 18, world, inverse.ang)


@wp.func
def get_solve(record: LegRecord, entry: int, world: int, leg: int) -> LegSolve:
    """Return the recorded matrices of a leg's motor accelerations by the base's acceleration; `free` is 0."""
    solve = LegSolve()
    solve.inverse = get_mat(record, entry, SOLVE, world, leg)
    solve.to_lin = get_mat(record, entry, SOLVE + 9, world, leg)
    solve.to_ang = get_mat(record, entry, SOLVE + 18, world, leg)
    return solve


@wp.func
def put_solve(record: LegRecord, entry: int, world: int, leg: int, solve: LegSolve):
    """Record the matrices of a leg's motor accelerations as a function of the base's acceleration, without the offset.

    The reverse pass solves the transposed equations, with the same matrices and another right-hand side.
    """
    put_mat(record, entry, SOLVE, world, leg, solve.inverse)
    put_mat(record, entry, SOLVE + 9, world, leg, solve.to_lin)
    put_mat(record, entry, SOLVE + 18, world, leg, solve.to_ang)


@wp.func
def get_slopes(record: LegRecord, entry: int, world: int, leg: int) -> MotorSlopes:
    """Return the recorded derivatives of a leg's motor torques w.r.t. targets, angles and rates."""
    slopes = MotorSlopes()
    slopes.target = get_vec(record, entry, SLOPES, world, leg)
    slopes.angle = get_vec(record, entry, SLOPES + 3, world, leg)
    slopes.rate = get_vec(record, entry, SLOPES + 6, world, leg)
    return slopes


@wp.func
def put_slopes(record: LegRecord, entry: int, world: int, leg: int, slopes: MotorSlopes):
    """Write the derivatives of a leg's motor torques w.r.t. targets, angles and rates to the record."""
    put_vec(record, entry, SLOPES, world, leg, slopes.target)
    put_vec(record, entry, SLOPES + 3, world, leg, slopes.angle)
    put_vec(record, entry, SLOPES + 6, world, leg, slopes.rate)


@wp.func
def get_law(record: LegRecord, entry: int, world: int, leg: int) -> LegLaw:
    """Return a paw's recorded contact law; for a paw without contact (mode SEPARATE), all fields but `mode` are 0."""
    law = LegLaw()
    law.mode = int(record.legs[entry, MODE, world, leg])
    if law.mode != SEPARATE:
        law.mu_row = int(record.legs[entry, MU_ROW, world, leg])
        law.mu = record.legs[entry, MU, world, leg]
        law.impulse = get_vec(record, entry, PUSH, world, leg)
        law.point = get_vec(record, entry, PUSH + 3, world, leg)
        law.jacobian = get_mat(record, entry, PAW, world, leg)
        law.to_lin = get_mat(record, entry, PAW + 9, world, leg)
        law.to_ang = get_mat(record, entry, PAW + 18, world, leg)
        law.by_velocity = get_mat(record, entry, PAW + 27, world, leg)
    return law


@wp.func
def put_law(record: LegRecord, entry: int, world: int, leg: int, law: LegLaw):
    """Write a paw's contact (impulse and derivatives) to the record; without contact, only its mode."""
    record.legs[entry, MODE, world, leg] = real(law.mode)
    if law.mode != SEPARATE:
        record.legs[entry, MU_ROW, world, leg] = real(law.mu_row)
        record.legs[entry, MU, world, leg] = law.mu
        put_vec(record, entry, PUSH, world, leg, law.impulse)
        put_vec(record, entry, PUSH + 3, world, leg, law.point)
        put_mat(record, entry, PAW, world, leg, law.jacobian)
        put_mat(record, entry, PAW + 9, world, leg, law.to_lin)
        put_mat(record, entry, PAW + 18, world, leg, law.to_ang)
        put_mat(record, entry, PAW + 27, world, leg, law.by_velocity)


@wp.func
def get_law_row(record: LegRecord, entry: int, world: int, leg: int) -> LawRow:
    """Return a paw's recorded row of the inverse contact-law matrix, defined only where a paw of the world touches."""
    row = LawRow()
    row.a = get_mat(record, entry, LAWS, world, leg)
    row.b = get_mat(record, entry, LAWS + 9, world, leg)
    row.c = get_mat(record, entry, LAWS + 18, world, leg)
    row.d = get_mat(record, entry, LAWS + 27, world, leg)
    return row


@wp.func
def put_law_row(record: LegRecord, entry: int, world: int, leg: int, row: LawRow):
    """Write a paw's row of the inverse contact-law matrix to the record."""
    put_mat(record, entry, LAWS, world, leg, row.a)
    put_mat(record, entry, LAWS + 9, world, leg, row.b)
    put_mat(record, entry, LAWS + 18, world, leg, row.c)
    put_mat(record, entry, LAWS + 27, world, leg, row.d)


@wp.func
def get_leg_weights(record: LegRecord, entry: int, world: int, leg: int) -> LegWeights:
    """Return the recorded adjoint multipliers of a leg's equations of motion and of its paw's contact law."""
    weights = LegWeights()
    weights.rates = get_vec(record, entry, LEG_WEIGHTS, world, leg)
    weights.law = get_vec(record, entry, LEG_WEIGHTS + 3, world, leg)
    return weights


@wp.func
def put_leg_weights(record: LegRecord, entry: int, world: int, leg: int, weights: LegWeights):
    """Write the adjoint multipliers of a leg's equations of motion and of its paw's contact law to the record."""
    put_vec(record, entry, LEG_WEIGHTS, world, leg, weights.rates)
    put_vec(record, entry, LEG_WEIGHTS + 3, world, leg, weights.law)


@wp.func
def get_base_weights(record: LegRecord, entry: int, world: int) -> BaseWeights:
    """Return the recorded adjoint multipliers of the base's equations of motion."""
    weights = BaseWeights()
    weights.lin = row_vec3(record.base, entry, BASE_WEIGHTS, world)
    weights.ang = row_vec3(record.base, entry, BASE_WEIGHTS + 3, world)
    weights.cotangent.velocity = row_vec3(record.base, entry, BASE_WEIGHTS + 6, world)
    weights.cotangent.new_velocity = row_vec3(record.base, entry, BASE_WEIGHTS + 9, world)
    weights.cotangent.gravity = row_vec3(record.base, entry, BASE_WEIGHTS + 12, world)
    return weights


@wp.func
def put_base_weights(record: LegRecord, entry: int, world: int, weights: BaseWeights):
    """Write the adjoint multipliers of the base's equations of motion to the record."""
    store_row_vec3(record.base, entry, BASE_WEIGHTS, world, weights.lin)
    store_row_vec3(record.base, entry, BASE_WEIGHTS + 3, world, weights.ang)
    store_row_vec3(record.base, entry, BASE_WEIGHTS + 6, world, weights.cotangent.velocity)
    store_row_vec3(record.base, entry, BASE_WEIGHTS + 9, world, weights.cotangent.new_velocity)
    store_row_vec3(record.base, entry, BASE_WEIGHTS + 12, world, weights.cotangent.gravity)
