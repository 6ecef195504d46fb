import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from scipy.stats import kstest

from columns import MOTOR_DOFS
from jumper_warp.envs.parameters import robot_parameters
from jumper_warp.kernels.mdp import parameters
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.kernels.mdp.random import make_stream
from jumper_warp.registry import make_task
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.sim.simulation import Simulation
from mdp_helpers import array

N = 512
NAMES = """base_mass link_mass com_shift armature motor_friction gains speed_limits joint_offset friction action_latency
observation_latency push""".split()
FUNCS = [getattr(parameters, name) for name in NAMES]
COUNTS = [len(func.input_types) - 2 for func in FUNCS]
OTHER_DOFS = np.setdiff1d(np.arange(38), MOTOR_DOFS)
MOTORS = ("kp", "kd", "saturation", "no_load_speed", "cutoff_speed", "offset")
FIXED = ("motors", "physics_dt", "skill", "paw_shapes", "zero_latency")
CHANGEABLE = [
    name
    for name in RobotParameters.vars
    if not name.startswith("nominal_") and not name.endswith("_move") and name not in FIXED
]


@wp.kernel(enable_backward=False)
def event_kernel(which: int, p: wp.array(dtype=float), robot: RobotParameters):
    """Run event FUNCS[which] with numbers p in every world, with two lanes per world."""
    world, lane = wp.tid()
    rng = make_stream(11, 0, world, 16, 100 + which)
    rng.lane = lane
    rng.lanes = 2
    for i in range(wp.static(len(FUNCS))):
        if which == i:
            wp.static(FUNCS[i])(robot, rng, *p[0 : wp.static(COUNTS[i])])


def second_skill_motors():
    """Return motors whose constants all differ from those of the first skill."""
    motors, kinds = jumping_motors(18.0), {}
    factors = {"kp": 1.25, "kd": 0.75, "saturation": 0.5, "no_load_speed": 1.5, "cutoff_speed": 1.375}
    for name in ("lateral", "transversal"):
        kind = getattr(motors, name)
        kinds[name] = dataclasses.replace(kind, **{key: getattr(kind, key) * f for key, f in factors.items()})
    return dataclasses.replace(motors, **kinds)


