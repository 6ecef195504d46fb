import numpy as np
import pytest
import warp as wp

from collision_kernels import make_collision_kernel
from jumper_warp.envs.skill import TaskRuntime
from jumper_warp.kernels.mdp.env import SkillSettings
from jumper_warp.kernels.mdp.track import track_kernel
from jumper_warp.kernels.mdp.view import RobotArrays, load_view
from jumper_warp.kernels.terrain.ground import Ground
from jumper_warp.registry import make_task
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.sim.simulation import Simulation
from mdp_helpers import STEP_DT, array, new_worlds, standing_robots, write
from solver_helpers import BODIES, Reference, random_states

N = 64


def skill_settings(force, self_collision_margin=0.0, obstacle_margin=0.0):
    """Return one `SkillSettings` per contact force threshold in `force` [N]; margins [m]."""
    settings = []
    for threshold in np.atleast_1d(force):
        skill = TaskRuntime(make_task("vertical-jump"), 0, 1, STEP_DT, 8, "cpu").settings_of_skill()
        skill.contact_force, skill.self_collision_margin = float(threshold), self_collision_margin
        skill.obstacle_margin = obstacle_margin
        settings.append(skill)
    return wp.array(settings, dtype=SkillSettings, device="cpu")


@pytest.fixture(scope="module")
def sim():
    """Return a simulation for the robot's geometry, flat ground and model."""
    return Simulation(N, visuals=False, device="cpu")


@pytest.fixture
def robots(sim):
    """Return the arrays of N robots at rest without contacts."""
    return standing_robots(N)


def track(robot, sim, ground=None, settings=None, worlds=None):
    """Launch `track_kernel` on all robots; by default on the simulation's ground, contact above 0.1 N."""
    n, model = robot.diverged.shape[0], sim.dynamics.robot
    settings = skill_settings(0.1) if settings is None else settings
    inputs = [model.geometry, model.ground if ground is None else ground, settings, worlds or new_worlds(n), robot]
    wp.launch(track_kernel, (4, n), inputs, device="cpu")


def test_paw_positions_and_velocities_equal_pinocchios(sim, robots):
    states, reference = random_states(N, seed=1), Reference(sim.model)
    robots.joint_q, robots.joint_qd = array(states.joint_q()), array(states.joint_qd())
    robots.body_com = sim.model.body_com
    assert np.abs(robots.body_com.numpy()[:: int(BODIES)]).max() > 1e-3
    track(robots, sim)
    place, speed = robots.paw_pos.numpy().swapaxes(0, 1), robots.paw_vel.numpy().swapaxes(0, 1)
    for i in range(N):
        q, v = reference.state(states, i)
        np.testing.assert_allclose(place[i], reference.robot.paw_positions(q), atol=2e-5)  # [m]
        np.testing.assert_allclose(speed[i], reference.robot.paw_velocities(q, v), atol=2e-3)  # [m/s]
    assert np.abs(speed).max() > 3.0


@wp.kernel(enable_backward=False)
def seen_kernel(
    arrays: RobotArrays, ground: Ground, contact: wp.array(dtype=wp.vec4), first: wp.array(dtype=wp.vec4),
    contacts: wp.array(dtype=int), collisions: wp.array(dtype=int),
):  # fmt: skip
    """Write contacts and collision flags of each robot's `RobotView`."""
    world = wp.tid()
    view = load_view(arrays, ground, world)
    contact[world] = view.contact
    first[world] = view.first_contact
    contacts[world] = view.contacts
    collisions[world] = view.collisions


def paw_view(robot, sim):
    """Return contact (n, 4), first contact (n, 4), number of contacts (n,) and collisions (n,) of the `RobotView`s."""
    n, ground = robot.diverged.shape[0], sim.dynamics.robot.ground
    arrays = [wp.zeros(n, dtype=kind, device="cpu") for kind in (wp.vec4, wp.vec4, int, int)]
    wp.launch(seen_kernel, n, [robot, ground, *arrays], device="cpu")
    return [values.numpy() for values in arrays]


def set_paw_forces(robot, down, force=50.0):
    """Write a slanted paw force of magnitude `force` [N] where down, (4,) or (4, n), is set, else 0."""
    forces = np.zeros((4, robot.diverged.shape[0], 3))
    forces += force * np.array([0.6, 0.0, 0.8]) * np.reshape(down, (4, -1))[:, :, None]
    robot.paw_force.assign(forces)


