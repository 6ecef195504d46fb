import numpy as np
import pytest
import warp as wp

from coal_shapes import box, capsule, coal_distance
from jumper_warp.kernels.collision import distances as collision_shapes
from jumper_warp.kernels.scalar import vec3

wp.set_module_options({"enable_backward": False})


@wp.kernel
def shape_kernel(
    start_a: wp.array(dtype=wp.vec3), end_a: wp.array(dtype=wp.vec3), start_b: wp.array(dtype=wp.vec3),
    end_b: wp.array(dtype=wp.vec3), half: wp.array(dtype=wp.vec3), segments: wp.array(dtype=float),
    boxes: wp.array(dtype=float),
):  # fmt: skip
    """Write the distances [m] of segments a and b, and of segment a and the box at the origin; one thread per case."""
    i = wp.tid()
    segments[i] = wp.sqrt(collision_shapes.segment_segment_sq(start_a[i], end_a[i], start_b[i], end_b[i]))
    boxes[i] = wp.sqrt(collision_shapes.segment_box_sq(start_a[i], end_a[i], half[i]))


def shape_distances(start_a, end_a, start_b, end_b, half):
    """Return distances [m] (n,) of segments a to segments b, and of a to boxes of half extents `half`; all (n, 3)."""
    arrays = [wp.array(a, dtype=wp.vec3, device="cpu") for a in (start_a, end_a, start_b, end_b, half)]
    segments, boxes = (wp.zeros(len(start_a), dtype=float, device="cpu") for _ in range(2))
    wp.launch(shape_kernel, len(start_a), inputs=arrays, outputs=[segments, boxes], device="cpu")
    return segments.numpy(), boxes.numpy()


def random_segments(count=4000):
    """Return start_a, end_a, start_b, end_b, half [m], (count, 3); quarters: parallel, a along y, a a point, any."""
    rng = np.random.default_rng(3)
    start_a, start_b = rng.uniform(-0.3, 0.3, (2, count, 3))
    step_a, step_b = rng.uniform(-0.3, 0.3, (2, count, 3))
    quarter = count // 4
    step_b[:quarter] = step_a[:quarter] * rng.uniform(-1.5, 1.5, (quarter, 1)) + rng.normal(0, 1e-5, (quarter, 3))
    step_a[quarter : 2 * quarter] *= [0.0, 1.0, 0.0]
    step_a[2 * quarter : 3 * quarter] = 0.0
    return start_a, start_a + step_a, start_b, start_b + step_b, rng.uniform(0.03, 0.2, (count, 3))


def test_segment_and_box_distances_agree_with_coal():
    cases = random_segments()
    for segment, distance, start, end, *other, half in zip(*shape_distances(*cases), *cases, strict=True):
        bar = capsule(start, end, 0.01)
        assert segment == pytest.approx(coal_distance(bar, capsule(*other, 0.01)) + 0.02, abs=1e-5)  # less the radii
        assert distance == pytest.approx(coal_distance(bar, box(-half, half)) + 0.01, abs=1e-5)  # less the radius


@pytest.mark.parametrize(  # the other segment goes from (0, 0, 0) to (1, 0, 0); all [m]
    ("end_b", "start_b", "expected"),
    [
        ((0, 0.3, 0.4), (1, 0.3, 0.4), 0.5),  # parallel, side by side
        ((2, 0, 0), (3, 0, 0), 1.0),  # in one line
        ((0.5, -1, 0.2), (0.5, 1, 0.2), 0.2),  # crossing above
        ((4, 4, 0), (4, 4, 0), 5.0),  # a point past the end
    ],
)
def test_segment_distance_by_hand(start_b, end_b, expected):
    start_a, end_a = vec3(0.0, 0.0, 0.0), vec3(1.0, 0.0, 0.0)
    distance_sq = collision_shapes.segment_segment_sq(start_a, end_a, vec3(*start_b), vec3(*end_b))
    assert distance_sq == pytest.approx(expected**2, rel=1e-6)


@pytest.mark.parametrize(  # from a segment to the box |x| < 1, |y| < 2, |z| < 3; all [m]
    ("start", "end", "expected"),
    [
        ((1, 0, 4), (2, 0, 3), 0.5**0.5),  # down past the edge x = 1, z = 3, nearest half a metre outside both faces
        ((-9, 0, 0), (9, 0.5, 0), 0.0),  # right through
        ((0, 5, 7), (0, 5, 7), 5.0),  # a point 3 and 4 outside
        ((-5, -5, 3.5), (5, 5, 3.5), 0.5),  # flat above a face
    ],
)
def test_box_distance_by_hand(start, end, expected):
    _, (distance,) = shape_distances([start], [end], [start], [end], half=[(1, 2, 3)])
    assert distance == pytest.approx(expected, abs=1e-6)
