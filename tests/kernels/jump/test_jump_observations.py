import math

import numpy as np
import pytest

from columns import MOTOR_COORDS, MOTOR_DOFS
from jump_helpers import DEFAULT_ANGLE, DEG, Robots, make_episode, without_draws
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE
from jumper_warp.registry import make_task

TASK = without_draws(make_task("vertical-jump"))
NAMES = TASK.observation_names
COLUMN = {name: i for i, name in enumerate(NAMES)}
MOTORS = [f"{leg}_{motor}" for leg in ("FL", "FR", "BL", "BR") for motor in ("lateral", "outer", "inner")]
SCALES = np.concatenate(  # standard deviations of the noise: [m], [m/s], [rad/s], [1], [rad], [rad/s] by column
    [
        [0.0, 0.0, 0.005], [0.1] * 6, [0.05] * 3, [3.0 * DEG] * 12, [10.0 * DEG] * 12, [0.0] * 12,
    ]
)  # fmt: skip


def standing_robots(n=1):
    """Return n robots at rest in the default pose, 0.35 m high, before a vertical jump of 0.8 m."""
    return Robots(TASK, n)


def columns_of(prefix, names):
    """Return the column indices of the components prefix_name."""
    return [COLUMN[f"{prefix}_{name}"] for name in names]


def test_the_layout_of_columns_is_the_papers():
    robot = [f"{quantity}_{axis}" for quantity in ("lin_vel", "ang_vel", "gravity") for axis in "xyz"]
    joints = [f"{quantity}_{motor}" for quantity in ("angle", "rate", "last_action") for motor in MOTORS]
    assert list(NAMES) == ["wanted_height", "jump_command", "height", *robot, *joints]


def test_observation_of_a_robot_at_rest():
    expected = np.zeros(48)
    expected[[COLUMN["wanted_height"], COLUMN["height"], COLUMN["gravity_z"]]] = 0.8, 0.35, -1.0
    np.testing.assert_allclose(standing_robots().observe()[0], expected, atol=1e-6)


def test_joints_are_in_motor_order_and_angles_relative_to_default():
    robots = standing_robots()
    robots.q[0, MOTOR_COORDS] = DEFAULT_ANGLE + 0.01 * np.arange(12)
    robots.qd[0, MOTOR_DOFS] = np.arange(12.0)
    robots.action[:, 0] = -0.05 * np.arange(12)
    obs = robots.observe()[0]
    np.testing.assert_allclose(obs[columns_of("angle", MOTORS)], 0.01 * np.arange(12), atol=1e-6)
    np.testing.assert_allclose(obs[columns_of("rate", MOTORS)], np.arange(12.0))
    np.testing.assert_allclose(obs[columns_of("last_action", MOTORS)], -0.05 * np.arange(12), atol=1e-6)


