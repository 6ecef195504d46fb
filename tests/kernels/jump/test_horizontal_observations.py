import math

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from columns import ANG_VEL, LIN_VEL, MOTOR_COORDS, POS, QUAT, X, Y, Z
from jump_helpers import DEG, Robots, edit_episodes, make_env, make_episode, only, without_draws
from jumper_warp.kernels.jump.observations import edges_of_block
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE
from jumper_warp.kernels.scalar import vec2
from jumper_warp.kernels.terrain.ground import Block
from jumper_warp.registry import make_task
from jumper_warp.tasks.mirror import mirror_of
from mdp_helpers import array

HORIZONTAL, VERTICAL = (without_draws(make_task(name)) for name in ("horizontal-jump", "vertical-jump"))
NAMES = HORIZONTAL.observation_names
ROBOT, EPISODE, BLOCK = 48, 15, 7  # columns of the critic: the actor's, of the episode, of the block ahead (last)
DRAWN = slice(ROBOT + EPISODE, -BLOCK)  # columns of randomised parameters
N = 200  # robots


def random_robots(task, turn=0.0, seed=0):
    """Return N random robots and goals, all turned about the world's z axis by `turn` [rad]; deterministic in seed."""
    rng = np.random.default_rng(seed)
    robots = Robots(task, N)
    heading = rng.uniform(-np.pi, np.pi, N)
    heading[:50] = np.pi + rng.uniform(-0.02, 0.02, 50)  # around the jump of the yaw at pi
    tilt = Rotation.from_rotvec(rng.uniform(-0.8, 0.8, (N, 3)))
    world = Rotation.from_euler("z", turn)
    robots.q[:, POS] = world.apply(rng.uniform(-1.0, 1.0, (N, 3)))
    robots.q[:, QUAT] = (world * Rotation.from_euler("z", heading[:, None]) * tilt).as_quat()
    robots.q[:, MOTOR_COORDS] += rng.uniform(-1.0, 1.0, (N, 12))
    robots.qd[:, LIN_VEL], robots.qd[:, ANG_VEL] = (
        world.apply(rng.normal(size=(N, 3))),
        world.apply(rng.normal(size=(N, 3))),
    )
    robots.qd[:, 6:] = rng.normal(size=(N, 32))
    robots.com = rng.uniform(-0.05, 0.05, 3)
    robots.action, robots.offset = rng.uniform(-1.0, 1.0, (12, N)), rng.uniform(-0.03, 0.03, (12, N))
    robots.force = 200.0 * rng.normal(size=(4, N, 3))
    goals = world.apply(np.concatenate([rng.uniform(-2.0, 2.0, (N, 2)), rng.uniform(0.0, 1.0, (N, 1))], axis=1))
    robots.tasks = [
        make_episode(
            goal=goal, heading=turn, phase=int(phase), phase_steps=int(steps), steps=200, max_height=float(height)
        )
        for goal, phase, steps, height in zip(
            goals, rng.integers(0, 3, N), rng.integers(0, 200, N), rng.uniform(0.3, 1.0, N), strict=True
        )
    ]
    return robots


def one_robot(task=HORIZONTAL, **fields):
    """Return one robot at rest in the default pose; fields: of its `JumpState`."""
    robots = Robots(task)
    robots.tasks = [make_episode(**fields)]
    return robots


def yaw_quat(angle):
    """Return the quaternion (xyzw) of a rotation about z by `angle` [deg]."""
    return Rotation.from_euler("z", angle, degrees=True).as_quat()


def test_the_layout_is_that_of_the_vertical_jump_but_for_the_goal():
    assert NAMES[:4] == ("goal_x", "goal_y", "height", "lin_vel_x") and len(NAMES) == ROBOT
    assert NAMES[3:] == VERTICAL.observation_names[3:]


@pytest.mark.parametrize(
    ("yaw", "offset"),
    [(0.0, (0.6, 0.2)), (90.0, (0.2, -0.6)), (180.0, (-0.6, -0.2)), (-180.0, (-0.6, -0.2)), (-90.0, (-0.2, 0.6))],
)
def test_goal_and_height_are_observed_in_the_yaw_aligned_frame(yaw, offset):
    robots = one_robot(goal=(1.6, -0.8, 0.0))
    robots.q[0, :3], robots.q[0, 3:7] = (1.0, -1.0, 0.4), yaw_quat(yaw)
    np.testing.assert_allclose(robots.observe()[0, :3], [*offset, 0.4], atol=1e-6)


def test_goal_columns_do_not_change_with_pitch_and_roll():
    robots = one_robot(goal=(0.6, 0.2, 0.0))
    robots.q[0, 3:7] = Rotation.from_euler("ZYX", [90.0, 40.0, -30.0], degrees=True).as_quat()
    np.testing.assert_allclose(robots.observe()[0, :2], [0.2, -0.6], atol=1e-6)


