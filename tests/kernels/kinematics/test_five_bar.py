"""The closed form of `kernels/five_bar.py` against hand figures and a numeric solution of the loop equations."""

import importlib
import math

import numpy as np
import pytest
import warp as wp

from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import leg_geometry, leg_geometry_array
from jumper_warp.sim.precision import float64_kernels

SAMPLES = 1000
POINTS = ("outer_knee", "inner_knee", "ankle")
LINKS = ("outer_thigh", "inner_thigh", "outer_shank", "inner_shank")

# columns that the test kernel writes
FIELDS = (
    ["outer_knee", "inner_knee", "ankle", "outer_shank", "inner_shank"]
    + ["outer_knee_do", "inner_knee_di", "ankle_do", "ankle_di"]
    + ["outer_knee_acc", "inner_knee_acc", "ankle_acc"]
)
SCALARS = (
    ["outer_shank_do", "outer_shank_di", "inner_shank_do", "inner_shank_di"]
    + ["outer_thigh_rate", "inner_thigh_rate", "outer_shank_rate", "inner_shank_rate"]
    + ["outer_shank_acc", "inner_shank_acc"]
)


def make_kernel(five_bar, geometry, scalar):
    @wp.func
    def put(row: int, col: int, value: scalar.vec2, out: wp.array2d(dtype=scalar.real)):
        out[row, col] = value[0]
        out[row, col + 1] = value[1]

    @wp.kernel(module="unique", enable_backward=False)
    def five_bar_kernel(
        geo: wp.array(dtype=geometry.LegGeometry),
        motors: wp.array2d(dtype=scalar.real),
        out: wp.array2d(dtype=scalar.real),
    ):
        i = wp.tid()
        leg = geo[0]
        loop = five_bar.five_bar(leg, motors[i, 0], motors[i, 1])
        bias = five_bar.five_bar_bias(leg, loop, motors[i, 2], motors[i, 3])
        put(i, 0, loop.outer_knee, out)
        put(i, 2, loop.inner_knee, out)
        put(i, 4, loop.ankle, out)
        put(i, 6, loop.outer_shank, out)
        put(i, 8, loop.inner_shank, out)
        put(i, 10, loop.outer_knee_do, out)
        put(i, 12, loop.inner_knee_di, out)
        put(i, 14, loop.ankle_do, out)
        put(i, 16, loop.ankle_di, out)
        put(i, 18, bias.outer_knee_acc, out)
        put(i, 20, bias.inner_knee_acc, out)
        put(i, 22, bias.ankle_acc, out)
        out[i, 24] = loop.outer_shank_do
        out[i, 25] = loop.outer_shank_di
        out[i, 26] = loop.inner_shank_do
        out[i, 27] = loop.inner_shank_di
        out[i, 28] = bias.outer_thigh_rate
        out[i, 29] = bias.inner_thigh_rate
        out[i, 30] = bias.outer_shank_rate
        out[i, 31] = bias.inner_shank_rate
        out[i, 32] = bias.outer_shank_acc
        out[i, 33] = bias.inner_shank_acc

    return five_bar_kernel


class Build:
    """One precision of the kernels; calling it evaluates the loop of a leg."""

    def __init__(self, package: str) -> None:
        float64_kernels()
        scalar = importlib.import_module(f"{package}.scalar")
        geometry = importlib.import_module(f"{package}.kinematics.geometry")
        self.real = scalar.real
        self.numpy_real = np.float64 if package == "jumper_warp.kernels_float64" else np.float32
        self.tolerance = 1.0e-9 if package == "jumper_warp.kernels_float64" else 1.0e-6
        self.legs = leg_geometry_array(load_description(), geometry, "cpu")
        self.kernel = make_kernel(importlib.import_module(f"{package}.kinematics.five_bar"), geometry, scalar)

    def __call__(self, leg: int, motors: np.ndarray) -> dict[str, np.ndarray]:
        """Return the fields for rows of (outer, inner [rad], their rates [rad/s]), as float64."""
        rows = wp.array(motors.astype(self.numpy_real), dtype=self.real, device="cpu")
        out = wp.zeros((len(motors), 34), dtype=self.real, device="cpu")
        wp.launch(self.kernel, len(motors), [self.legs[leg : leg + 1], rows], [out], device="cpu")
        table = out.numpy().astype(np.float64)
        fields = {name: table[:, 2 * i : 2 * i + 2] for i, name in enumerate(FIELDS)}
        return fields | {name: table[:, 24 + i] for i, name in enumerate(SCALARS)}


