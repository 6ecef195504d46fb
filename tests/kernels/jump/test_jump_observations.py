"""Observations of jumps: values by hand, noise, invariance, mirror images, randomised parameters and blocks ahead."""

import math

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from columns import ANG_VEL, LIN_VEL, MOTOR_COORDS, MOTOR_DOFS, POS, QUAT, X, Y, Z
from jump_helpers import DEFAULT_ANGLE, DEG, PHASES, Robots, edit_episodes, make_env, make_episode, only, without_draws
from jumper_warp.kernels.jump.observations import edges_of_block
from jumper_warp.kernels.scalar import vec2
from jumper_warp.kernels.terrain.ground import Block
from jumper_warp.registry import make_task
from jumper_warp.tasks.mirror import mirror_of
from mdp_helpers import array

_, F, L = PHASES
HORIZONTAL, VERTICAL = (without_draws(make_task(name)) for name in ("horizontal-jump", "vertical-jump"))
MOTORS = [f"{leg}_{motor}" for leg in ("FL", "FR", "BL", "BR") for motor in ("lateral", "outer", "inner")]
SCALES = np.concatenate(  # standard deviations of the noise: [m], [m/s], [rad/s], [1], [rad], [rad/s] by column
    [[0.0, 0.0, 0.005], [0.1] * 6, [0.05] * 3, [3.0 * DEG] * 12, [10.0 * DEG] * 12, [0.0] * 12]
)
ROBOT, EPISODE, BLOCK = 48, 15, 7  # columns of the critic: the actor's, of the episode, of the block ahead (last)
DRAWN = slice(ROBOT + EPISODE, -BLOCK)  # columns of randomised parameters
N = 200  # robots


def test_layouts_are_the_papers_but_for_the_horizontal_goal():
    robot = [f"{quantity}_{axis}" for quantity in ("lin_vel", "ang_vel", "gravity") for axis in "xyz"]
    joints = [f"{quantity}_{motor}" for quantity in ("angle", "rate", "last_action") for motor in MOTORS]
    assert list(VERTICAL.observation_names) == ["wanted_height", "jump_command", "height", *robot, *joints]
    assert list(HORIZONTAL.observation_names) == ["goal_x", "goal_y", "height", *robot, *joints]


def euler(*angles):
    """Return the quaternion (xyzw) of intrinsic rotations about z, y and x [deg]."""
    return Rotation.from_euler("ZYX", angles, degrees=True).as_quat()


