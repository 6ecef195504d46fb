import math

import numpy as np
import pytest
import warp as wp
from jump_helpers import DEFAULT_ANGLE, DEG, make_episode

from jumper_warp.tasks import make_task
from jumper_warp.tasks.task import NoiseCfg
from kernels.observe import make_observe_kernel, observe_vertical
from kernels.task import FLIGHT, LANDED, STANCE, JumpTask, ViewArrays

KERNEL = make_observe_kernel(observe_vertical)
NAMES = make_task("vertical-jump").observation_names
COLUMN = {name: i for i, name in enumerate(NAMES)}
MOTORS = [f"{leg}_{motor}" for leg in ("FL", "FR", "BL", "BR") for motor in ("lateral", "outer", "inner")]
MOTOR_SLOTS = np.array([5 * leg + joint for leg in range(4) for joint in (0, 1, 3)])
SCALES = np.concatenate(
    [
        [0.0, 0.0, 0.005], [0.1] * 6, [0.05] * 3, [3.0 * DEG] * 12, [10.0 * DEG] * 12, [0.0] * 12,
    ]
)  # fmt: skip


class Robots:
    """Arrays of robots that all stand at rest in the default pose, to be changed by the tests."""

    def __init__(self, n=1):
        self.n = n
        self.q, self.qd = np.zeros((n, 43)), np.zeros((n, 38))
        self.q[:, 2], self.q[:, 6], self.q[:, 7 + MOTOR_SLOTS] = 0.35, 1.0, DEFAULT_ANGLE
        self.com, self.action, self.offset = np.zeros(3), np.zeros((12, n)), np.zeros((12, n))
        self.task = make_episode(goal=(0.0, 0.0, 0.8), command_step=5)
        self.random = np.arange(1, n + 1, dtype=np.uint32) * np.uint32(7919)

    def observe(self, noise=False):
        """Return the observations, (n, 48); draws go on from call to call."""

        def array(value, dtype=float):
            return wp.array(np.asarray(value), dtype=dtype, device="cpu")

        views, n = ViewArrays(), self.n
        views.joint_q, views.joint_qd = array(self.q.ravel()), array(self.qd.ravel())
        views.body_com = array(np.tile(self.com, (21 * n, 1)), wp.vec3)
        views.paw_force = wp.zeros((4, n), dtype=wp.vec3, device="cpu")
        for name in ("torque", "old_action", "target", "safe_target", "old_rate"):
            setattr(views, name, wp.zeros((12, n), dtype=float, device="cpu"))
        views.action = array(self.action)
        views.old_lin_vel = wp.zeros(n, dtype=wp.vec3, device="cpu")
        views.default_angle, views.step_dt = array(DEFAULT_ANGLE), 1.0 / 60.0
        out, none = wp.zeros((n, len(NAMES)), dtype=float, device="cpu"), wp.zeros(n, dtype=float, device="cpu")
        random = array(self.random, wp.uint32)
        tasks = wp.array([self.task] * n, dtype=JumpTask, device="cpu")
        inputs = [views, tasks, array(self.offset), NoiseCfg().sensor_noise(noise), none, 1, out, random]
        wp.launch(KERNEL, n, inputs, [out], device="cpu")
        self.random = random.numpy()
        return out.numpy().astype(float)


def columns(prefix, names):
    return [COLUMN[f"{prefix}_{name}"] for name in names]


def test_the_layout_is_the_papers():
    robot = [f"{what}_{axis}" for what in ("lin_vel", "ang_vel", "gravity") for axis in "xyz"]
    joints = [f"{what}_{motor}" for what in ("angle", "rate", "last_action") for motor in MOTORS]
    assert list(NAMES) == ["wanted_height", "jump_command", "height", *robot, *joints]


def test_a_standing_robot():
    expected = np.zeros(48)
    expected[[COLUMN["wanted_height"], COLUMN["height"], COLUMN["gravity_z"]]] = 0.8, 0.35, -1.0
    np.testing.assert_allclose(Robots().observe()[0], expected, atol=1e-6)


def test_joints_are_in_motor_order_and_angles_relative_to_default():
    robots = Robots()
    robots.q[0, 7 + MOTOR_SLOTS] = DEFAULT_ANGLE + 0.01 * np.arange(12)
    robots.qd[0, 6 + MOTOR_SLOTS] = np.arange(12.0)
    robots.action[:, 0] = -0.05 * np.arange(12)
    obs = robots.observe()[0]
    np.testing.assert_allclose(obs[columns("angle", MOTORS)], 0.01 * np.arange(12), atol=1e-6)
    np.testing.assert_allclose(obs[columns("rate", MOTORS)], np.arange(12.0))
    np.testing.assert_allclose(obs[columns("last_action", MOTORS)], -0.05 * np.arange(12), atol=1e-6)