@pytest.mark.parametrize("turn", [0.3, 137.0 * DEG, math.pi, -2.0])
def test_observations_do_not_change_if_robot_and_goal_turn_about_the_vertical(turn):
    unturned, turned = random_robots(HORIZONTAL).both(), random_robots(HORIZONTAL, turn).both()
    for group, turned_group in zip(unturned, turned, strict=True):
        np.testing.assert_allclose(group, turned_group, atol=2e-5)
    assert np.abs(unturned[0][:, :2]).max() > 1.0  # [m] goals


@pytest.mark.parametrize(
    ("episode", "visible"),
    [
        ({"phase": STANCE, "steps": 4}, False),
        ({"phase": STANCE, "steps": 5}, True),
        ({"phase": FLIGHT, "steps": 5}, True),
        ({"phase": LANDED, "steps": 50}, True),
    ],
)
def test_the_goal_is_zero_before_the_command_and_stays_after_the_landing(episode, visible):
    robots = one_robot(goal=(0.6, 0.2, 0.0), command_step=5, **episode)
    np.testing.assert_allclose(robots.observe()[0, :2], [0.6 * visible, 0.2 * visible], atol=1e-6)


@pytest.mark.parametrize("steps", [4, 5])
def test_noise_of_goal_and_height_is_independent_and_clamped_at_one_sigma(steps):
    robots = Robots(HORIZONTAL, 4096)
    robots.tasks = [make_episode(goal=(0.6, 0.2, 0.0), command_step=5, steps=steps)] * 4096
    clean = robots.observe()
    noise = (robots.observe(noise=True) - clean)[:, :3] / 0.005  # goal x, y and height; 0.005 m: their std
    assert np.abs(noise).max() <= 1.0 + 1e-3
    # variance of a clamped standard normal number: 0.5161; bounds: 4 standard errors of 4096 = 64^2 samples
    assert noise.std(axis=0) == pytest.approx(math.sqrt(0.5161), abs=4.0 * 0.283 / 64.0)
    assert noise.mean(axis=0) == pytest.approx(0.0, abs=4.0 * 0.7184 / 64.0)
    assert np.abs(np.corrcoef(noise.T) - np.eye(3)).max() < 5.0 / 64.0


def test_height_is_measured_from_the_ground_below_the_base():
    robots = Robots(HORIZONTAL, 2)
    # falls by 0.15 m from x = 0 to x = 2 m, rises by 0.1 m from y = -2 m to y = 2 m
    robots.heights = np.array([[0.0, 0.0, -0.15], [0.1, 0.1, -0.05]])
    robots.q[:, X], robots.q[:, Y], robots.q[:, Z] = (-1.0, 1.0), (1.0, -2.0), (0.4, 0.3)
    np.testing.assert_allclose(robots.observe()[:, 2], [0.4 - 0.075, 0.3 + 0.075], atol=1e-6)


@pytest.mark.parametrize("task", [HORIZONTAL, VERTICAL], ids=lambda task: task.name)
def test_the_critic_gets_the_actors_terms_without_noise(task):
    robots = random_robots(task)
    clean, critic = robots.both()
    np.testing.assert_array_equal(critic[:, :ROBOT], clean)
    noisy, critic_again = robots.both(noise=True)
    np.testing.assert_array_equal(critic_again, critic)
    assert (noisy[:, 2:36] != clean[:, 2:36]).mean() > 0.99  # columns with noise


def test_every_element_of_the_observations_is_written_and_none_beyond_them():
    robots = random_robots(VERTICAL)
    arrays = robots.skill.observations
    marked = np.full(arrays.now.shape[0] + 7, 7.0)  # 7 more elements than observations
    arrays.now, last = array(marked), arrays.now.shape[0]
    robots.both()
    values = arrays.now.numpy()
    assert last == N * (ROBOT + ROBOT + EPISODE) and not (values[:last] == 7.0).any()
    np.testing.assert_array_equal(values[last:], 7.0)


@pytest.mark.parametrize("phase", [STANCE, FLIGHT, LANDED])
def test_the_critic_gets_phase_and_times(phase):
    robots = one_robot(phase=phase, phase_steps=90, steps=150, command_step=60)
    values = robots.both()[1][0, ROBOT : ROBOT + 5]
    np.testing.assert_allclose(values, [*(float(phase == i) for i in range(3)), 1.5, 1.5], atol=1e-6)  # 90 / 60 s


