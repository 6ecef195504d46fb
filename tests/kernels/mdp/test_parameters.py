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


def test_a_mass_is_added_to_the_base_only(robots, run_event):
    sample = run_event("base_mass", -1.0, 2.0, only=MASS)
    added = bodies(sample.body_mass) - bodies(robots.nominal["body_mass"])
    assert is_uniform(added[:, 0], -1.0, 2.0) and not added[:, 1:].any()
    np.testing.assert_array_equal(bodies(sample.body_inertia)[:, 1:], bodies(robots.nominal["body_inertia"])[:, 1:])
    check_inertias(robots, sample)


def test_each_leg_link_is_scaled_independently(robots, run_event):
    sample = run_event("link_mass", 0.8, 1.2, only=MASS)
    scale = bodies(sample.body_mass) / bodies(robots.nominal["body_mass"])
    np.testing.assert_array_equal(scale[:, 0], 1.0)
    assert is_uniform(scale[:, 1:], 0.8, 1.2) and is_uncorrelated(scale[:, 1:])
    check_inertias(robots, sample)


def test_a_second_sample_starts_from_the_nominal_mass(robots, run_event):
    run_event("base_mass", 1.0, 2.0, only=MASS)
    sample = run_event("base_mass", -1.0, -0.5, only=MASS)
    assert is_uniform(bodies(sample.body_mass)[:, 0] - robots.nominal["body_mass"][0], -1.0, -0.5)


def test_the_bases_centre_of_mass_is_shifted_along_each_axis(robots, run_event):
    sample = run_event("com_shift", -0.03, 0.02, only=("body_com",))
    shift = bodies(sample.body_com) - bodies(robots.nominal["body_com"])
    assert is_uniform(shift[:, 0], -0.03, 0.02) and is_uncorrelated(shift[:, 0]) and not shift[:, 1:].any()


def test_kp_and_kd_have_separate_ranges(robots, run_event):
    sample = run_event("gains", 0.6, 0.7, 1.0, 1.0, only=("gain_ratio", "motors.kp"))
    assert is_uniform(sample.kp / robots.nominal["motors.kp"], 0.6, 0.7)
    np.testing.assert_array_equal(sample.kd, robots.nominal["motors.kd"])


def test_only_armatures_of_motors_are_scaled(robots, run_event):
    sample = run_event("armature", 0.6, 1.4, only=("joint_armature",))
    before, after = dofs(robots.nominal["joint_armature"]), dofs(sample.joint_armature)
    motors = MOTOR_DOFS
    scale = after[:, motors] / before[:, motors]
    assert is_uniform(scale, 0.6, 1.4) and is_uncorrelated(scale)
    others = np.setdiff1d(np.arange(38), motors)
    np.testing.assert_array_equal(after[:, others], before[:, others])


def test_only_motors_have_friction(robots, run_event):
    sample = run_event("motor_friction", 0.005, 0.04, only=("joint_friction",))
    motors = MOTOR_DOFS
    values = dofs(sample.joint_friction)
    assert is_uniform(values[:, motors], 0.005, 0.04) and is_uncorrelated(values[:, motors])
    others = np.setdiff1d(np.arange(38), motors)
    np.testing.assert_array_equal(values[:, others], dofs(robots.nominal["joint_friction"])[:, others])


def test_gains_are_scaled_from_those_of_the_active_skill(robots, run_event):
    sample = run_event("gains", 0.6, 1.4, 0.6, 1.4, only=("gain_ratio", "motors.kp", "motors.kd"))
    ratio = np.concatenate([sample.kp / robots.nominal["motors.kp"], sample.kd / robots.nominal["motors.kd"]]).T
    assert is_uniform(ratio, 0.6, 1.4) and is_uncorrelated(ratio)
    np.testing.assert_allclose(
        ratio, np.concatenate([sample.gain_ratio[..., 0], sample.gain_ratio[..., 1]]).T, rtol=1e-6
    )
    motors = [robots.tasks[world % 2].motors for world in range(N)]
    for name in ("kp", "kd"):
        lateral = [getattr(motor.lateral, name) for motor in motors]
        np.testing.assert_array_equal(robots.nominal[f"motors.{name}"][0], np.float32(lateral))


SPEEDS = ("motors.no_load_speed", "motors.cutoff_speed", "speed_ratio")


def test_speed_limits_are_scaled_and_the_cutoff_stays_below_the_no_load_speed(robots, run_event):
    sample = run_event("speed_limits", 0.8, 1.2, 0.8, 1.4, only=SPEEDS)
    no_load = sample.no_load_speed / robots.nominal["motors.no_load_speed"]
    assert is_uniform(no_load, 0.8, 1.2) and is_uncorrelated(no_load.T)
    expected = sample.speed_ratio[..., 1] * robots.nominal["motors.cutoff_speed"]
    assert is_uniform(sample.speed_ratio[..., 1], 0.8, 1.4)
    np.testing.assert_allclose(sample.cutoff_speed, np.minimum(expected, 0.95 * sample.no_load_speed), rtol=1e-6)
    bound = sample.cutoff_speed >= 0.9499 * sample.no_load_speed
    assert 0.01 < bound.mean() < 0.9 and (sample.cutoff_speed <= 0.9501 * sample.no_load_speed).all()


def test_sensor_offsets_are_uniform_and_independent(robots, run_event):
    sample = run_event("joint_offset", -0.035, 0.02, only=("motors.offset",))
    assert is_uniform(sample.offset, -0.035, 0.02) and is_uncorrelated(sample.offset.T)


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
    some = getattr(run_event(name, 0.004, 0.016, 0.3, only=(array_of,)), array_of)  # 1.92 steps at least, unless none
    assert np.mean(some == 0) == pytest.approx(0.3, abs=4.5 * np.sqrt(0.3 * 0.7 / N)) and some[some > 0].max() == 8


@pytest.mark.parametrize("name", ["action_latency", "observation_latency"])
def test_latencies_are_rounded_to_physics_steps_of_1_480_s(robots, run_event, name):
    array_of = {"action_latency": "latency", "observation_latency": "observation_latency"}[name]
    for steps in range(49):
        seconds = float(np.float32(steps / 480.0))
        assert (getattr(run_event(name, seconds, seconds, 0.0, only=(array_of,)), array_of) == steps).all(), steps
    for seconds, steps in ((0.008, 4), (0.001, 0), (0.0011, 1), (0.0167, 8), (0.1, 48)):
        assert (getattr(run_event(name, seconds, seconds, 0.0, only=(array_of,)), array_of) == steps).all(), steps


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
