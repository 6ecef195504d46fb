"""Explicit passive torques for Newton's SolverMuJoCo: capped knee damping, stops of outer + inner angle, springs.

MuJoCo has neither a damper with a torque limit nor a stop for the sum of two angles. These torques are therefore added
to its joint forces before each step. `SolverJumper` includes them, damping and stops implicitly (`joint_forces`,
`stops`, `springs`).
"""

import warp as wp

from ..kinematics.five_bar import five_bar
from ..kinematics.geometry import LegGeometry, leg_of
from ..layout import COORDS, DOFS
from ..scalar import real
from .joint_forces import capped_damping
from .springs import LegSpring, spring_torque

wp.set_module_options({"enable_backward": False})


@wp.func
def stop_torque(angle: real, rate: real, lower: real, upper: real, ke: real, kd: real) -> real:
    """Return the torque [N m] of a pair of hard stops: a spring, with damping while the penetration grows.

    angle, lower, upper [rad], rate [rad/s], ke [N m/rad], kd [N m s/rad]. The torque is 0 within [lower, upper]. No
    damping acts on the way out, where it would pull the joint toward the stop.
    """
    if angle < lower:
        return ke * (lower - angle) - wp.where(rate < real(0.0), kd * rate, real(0.0))
    if angle > upper:
        return ke * (upper - angle) - wp.where(rate > real(0.0), kd * rate, real(0.0))
    return real(0.0)


@wp.kernel
def passive_torque_kernel(
    # in
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    knee_damping: real,
    knee_limit: real,
    sum_lower: real,
    sum_upper: real,
    stop_ke: real,
    stop_kd: real,
    geometry: wp.array(dtype=LegGeometry),
    springs: wp.array(dtype=wp.vec2),
    # in, out
    joint_f: wp.array(dtype=real),
):
    """Apply every leg's passive torques [N m] to joint_f: knee damping, hard stops of outer + inner angle, and springs.

    The torques of the knees replace the entries of joint_f, which no motor writes. The other torques are added to the
    torques of the motors. One thread per (world, leg). knee_damping [N m s/rad] acts up to knee_limit [N m]. sum_lower,
    sum_upper [rad]: stops of outer + inner angle; stop_ke [N m/rad], stop_kd [N m s/rad] must be soft enough for
    explicit integration. springs (num_worlds,): stiffness [N/m] and rest length [m]. joint_q, joint_qd, joint_f:
    Newton's, flat over worlds.
    """
    world, leg = wp.tid()
    q = world * COORDS + 7 + 5 * leg  # joints: lateral, outer motor, outer knee, inner motor, inner knee
    d = world * DOFS + 6 + 5 * leg
    outer_knee_rate = joint_qd[d + 2]
    inner_knee_rate = joint_qd[d + 4]
    joint_f[d + 2] = -capped_damping(knee_damping, outer_knee_rate, knee_limit) * outer_knee_rate
    joint_f[d + 4] = -capped_damping(knee_damping, inner_knee_rate, knee_limit) * inner_knee_rate
    fold = joint_q[q + 1] + joint_q[q + 3]
    fold_rate = joint_qd[d + 1] + joint_qd[d + 3]
    stop = stop_torque(fold, fold_rate, sum_lower, sum_upper, stop_ke, stop_kd)
    joint_f[d + 1] = joint_f[d + 1] + stop
    joint_f[d + 3] = joint_f[d + 3] + stop
    if springs[world][0] != 0.0:
        spring = LegSpring()
        spring.stiffness = real(springs[world][0])
        spring.length = real(springs[world][1])
        pull = spring_torque(
            spring, five_bar(leg_of(geometry, world, leg), joint_q[q + 1], joint_q[q + 3])
        )  # lateral, outer, inner [N m]
        joint_f[d + 1] = joint_f[d + 1] + pull[1]
        joint_f[d + 3] = joint_f[d + 3] + pull[2]