def test_velocities_and_gravity_are_in_body_axes():
    robots = standing_robots()
    # turned by 90 degrees about z: body x is world y, body y is world -x
    robots.q[0, 3:7] = [0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]
    robots.qd[0, :6] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    obs = robots.observe()[0]
    np.testing.assert_allclose(obs[columns_of("lin_vel", "xyz")], [2.0, -1.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(obs[columns_of("ang_vel", "xyz")], [5.0, -4.0, 6.0], atol=1e-6)
    # nose down by 30 degrees: gravity has a component along body x
    robots.q[0, 3:7] = [0.0, math.sin(15.0 * DEG), 0.0, math.cos(15.0 * DEG)]
    gravity = robots.observe()[0][columns_of("gravity", "xyz")]
    np.testing.assert_allclose(gravity, [0.5, 0.0, -math.sqrt(0.75)], atol=1e-6)


def test_lin_vel_is_the_velocity_of_the_base_origin_not_the_centre_of_mass():
    robots = standing_robots()
    robots.com = np.array([0.0, 0.1, 0.02])
    # the com moves with 1 m/s along x and the base turns with 3 rad/s about z: the origin moves 0.3 m/s faster
    robots.qd[0, :6] = [1.0, 0.0, 0.0, 0.0, 0.0, 3.0]
    np.testing.assert_allclose(robots.observe()[0][columns_of("lin_vel", "xyz")], [1.3, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("fields", "command"),
    [
        ({"phase": STANCE, "steps": 4}, 0.0),
        ({"phase": STANCE, "steps": 5}, 1.0),
        ({"phase": FLIGHT, "steps": 5}, 1.0),
        ({"phase": LANDED, "steps": 50}, 0.0),
    ],
)
def test_jump_command_is_1_from_its_step_until_the_landing(fields, command):
    robots = standing_robots()
    robots.tasks = [make_episode(goal=(0.0, 0.0, 0.8), command_step=5, **fields)]
    assert robots.observe()[0, COLUMN["jump_command"]] == command


def test_a_sensor_offset_is_added_to_its_own_angle():
    robots = standing_robots(2)
    robots.offset[4, 1] = 0.03  # [rad] of FR outer, in the second world
    difference = robots.observe()[1] - robots.observe()[0]
    assert np.flatnonzero(difference).tolist() == [COLUMN["angle_FR_outer"]]
    assert difference[COLUMN["angle_FR_outer"]] == pytest.approx(0.03, abs=1e-6)


@pytest.fixture(scope="module")
def noise_samples():
    """Return noise over its standard deviation, (4 steps, 4096 worlds, 33 noisy columns), and raw noise, all 48."""
    robots, clean = standing_robots(4096), standing_robots().observe()[0]
    raw = np.array([robots.observe(noise=True) - clean for _ in range(4)])
    return raw[..., SCALES > 0.0] / SCALES[SCALES > 0.0], raw


def test_noise_is_clamped_at_one_standard_deviation_by_default(noise_samples):
    scaled, raw = noise_samples
    assert not raw[..., SCALES == 0.0].any()  # commanded height, command and last actions have no noise
    assert np.abs(scaled).max() <= 1.0 + 1e-4
    # 31.7 % of a Gaussian lie beyond one sigma; clamped, its variance is 0.5161; bounds: 4 standard errors
    cells = scaled.shape[0] * scaled.shape[1]
    assert np.mean(np.abs(scaled) > 0.9999, axis=(0, 1)) == pytest.approx(0.3173, abs=4.0 * 0.466 / math.sqrt(cells))
    assert scaled.std(axis=(0, 1)) == pytest.approx(math.sqrt(0.5161), abs=4.0 * 0.4 / math.sqrt(cells))
    assert scaled.mean(axis=(0, 1)) == pytest.approx(0.0, abs=4.0 * 0.7184 / math.sqrt(cells))


def test_noise_of_the_papers_task_is_gaussian_with_table_vi_as_standard_deviations():
    task = make_task("vertical-jump-paper")
    robots, n = Robots(task, 4096), 4096
    noise = robots.observe(noise=True) - robots.observe()
    assert not noise[:, :3].any() and not noise[:, 36:].any()  # commanded height, command, height; last actions
    # Table VI of the paper: velocities [m/s, rad/s], gravity's direction [1], joint positions [rad], velocities [rad/s]
    sizes = np.concatenate([[0.1] * 6, [0.05] * 3, [3.0 * DEG] * 12, [10.0 * DEG] * 12])
    scaled = noise[:, 3:36] / sizes
    assert scaled.std(axis=0) == pytest.approx(1.0, abs=4.0 / math.sqrt(2.0 * n))
    beyond = np.mean(np.abs(scaled) > 2.0)  # 4.55 % of a Gaussian
    assert beyond == pytest.approx(0.0455, abs=4.0 * math.sqrt(0.0455 / (33 * n)))


def correlation(a, b):
    """Return the correlation of two arrays of scaled noise (mean 0, variance 0.5161)."""
    return np.mean(a * b) / 0.5161


def test_noise_is_independent_across_columns_worlds_and_steps(noise_samples):
    scaled, _ = noise_samples
    matrix = np.corrcoef(scaled.reshape(-1, scaled.shape[2]).T) - np.eye(scaled.shape[2])
    assert np.abs(matrix).max() < 5.0 / math.sqrt(4 * 4096)
    bound = 5.0 / math.sqrt(3 * 4096 * 33)
    assert abs(correlation(scaled[:, 1:], scaled[:, :-1])) < bound  # neighbouring worlds
    for shift in (1, 2, 3):
        assert abs(correlation(scaled[shift:], scaled[:-shift])) < 5.0 / math.sqrt((4 - shift) * 4096 * 33)
        # a step does not repeat another column of the previous step
        assert abs(correlation(scaled[1:, :, shift:], scaled[:-1, :, :-shift])) < bound