@pytest.mark.parametrize(
    ("episode", "times"),
    [
        ({"phase_steps": 500, "steps": 900, "command_step": 0}, [2.0, 3.0]),
        ({"phase_steps": 6, "steps": 0, "command_step": 30}, [0.1, -0.5]),
        ({"phase_steps": 0, "steps": 0, "command_step": 90}, [0.0, -1.0]),
    ],
)
def test_times_in_the_phase_and_since_the_command_are_clamped(episode, times):
    np.testing.assert_allclose(one_robot(**episode).both()[1][0, ROBOT + 3 : ROBOT + 5], times, atol=1e-6)


def test_the_critic_gets_height_errors_predicted_miss_and_goal_even_before_the_command():
    robots = one_robot(goal=(1.6, -0.8, 0.9), max_height=0.7, steps=0, command_step=30)
    robots.q[0, :3], robots.q[0, 3:7] = (1.0, -1.0, 0.52625), yaw_quat(90.0)
    robots.qd[0, :3] = (1.0, -0.6, 2.0)
    values = robots.both()[1][0, ROBOT + 5 : ROBOT + 11]
    # apex 0.52625 + 4 / 19.62 m; half a second to 0.3 m, at (1.5, -1.3); body x is world y, body y is world -x
    expected = [0.7 - 0.9, 0.52625 + 4.0 / 19.62 - 0.9, 0.5, -0.1, 0.2, -0.6]
    np.testing.assert_allclose(values, expected, atol=1e-5)


def test_the_predicted_miss_is_computed_above_the_ground_at_the_goal():
    robots = one_robot(goal=(1.6, -0.8, 0.0), goal_ground=0.08)
    robots.q[0, :3], robots.qd[0, :3] = (1.0, -1.0, 0.60625), (1.0, -0.6, 2.0)
    # half a second to 0.38 m, at (1.5, -1.3)
    np.testing.assert_allclose(robots.both()[1][0, ROBOT + 7 : ROBOT + 9], [0.1, 0.5], atol=1e-5)


def test_the_critic_gets_paw_forces_in_body_weights_up_to_five():
    robots = one_robot()
    robots.force[:, 0] = [(0.0, 0.0, 0.0), (84.0, 0.0, 112.0), (0.0, 0.0, 70.0), (0.0, 9000.0, 0.0)]
    values = robots.both()[1][0, ROBOT + 11 : ROBOT + EPISODE]
    np.testing.assert_allclose(values, [0.0, 1.0, 0.5, 5.0], atol=1e-6)


@pytest.fixture(scope="module")
def env():
    """Return horizontal jumps of 256 randomised robots with noise, in the default pose."""
    return make_env(256, task=make_task("horizontal-jump"), reset=only("default"), randomize=True, noise=True, seed=8)


def test_the_critic_gets_the_environments_randomised_parameters(env):
    model, motors = env.sim.model, env.sim.motors
    nominal = make_env(1, task=make_task("horizontal-jump"), reset=only("default")).sim
    mass, com = model.body_mass.numpy().reshape(256, -1), model.body_com.numpy().reshape(256, -1, 3)
    mass = mass - nominal.model.body_mass.numpy()
    friction = model.shape_material_mu.numpy()[model.shape_world.numpy() >= 0].reshape(256, -1)
    push = env.parameters.push.numpy()
    columns = [
        mass[:, :1], mass[:, 1:].sum(axis=1, keepdims=True), (com[:, 0] - nominal.model.body_com.numpy()[0]) / 0.03,
        (motors.kp.numpy() / nominal.motors.kp.numpy() - 1.0).T,
        (motors.no_load_speed.numpy() / nominal.motors.no_load_speed.numpy() - 1.0).T,
        env.parameters.latency.numpy()[:, None] / 8.0, (friction[:, :1] - 0.85) * 10.0,
        env.parameters.static_ratio.numpy()[:, None] - 1.0, motors.offset.numpy().T / 0.035,
        push[:, :3] / 5.0, push[:, 3:] / 3.0,
    ]  # fmt: skip
    np.testing.assert_allclose(env.critic_obs[:, DRAWN], np.concatenate(columns, axis=1), atol=1e-4)


def test_randomised_parameters_are_of_order_one_and_zero_without_randomisation(env):
    observed = env.critic_obs[:, DRAWN].numpy()
    assert observed.shape[1] == env.num_critic_obs - ROBOT - EPISODE - BLOCK
    assert np.abs(observed).max() < 3.0 and (np.abs(observed).max(axis=0) > 0.04).all()
    nominal = make_env(16, task=make_task("horizontal-jump"), reset=only("default"))
    assert not nominal.critic_obs[:, DRAWN].any()


def ray_edges(block, base, heading):
    """Return the first and last distance [m] along a ray above a block, sampled every 0.5 mm; (2, 2) if there is none.

    base: x, y [m] of the ray's origin; heading [rad].
    """
    distance = np.arange(-2.0, 2.0, 5e-4)
    points = base[:, None] + np.outer([np.cos(heading), np.sin(heading)], distance)
    above = distance[(np.abs(points - block["center"][:, None]) <= block["half"][:, None]).all(axis=0)]
    return (above[0], above[-1]) if len(above) and block["exists"] else (2.0, 2.0)