@pytest.fixture(scope="module", params=["jumper_warp.kernels", "jumper_warp.kernels_float64"])
def build(request):
    return Build(request.param)


# --- The reference: the loop equations, solved for the shanks' rotations by Newton's method and continuation. ---


def direction(turn):
    """Return the direction (x, z) of a link turned by `turn` [rad] about +y from -z, shape (2, n)."""
    return np.array([-np.sin(turn), -np.cos(turn)])


def slope(turn):
    return np.array([-np.cos(turn), np.sin(turn)])


def solve_loop(leg, outer, inner, shanks, iterations=4):
    """Return the shanks' rotations, shape (2, n), that close the loop; accepts complex angles."""
    gap_of_axes = np.array([leg["outer_x"] - leg["inner_x"], 0.0])[:, None]
    thighs = leg["thigh"] * (direction(-leg["front"] * outer) - direction(leg["front"] * inner))
    for _ in range(iterations):
        gap = gap_of_axes + thighs + leg["shank"] * (direction(shanks[0]) - direction(shanks[1]))
        a, b = leg["shank"] * slope(shanks[0]), -leg["shank"] * slope(shanks[1])
        det = a[0] * b[1] - a[1] * b[0]
        shanks = shanks - np.array([gap[0] * b[1] - gap[1] * b[0], a[0] * gap[1] - a[1] * gap[0]]) / det
    return shanks


def assemble(leg, outer, inner):
    """Return the shanks' rotations, followed from the default pose (45, 45 degrees), which hangs below the knees."""
    start = math.radians(45.0)
    half_base = 0.045 + 0.175 * math.sin(start)
    lean = leg["front"] * math.asin(half_base / 0.3)
    shanks = np.array([np.full_like(outer, lean), np.full_like(outer, -lean)])
    for part in np.linspace(0.0, 1.0, 61):
        shanks = solve_loop(leg, start + part * (outer - start), start + part * (inner - start), shanks)
    return shanks


def configuration(leg, outer, inner, shanks):
    """Return points [m], (2, n), and rotations of links [rad], (n,), by name."""
    shanks = solve_loop(leg, outer, inner, shanks)
    turns = {"outer_thigh": -leg["front"] * outer, "inner_thigh": leg["front"] * inner}
    turns |= {"outer_shank": shanks[0], "inner_shank": shanks[1]}
    outer_knee = np.array([[leg["outer_x"]], [0.0]]) + leg["thigh"] * direction(turns["outer_thigh"])
    inner_knee = np.array([[leg["inner_x"]], [0.0]]) + leg["thigh"] * direction(turns["inner_thigh"])
    ankle = outer_knee + leg["shank"] * direction(shanks[0])
    return {"outer_knee": outer_knee, "inner_knee": inner_knee, "ankle": ankle} | turns


def derivative(leg, outer, inner, shanks, along):
    """Return d configuration along (d outer, d inner), by a complex step."""
    step = 1.0e-20
    moved = configuration(leg, outer + 1j * step * along[0], inner + 1j * step * along[1], shanks + 0j)
    return {name: np.imag(value) / step for name, value in moved.items()}


def second_derivative(leg, outer, inner, shanks, along):
    """Return d^2 configuration along a straight line in motor angles: fourth-order differences of the complex step."""
    h = 5.0e-4
    total = {name: 0.0 for name in POINTS + LINKS}
    for offset, weight in ((-2, 1.0), (-1, -8.0), (1, 8.0), (2, -1.0)):
        at = derivative(leg, outer + offset * h * along[0], inner + offset * h * along[1], shanks, along)
        total = {name: total[name] + weight * at[name] / (12.0 * h) for name in total}
    return total


