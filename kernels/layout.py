"""Layout of flat arrays: rows of the parameter table, and Newton's joints and bodies a world.

The table has one column per world and one row per parameter, so that neighbouring GPU threads read neighbouring
addresses. Rows: a block for each leg (constants below, relative to the block's start), then the base block.
"""

import warp as wp

MOMENT_ROWS = 10  # mass, first (3), second (6)

# rows of a leg's block
HOUSING = wp.constant(0)
OUTER_THIGH = wp.constant(MOMENT_ROWS)
OUTER_SHANK = wp.constant(2 * MOMENT_ROWS)
INNER_THIGH = wp.constant(3 * MOMENT_ROWS)
INNER_SHANK = wp.constant(4 * MOMENT_ROWS)
ARMATURE = wp.constant(50)  # 3: lateral, outer, inner [kg m^2]
FRICTION = wp.constant(53)  # 3: Coulomb friction torque [N m]
DAMPING = wp.constant(56)  # 3: viscous [N m s/rad]
KNEE_DAMPING = wp.constant(59)  # 2: outer, inner [N m s/rad]
LOWER = wp.constant(61)  # 3: hard stops [rad]
UPPER = wp.constant(64)  # 3
SUM_LOWER = wp.constant(67)  # hard stops of outer + inner [rad]
SUM_UPPER = wp.constant(68)
STOP_KE = wp.constant(69)  # [N m/rad]
STOP_KD = wp.constant(70)  # [N m s/rad]
MU_DYNAMIC = wp.constant(71)
MU_STATIC = wp.constant(72)
KNEE_LIMIT = wp.constant(73)  # 2: outer, inner: largest torque of the knee damping [N m]
SPRING = wp.constant(75)  # 2: stiffness [N/m] of the spring between the knees, 0: none; its rest length [m]
LEG_ROWS = wp.constant(77)

# rows of the base block
BASE = wp.constant(4 * LEG_ROWS)
GRAVITY = wp.constant(BASE + MOMENT_ROWS)  # 3, world frame [m/s^2]
PARAMETER_ROWS = GRAVITY + 3

BODIES = wp.constant(21)  # per world: base, then 5 links a leg
LEG_BODIES = wp.constant(5)
DOFS = wp.constant(38)  # per world: 6 base, 5 a leg, 3 a loop joint
COORDS = wp.constant(43)  # per world: 7 base, 5 a leg, 4 a loop joint


@wp.func
def motor_slot(motor: int) -> int:
    """Return the index of a motor among a world's joints after the base: joints 0, 1 and 3 of each leg's five."""
    kind = motor % 3
    return 5 * (motor // 3) + kind + kind // 2
