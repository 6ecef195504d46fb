"""Geometric constants of one leg, which most physics kernels take as an argument."""

import warp as wp

from ..scalar import real, vec3


@wp.struct
class LegGeometry:
    """Geometric constants of one leg, in the body frame (x forward, y left, z up) and the motor housing frame.

    The housing frame has its origin on the lateral motor's axis (the hip), x along body x, and turns about x with
    the lateral motor. The five-bar loop lies in the housing's x-z plane, at `plane_y`.
    """

    hip: vec3  # [m] origin of the housing frame, on the lateral axis, in the body frame
    front: real  # +1 front leg, -1 back leg
    side: real  # +1 left leg, -1 right leg
    outer_x: real  # [m] outer transversal axis, housing x
    inner_x: real  # [m] inner transversal axis, housing x
    plane_y: real  # [m] both transversal axes, housing y
    knee_y: real  # [m] offset of knees, ankle and paw from the thigh plane, along housing y
    thigh: real  # [m] transversal axis to knee
    shank: real  # [m] inner knee to ankle
    paw_radius: real  # [m]
    outer_shank: real  # [m] outer knee to ankle
    paw_offset: real  # [m] ankle to centre of the paw, along the inner shank
    thigh_radius: real  # [m] of the capsules that collisions are tested with; knees too
    shank_radius: real  # [m]
    housing_radius: real  # [m]
    housing_length: real  # [m] from the hip outward along the lateral axis
    shell: vec3  # [1] length, width and height of the body's shell as factors on the boxes of `collision.robot`


@wp.func
def leg_of(geometry: wp.array(dtype=LegGeometry), world: int, leg: int) -> LegGeometry:
    """Return the geometry of a leg of a world; the array has four rows a robot, and worlds take robots in turn."""
    return geometry[(4 * world + leg) % geometry.shape[0]]
