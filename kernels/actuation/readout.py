"""Kernels that read motor values, paw forces and the base's velocity from Newton's arrays.

Motors are 3 * leg + j: legs FL, FR, BL, BR; j lateral, outer, inner. Newton's joint arrays also hold the base, the
passive knees and the loop joints, which these kernels skip. Forces and velocities are in the world frame, z up.
"""

import warp as wp

from ..layout import BODIES, DOFS, motor_slot
from ..state import load_base

wp.set_module_options({"enable_backward": False})


@wp.kernel
def motor_values_kernel(
    # in
    joint_values: wp.array(dtype=float),
    # out
    motor_values: wp.array2d(dtype=float),
):
    """Copy the motors' values from an array of all joints (38 num_worlds,) to (12, num_worlds); a thread per motor."""
    motor, world = wp.tid()
    motor_values[motor, world] = joint_values[DOFS * world + 6 + motor_slot(motor)]


@wp.kernel
def paw_force_kernel(
    # in
    total_force: wp.array(dtype=wp.vec3),
    restart: int,
    # out
    paw_force: wp.array2d(dtype=wp.vec3),
    peak_force: wp.array(dtype=float),
    peak_paw_force: wp.array2d(dtype=float),
):
    """Copy the paws' contact forces [N] to shape (4, num_worlds) and update their peaks over time; thread per world.

    total_force (4 num_worlds,): a contact sensor's, paws FL, FR, BL, BR of each world. peak_paw_force (4, num_worlds)
    is the largest force on each paw, peak_force the largest sum of the four forces. restart != 0 discards earlier
    peaks.
    """
    world = wp.tid()
    total = wp.vec3(0.0)
    for k in range(4):
        force = total_force[4 * world + k]
        paw_force[k, world] = force
        total += force
        largest = wp.where(restart != 0, 0.0, peak_paw_force[k, world])
        peak_paw_force[k, world] = wp.max(largest, wp.length(force))
    peak = peak_force[world]
    if restart != 0:
        peak = 0.0
    peak_force[world] = wp.max(peak, wp.length(total))


@wp.kernel
def arrived_target_kernel(
    # in
    target: wp.array2d(dtype=float),
    previous: wp.array2d(dtype=float),
    delay: wp.array(dtype=int),
    step: int,
    # out
    arrived: wp.array2d(dtype=float),
):
    """Write the target [rad] that each motor follows in physics step `step`, delayed by the latency of its world.

    The motor follows `previous` for `delay` [steps], then `target`. Launch over (12, num_worlds), the shape of all
    targets. delay: (num_worlds,). step counts from the new target.
    """
    motor, world = wp.tid()
    arrived[motor, world] = wp.where(step < delay[world], previous[motor, world], target[motor, world])


@wp.kernel
def base_velocity_kernel(
    # in
    joint_q: wp.array(dtype=float),
    joint_qd: wp.array(dtype=float),
    body_com: wp.array(dtype=wp.vec3),
    # out
    velocity: wp.array(dtype=wp.vec3),
):
    """Write the velocity of the base link's origin [m/s], world frame, (num_worlds,); one thread per world.

    Newton's joint_qd has the velocity of the link's centre of mass, `body_com` [m] in its frame, instead.
    """
    world = wp.tid()
    velocity[world] = load_base(joint_q, joint_qd, body_com[world * BODIES], world).lin


@wp.kernel
def body_acceleration_kernel(
    # in
    before: wp.array(dtype=wp.spatial_vector),
    after: wp.array(dtype=wp.spatial_vector),
    dt: float,
    # out
    acceleration: wp.array(dtype=wp.spatial_vector),
):
    """Write the mean acceleration ([m/s^2], [rad/s^2]) of each body over dt [s]; one thread per body.

    before, after: (linear [m/s], angular [rad/s]) velocities of all bodies at the start and the end of dt.
    """
    body = wp.tid()
    acceleration[body] = (after[body] - before[body]) / dt