def test_block_ahead_matches_sampling_along_three_rays():
    task = make_task("horizontal-jump-sighted")
    assert list(task.layout("actor"))[-1] == "block_ahead"
    env = make_env(256, task=task, reset=only("standing", task.reset.settings), randomize=True, seed=5)
    edit_episodes(env, level=7)  # far goals, most with room for a block
    env.reset()
    blocks = env.sim.dynamics.robot.ground.blocks.numpy()
    exists = blocks["exists"] == 1
    assert 40 < exists.sum() < 216
    observed = env.obs[:, -BLOCK:].numpy()
    np.testing.assert_array_equal(env.critic_obs[:, ROBOT : ROBOT + BLOCK], observed)
    q = env.sim.joint_q()
    yaw = np.arctan2(*Rotation.from_quat(q[:, QUAT]).apply([1.0, 0.0, 0.0])[:, 1::-1].T)
    sides = [(0, 0.2), (1, 0.0), (2, -0.2)]  # (ray, distance to the left of the base [m])
    for world in range(256):
        for ray, aside in sides:
            base = q[world, :2] + aside * np.array([-np.sin(yaw[world]), np.cos(yaw[world])])
            expected = ray_edges(blocks[world], base, yaw[world])
            np.testing.assert_allclose(observed[world, 2 * ray : 2 * ray + 2], expected, atol=2e-3)
    np.testing.assert_allclose(observed[:, 6], np.where(exists, blocks["height"], 0.0), atol=1e-6)
    ahead = exists & (observed[:, 2] > 0.0) & (observed[:, 2] < 2.0)
    under = exists & (observed[:, 2] < 0.0)
    assert ahead.sum() > 20 and under.sum() > 20


@wp.kernel
def edges_kernel(centers: wp.array(dtype=float), edges: wp.array(dtype=wp.vec2)):
    """Write the distances along x from the origin to blocks of 0.6 m with these centres [m] on the x axis."""
    i = wp.tid()
    block = Block()
    block.exists = 1
    block.center = vec2(centers[i], 0.0)
    block.half = vec2(0.3, 0.3)
    edges[i] = edges_of_block(block, 0.0, 0.0, 0.0)


def test_distances_to_a_block_stay_within_sight():
    edges = wp.zeros(3, dtype=wp.vec2, device="cpu")
    wp.launch(edges_kernel, 3, [array([-4.0, -2.1, 1.9]), edges], device="cpu")
    np.testing.assert_allclose(edges.numpy(), [(-2.0, -2.0), (-2.0, -1.8), (1.6, 2.0)], atol=1e-6)


def test_block_ahead_is_2_m_for_all_rays_without_a_block():
    env = make_env(2, task=make_task("horizontal-jump-sighted"))
    np.testing.assert_array_equal(env.obs[:, -BLOCK:], np.tile([2.0] * 6 + [0.0], (2, 1)))


@pytest.mark.parametrize("task", [HORIZONTAL, VERTICAL], ids=["horizontal", "vertical"])
def test_observations_of_a_mirrored_robot_are_the_mirror_image(task):
    robots = random_robots(task)
    first = robots.both()
    flip, spin = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])  # of vectors, of angular velocities
    legs = [1, 0, 3, 2]  # FL, FR, BL, BR with sides swapped
    joints = [5 * leg + j for leg in legs for j in range(5)]
    motors = [3 * leg + j for leg in legs for j in range(3)]
    robots.q[:, POS] *= flip
    robots.q[:, QUAT] *= [-1.0, 1.0, -1.0, 1.0]
    robots.q[:, 7:27] = robots.q[:, 7:27][:, joints]
    robots.qd[:, LIN_VEL], robots.qd[:, ANG_VEL] = robots.qd[:, LIN_VEL] * flip, robots.qd[:, ANG_VEL] * spin
    robots.qd[:, 6:26] = robots.qd[:, 6:26][:, joints]
    robots.com = robots.com * flip
    robots.action, robots.offset = robots.action[motors], robots.offset[motors]
    robots.force = robots.force[legs] * flip
    for episode in robots.tasks:
        episode.goal = wp.vec3(episode.goal[0], -episode.goal[1], episode.goal[2])
    second, observed_task = robots.both(), robots.skill.task
    for group, original, mirrored in zip(("actor", "critic"), first, second, strict=True):
        mirror = mirror_of(observed_task, group)
        np.testing.assert_allclose(mirrored, mirror.signs * original[:, mirror.order], atol=1e-5)
        assert np.abs(mirrored - original).max() > 0.5