@pytest.fixture(scope="module")
def robots():
    """Return simulation, parameters, two tasks (world i has skill i % 2), and nominal copies of all parameters."""
    sim = Simulation(N, visuals=False, device="cpu")
    tasks = (
        make_task("vertical-jump"),
        dataclasses.replace(make_task("horizontal-jump"), motors=second_skill_motors()),
    )
    robot = robot_parameters(sim, tasks, array(np.arange(N) % 2, int))
    wp.launch(parameters.motors_kernel, (12, N), [robot], device="cpu")
    robot.latency.fill_(-1)
    robot.observation_latency.fill_(-1)
    robot.push.fill_(wp.spatial_vector(1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    return SimpleNamespace(sim=sim, robot=robot, tasks=tasks, nominal=copies(robot))


@pytest.fixture
def run_event(robots):
    """Return `run_and_check(robots, ...)` as (event, *numbers, only=names); restore nominal values."""
    yield lambda name, *numbers, only: run_and_check(robots, name, numbers, only)
    for name in CHANGEABLE:
        getattr(robots.robot, name).assign(robots.nominal[name])
    for name in MOTORS:
        getattr(robots.robot.motors, name).assign(robots.nominal[f"motors.{name}"])


def copies(robot):
    """Return copies of all parameters that may change, by name."""
    values = {name: getattr(robot, name).numpy().copy() for name in CHANGEABLE}
    return values | {f"motors.{name}": getattr(robot.motors, name).numpy().copy() for name in MOTORS}


def run_and_check(robots, name, numbers, only):
    """Run an event; assert that exactly the parameters `only` change, and return all as a namespace."""
    assert len(numbers) == COUNTS[NAMES.index(name)]
    inputs = [NAMES.index(name), array([*numbers, *[0.0] * 8]), robots.robot]
    wp.launch(event_kernel, (N, 2), inputs, device="cpu")
    parameters_after = copies(robots.robot)
    for parameter, values in parameters_after.items():
        if parameter not in only:
            np.testing.assert_array_equal(values, robots.nominal[parameter], parameter)
        else:
            assert (values != robots.nominal[parameter]).any(), parameter
    return SimpleNamespace(**{key.removeprefix("motors."): values for key, values in parameters_after.items()})


def is_uniform(values, lower, upper):
    """Assert that values are uniform in a range (Kolmogorov-Smirnov), and return True."""
    fraction = (np.asarray(values, dtype=float).ravel() - lower) / (upper - lower)
    assert fraction.min() >= -1e-5 and fraction.max() <= 1.0 + 1e-5
    assert kstest(fraction, "uniform").pvalue > 1e-3
    return True


def is_uncorrelated(columns):
    """Assert that columns (N, columns) are pairwise uncorrelated, and return True."""
    assert np.abs(np.corrcoef(np.asarray(columns, dtype=float).T) - np.eye(columns.shape[1])).max() < 5.0 / np.sqrt(N)
    return True


def bodies(values):
    """Return an array of all bodies by world, (N, 21, ...)."""
    return values.reshape(N, 21, *values.shape[1:])


def dofs(values):
    """Return an array of all degrees of freedom by world, (N, 38)."""
    return values.reshape(N, 38)


def check_inertias(robots, sample):
    """Assert that inertias scale with masses, and that inverse masses and inertias are inverses."""
    mass, inertia = bodies(sample.body_mass), bodies(sample.body_inertia).astype(float)
    nominal = robots.nominal["body_mass"][:21], robots.nominal["body_inertia"][:21]
    np.testing.assert_allclose(inertia, nominal[1] * (mass / nominal[0])[..., None, None], rtol=1e-5)
    np.testing.assert_allclose(bodies(sample.body_inv_mass) * mass, 1.0, rtol=1e-6)
    product = bodies(sample.body_inv_inertia).astype(float) @ inertia
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-5)


MASS = ("body_mass", "body_inv_mass", "body_inertia", "body_inv_inertia")  # changed by mass events
SPEEDS = ("motors.no_load_speed", "motors.cutoff_speed", "speed_ratio")


def ratio(name):
    """Return a function of a sample to its values of a motor parameter over the nominal ones, (N, 12)."""
    return lambda new, old: (getattr(new, name) / old[f"motors.{name}"]).T


def offset(name, part=0):
    """Return a function of a sample to its change of a body's values, (N, ...); part: index of the body."""
    return lambda new, old: (bodies(getattr(new, name)) - bodies(old[name]))[:, part]


SAMPLES = [  # event, its numbers, parameters that it changes, what it samples, range, others that stay nominal
    ("base_mass", (-1.0, 2.0), MASS, offset("body_mass"), (-1.0, 2.0), offset("body_mass", slice(1, None))),
    ("base_mass", (-1.0, 2.0), MASS, offset("body_mass"), (-1.0, 2.0), offset("body_inertia", slice(1, None))),
    ("link_mass", (0.8, 1.2), MASS, lambda new, old: (bodies(new.body_mass) / bodies(old["body_mass"]))[:, 1:],
     (0.8, 1.2), offset("body_mass")),
    ("com_shift", (-0.03, 0.02), ("body_com",), offset("body_com"), (-0.03, 0.02), offset("body_com", slice(1, None))),
    ("gains", (0.6, 0.7, 1.0, 1.0), ("gain_ratio", "motors.kp"), ratio("kp"), (0.6, 0.7),
     lambda new, old: new.kd - old["motors.kd"]),
    ("gains", (0.6, 1.4, 0.6, 1.4), ("gain_ratio", "motors.kp", "motors.kd"),
     lambda new, old: np.hstack([ratio("kp")(new, old), ratio("kd")(new, old)]), (0.6, 1.4), None),
    ("armature", (0.6, 1.4), ("joint_armature",), lambda new, old: (
        dofs(new.joint_armature)[:, MOTOR_DOFS] / dofs(old["joint_armature"])[:, MOTOR_DOFS]), (0.6, 1.4),
     lambda new, old: (dofs(new.joint_armature) - dofs(old["joint_armature"]))[:, OTHER_DOFS]),
    ("motor_friction", (0.005, 0.04), ("joint_friction",), lambda new, old: dofs(new.joint_friction)[:, MOTOR_DOFS],
     (0.005, 0.04), lambda new, old: (dofs(new.joint_friction) - dofs(old["joint_friction"]))[:, OTHER_DOFS]),
    ("speed_limits", (0.8, 1.2, 0.8, 1.4), SPEEDS, ratio("no_load_speed"), (0.8, 1.2), None),
    ("joint_offset", (-0.035, 0.02), ("motors.offset",), lambda new, old: new.offset.T, (-0.035, 0.02), None),
]  # fmt: skip


@pytest.mark.parametrize("row", SAMPLES, ids=lambda row: row[0])
def test_an_event_samples_uniform_independent_values_and_changes_nothing_else(robots, run_event, row):
    name, numbers, only, sampled, (lower, upper), nominal = row
    new = run_event(name, *numbers, only=only)
    values = sampled(new, robots.nominal)
    assert is_uniform(values, lower, upper) and (values.ndim == 1 or is_uncorrelated(values))
    assert nominal is None or not nominal(new, robots.nominal).any()
    if only == MASS:
        check_inertias(robots, new)
    if name == "gains":
        np.testing.assert_allclose(ratio("kp")(new, robots.nominal).T, new.gain_ratio[..., 0], rtol=1e-6)


def test_a_second_sample_starts_from_the_nominal_mass(robots, run_event):
    run_event("base_mass", 1.0, 2.0, only=MASS)
    sample = run_event("base_mass", -1.0, -0.5, only=MASS)
    assert is_uniform(bodies(sample.body_mass)[:, 0] - robots.nominal["body_mass"][0], -1.0, -0.5)


def test_the_cutoff_speed_stays_below_the_no_load_speed(robots, run_event):
    sample = run_event("speed_limits", 0.8, 1.2, 0.8, 1.4, only=SPEEDS)
    expected = sample.speed_ratio[..., 1] * robots.nominal["motors.cutoff_speed"]
    assert is_uniform(sample.speed_ratio[..., 1], 0.8, 1.4)
    np.testing.assert_allclose(sample.cutoff_speed, np.minimum(expected, 0.95 * sample.no_load_speed), rtol=1e-6)
    assert 0.01 < np.mean(expected > 0.95 * sample.no_load_speed) < 0.9


@pytest.mark.parametrize(("dynamic", "static", "bound"), [((0.8, 0.9), (0.9, 1.2), 0.0), ((0.7, 0.9), (0.6, 1.0), 0.5)])
def test_paws_share_one_dynamic_coefficient_and_a_static_one_not_below_it(robots, run_event, dynamic, static, bound):
    sample = run_event("friction", *dynamic, *static, only=("shape_mu", "static_ratio"))
    paws = robots.robot.paw_shapes.numpy().reshape(N, 4)
    mu = sample.shape_mu[paws]
    assert is_uniform(mu[:, 0], *dynamic) and (mu == mu[:, :1]).all()
    others = np.setdiff1d(np.arange(len(sample.shape_mu)), paws)
    np.testing.assert_array_equal(sample.shape_mu[others], robots.nominal["shape_mu"][others])
    ratio, sticking = sample.static_ratio, sample.static_ratio * mu[:, 0]
    assert ratio.min() >= 1.0 and sticking.max() <= static[1] + 1e-5
    assert np.mean(ratio == 1.0) == pytest.approx(bound, abs=4.0 * np.sqrt(0.25 / N))
    assert np.ptp(sticking) > 0.8 * (static[1] - max(static[0], dynamic[0]))


@pytest.mark.parametrize("name", ["action_latency", "observation_latency"])
def test_a_latency_is_the_nearest_number_of_physics_steps(robots, run_event, name):
    array_of = {"action_latency": "latency", "observation_latency": "observation_latency"}[name]
    sample = getattr(run_event(name, 0.0, 0.016, 0.0, only=(array_of,)), array_of)
    # 0 to 16 ms are 0 to 7.68 steps of 1/480 s: half of the first step counts as 0, 0.18 of the last as 8
    fractions = np.bincount(sample, minlength=9) / N
    expected = np.array([0.5, *[1.0] * 7, 0.18]) / 7.68
    assert len(fractions) == 9 and np.abs(fractions - expected).max() < 4.5 * np.sqrt(0.13 * 0.87 / N)
    for seconds in (*np.float32(np.arange(49) / 480.0), 0.0011, 0.1):
        drawn = getattr(run_event(name, float(seconds), float(seconds), 0.0, only=(array_of,)), array_of)
        assert (drawn == round(480.0 * float(seconds))).all(), seconds
    some = getattr(run_event(name, 0.004, 0.016, 0.3, only=(array_of,)), array_of)  # 1.92 steps at least, unless none
    assert np.mean(some == 0) == pytest.approx(0.3, abs=4.5 * np.sqrt(0.3 * 0.7 / N)) and some[some > 0].max() == 8


def test_a_push_has_its_probability_and_uncorrelated_uniform_components(run_event):
    push = run_event("push", 0.25, -5.0, 4.0, -3.0, 2.0, only=("push",)).push
    pushed = push.any(axis=1)
    assert pushed.mean() == pytest.approx(0.25, abs=4.0 * np.sqrt(0.25 * 0.75 / N))
    assert is_uniform(push[pushed, :3], -5.0, 4.0) and is_uniform(push[pushed, 3:], -3.0, 2.0)
    matrix = np.corrcoef(push[pushed].T) - np.eye(6)
    assert np.abs(matrix).max() < 5.0 / np.sqrt(pushed.sum())
    assert run_event("push", 1.0, -5.0, 4.0, -3.0, 2.0, only=("push",)).push.any(axis=1).all()


def test_motors_after_a_handover_are_those_of_the_new_skill_times_the_sampled_ratios(robots, run_event):
    run_event("gains", 0.6, 1.4, 0.6, 1.4, only=("gain_ratio", "motors.kp", "motors.kd"))
    robot, ratio = robots.robot, robots.robot.gain_ratio.numpy()
    before = {name: getattr(robot.motors, name).numpy().copy() for name in MOTORS}
    robot.skill.assign(1 - np.arange(N) % 2)
    wp.launch(parameters.motors_kernel, (12, N), [robot], device="cpu")
    robot.skill.assign(np.arange(N) % 2)
    nominal = {"kp": robot.nominal_kp, "kd": robot.nominal_kd, "saturation": robot.nominal_saturation,
               "no_load_speed": robot.nominal_no_load, "cutoff_speed": robot.nominal_cutoff}  # fmt: skip
    for name, table in nominal.items():
        first_skill, second_skill = table.numpy()
        assert (first_skill != second_skill).all()
        expected = table.numpy()[1 - np.arange(N) % 2].T
        expected = expected * (ratio[..., ["kp", "kd"].index(name)] if name in ("kp", "kd") else 1.0)
        np.testing.assert_allclose(getattr(robot.motors, name).numpy(), expected, rtol=1e-6)
    np.testing.assert_array_equal(robot.motors.offset.numpy(), before["offset"])
