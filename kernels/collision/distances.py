"""Distances between the simple shapes that model links: capsules and boxes.

A sphere is a capsule of zero length. Distances of capsules are negative where they overlap, and at least minus the sum
of the radii. All points are [m], in any common frame.
"""

import warp as wp

from ..scalar import real, vec3


@wp.func
def segment_segment_sq(start_a: vec3, end_a: vec3, start_b: vec3, end_b: vec3) -> real:
    """Return the squared distance [m^2] between segments a and b; a segment may be a point."""
    a = end_a - start_a
    b = end_b - start_b
    start_offset = start_a - start_b
    aa = wp.max(wp.dot(a, a), real(1.0e-12))
    bb = wp.max(wp.dot(b, b), real(1.0e-12))
    ab = wp.dot(a, b)
    a_between = wp.dot(a, start_offset)
    b_between = wp.dot(b, start_offset)
    # for (nearly) parallel segments a floor on the determinant keeps the step finite and downhill
    det = wp.max(aa * bb - ab * ab, real(1.0e-7) * aa * bb)
    along_a = wp.clamp((ab * b_between - a_between * bb) / det, real(0.0), real(1.0))
    along_b = wp.clamp((ab * along_a + b_between) / bb, real(0.0), real(1.0))
    nearest_a = wp.clamp((ab * along_b - a_between) / aa, real(0.0), real(1.0))
    gap = start_offset + nearest_a * a - along_b * b
    return wp.dot(gap, gap)


@wp.func
def outside_box(point: vec3, half: vec3) -> vec3:
    """Return the vector [m] from the nearest point of a box (half extents `half` [m], at the origin) to `point`."""
    return point - wp.min(wp.max(point, -half), half)


@wp.func
def segment_box_sq(start: vec3, end: vec3, half: vec3) -> real:
    """Return the squared distance [m^2] between a segment and an axis-aligned box of half extents `half` at the origin.

    Along the segment the squared distance is convex and piecewise quadratic, with breaks where the segment crosses the
    plane of a face. Its slope finds the piece that holds the minimum; within that piece the slope is linear.
    """
    step = end - start
    low = real(0.0)
    high = real(1.0)
    for i in range(6):
        axis = i // 2
        face = wp.where(i % 2 == 0, half[axis], -half[axis])
        seam = (face - start[axis]) / wp.where(step[axis] == real(0.0), real(1.0e-12), step[axis])
        if seam > low and seam < high:
            if wp.dot(step, outside_box(start + seam * step, half)) > real(0.0):
                high = seam
            else:
                low = seam
    slope_low = wp.min(wp.dot(step, outside_box(start + low * step, half)), real(0.0))
    slope_high = wp.max(wp.dot(step, outside_box(start + high * step, half)), real(0.0))
    fraction = -slope_low / wp.max(slope_high - slope_low, real(1.0e-20))
    gap = outside_box(start + (low + fraction * (high - low)) * step, half)
    return wp.dot(gap, gap)


@wp.func
def segment_box_bound_sq(start: vec3, end: vec3, half: vec3) -> real:
    """Return a cheap lower bound [m^2] on the squared distance of a segment from a box (`segment_box_sq`).

    The bound is the distance of the segment's axis-aligned bounding box. For most pairs, which are far apart, the bound
    suffices.
    """
    gap = wp.max(wp.min(start, end) - half, -half - wp.max(start, end))
    gap_outside = wp.max(gap, vec3(real(0.0)))
    return wp.dot(gap_outside, gap_outside)


@wp.func
def inflated_distance(distance_sq: real, radius: real, bound: real) -> real:
    """Return the distance [m] of two rounded shapes, at most `bound` [m], from the squared one of their axes or boxes.

    The result is min(sqrt(distance_sq [m^2]) - radius, bound). radius: sum of both radii; bound >= 0, such as the
    smallest distance so far. A pair beyond the bound needs no square root.
    """
    reach = bound + radius
    if distance_sq >= reach * reach:
        return bound
    return wp.sqrt(distance_sq) - radius
