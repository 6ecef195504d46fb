import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from scipy.stats import kstest

from jumper_warp.envs.parameters import robot_parameters
from jumper_warp.kernels.mdp import parameters
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.kernels.mdp.random import make_stream
from jumper_warp.registry import make_task
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.sim.simulation import Simulation
from mdp_helpers import MOTOR_SLOTS, array

N = 512
NAMES = """base_mass link_mass com_shift armature motor_friction gains speed_limits joint_offset friction action_latency
observation_latency push""".split()
FUNCS = [getattr(parameters, name) for name in NAMES]
COUNTS = [len(func.input_types) - 2 for func in FUNCS]
MOTORS = ("kp", "kd", "saturation", "no_load_speed", "cutoff_speed", "offset")
DRAWN = [name for name in RobotParameters.vars if not name.startswith("nominal_") and name not in
         ("motors", "physics_dt", "skill", "paw_shapes")]  # fmt: skip


@wp.kernel(enable_backward=False)
def event_kernel(which: int, p: wp.array(dtype=float), robot: RobotParameters):
    """Run one of the events in every world, two threads a world."""
    world, lane = wp.tid()
    rng = make_stream(11, world, 16, 100 + which)
    rng.lane = lane
    rng.lanes = 2
    for i in range(wp.static(len(FUNCS))):
        if which == i:
            wp.static(FUNCS[i])(robot, rng, *p[0 : wp.static(COUNTS[i])])


def other_motors():
    """Return motors of which nothing is as in a jump."""
    motors, kinds = jumping_motors(18.0), {}
    factors = {"kp": 1.25, "kd": 0.75, "saturation": 0.5, "no_load_speed": 1.5, "cutoff_speed": 1.375}
    for name in ("lateral", "transversal"):
        kind = getattr(motors, name)
        kinds[name] = dataclasses.replace(kind, **{key: getattr(kind, key) * f for key, f in factors.items()})
    return dataclasses.replace(motors, **kinds)


