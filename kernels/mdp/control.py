"""From the policy's action to motor targets, and the disturbances that act during a policy step."""

import warp as wp

from ..actuation.command_filter import FilterParams, filter_leg
from ..jump.task import FLIGHT, JumpTask, ViewArrays, base_velocity
from ..layout import BODIES, COORDS, DOFS

wp.set_module_options({"enable_backward": False})


@wp.struct
class ActionScales:
    """theta = a * scale + default, per kind of motor [rad]."""

    lateral: float
    transversal: float


@wp.kernel
def action_kernel(
    # in
    policy_action: wp.array2d(dtype=float),
    scales: ActionScales,
    command_filter: FilterParams,
    arrays: ViewArrays,
    offset: wp.array2d(dtype=float),
    # out
    previous_target: wp.array2d(dtype=float),
):
    """Clamp, scale and filter the action (num_worlds, 12), and remember the old one; one thread per (world, leg).

    offset [rad], (12, num_worlds): constant error of each motor's position sensor, which the filter reads.
    previous_target [rad], (12, num_worlds): the filtered target that acts until the new one arrives.
    """
    world, leg = wp.tid()
    q = world * COORDS + 7 + 5 * leg
    d = world * DOFS + 6 + 5 * leg
    angles = wp.vec3(arrays.joint_q[q], arrays.joint_q[q + 1], arrays.joint_q[q + 3])
    rates = wp.vec3(arrays.joint_qd[d], arrays.joint_qd[d + 1], arrays.joint_qd[d + 3])
    target = wp.vec3(0.0)
    for j in range(3):
        m = 3 * leg + j
        action = wp.clamp(policy_action[world, m], -1.0, 1.0)
        scale = scales.transversal
        if j == 0:
            scale = scales.lateral
        arrays.old_action[m, world] = arrays.action[m, world]
        arrays.action[m, world] = action
        arrays.old_rate[m, world] = rates[j]
        angles[j] = angles[j] + offset[m, world]
        target[j] = action * scale + arrays.default_angle[m]
    safe = filter_leg(target, angles, rates, command_filter)
    for j in range(3):
        m = 3 * leg + j
        previous_target[m, world] = arrays.safe_target[m, world]
        arrays.target[m, world] = target[j]
        arrays.safe_target[m, world] = safe[j]
    if leg == 0:
        i = world * COORDS + 3
        quat = wp.quat(arrays.joint_q[i], arrays.joint_q[i + 1], arrays.joint_q[i + 2], arrays.joint_q[i + 3])
        arrays.old_lin_vel[world] = base_velocity(arrays, world, quat)


@wp.kernel
def push_kernel(
    # in
    tasks: wp.array(dtype=JumpTask),
    push: wp.array(dtype=wp.spatial_vector),
    # out
    body_f: wp.array(dtype=wp.spatial_vector),
):
    """Apply each world's push (force [N], torque [N m] at the base's com, world axes), on the ground only."""
    world = wp.tid()
    wrench = wp.spatial_vector()
    if tasks[world].phase != FLIGHT:
        wrench = push[world]
    body_f[world * BODIES] = wrench
