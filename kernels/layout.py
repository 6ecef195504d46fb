"""Layout of flat arrays: rows of the parameter table, and Newton's joints and bodies per world.

The table has one column per world and one row per parameter, so that neighbouring GPU threads read neighbouring
addresses. Rows: a block of `LEG_ROWS` for each leg (FL, FR, BL, BR; the constants below count from the block's start),
then the base block. Rows of three are lateral, outer, inner.
"""

import warp as wp

MOMENT_ROWS = 10  # rows of a link's `MassMoments`: mass, first (3), second (6: xx yy zz xy xz yz)

# rows of a leg's block
HOUSING = wp.constant(0)  # first of MOMENT_ROWS rows, as the next four
OUTER_THIGH = wp.constant(MOMENT_ROWS)
OUTER_SHANK = wp.constant(2 * MOMENT_ROWS)
INNER_THIGH = wp.constant(3 * MOMENT_ROWS)
INNER_SHANK = wp.constant(4 * MOMENT_ROWS)
ARMATURE = wp.constant(50)  # 3: lateral, outer, inner [kg m^2]
FRICTION = wp.constant(53)  # 3: Coulomb friction torque [N m]
DAMPING = wp.constant(56)  # 3: viscous [N m s/rad]
KNEE_DAMPING = wp.constant(59)  # 2: outer, inner [N m s/rad]
LOWER = wp.constant(61)  # 3: hard stops [rad]
UPPER = wp.constant(64)  # 3: hard stops [rad]
SUM_LOWER = wp.constant(67)  # hard stop of outer + inner [rad]
SUM_UPPER = wp.constant(68)  # [rad]
STOP_KE = wp.constant(69)  # stiffness of all hard stops of the leg [N m/rad]
STOP_KD = wp.constant(70)  # their damping [N m s/rad]
MU_DYNAMIC = wp.constant(71)  # coefficient of sliding friction of the paw [1]
MU_STATIC = wp.constant(72)  # coefficient of static friction of the paw [1]
KNEE_LIMIT = wp.constant(73)  # 2: outer, inner: largest torque of the knee damping [N m]
SPRING = wp.constant(75)  # 2: stiffness [N/m] of the spring between the knees, 0: none; its rest length [m]
LEG_ROWS = wp.constant(77)

# rows of the base block
BASE = wp.constant(4 * LEG_ROWS)  # first of MOMENT_ROWS rows of the base link
GRAVITY = wp.constant(BASE + MOMENT_ROWS)  # 3, world frame [m/s^2]
PARAMETER_ROWS = GRAVITY + 3

BODIES = wp.constant(21)  # per world: base, then 5 links a leg
LEG_BODIES = wp.constant(5)  # housing, outer thigh, outer shank, inner thigh, inner shank
DOFS = wp.constant(38)  # per world: 6 base, 5 a leg, 3 a loop joint
COORDS = wp.constant(43)  # per world: 7 base, 5 a leg, 4 a loop joint


@wp.func
def motor_slot(motor: int) -> int:
    """Return the index of motor 0 to 11 among a world's 20 leg joints; motors are joints 0, 1, 3 of a leg's five."""
    kind = motor % 3
    return 5 * (motor // 3) + kind + kind // 2
