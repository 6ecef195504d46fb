"""The closed form of `kinematics/five_bar.py` against hand calculations and numeric solutions of the loop equations."""

import importlib
import math
from typing import NamedTuple

import numpy as np
import pytest
import warp as wp

from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import leg_geometry, leg_geometry_array
from jumper_warp.sim.precision import float64_kernels

SAMPLES = 1000  # random configurations per leg
POINTS = ("outer_knee", "inner_knee", "ankle")
LINKS = ("outer_thigh", "inner_thigh", "outer_shank", "inner_shank")


def make_kernel(five_bar, geometry, scalar):
    """Return a kernel that evaluates the functions of `five_bar`; arguments: modules of one precision."""

    @wp.kernel(module="unique", enable_backward=False)
    def five_bar_kernel(
        geo: wp.array(dtype=geometry.LegGeometry), motors: wp.array2d(dtype=scalar.real),
        loops: wp.array(dtype=five_bar.FiveBar), biases: wp.array(dtype=five_bar.FiveBarBias),
    ):  # fmt: skip
        """Evaluate one leg, geo (1,), at motors (n, 4): outer, inner [rad], their rates [rad/s]; one thread per row."""
        i = wp.tid()
        loops[i] = five_bar.five_bar(geo[0], motors[i, 0], motors[i, 1])
        biases[i] = five_bar.five_bar_bias(geo[0], loops[i], motors[i, 2], motors[i, 3])

    return five_bar_kernel


class Build:
    """Kernels of one precision; a call evaluates the loop of a leg. package: jumper_warp.kernels or kernels_float64."""

    def __init__(self, package: str) -> None:
        float64_kernels()
        scalar = importlib.import_module(f"{package}.scalar")
        geometry = importlib.import_module(f"{package}.kinematics.geometry")
        self.five_bar = importlib.import_module(f"{package}.kinematics.five_bar")
        self.real = scalar.real
        self.numpy_real = np.float64 if package == "jumper_warp.kernels_float64" else np.float32
        self.tolerance = 1.0e-9 if package == "jumper_warp.kernels_float64" else 1.0e-6
        self.legs = leg_geometry_array(load_description(), geometry, "cpu")
        self.kernel = make_kernel(self.five_bar, geometry, scalar)

    def __call__(self, leg: int, motors: np.ndarray) -> dict[str, np.ndarray]:
        """Return the fields of loop and bias by name, as float64; motors (n, 4): outer, inner [rad], rates [rad/s]."""
        rows = wp.array(motors.astype(self.numpy_real), dtype=self.real, device="cpu")
        kinds = self.five_bar.FiveBar, self.five_bar.FiveBarBias
        out = [wp.zeros(len(motors), dtype=kind, device="cpu") for kind in kinds]
        wp.launch(self.kernel, len(motors), [self.legs[leg : leg + 1], rows], out, device="cpu")
        tables = [array.numpy() for array in out]
        return {name: table[name].astype(np.float64) for table in tables for name in table.dtype.names}


@pytest.fixture(scope="module", params=["jumper_warp.kernels", "jumper_warp.kernels_float64"])
def build(request):
    """Return the `Build` of each precision."""
    return Build(request.param)


# --- The reference: the loop equations, solved for the shanks' rotations by Newton's method and continuation. ---
# leg: `leg_geometry` of a leg; outer, inner [rad]: motor angles (n,); shanks [rad]: rotations about +y from -z, (2, n).


def direction(angle):
    """Return the unit vectors (x, z), (2, n), along links rotated by `angle` [rad] (n,) about +y from -z."""
    return np.array([-np.sin(angle), -np.cos(angle)])


def direction_derivative(angle):
    """Return d direction / d angle, (2, n)."""
    return np.array([-np.cos(angle), np.sin(angle)])


def solve_loop(leg, outer, inner, shanks, iterations=4):
    """Return the shanks' rotations that close the loop, by Newton's method from `shanks`; accepts complex angles."""
    gap_of_axes = np.array([leg["outer_x"] - leg["inner_x"], 0.0])[:, None]
    thighs = leg["thigh"] * (direction(-leg["front"] * outer) - direction(leg["front"] * inner))
    for _ in range(iterations):
        gap = gap_of_axes + thighs + leg["shank"] * (direction(shanks[0]) - direction(shanks[1]))
        a, b = leg["shank"] * direction_derivative(shanks[0]), -leg["shank"] * direction_derivative(shanks[1])
        det = a[0] * b[1] - a[1] * b[0]
        shanks = shanks - np.array([gap[0] * b[1] - gap[1] * b[0], a[0] * gap[1] - a[1] * gap[0]]) / det
    return shanks


def assemble(leg, outer, inner):
    """Return the shanks' rotations on the branch of the default pose (45, 45 degrees), by continuation in 61 steps."""
    start = math.radians(45.0)
    half_base = 0.045 + 0.175 * math.sin(start)  # [m] half the distance between the knees
    start_angle = leg["front"] * math.asin(half_base / 0.3)
    shanks = np.array([np.full_like(outer, start_angle), np.full_like(outer, -start_angle)])
    for fraction in np.linspace(0.0, 1.0, 61):
        shanks = solve_loop(leg, start + fraction * (outer - start), start + fraction * (inner - start), shanks)
    return shanks


