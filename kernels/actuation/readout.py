"""Reading motor values, paw forces and the base's velocity out of Newton's arrays."""

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
    """Gather the motors' entries of a per-dof array into shape (12, num_worlds); launch over that shape."""
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
    """Turn a contact sensor's forces [N], four rows a world, into shape (4, num_worlds), and keep the largest.

    Launch over worlds. peak_force is of their sum. restart 1: forget the largest so far.
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
    """Write the motor targets [rad] of a physics step: before `delay` the previous ones; (12, num_worlds) threads."""
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
    """Write the velocity of the base link's origin [m/s], world frame; launch over worlds."""
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
    """Write the mean acceleration of each body over dt [s]; one thread per body."""
    body = wp.tid()
    acceleration[body] = (after[body] - before[body]) / dt