PLACED = {"pos": (1.0, -1.0, 0.4)}
GOAL = {"goal": (1.6, -0.8, 0.0)}
JUMP = {"goal": (0.0, 0.0, 0.8), "command_step": 5}
MOVING = {"quat": euler(90.0, 0.0, 0.0), "vel": (1.0, 2.0, 3.0), "spin": (4.0, 5.0, 6.0)}  # body x is world y
SPINNING = {"com": (0.0, 0.1, 0.02), "vel": (1.0, 0.0, 0.0), "spin": (0.0, 0.0, 3.0)}  # the origin is 0.3 m/s faster
FLYING = {"pos": (1.0, -1.0, 0.52625), "quat": euler(90.0, 0.0, 0.0), "vel": (1.0, -0.6, 2.0)}  # 0.5 s to 0.3 m
MISSES = {"goal": (1.6, -0.8, 0.9), "max_height": 0.7, "command_step": 30}
FORCES = {"force": [(0.0, 0.0, 0.0), (84.0, 0.0, 112.0), (0.0, 0.0, 70.0), (0.0, 9000.0, 0.0)]}
COUNT = np.arange(12.0)
VALUES = [  # task, term (the actor's, unless only the critic has it), value, robot, episode
    *((HORIZONTAL, "goal", offset, PLACED | {"quat": euler(yaw, 0.0, 0.0)}, GOAL) for yaw, offset in (
        (0.0, (0.6, 0.2)), (90.0, (0.2, -0.6)), (180.0, (-0.6, -0.2)), (-180.0, (-0.6, -0.2)), (-90.0, (-0.2, 0.6)))),
    (HORIZONTAL, "goal", (0.2, -0.6), {"quat": euler(90.0, 40.0, -30.0)}, {"goal": (0.6, 0.2, 0.0)}),
    (HORIZONTAL, "height", 0.4, PLACED, {}),
    *((HORIZONTAL, "goal", (0.6 * shown, 0.2 * shown), {}, episode | {"goal": (0.6, 0.2, 0.0), "command_step": 5})
      for episode, shown in (({"steps": 4}, 0), ({"steps": 5}, 1), ({"phase": F, "steps": 5}, 1),
                             ({"phase": L, "steps": 50}, 1))),
    *((VERTICAL, "jump_command", command, {}, episode | JUMP) for episode, command in (
        ({"steps": 4}, 0.0), ({"steps": 5}, 1.0), ({"phase": F, "steps": 5}, 1.0), ({"phase": L, "steps": 50}, 0.0))),
    *((VERTICAL, term, value, {}, JUMP) for term, value in (
        ("wanted_height", 0.8), ("height", 0.35), ("gravity", (0.0, 0.0, -1.0)), ("lin_vel", 0.0), ("ang_vel", 0.0),
        ("angle", 0.0), ("rate", 0.0), ("last_action", 0.0))),
    (VERTICAL, "angle", 0.01 * COUNT, {"angles": DEFAULT_ANGLE + 0.01 * COUNT}, JUMP),
    (VERTICAL, "rate", COUNT, {"rates": COUNT}, JUMP),
    (VERTICAL, "last_action", -0.05 * COUNT, {"action": -0.05 * COUNT}, JUMP),
    (VERTICAL, "angle", 0.03 * np.eye(12)[4], {"offset": 0.03 * np.eye(12)[4]}, JUMP),  # sensor offset of FR outer
    (VERTICAL, "lin_vel", (2.0, -1.0, 3.0), MOVING, JUMP), (VERTICAL, "ang_vel", (5.0, -4.0, 6.0), MOVING, JUMP),
    (VERTICAL, "gravity", (0.5, 0.0, -math.sqrt(0.75)), {"quat": euler(0.0, 30.0, 0.0)}, JUMP),  # nose down
    (VERTICAL, "lin_vel", (1.3, 0.0, 0.0), SPINNING, JUMP),  # of the base's origin, not of its centre of mass
    *((HORIZONTAL, "phase", np.eye(3)[phase], {}, {"phase": phase}) for phase in PHASES),
    *((HORIZONTAL, "phase_times", times, {}, dict(zip(("phase_steps", "steps", "command_step"), steps, strict=True)))
      for steps, times in (((90, 150, 60), (1.5, 1.5)), ((500, 900, 0), (2.0, 3.0)),  # [s] steps of 1/60 s, clamped
                           ((6, 0, 30), (0.1, -0.5)), ((0, 0, 90), (0.0, -1.0)))),
    # apex 0.52625 + 4 / 19.62 m; landing at (1.5, -1.3); body x is world y, body y is world -x
    (HORIZONTAL, "height_errors", (0.7 - 0.9, 0.52625 + 4.0 / 19.62 - 0.9), FLYING, MISSES),
    (HORIZONTAL, "landing_miss", (0.5, -0.1), FLYING, MISSES), (HORIZONTAL, "way", (0.2, -0.6), FLYING, MISSES),
    (HORIZONTAL, "landing_miss", (0.1, 0.5), {"pos": (1.0, -1.0, 0.60625), "vel": (1.0, -0.6, 2.0)},
     GOAL | {"goal_ground": 0.08}),
    (HORIZONTAL, "paw_forces", (0.0, 1.0, 0.5, 5.0), FORCES, {}),  # [1] body weights, up to 5
]  # fmt: skip


@pytest.mark.parametrize("row", VALUES, ids=lambda row: row[1])
def test_observation_by_hand(row):
    task, term, value, robot, episode = row
    robots = Robots(task)
    robots.tasks = [make_episode(**episode)]
    places = {"pos": robots.q[0, POS], "quat": robots.q[0, QUAT], "vel": robots.qd[0, LIN_VEL],
              "spin": robots.qd[0, ANG_VEL], "com": robots.com, "force": robots.force[:, 0],
              "action": robots.action[:, 0], "offset": robots.offset[:, 0]}  # fmt: skip
    for name, values in robot.items():
        if name in places:
            places[name][:] = values
        else:
            (robots.q if name == "angles" else robots.qd)[0, MOTOR_COORDS if name == "angles" else MOTOR_DOFS] = values
    group = "actor" if term in task.layout("actor") else "critic"
    observed = robots.both()[group == "critic"][0, slice(*task.layout(group)[term])]
    np.testing.assert_allclose(observed, np.broadcast_to(value, observed.shape), atol=1e-5)


def test_height_is_measured_from_the_ground_below_the_base():
    robots = Robots(HORIZONTAL, 2)
    # falls by 0.15 m from x = 0 to x = 2 m, rises by 0.1 m from y = -2 m to y = 2 m
    robots.heights = np.array([[0.0, 0.0, -0.15], [0.1, 0.1, -0.05]])
    robots.q[:, X], robots.q[:, Y], robots.q[:, Z] = (-1.0, 1.0), (1.0, -2.0), (0.4, 0.3)
    np.testing.assert_allclose(robots.observe()[:, 2], [0.4 - 0.075, 0.3 + 0.075], atol=1e-6)