def test_times_and_first_contacts_follow_a_scripted_gait(sim, robots):
    """Paws are always down, always in the air, land twice, or bounce every step; tables are (leg, policy step)."""
    script = np.array([[1, 1, 1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0, 0, 0], [0, 0, 1, 1, 1, 0, 0, 1],
                       [0, 1, 0, 1, 0, 1, 0, 1]])  # fmt: skip
    contact_steps = [[1, 2, 3, 4, 5, 6, 7, 8], [0] * 8, [0, 0, 1, 2, 3, 0, 0, 1], [0, 1, 0, 1, 0, 1, 0, 1]]
    # at a first contact the time in the air stays, one step later it is 0
    air_steps = [[0] * 8, [1, 2, 3, 4, 5, 6, 7, 8], [1, 2, 2, 0, 0, 1, 2, 2], [1] * 8]
    first = [[0] * 8, [0] * 8, [0, 0, 1, 0, 0, 0, 0, 1], [0, 1, 0, 1, 0, 1, 0, 1]]
    for step in range(8):
        set_paw_forces(robots, script[:, step])
        track(robots, sim)
        for leg in range(4):
            time = robots.contact_time.numpy()[leg], robots.air_time.numpy()[leg]
            np.testing.assert_allclose(time[0], contact_steps[leg][step] * STEP_DT, rtol=1e-6, err_msg=f"{step} {leg}")
            np.testing.assert_allclose(time[1], air_steps[leg][step] * STEP_DT, rtol=1e-6, err_msg=f"{step} {leg}")
        contact, first_contact, number, _ = paw_view(robots, sim)
        np.testing.assert_array_equal(contact, np.tile(script[:, step], (N, 1)))
        np.testing.assert_array_equal(first_contact, np.tile([row[step] for row in first], (N, 1)))
        np.testing.assert_array_equal(number, script[:, step].sum())


def set_vertical_speed(robot, speed):
    """Write the upward speeds [m/s] of the bases, (n,) or one for all."""
    write(robot.joint_qd, slice(2, None, 38), speed)


def test_touchdown_speed_is_that_of_the_previous_step_and_stays_until_the_next_touchdown(sim, robots):
    speed = np.linspace(-3.0, 1.0, N).astype(np.float32)
    set_vertical_speed(robots, speed)
    set_paw_forces(robots, [0, 0, 0, 1])
    track(robots, sim)
    assert not robots.touchdown_speed.numpy().any()
    set_vertical_speed(robots, 0.0)  # stopped by the ground within the step
    set_paw_forces(robots, [1, 0, 0, 1])
    track(robots, sim)
    landed = np.maximum(-speed, 0.0)
    np.testing.assert_allclose(robots.touchdown_speed.numpy()[0], landed, atol=1e-6)
    assert not robots.touchdown_speed.numpy()[1:].any()  # still in the air, or down from the start
    set_vertical_speed(robots, -9.0)
    for down in ([1, 0, 0, 1], [0, 0, 0, 1]):
        set_paw_forces(robots, down)
        track(robots, sim)
        np.testing.assert_allclose(robots.touchdown_speed.numpy()[0], landed, atol=1e-6)
    set_paw_forces(robots, [1, 0, 0, 1])
    track(robots, sim)
    np.testing.assert_allclose(robots.touchdown_speed.numpy()[0], 9.0, atol=1e-5)


def test_a_paw_is_in_contact_above_the_force_threshold_of_its_worlds_skill(sim, robots):
    worlds = new_worlds(N, skill=np.arange(N) % 2)
    forces = np.linspace(0.5, 5.5, N)
    robots.paw_force.assign(np.tile(forces[:, None] * [0.0, 0.6, 0.8], (4, 1, 1)))
    track(robots, sim, settings=skill_settings([1.0, 4.0]), worlds=worlds)
    down = forces > np.where(np.arange(N) % 2 == 0, 1.0, 4.0)
    np.testing.assert_array_equal(robots.contact_time.numpy() > 0.0, np.tile(down, (4, 1)))


def hilly_ground():
    """Return a heightfield of random hills, 4 m by 4 m, up to 0.15 m high."""
    ground = Ground()
    ground.heights = array(np.random.default_rng(3).uniform(0.0, 0.15, (13, 17)))
    ground.rows, ground.cols, ground.half_x, ground.half_y = 13, 17, 2.0, 2.0
    return ground