@pytest.fixture(scope="module")
def made():
    """Parameters of robots of two skills, and copies of all that may change."""
    sim = Simulation(N, visuals=False, device="cpu")
    tasks = (make_task("vertical-jump"), dataclasses.replace(make_task("horizontal-jump"), motors=other_motors()))
    robot = robot_parameters(sim, tasks, array(np.arange(N) % 2, int))
    wp.launch(parameters.motors_kernel, (12, N), [robot], device="cpu")
    robot.latency.fill_(-1)
    robot.observation_latency.fill_(-1)
    robot.push.fill_(wp.spatial_vector(1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    return SimpleNamespace(sim=sim, robot=robot, tasks=tasks, nominal=copies(robot))


@pytest.fixture
def drawn(made):
    """(event, numbers) -> parameters after it; those that it has no business with are checked to be as before."""
    yield lambda name, *numbers, only: draw(made, name, numbers, only)
    for name in DRAWN:
        getattr(made.robot, name).assign(made.nominal[name])
    for name in MOTORS:
        getattr(made.robot.motors, name).assign(made.nominal[f"motors.{name}"])


def copies(robot):
    """Return copies of all parameters that may change."""
    found = {name: getattr(robot, name).numpy().copy() for name in DRAWN}
    return found | {f"motors.{name}": getattr(robot.motors, name).numpy().copy() for name in MOTORS}


def draw(made, name, numbers, only):
    assert len(numbers) == COUNTS[NAMES.index(name)]
    inputs = [NAMES.index(name), array([*numbers, *[0.0] * 8]), made.robot]
    wp.launch(event_kernel, (N, 2), inputs, device="cpu")
    found = copies(made.robot)
    for other, values in found.items():
        if other not in only:
            np.testing.assert_array_equal(values, made.nominal[other], other)
        else:
            assert (values != made.nominal[other]).any(), other
    return SimpleNamespace(**{key.removeprefix("motors."): values for key, values in found.items()})


def uniform(values, lower, upper):
    """Whether values are uniform in a range, up to rounding."""
    share = (np.asarray(values, dtype=float).ravel() - lower) / (upper - lower)
    assert share.min() >= -1e-5 and share.max() <= 1.0 + 1e-5
    assert kstest(share, "uniform").pvalue > 1e-3
    return True


def independent(columns):
    """Whether the columns of (worlds, columns) are pairwise uncorrelated."""
    assert np.abs(np.corrcoef(np.asarray(columns, dtype=float).T) - np.eye(columns.shape[1])).max() < 5.0 / np.sqrt(N)
    return True


def bodies(values):
    return values.reshape(N, 21, *values.shape[1:])


def dofs(values):
    return values.reshape(N, 38)


def consistent(made, found):
    """Check that inertias are in proportion to masses, and inverses are those of what they invert."""
    mass, inertia = bodies(found.body_mass), bodies(found.body_inertia).astype(float)
    nominal = made.nominal["body_mass"][:21], made.nominal["body_inertia"][:21]
    np.testing.assert_allclose(inertia, nominal[1] * (mass / nominal[0])[..., None, None], rtol=1e-5)
    np.testing.assert_allclose(bodies(found.body_inv_mass) * mass, 1.0, rtol=1e-6)
    product = bodies(found.body_inv_inertia).astype(float) @ inertia
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-5)


MASS = ("body_mass", "body_inv_mass", "body_inertia", "body_inv_inertia")


def test_a_mass_is_added_to_the_base_only(made, drawn):
    found = drawn("base_mass", -1.0, 2.0, only=MASS)
    added = bodies(found.body_mass) - bodies(made.nominal["body_mass"])
    assert uniform(added[:, 0], -1.0, 2.0) and not added[:, 1:].any()
    np.testing.assert_array_equal(bodies(found.body_inertia)[:, 1:], bodies(made.nominal["body_inertia"])[:, 1:])
    consistent(made, found)


def test_each_link_of_the_legs_is_scaled_by_itself(made, drawn):
    found = drawn("link_mass", 0.8, 1.2, only=MASS)
    scale = bodies(found.body_mass) / bodies(made.nominal["body_mass"])
    np.testing.assert_array_equal(scale[:, 0], 1.0)
    assert uniform(scale[:, 1:], 0.8, 1.2) and independent(scale[:, 1:])
    consistent(made, found)


def test_a_second_draw_starts_from_the_nominal_mass(made, drawn):
    drawn("base_mass", 1.0, 2.0, only=MASS)
    found = drawn("base_mass", -1.0, -0.5, only=MASS)
    assert uniform(bodies(found.body_mass)[:, 0] - made.nominal["body_mass"][0], -1.0, -0.5)


def test_the_bases_centre_of_mass_is_shifted_along_each_axis(made, drawn):
    found = drawn("com_shift", -0.03, 0.02, only=("body_com",))
    shift = bodies(found.body_com) - bodies(made.nominal["body_com"])
    assert uniform(shift[:, 0], -0.03, 0.02) and independent(shift[:, 0]) and not shift[:, 1:].any()


def test_kp_and_kd_may_have_ranges_of_their_own(made, drawn):
    found = drawn("gains", 0.6, 0.7, 1.0, 1.0, only=("gain_ratio", "motors.kp"))
    assert uniform(found.kp / made.nominal["motors.kp"], 0.6, 0.7)
    np.testing.assert_array_equal(found.kd, made.nominal["motors.kd"])


def test_each_motors_armature_is_scaled_and_that_of_no_other_joint(made, drawn):
    found = drawn("armature", 0.6, 1.4, only=("joint_armature",))
    before, after = dofs(made.nominal["joint_armature"]), dofs(found.joint_armature)
    motors = 6 + MOTOR_SLOTS
    scale = after[:, motors] / before[:, motors]
    assert uniform(scale, 0.6, 1.4) and independent(scale)
    others = np.setdiff1d(np.arange(38), motors)
    np.testing.assert_array_equal(after[:, others], before[:, others])


def test_each_motor_has_a_friction(made, drawn):
    found = drawn("motor_friction", 0.005, 0.04, only=("joint_friction",))
    motors = 6 + MOTOR_SLOTS
    values = dofs(found.joint_friction)
    assert uniform(values[:, motors], 0.005, 0.04) and independent(values[:, motors])
    others = np.setdiff1d(np.arange(38), motors)
    np.testing.assert_array_equal(values[:, others], dofs(made.nominal["joint_friction"])[:, others])


def test_gains_are_scaled_from_those_of_the_worlds_skill(made, drawn):
    found = drawn("gains", 0.6, 1.4, 0.6, 1.4, only=("gain_ratio", "motors.kp", "motors.kd"))
    ratio = np.concatenate([found.kp / made.nominal["motors.kp"], found.kd / made.nominal["motors.kd"]]).T
    assert uniform(ratio, 0.6, 1.4) and independent(ratio)
    np.testing.assert_allclose(ratio, np.concatenate([found.gain_ratio[..., 0], found.gain_ratio[..., 1]]).T, rtol=1e-6)
    motors = [made.tasks[world % 2].motors for world in range(N)]
    for name in ("kp", "kd"):
        lateral = [getattr(motor.lateral, name) for motor in motors]
        np.testing.assert_array_equal(made.nominal[f"motors.{name}"][0], np.float32(lateral))


SPEEDS = ("motors.no_load_speed", "motors.cutoff_speed", "speed_ratio")


def test_speed_limits_are_scaled_and_the_cutoff_stays_below_the_no_load_speed(made, drawn):
    found = drawn("speed_limits", 0.8, 1.2, 0.8, 1.4, only=SPEEDS)
    no_load = found.no_load_speed / made.nominal["motors.no_load_speed"]
    assert uniform(no_load, 0.8, 1.2) and independent(no_load.T)
    wanted = found.speed_ratio[..., 1] * made.nominal["motors.cutoff_speed"]
    assert uniform(found.speed_ratio[..., 1], 0.8, 1.4)
    np.testing.assert_allclose(found.cutoff_speed, np.minimum(wanted, 0.95 * found.no_load_speed), rtol=1e-6)
    bound = found.cutoff_speed >= 0.9499 * found.no_load_speed
    assert 0.01 < bound.mean() < 0.9 and (found.cutoff_speed <= 0.9501 * found.no_load_speed).all()


def test_each_sensor_has_a_constant_error(made, drawn):
    found = drawn("joint_offset", -0.035, 0.02, only=("motors.offset",))
    assert uniform(found.offset, -0.035, 0.02) and independent(found.offset.T)


@pytest.mark.parametrize(("dynamic", "static", "bound"), [((0.8, 0.9), (0.9, 1.2), 0.0), ((0.7, 0.9), (0.6, 1.0), 0.5)])
def test_paws_have_one_dynamic_coefficient_and_a_static_one_that_is_not_below_it(made, drawn, dynamic, static, bound):
    found = drawn("friction", *dynamic, *static, only=("shape_mu", "static_ratio"))
    paws = made.robot.paw_shapes.numpy().reshape(N, 4)
    mu = found.shape_mu[paws]
    assert uniform(mu[:, 0], *dynamic) and (mu == mu[:, :1]).all()
    others = np.setdiff1d(np.arange(len(found.shape_mu)), paws)
    np.testing.assert_array_equal(found.shape_mu[others], made.nominal["shape_mu"][others])
    ratio, sticking = found.static_ratio, found.static_ratio * mu[:, 0]
    assert ratio.min() >= 1.0 and sticking.max() <= static[1] + 1e-5
    assert np.mean(ratio == 1.0) == pytest.approx(bound, abs=4.0 * np.sqrt(0.25 / N))
    assert np.ptp(sticking) > 0.8 * (static[1] - max(static[0], dynamic[0]))


@pytest.mark.parametrize("name", ["action_latency", "observation_latency"])
def test_a_latency_is_the_nearest_number_of_physics_steps(made, drawn, name):
    array_of = {"action_latency": "latency", "observation_latency": "observation_latency"}[name]
    found = getattr(drawn(name, 0.0, 0.016, 0.0, only=(array_of,)), array_of)
    # 0 to 16 ms are 0 to 7.68 steps of 1/480 s: half of the first step counts as 0, 0.18 of the last as 8
    shares = np.bincount(found, minlength=9) / N
    expected = np.array([0.5, *[1.0] * 7, 0.18]) / 7.68
    assert len(shares) == 9 and np.abs(shares - expected).max() < 4.5 * np.sqrt(0.13 * 0.87 / N)
    some = getattr(drawn(name, 0.004, 0.016, 0.3, only=(array_of,)), array_of)  # 1.92 steps at least, unless none
    assert np.mean(some == 0) == pytest.approx(0.3, abs=4.5 * np.sqrt(0.3 * 0.7 / N)) and some[some > 0].max() == 8


@pytest.mark.parametrize("name", ["action_latency", "observation_latency"])
def test_a_latency_of_whole_steps_stays_so_many(made, drawn, name):
    array_of = {"action_latency": "latency", "observation_latency": "observation_latency"}[name]
    for steps in range(49):
        seconds = float(np.float32(steps / 480.0))
        assert (getattr(drawn(name, seconds, seconds, 0.0, only=(array_of,)), array_of) == steps).all(), steps
    for seconds, steps in ((0.008, 4), (0.001, 0), (0.0011, 1), (0.0167, 8), (0.1, 48)):
        assert (getattr(drawn(name, seconds, seconds, 0.0, only=(array_of,)), array_of) == steps).all(), steps


def test_a_push_comes_in_its_share_of_draws_and_else_there_is_none(drawn):
    push = drawn("push", 0.25, -5.0, 4.0, -3.0, 2.0, only=("push",)).push
    there = push.any(axis=1)
    assert there.mean() == pytest.approx(0.25, abs=4.0 * np.sqrt(0.25 * 0.75 / N))
    assert uniform(push[there, :3], -5.0, 4.0) and uniform(push[there, 3:], -3.0, 2.0)
    matrix = np.corrcoef(push[there].T) - np.eye(6)
    assert np.abs(matrix).max() < 5.0 / np.sqrt(there.sum())
    assert drawn("push", 1.0, -5.0, 4.0, -3.0, 2.0, only=("push",)).push.any(axis=1).all()


def test_every_world_has_the_motors_of_its_skill_by_what_was_drawn(made, drawn):
    drawn("gains", 0.6, 1.4, 0.6, 1.4, only=("gain_ratio", "motors.kp", "motors.kd"))
    robot, ratio = made.robot, made.robot.gain_ratio.numpy()
    before = {name: getattr(robot.motors, name).numpy().copy() for name in MOTORS}
    robot.skill.assign(1 - np.arange(N) % 2)
    wp.launch(parameters.motors_kernel, (12, N), [robot], device="cpu")
    robot.skill.assign(np.arange(N) % 2)
    nominal = {"kp": robot.nominal_kp, "kd": robot.nominal_kd, "saturation": robot.nominal_saturation,
               "no_load_speed": robot.nominal_no_load, "cutoff_speed": robot.nominal_cutoff}  # fmt: skip
    for name, table in nominal.items():
        one, other = table.numpy()
        assert (one != other).all()
        expected = table.numpy()[1 - np.arange(N) % 2].T
        expected = expected * (ratio[..., ["kp", "kd"].index(name)] if name in ("kp", "kd") else 1.0)
        np.testing.assert_allclose(getattr(robot.motors, name).numpy(), expected, rtol=1e-6)
    np.testing.assert_array_equal(robot.motors.offset.numpy(), before["offset"])