def correlation(a, b):
    """Return the correlation of two arrays of scaled noise (mean 0, variance 0.5161)."""
    return np.mean(a * b) / 0.5161


def test_noise_is_clamped_at_one_standard_deviation_and_independent():
    robots, clean = Robots(VERTICAL, 4096), Robots(VERTICAL).observe()[0]
    raw = np.array([robots.observe(noise=True) - clean for _ in range(4)])  # (steps, worlds, columns)
    assert not raw[..., SCALES == 0.0].any()  # commanded height, command and last actions have no noise
    scaled = raw[..., SCALES > 0.0] / SCALES[SCALES > 0.0]
    assert np.abs(scaled).max() <= 1.0 + 1e-4
    # 31.7 % of a Gaussian lie beyond one sigma; clamped, its variance is 0.5161; bounds: 4 standard errors
    cells = scaled.shape[0] * scaled.shape[1]
    assert np.mean(np.abs(scaled) > 0.9999, axis=(0, 1)) == pytest.approx(0.3173, abs=4.0 * 0.466 / math.sqrt(cells))
    assert scaled.std(axis=(0, 1)) == pytest.approx(math.sqrt(0.5161), abs=4.0 * 0.4 / math.sqrt(cells))
    assert scaled.mean(axis=(0, 1)) == pytest.approx(0.0, abs=4.0 * 0.7184 / math.sqrt(cells))
    matrix = np.corrcoef(scaled.reshape(-1, scaled.shape[2]).T) - np.eye(scaled.shape[2])
    assert np.abs(matrix).max() < 5.0 / math.sqrt(4 * 4096)
    bound = 5.0 / math.sqrt(3 * 4096 * 33)
    assert abs(correlation(scaled[:, 1:], scaled[:, :-1])) < bound  # neighbouring worlds
    for shift in (1, 2, 3):
        assert abs(correlation(scaled[shift:], scaled[:-shift])) < 5.0 / math.sqrt((4 - shift) * 4096 * 33)
        # a step does not repeat another column of the previous step
        assert abs(correlation(scaled[1:, :, shift:], scaled[:-1, :, :-shift])) < bound


@pytest.mark.parametrize("steps", [4, 5])  # before and after the command
def test_noise_of_a_horizontal_goal_is_that_of_the_height(steps):
    robots = Robots(HORIZONTAL, 4096)
    robots.tasks = [make_episode(goal=(0.6, 0.2, 0.0), command_step=5, steps=steps)] * 4096
    clean = robots.observe()
    noise = (robots.observe(noise=True) - clean)[:, :3] / 0.005  # [m]
    assert np.abs(noise).max() <= 1.0 + 1e-3
    assert noise.std(axis=0) == pytest.approx(math.sqrt(0.5161), abs=4.0 * 0.283 / 64.0)


def test_noise_of_the_papers_task_is_gaussian_with_table_vi_as_standard_deviations():
    robots, n = Robots(make_task("vertical-jump-paper"), 4096), 4096
    noise = robots.observe(noise=True) - robots.observe()
    assert not noise[:, :3].any() and not noise[:, 36:].any()  # commanded height, command, height; last actions
    scaled = noise[:, 3:36] / SCALES[3:36]  # Table VI: velocities, gravity's direction, joint positions, velocities
    assert scaled.std(axis=0) == pytest.approx(1.0, abs=4.0 / math.sqrt(2.0 * n))
    beyond = np.mean(np.abs(scaled) > 2.0)  # 4.55 % of a Gaussian
    assert beyond == pytest.approx(0.0455, abs=4.0 * math.sqrt(0.0455 / (33 * n)))


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
    robots.qd[:, LIN_VEL] = world.apply(rng.normal(size=(N, 3)))
    robots.qd[:, ANG_VEL] = world.apply(rng.normal(size=(N, 3)))
    robots.qd[:, 6:] = rng.normal(size=(N, 32))
    robots.com = rng.uniform(-0.05, 0.05, 3)
    robots.action, robots.offset = rng.uniform(-1.0, 1.0, (12, N)), rng.uniform(-0.03, 0.03, (12, N))
    robots.force = 200.0 * rng.normal(size=(4, N, 3))
    goals = world.apply(np.concatenate([rng.uniform(-2.0, 2.0, (N, 2)), rng.uniform(0.0, 1.0, (N, 1))], axis=1))
    robots.tasks = [
        make_episode(goal=goal, heading=turn, phase=int(rng.integers(3)), phase_steps=int(rng.integers(200)), steps=200,
                     max_height=float(rng.uniform(0.3, 1.0))) for goal in goals
    ]  # fmt: skip
    return robots