def test_velocities_and_gravity_are_in_body_axes():
    robots = Robots()
    # turned by 90 degrees about z: body x is world y, body y is world -x
    robots.q[0, 3:7] = [0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]
    robots.qd[0, :6] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    obs = robots.observe()[0]
    np.testing.assert_allclose(obs[columns("lin_vel", "xyz")], [2.0, -1.0, 3.0], atol=1e-6)
    np.testing.assert_allclose(obs[columns("ang_vel", "xyz")], [5.0, -4.0, 6.0], atol=1e-6)
    # nose down by 30 degrees: gravity has a share along body x
    robots.q[0, 3:7] = [0.0, math.sin(15.0 * DEG), 0.0, math.cos(15.0 * DEG)]
    gravity = robots.observe()[0][columns("gravity", "xyz")]
    np.testing.assert_allclose(gravity, [0.5, 0.0, -math.sqrt(0.75)], atol=1e-6)


def test_the_velocity_is_that_of_the_base_origin():
    robots = Robots()
    robots.com = np.array([0.0, 0.1, 0.02])
    # the com moves with 1 m/s along x and the base turns with 3 rad/s about z: the origin moves 0.3 m/s faster
    robots.qd[0, :6] = [1.0, 0.0, 0.0, 0.0, 0.0, 3.0]
    np.testing.assert_allclose(robots.observe()[0][columns("lin_vel", "xyz")], [1.3, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("fields", "command"),
    [
        ({"phase": STANCE, "steps": 4}, 0.0),
        ({"phase": STANCE, "steps": 5}, 1.0),
        ({"phase": FLIGHT, "steps": 5}, 1.0),
        ({"phase": LANDED, "steps": 50}, 0.0),
    ],
)
def test_the_jump_is_commanded_after_its_delay_and_until_the_landing(fields, command):
    robots = Robots()
    robots.task = make_episode(goal=(0.0, 0.0, 0.8), command_step=5, **fields)
    assert robots.observe()[0, COLUMN["jump_command"]] == command


def test_a_sensor_offset_is_added_to_its_own_angle():
    robots = Robots(2)
    robots.offset[4, 1] = 0.03
    difference = robots.observe()[1] - robots.observe()[0]
    assert np.flatnonzero(difference).tolist() == [COLUMN["angle_FR_outer"]]
    assert difference[COLUMN["angle_FR_outer"]] == pytest.approx(0.03, abs=1e-6)


def test_what_is_not_finite_is_seen_as_zero():
    robots = Robots()
    robots.q[0, 8], robots.qd[0, 0] = math.nan, math.inf
    obs = robots.observe()[0]
    assert np.isfinite(obs).all() and obs[COLUMN["angle_FL_outer"]] == 0.0


@pytest.fixture(scope="module")
def draws():
    """Noise over its standard deviation in 4 steps of 4096 worlds, (4, 4096, 33), and the raw noise."""
    robots, clean = Robots(4096), Robots().observe()[0]
    raw = np.array([robots.observe(noise=True) - clean for _ in range(4)])
    return raw[..., SCALES > 0.0] / SCALES[SCALES > 0.0], raw


def test_noise_has_the_papers_size_and_ends_at_one_sigma(draws):
    scaled, raw = draws
    assert not raw[..., SCALES == 0.0].any()  # command, wanted height and own actions are known
    assert np.abs(scaled).max() <= 1.0 + 1e-4
    # of a Gaussian, 31.7 % lie beyond one sigma; cut, the standard deviation is sqrt(0.5161); 4 standard errors
    cells = scaled.shape[0] * scaled.shape[1]
    assert np.mean(np.abs(scaled) > 0.9999, axis=(0, 1)) == pytest.approx(0.3173, abs=4.0 * 0.466 / math.sqrt(cells))
    assert scaled.std(axis=(0, 1)) == pytest.approx(math.sqrt(0.5161), abs=4.0 * 0.4 / math.sqrt(cells))
    assert scaled.mean(axis=(0, 1)) == pytest.approx(0.0, abs=4.0 * 0.7184 / math.sqrt(cells))


def correlation(a, b):
    return np.mean(a * b) / 0.5161


def test_noise_is_independent_across_columns_worlds_and_steps(draws):
    scaled, _ = draws
    matrix = np.corrcoef(scaled.reshape(-1, scaled.shape[2]).T) - np.eye(scaled.shape[2])
    assert np.abs(matrix).max() < 5.0 / math.sqrt(4 * 4096)
    bound = 5.0 / math.sqrt(3 * 4096 * 33)
    assert abs(correlation(scaled[:, 1:], scaled[:, :-1])) < bound  # neighbouring worlds
    for shift in (1, 2, 3):
        assert abs(correlation(scaled[shift:], scaled[:-shift])) < 5.0 / math.sqrt((4 - shift) * 4096 * 33)
        # nor does a step repeat another column of the one before
        assert abs(correlation(scaled[1:, :, shift:], scaled[:-1, :, :-shift])) < bound
