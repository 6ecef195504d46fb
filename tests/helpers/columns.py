"""Columns of arrays of robots: axes of vectors, and parts of `joint_q` (..., 43) and `joint_qd` (..., 38)."""

import numpy as np

X, Y, Z = 0, 1, 2
XY = slice(0, 2)
POS, QUAT = slice(0, 3), slice(3, 7)  # of joint_q or a pose: base position [m], quaternion xyzw
LIN_VEL, ANG_VEL = slice(0, 3), slice(3, 6)  # of joint_qd: velocity [m/s] of the base's com, angular velocity [rad/s]
COORDS, DOFS = 43, 38  # columns of joint_q and joint_qd
MOTOR_SLOTS = np.array([5 * leg + joint for leg in range(4) for joint in (0, 1, 3)])  # among the 20 leg joints
MOTOR_COORDS, MOTOR_DOFS = 7 + MOTOR_SLOTS, 6 + MOTOR_SLOTS  # the 12 motors: lateral, outer, inner of FL, FR, BL, BR
