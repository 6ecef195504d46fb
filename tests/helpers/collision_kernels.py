"""Kernel that checks all forbidden contacts of whole robots, one thread per world."""

import functools
import importlib

import warp as wp


@functools.cache
def make_collision_kernel(package="jumper_warp.kernels"):
    """Return a kernel that writes the forbidden contacts (flags) and clearance [m] of every robot, at most `margin`.

    joint_q: Newton's, flat, `coords_per_world` per world. With a margin of 0 [m] only the flags are meaningful.
    """
    names = ("collision.robot", "kinematics.geometry", "scalar", "terrain.ground")
    collision, geometries, scalar, terrain = (importlib.import_module(f"{package}.{name}") for name in names)
    real, vec3, quat = scalar.real, scalar.vec3, scalar.quat

    @wp.kernel(module="unique", enable_backward=False)
    def collision_kernel(
        geometry: wp.array(dtype=geometries.LegGeometry), ground: terrain.Ground, joint_q: wp.array(dtype=wp.float32),
        coords_per_world: int, margin: real, flags: wp.array(dtype=wp.int32), clearance: wp.array(dtype=wp.float32),
    ):  # fmt: skip
        """Write flags and clearance."""
        world = wp.tid()
        start = world * coords_per_world
        here = terrain.world_ground(ground, world)
        pos = vec3(real(joint_q[start]), real(joint_q[start + 1]), real(joint_q[start + 2]))
        rotation = wp.quat_to_matrix(
            quat(real(joint_q[start + 3]), real(joint_q[start + 4]), real(joint_q[start + 5]), real(joint_q[start + 6]))
        )
        found = collision.Collisions()
        found.clearance = margin
        body = collision.body_ground_distance(here, geometries.leg_of(geometry, world, 0).shell, pos, rotation)
        found = collision.add_distance(found, body, real(0.0), collision.BODY_GROUND)
        leg = collision.load_leg(geometry, joint_q, world, start, 0)
        count = wp.int32(4)
        for order in range(count):
            neighbour = collision.load_leg(geometry, joint_q, world, start, collision.next_leg(order + 1))
            found = collision.add_leg_distances(found, here, leg, neighbour, pos, rotation, real(0.0))
            leg = neighbour
        flags[world] = found.flags
        clearance[world] = wp.float32(found.clearance)

    return collision_kernel