@pytest.mark.parametrize("turn", [0.3, 137.0 * DEG, math.pi, -2.0])
def test_observations_do_not_change_if_robot_and_goal_turn_about_the_vertical(turn):
    unturned, turned = random_robots(HORIZONTAL).both(), random_robots(HORIZONTAL, turn).both()
    for group, turned_group in zip(unturned, turned, strict=True):
        np.testing.assert_allclose(group, turned_group, atol=2e-5)
    assert np.abs(unturned[0][:, :2]).max() > 1.0  # [m] goals


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
    arrays, last = robots.skill.observations, N * (ROBOT + ROBOT + EPISODE)
    assert arrays.now.shape[0] == last
    arrays.now = array(np.full(last + 7, 7.0))
    robots.both()
    np.testing.assert_array_equal(arrays.now.numpy() == 7.0, np.arange(last + 7) >= last)


def test_the_critic_gets_the_environments_randomised_parameters():
    task, starts = make_task("horizontal-jump"), only("default")
    env = make_env(256, task=task, reset=starts, randomize=True, noise=True, seed=8)
    model, motors = env.sim.model, env.sim.motors
    nominal_env = make_env(1, task=task, reset=starts)
    nominal = nominal_env.sim
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
    observed = env.critic_obs[:, DRAWN].numpy()
    np.testing.assert_allclose(observed, np.concatenate(columns, axis=1), atol=1e-4)
    assert np.abs(observed).max() < 3.0 and (np.abs(observed).max(axis=0) > 0.04).all()
    assert not nominal_env.critic_obs[:, DRAWN].any()


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
    np.testing.assert_array_equal(make_env(2, task=task).obs[:, -BLOCK:], np.tile([2.0] * 6 + [0.0], (2, 1)))  # none
    edit_episodes(env, level=7)  # far goals, most with room for a block
    env.reset()
    blocks = env.sim.dynamics.robot.ground.blocks.numpy()
    exists = blocks["exists"] == 1
    assert 40 < exists.sum() < 216
    observed = env.obs[:, -BLOCK:].numpy()
    np.testing.assert_array_equal(env.critic_obs[:, ROBOT : ROBOT + BLOCK], observed)
    q = env.sim.joint_q()
    yaw = np.arctan2(*Rotation.from_quat(q[:, QUAT]).apply([1.0, 0.0, 0.0])[:, 1::-1].T)
    for world in range(256):
        for ray, aside in enumerate((0.2, 0.0, -0.2)):  # [m] distance to the left of the base
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


@pytest.mark.parametrize("task", [HORIZONTAL, VERTICAL], ids=["horizontal", "vertical"])
@pytest.mark.parametrize(
    ("plane", "flip", "legs"),  # signs of vectors; FL, FR, BL, BR swapped
    [("left-right", [1.0, -1.0, 1.0], [1, 0, 3, 2]), ("front-back", [-1.0, 1.0, 1.0], [2, 3, 0, 1])],
)
def test_observations_of_a_mirrored_robot_are_the_mirror_image(task, plane, flip, legs):
    robots = random_robots(task)
    first = robots.both()
    flip = np.array(flip)
    spin = -flip  # of angular velocities
    joints = [5 * leg + j for leg in legs for j in range(5)]
    motors = [3 * leg + j for leg in legs for j in range(3)]
    robots.q[:, POS] *= flip
    robots.q[:, QUAT] *= [*spin, 1.0]
    robots.q[:, 7:27] = robots.q[:, 7:27][:, joints]
    robots.qd[:, LIN_VEL] *= flip
    robots.qd[:, ANG_VEL] *= spin
    robots.qd[:, 6:26] = robots.qd[:, 6:26][:, joints]
    robots.com = robots.com * flip
    robots.action, robots.offset = robots.action[motors], robots.offset[motors]
    robots.force = robots.force[legs] * flip
    for episode in robots.tasks:
        episode.goal = wp.cw_mul(episode.goal, wp.vec3(*flip))
    second, observed_task = robots.both(), robots.skill.task
    groups = ("actor", "critic") if plane == "left-right" else ("actor",)  # of critics only this image is known
    for group, original, mirrored in zip(groups, first, second, strict=False):
        mirror = mirror_of(observed_task, group, plane)
        np.testing.assert_allclose(mirrored, mirror.signs * original[:, mirror.order], atol=1e-5)
        assert np.abs(mirrored - original).max() > 0.5