def random_motors(seed):
    """Return rows of outer, inner [rad], outer rate, inner rate [rad/s]; transversal -10..140, sum 0..240 degrees."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-10.0, 140.0, (4 * SAMPLES, 2))
    angles = angles[(angles.sum(1) >= 0.0) & (angles.sum(1) <= 240.0)][:SAMPLES]
    return np.hstack([np.radians(angles), rng.uniform(-1.0, 1.0, (SAMPLES, 2))])


@pytest.fixture(scope="module", params=range(4), ids=["FL", "FR", "BL", "BR"])
def case(request, build):
    """Return (fields under test, reference leg, outer, inner, rates, shanks, tolerance)."""
    leg = leg_geometry(load_description())[request.param]
    # the reference starts from the very numbers that the kernel reads
    motors = random_motors(request.param).astype(build.numpy_real).astype(np.float64)
    outer, inner, rates = motors[:, 0], motors[:, 1], motors[:, 2:].T
    return build(request.param, motors), leg, outer, inner, rates, assemble(leg, outer, inner), build.tolerance


def assert_close(got, want, tolerance):
    """Compare relative to the reference where that exceeds 1 (second derivatives grow toward a stretched leg)."""
    np.testing.assert_allclose(got, np.moveaxis(np.asarray(want), 0, -1), rtol=tolerance, atol=tolerance)


# --- Hand figures ---


@pytest.mark.parametrize(("angle", "depth"), [(0.0, 0.4716), (45.0, 0.3718), (57.0, 0.3260)])
def test_ankle_of_symmetric_leg_by_hand(build, angle, depth):
    motors = np.radians([[angle, angle, 0.0, 0.0]])
    for leg, geo in enumerate(leg_geometry(load_description())):
        ankle = build(leg, motors)["ankle"][0]
        assert ankle == pytest.approx([0.5 * (geo["outer_x"] + geo["inner_x"]), -depth], abs=5.0e-5)


def test_jacobian_of_symmetric_leg_by_hand(build):
    # depth = 0.175 cos a + sqrt(0.09 - w^2), w = 0.045 + 0.175 sin a; at 45 degrees w = 0.168744, sqrt = 0.248046
    fields = build(0, np.radians([[45.0, 45.0, 0.0, 0.0]]))
    rise = fields["ankle_do"][0, 1] + fields["ankle_di"][0, 1]
    assert rise == pytest.approx(0.123744 + 0.168744 * 0.123744 / 0.248046, abs=2.0e-6)


def test_parallel_thighs_move_ankle_on_a_circle(build):
    # outer = -inner keeps knees 0.09 apart and level: the ankle moves as the thigh tips do, 0.175 m/rad
    fields = build(0, np.array([[0.0, 0.0, 1.0, -1.0]]))
    assert fields["ankle_do"][0] - fields["ankle_di"][0] == pytest.approx([0.175, 0.0], abs=1.0e-6)
    assert fields["ankle_acc"][0] == pytest.approx([0.0, 0.175], abs=1.0e-6)


def test_coinciding_knees_give_finite_values(build):
    angle = -math.asin(0.045 / 0.175)
    fields = build(0, np.array([[angle, angle, 10.0, -10.0]]))
    assert all(np.isfinite(value).all() for value in fields.values())


# --- Against the numeric solution ---


def test_positions_solve_the_loop_equations(case):
    fields, leg, outer, inner, _, shanks, tolerance = case
    want = configuration(leg, outer, inner, shanks)
    for name in POINTS:
        assert_close(fields[name], want[name], tolerance)
    for name in ("outer_shank", "inner_shank"):
        assert_close(fields[name], direction(want[name]), tolerance)


def test_derivatives_match_complex_step(case):
    fields, leg, outer, inner, _, shanks, tolerance = case
    by_outer = derivative(leg, outer, inner, shanks, (1.0, 0.0))
    by_inner = derivative(leg, outer, inner, shanks, (0.0, 1.0))
    assert_close(fields["outer_knee_do"], by_outer["outer_knee"], tolerance)
    assert_close(fields["inner_knee_di"], by_inner["inner_knee"], tolerance)
    for name in ("ankle", "outer_shank", "inner_shank"):
        assert_close(fields[f"{name}_do"], by_outer[name], tolerance)
        assert_close(fields[f"{name}_di"], by_inner[name], tolerance)


def test_rates_match_complex_step(case):
    fields, leg, outer, inner, rates, shanks, tolerance = case
    want = derivative(leg, outer, inner, shanks, rates)
    for name in LINKS:
        assert_close(fields[f"{name}_rate"], want[name], tolerance)


def test_bias_matches_second_differences(case):
    fields, leg, outer, inner, rates, shanks, tolerance = case
    want = second_derivative(leg, outer, inner, shanks, rates)
    # twice the tolerance: products of two rates, which partly cancel, are summed up to four at a time
    for name in (*POINTS, "outer_shank", "inner_shank"):
        assert_close(fields[f"{name}_acc"], want[name], 2.0 * tolerance)