@pytest.fixture(scope="module")
def poses():
    """Return joint_q of 4000 robots in random attitudes near the ground, motor angles over their whole ranges."""
    states = random_states(4000, seed=5)
    rng = np.random.default_rng(6)
    states.pos = rng.uniform([-1.5, -1.5, 0.05], [1.5, 1.5, 0.9], (4000, 3))
    states.angles = states.angles + np.where(rng.random((4000, 1)) < 0.5, 0.4, 1.2) * rng.normal(size=(4000, 12))
    return array(states.joint_q())


def blocks(n, margin=0.0):
    """Return a random block for each of n worlds, wider on every side and higher by a margin [m]; deterministic."""
    few = Simulation(8, block=BlockCfg((0.3, -0.2)), visuals=False, device="cpu").dynamics.robot.ground
    records = np.tile(few.blocks.numpy(), n // 8)
    records["center"] = np.random.default_rng(8).uniform(-0.6, 0.6, (n, 2))
    records["height"] = np.random.default_rng(9).uniform(0.05, 0.4, n) + margin
    records["half"] += margin
    return wp.array(records, dtype=few.blocks.dtype, device="cpu")


@pytest.mark.parametrize("kind", ["plane", "hills", "block", "hills and blocks"])
def test_collision_flags_of_all_legs_combined_equal_those_of_the_whole_robot(sim, poses, kind):
    n = 4000
    ground = hilly_ground() if "hills" in kind else Ground()
    if ground.rows == 0:
        ground.heights = array(np.zeros((1, 1)))
    if "block" in kind:
        ground.blocks = blocks(n)
    robot = standing_robots(n)
    robot.joint_q = poses
    track(robot, sim, ground=ground)
    flags, clearance = (wp.zeros(n, dtype=dtype, device="cpu") for dtype in (int, float))
    geometry = sim.dynamics.robot.geometry
    wp.launch(make_collision_kernel(), n, [geometry, ground, poses, 43, 0.0], [flags, clearance], device="cpu")
    by_leg, expected = robot.collisions.numpy(), flags.numpy()
    np.testing.assert_array_equal(np.bitwise_or.reduce(by_leg, axis=0), expected)
    np.testing.assert_array_equal(paw_view(robot, sim)[3], expected)
    for bit in range(8):  # every kind of collision occurs, but not in all poses
        assert 0.005 < np.mean(expected & (1 << bit) != 0) < 0.995, bit
    assert 0.05 < np.mean(expected == 0) < 0.95 or "block" in kind
    assert (np.count_nonzero(by_leg, axis=0) < 4).mean() > 0.2  # legs differ


def test_links_closer_than_self_collision_margin_count_as_touching(sim, poses):
    n, margin = 4000, 0.02
    high = poses.numpy().copy().reshape(n, -1)
    high[:, 2] += 10.0  # nothing is near the ground
    robot = standing_robots(n)
    robot.joint_q = array(high.ravel())
    track(robot, sim, settings=skill_settings(0.1, margin))
    flags, clearance = (wp.zeros(n, dtype=dtype, device="cpu") for dtype in (int, float))
    model = sim.dynamics.robot
    inputs = [model.geometry, model.ground, robot.joint_q, 43, 2.0 * margin]
    wp.launch(make_collision_kernel(), n, inputs, [flags, clearance], device="cpu")
    near, far = clearance.numpy() < margin - 1e-5, clearance.numpy() > margin + 1e-5
    collides = np.bitwise_or.reduce(robot.collisions.numpy(), axis=0) != 0
    assert collides[near].all() and not collides[far].any()
    assert (near & (flags.numpy() == 0)).sum() > 20  # poses that collide only because of the margin


def test_obstacle_margin_enlarges_blocks_for_collisions_but_not_for_paw_heights(sim, poses):
    n, margin = 4000, 0.03  # robots, [m]
    results = []
    for block_margin, obstacle_margin in ((0.0, margin), (margin, 0.0), (0.0, 0.0)):
        ground, robot = hilly_ground(), standing_robots(n)
        ground.blocks, robot.joint_q = blocks(n, block_margin), poses
        track(robot, sim, ground=ground, settings=skill_settings(0.1, obstacle_margin=obstacle_margin))
        results.append((robot.collisions.numpy().copy(), robot.paw_height.numpy().copy()))
    (flags, heights), (flags_of_large_blocks, _), (plain_flags, plain_heights) = results
    np.testing.assert_array_equal(flags, flags_of_large_blocks)
    assert (flags & plain_flags == plain_flags).all() and (flags != plain_flags).any(axis=0).sum() > 20
    np.testing.assert_array_equal(heights, plain_heights)