def configuration(leg, outer, inner, shanks):
    """Return POINTS [m] (2, n) and rotations of LINKS [rad] (n,) by name; shanks: start of Newton's method."""
    shanks = solve_loop(leg, outer, inner, shanks)
    rotations = {"outer_thigh": -leg["front"] * outer, "inner_thigh": leg["front"] * inner}
    rotations |= {"outer_shank": shanks[0], "inner_shank": shanks[1]}
    outer_knee = np.array([[leg["outer_x"]], [0.0]]) + leg["thigh"] * direction(rotations["outer_thigh"])
    inner_knee = np.array([[leg["inner_x"]], [0.0]]) + leg["thigh"] * direction(rotations["inner_thigh"])
    ankle = outer_knee + leg["shank"] * direction(shanks[0])
    return {"outer_knee": outer_knee, "inner_knee": inner_knee, "ankle": ankle} | rotations


def derivative(leg, outer, inner, shanks, along):
    """Return the derivative of `configuration` by motor angles along (d outer, d inner), by a complex step."""
    step = 1.0e-20
    moved = configuration(leg, outer + 1j * step * along[0], inner + 1j * step * along[1], shanks + 0j)
    return {name: np.imag(value) / step for name, value in moved.items()}


def second_derivative(leg, outer, inner, shanks, along):
    """Return the second derivative of `configuration` likewise: fourth-order differences of `derivative`."""
    h = 5.0e-4  # step along the line
    total = {name: 0.0 for name in POINTS + LINKS}
    for offset, weight in ((-2, 1.0), (-1, -8.0), (1, 8.0), (2, -1.0)):
        at = derivative(leg, outer + offset * h * along[0], inner + offset * h * along[1], shanks, along)
        total = {name: total[name] + weight * at[name] / (12.0 * h) for name in total}
    return total


def random_motors(seed):
    """Return (SAMPLES, 4): outer, inner [rad], their rates [rad/s]; angles -10..140, their sum 0..240 degrees."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-10.0, 140.0, (4 * SAMPLES, 2))
    angles = angles[(angles.sum(1) >= 0.0) & (angles.sum(1) <= 240.0)][:SAMPLES]
    return np.hstack([np.radians(angles), rng.uniform(-1.0, 1.0, (SAMPLES, 2))])


class Case(NamedTuple):
    """Random motions of a leg: the kernel's results, the inputs of the reference, and the tolerance between both."""

    fields: dict[str, np.ndarray]  # of `FiveBar` and `FiveBarBias`, (n, 2) or (n,)
    leg: dict  # `leg_geometry`
    outer: np.ndarray  # (n,) [rad]
    inner: np.ndarray  # (n,) [rad]
    rates: np.ndarray  # (2, n) [rad/s] of outer and inner
    shanks: np.ndarray  # (2, n) [rad]
    tolerance: float


@pytest.fixture(scope="module", params=range(4), ids=["FL", "FR", "BL", "BR"])
def case(request, build):
    """Return the `Case` of each leg."""
    leg = leg_geometry(load_description())[request.param]
    # rounded to the kernel's precision, so that kernel and reference have the same inputs
    motors = random_motors(request.param).astype(build.numpy_real).astype(np.float64)
    outer, inner, rates = motors[:, 0], motors[:, 1], motors[:, 2:].T
    return Case(build(request.param, motors), leg, outer, inner, rates, assemble(leg, outer, inner), build.tolerance)


def assert_close(actual, expected, tolerance):
    """Assert |actual - expected| <= tolerance (1 + |expected|); actual (n, 2) or (n,), expected (2, n) or (n,)."""
    np.testing.assert_allclose(actual, np.moveaxis(np.asarray(expected), 0, -1), rtol=tolerance, atol=tolerance)


# --- Hand calculations ---


# depth [m] of the ankle = 0.175 cos a + sqrt(0.3^2 - (0.045 + 0.175 sin a)^2) at outer = inner = a [deg]
@pytest.mark.parametrize(("angle", "depth"), [(0.0, 0.4716), (45.0, 0.3718), (57.0, 0.3260)])
def test_ankle_of_symmetric_leg_by_hand(build, angle, depth):
    motors = np.radians([[angle, angle, 0.0, 0.0]])
    for leg, geo in enumerate(leg_geometry(load_description())):
        ankle = build(leg, motors)["ankle"][0]
        assert ankle == pytest.approx([0.5 * (geo["outer_x"] + geo["inner_x"]), -depth], abs=5.0e-5)


def test_five_bar_with_coinciding_knees_is_finite(build):
    angle = -math.asin(0.045 / 0.175)  # both knees at the middle of the axes, which are 2 x 0.045 m apart
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
    """Rates of the links [rad/s] are derivatives of their rotations along the motors' rates."""
    fields, leg, outer, inner, rates, shanks, tolerance = case
    want = derivative(leg, outer, inner, shanks, rates)
    for name in LINKS:
        assert_close(fields[f"{name}_rate"], want[name], tolerance)


def test_bias_accelerations_match_second_differences(case):
    """At constant motor rates points and shanks accelerate by the second derivative along the rates."""
    fields, leg, outer, inner, rates, shanks, tolerance = case
    want = second_derivative(leg, outer, inner, shanks, rates)
    # twice the tolerance: products of two rates, which partly cancel, are summed up to four at a time
    for name in (*POINTS, "outer_shank", "inner_shank"):
        assert_close(fields[f"{name}_acc"], want[name], 2.0 * tolerance)
