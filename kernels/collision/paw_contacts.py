"""Contacts of the paws as rows of a `newton.Contacts`, the form in which other Newton code reads contacts.

`SolverJumper` finds contacts itself and solves for impulses per paw; only this file translates them.
"""

import warp as wp

from ..terrain.ground import Ground, block_distance, block_normal, floor_distance, floor_normal, world_ground

wp.set_module_options({"enable_backward": False})


@wp.struct
class ContactRows:
    """Arrays of a `newton.Contacts`, one row per contact; points in the frame of the shape's body."""

    count: wp.array(dtype=int)  # (1,)
    shape0: wp.array(dtype=int)
    shape1: wp.array(dtype=int)
    point0: wp.array(dtype=wp.vec3)  # [m]
    point1: wp.array(dtype=wp.vec3)  # [m]
    offset0: wp.array(dtype=wp.vec3)  # [m]
    offset1: wp.array(dtype=wp.vec3)  # [m]
    normal: wp.array(dtype=wp.vec3)  # world, from shape 0 to shape 1


@wp.struct
class PawShapes:
    """Indices of the shapes of paws and ground in a model, and body, transform and scale of all shapes."""

    paws: wp.array(dtype=int)  # (4 num_worlds,) shape index, FL, FR, BL, BR of each world
    ground: int  # shape index
    body: wp.array(dtype=int)
    transform: wp.array(dtype=wp.transform)
    scale: wp.array(dtype=wp.vec3)


@wp.kernel
def paw_contacts_kernel(
    # in
    shapes: PawShapes,
    ground: Ground,
    body_q: wp.array(dtype=wp.transform),
    force: wp.array2d(dtype=wp.vec3),
    # out
    rows: ContactRows,
    contact_f: wp.array(dtype=wp.spatial_vector),
):
    """Write every paw's contact with the ground, touching or not, to a row of a `newton.Contacts`.

    Row 4 world + leg always belongs to the same paw, so that threads need no shared counter. Shape 0 is the paw, shape
    1 the ground; launch over (4, num_worlds). force [N], (4, num_worlds): contact force of the ground on each paw,
    world axes. contact_f: force [N] and torque [N m] on the paw, world. A block counts as ground.
    """
    leg, world = wp.tid()
    row = 4 * world + leg
    paw = shapes.paws[row]
    pose = body_q[shapes.body[paw]]
    center = wp.transform_point(pose, wp.transform_get_translation(shapes.transform[paw]))
    here = world_ground(ground, world)
    distance = floor_distance(here, center)
    normal = floor_normal(here, center)
    if here.block.exists != 0:
        to_block = block_distance(here.block, center)
        if to_block < distance:
            distance = to_block
            normal = block_normal(here.block, center)
    if row == 0:
        rows.count[0] = shapes.paws.shape[0]
    rows.shape0[row] = paw
    rows.shape1[row] = shapes.ground
    rows.point0[row] = wp.transform_point(wp.transform_inverse(pose), center - shapes.scale[paw][0] * normal)
    rows.point1[row] = center - distance * normal  # the ground belongs to no body: world
    rows.offset0[row] = wp.vec3(0.0)
    rows.offset1[row] = wp.vec3(0.0)
    rows.normal[row] = -normal
    contact_f[row] = wp.spatial_vector(force[leg, world], wp.vec3(0.0))
