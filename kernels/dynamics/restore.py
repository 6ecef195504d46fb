"""Reset of masked worlds to their initial state; masks have shape (num_worlds,).

A launch covers all worlds, and worlds with a false mask stay unchanged. The host need not know which worlds are reset.
"""

import warp as wp

from ..layout import BODIES, COORDS, DOFS
from ..terrain.ground import Ground, rest_block

wp.set_module_options({"enable_backward": False})


@wp.struct
class StateArrays:
    """Coordinates and velocities of joints and bodies of all worlds, in Newton's layout."""

    joint_q: wp.array(dtype=float)  # (43 num_worlds,)
    joint_qd: wp.array(dtype=float)  # (38 num_worlds,)
    body_q: wp.array(dtype=wp.transform)  # (21 num_worlds,)
    body_qd: wp.array(dtype=wp.spatial_vector)  # (21 num_worlds,)


@wp.kernel
def restore_state_kernel(
    # in
    mask: wp.array(dtype=wp.bool),
    start: StateArrays,
    # out
    state: StateArrays,
):
    """Reset joint and body states of the masked worlds to those in `start`; launch over (num_worlds, 43)."""
    world, i = wp.tid()
    if not mask[world]:
        return
    coord = world * COORDS + i
    state.joint_q[coord] = start.joint_q[coord]
    if i < DOFS:
        dof = world * DOFS + i
        state.joint_qd[dof] = start.joint_qd[dof]
    if i < BODIES:
        body = world * BODIES + i
        state.body_q[body] = start.body_q[body]
        state.body_qd[body] = start.body_qd[body]


@wp.kernel
def restore_motors_kernel(
    # in
    mask: wp.array(dtype=wp.bool),
    standing: wp.array2d(dtype=float),
    # out
    target: wp.array2d(dtype=float),
    filtered_target: wp.array2d(dtype=float),
    torque: wp.array2d(dtype=float),
    paw_force: wp.array2d(dtype=wp.vec3),
    peak_force: wp.array(dtype=float),
    peak_paw_force: wp.array2d(dtype=float),
):
    """Reset the motors of masked worlds: targets to standing angles [rad], torques and forces to 0; thread per world.

    standing, target, filtered_target, torque: (12, num_worlds). paw_force, peak_paw_force: (4, num_worlds).
    """
    world = wp.tid()
    if not mask[world]:
        return
    for motor in range(12):
        target[motor, world] = standing[motor, world]
        filtered_target[motor, world] = standing[motor, world]
        torque[motor, world] = 0.0
    for k in range(4):
        paw_force[k, world] = wp.vec3(0.0)
        peak_paw_force[k, world] = 0.0
    peak_force[world] = 0.0


@wp.kernel
def zero_worlds_kernel(
    # in
    mask: wp.array(dtype=wp.bool),
    # out
    values: wp.array2d(dtype=wp.spatial_vector),
):
    """Zero the rows of masked worlds in an array `values` of shape (num_worlds, n); launch over that shape."""
    world, i = wp.tid()
    if mask[world]:
        values[world, i] = wp.spatial_vector()


@wp.kernel
def mask_kernel(
    # in
    mask: wp.array(dtype=float),
    # out
    chosen: wp.array(dtype=wp.bool),
):
    """Convert a float mask of worlds to bool (true where it is not 0), the type that Newton's solvers take.

    One thread per world.
    """
    world = wp.tid()
    chosen[world] = mask[world] != 0.0


@wp.kernel
def clear_contact_kernel(
    # in
    mask: wp.array(dtype=wp.bool),
    # out
    impulse: wp.array2d(dtype=wp.vec3),
    contact_force: wp.array2d(dtype=wp.vec3),
    diverged: wp.array(dtype=int),
):
    """Zero impulses and contact forces (4, num_worlds) and divergence flags of masked worlds; one thread per world.

    Impulses are the contact solver's first guess, which a reset must not take from the earlier motion.
    """
    world = wp.tid()
    if mask[world]:
        diverged[world] = 0
        for k in range(4):
            impulse[k, world] = wp.vec3(0.0)
            contact_force[k, world] = wp.vec3(0.0)


@wp.kernel
def rest_blocks_kernel(
    # in
    mask: wp.array(dtype=wp.bool),
    # in, out
    ground: Ground,
):
    """Move the sliding blocks of masked worlds to their start positions with zero velocity; one thread per world."""
    world = wp.tid()
    if mask[world]:
        rest_block(ground, world)
