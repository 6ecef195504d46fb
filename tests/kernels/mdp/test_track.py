import numpy as np
import pinocchio as pin
import pytest
import warp as wp

from jump_starts import ANKLE
from jumper_warp.envs.skill import TaskRuntime
from jumper_warp.kernels.collision.robot import collision_kernel
from jumper_warp.kernels.mdp.env import SkillSettings
from jumper_warp.kernels.mdp.track import track_kernel
from jumper_warp.kernels.mdp.view import RobotArrays, load_view
from jumper_warp.kernels.terrain.ground import Ground
from jumper_warp.registry import make_task
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.sim.simulation import Simulation
from mdp_helpers import STEP_DT, array, new_worlds, standing_robots, write
from solver_helpers import BODIES, Reference, paw_joint, random_states

N = 64
WEIGHT = 142.0  # [N]


def contact_force(force, self_collision_margin=0.0, obstacle_margin=0.0):
    """Return the settings of skills with a least contact force [N] each."""
    settings = []
    for least in np.atleast_1d(force):
        found = TaskRuntime(make_task("vertical-jump"), 0, 1, STEP_DT, 8, "cpu").settings_of_skill()
        found.contact_force, found.self_collision_margin, found.obstacle_margin = (
            float(least),
            self_collision_margin,
            obstacle_margin,
        )
        settings.append(found)
    return wp.array(settings, dtype=SkillSettings, device="cpu")


@pytest.fixture(scope="module")
def sim():
    return Simulation(N, visuals=False, device="cpu")


@pytest.fixture
def robots(sim):
    """Robots at rest whose paws touch nothing yet."""
    return standing_robots(N)


def track(robot, sim, ground=None, settings=None, worlds=None):
    """Launch the stage on some robots."""
    n, made = robot.diverged.shape[0], sim.physics.dynamics.robot
    settings = contact_force(0.1) if settings is None else settings
    inputs = [made.geometry, made.ground if ground is None else ground, settings, worlds or new_worlds(n), robot]
    wp.launch(track_kernel, (4, n), inputs, device="cpu")


def test_paws_are_where_pinocchio_puts_them_and_move_alike(sim, robots):
    states, reference = random_states(N, seed=1), Reference(sim.model)
    robots.joint_q, robots.joint_qd = array(states.joint_q()), array(states.joint_qd())
    robots.body_com = sim.model.body_com
    assert np.abs(robots.body_com.numpy()[:: int(BODIES)]).max() > 1e-3
    track(robots, sim)
    place, speed = robots.paw_pos.numpy().swapaxes(0, 1), robots.paw_vel.numpy().swapaxes(0, 1)
    model, data = reference.robot.model, reference.robot.data
    for i in range(N):
        pin.forwardKinematics(model, data, *reference.state(states, i))
        for leg in range(4):
            joint = paw_joint(reference, leg)
            twist = data.v[joint]
            velocity = data.oMi[joint].rotation @ (twist.linear + np.cross(twist.angular, ANKLE))
            np.testing.assert_allclose(place[i, leg], data.oMi[joint].act(ANKLE), atol=2e-5)
            np.testing.assert_allclose(speed[i, leg], velocity, atol=2e-3)
    assert np.abs(speed).max() > 3.0


@wp.kernel(enable_backward=False)
def seen_kernel(
    arrays: RobotArrays, ground: Ground, contact: wp.array(dtype=wp.vec4), first: wp.array(dtype=wp.vec4),
    contacts: wp.array(dtype=int), collisions: wp.array(dtype=int),
):  # fmt: skip
    """Read what rewards see of the paws."""
    world = wp.tid()
    view = load_view(arrays, ground, world)
    contact[world] = view.contact
    first[world] = view.first_contact
    contacts[world] = view.contacts
    collisions[world] = view.collisions


def seen(robot, sim):
    """Return which paws are down, which came down in this step, their number, and the collision flags."""
    n, ground = robot.diverged.shape[0], sim.physics.dynamics.robot.ground
    arrays = [wp.zeros(n, dtype=kind, device="cpu") for kind in (wp.vec4, wp.vec4, int, int)]
    wp.launch(seen_kernel, n, [robot, ground, *arrays], device="cpu")
    return [values.numpy() for values in arrays]


def push_paws(robot, down, force=50.0):
    """Press some paws, (4,) or (4, n) bool, with a force in any direction [N]."""
    forces = np.zeros((4, robot.diverged.shape[0], 3))
    forces += force * np.array([0.6, 0.0, 0.8]) * np.reshape(down, (4, -1))[:, :, None]
    robot.paw_force.assign(forces)


def test_times_and_first_contacts_follow_a_scripted_gait(sim, robots):
    """One paw down from the start, one in the air all along, one that lands twice, one that bounces every step."""
    script = np.array([[1, 1, 1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0, 0, 0], [0, 0, 1, 1, 1, 0, 0, 1],
                       [0, 1, 0, 1, 0, 1, 0, 1]])  # fmt: skip
    contact_steps = [[1, 2, 3, 4, 5, 6, 7, 8], [0] * 8, [0, 0, 1, 2, 3, 0, 0, 1], [0, 1, 0, 1, 0, 1, 0, 1]]
    # at a first contact the time in the air stays, one step later it is 0
    air_steps = [[0] * 8, [1, 2, 3, 4, 5, 6, 7, 8], [1, 2, 2, 0, 0, 1, 2, 2], [1] * 8]
    first = [[0] * 8, [0] * 8, [0, 0, 1, 0, 0, 0, 0, 1], [0, 1, 0, 1, 0, 1, 0, 1]]
    for step in range(8):
        push_paws(robots, script[:, step])
        track(robots, sim)
        for leg in range(4):
            time = robots.contact_time.numpy()[leg], robots.air_time.numpy()[leg]
            np.testing.assert_allclose(time[0], contact_steps[leg][step] * STEP_DT, rtol=1e-6, err_msg=f"{step} {leg}")
            np.testing.assert_allclose(time[1], air_steps[leg][step] * STEP_DT, rtol=1e-6, err_msg=f"{step} {leg}")
        contact, came_down, number, _ = seen(robots, sim)
        np.testing.assert_array_equal(contact, np.tile(script[:, step], (N, 1)))
        np.testing.assert_array_equal(came_down, np.tile([row[step] for row in first], (N, 1)))
        np.testing.assert_array_equal(number, script[:, step].sum())


def fall(robot, speed):
    """Let the bases move along z with these speeds [m/s], (n,)."""
    write(robot.joint_qd, slice(2, None, 38), speed)


def test_the_touchdown_speed_is_that_of_the_step_before_and_stays(sim, robots):
    speed = np.linspace(-3.0, 1.0, N).astype(np.float32)
    fall(robots, speed)
    push_paws(robots, [0, 0, 0, 1])
    track(robots, sim)
    assert not robots.touchdown_speed.numpy().any()
    fall(robots, 0.0)  # stopped by the ground within the step
    push_paws(robots, [1, 0, 0, 1])
    track(robots, sim)
    landed = np.maximum(-speed, 0.0)
    np.testing.assert_allclose(robots.touchdown_speed.numpy()[0], landed, atol=1e-6)
    assert not robots.touchdown_speed.numpy()[1:].any()  # still in the air, or down from the start
    fall(robots, -9.0)
    for down in ([1, 0, 0, 1], [0, 0, 0, 1]):
        push_paws(robots, down)
        track(robots, sim)
        np.testing.assert_allclose(robots.touchdown_speed.numpy()[0], landed, atol=1e-6)
    push_paws(robots, [1, 0, 0, 1])
    track(robots, sim)
    np.testing.assert_allclose(robots.touchdown_speed.numpy()[0], 9.0, atol=1e-5)


def test_a_paw_is_down_above_the_force_of_its_worlds_skill(sim, robots):
    worlds = new_worlds(N, skill=np.arange(N) % 2)
    forces = np.linspace(0.5, 5.5, N)
    robots.paw_force.assign(np.tile(forces[:, None] * [0.0, 0.6, 0.8], (4, 1, 1)))
    track(robots, sim, settings=contact_force([1.0, 4.0]), worlds=worlds)
    down = forces > np.where(np.arange(N) % 2 == 0, 1.0, 4.0)
    np.testing.assert_array_equal(robots.contact_time.numpy() > 0.0, np.tile(down, (4, 1)))


def hills():
    """Return a heightfield of random hills, 4 m wide, up to 0.15 m high."""
    ground = Ground()
    ground.heights = array(np.random.default_rng(3).uniform(0.0, 0.15, (13, 17)))
    ground.rows, ground.cols, ground.half_x, ground.half_y = 13, 17, 2.0, 2.0
    return ground


@pytest.fixture(scope="module")
def poses():
    """Thousands of robots in any attitude near the ground, with legs all over their ranges."""
    states = random_states(4000, seed=5)
    rng = np.random.default_rng(6)
    states.pos = rng.uniform([-1.5, -1.5, 0.05], [1.5, 1.5, 0.9], (4000, 3))
    states.angles = states.angles + np.where(rng.random((4000, 1)) < 0.5, 0.4, 1.2) * rng.normal(size=(4000, 12))
    return array(states.joint_q())


def blocks(n, margin=0.0):
    """Return a block for each of n worlds, wider on every side and higher by a margin [m]."""
    few = Simulation(8, block=BlockCfg((0.3, -0.2)), visuals=False, device="cpu").physics.dynamics.robot.ground
    records = np.tile(few.blocks.numpy(), n // 8)
    records["center"] = np.random.default_rng(8).uniform(-0.6, 0.6, (n, 2))
    records["height"] = np.random.default_rng(9).uniform(0.05, 0.4, n) + margin
    records["half"] += margin
    return wp.array(records, dtype=few.blocks.dtype, device="cpu")


@pytest.mark.parametrize("kind", ["plane", "hills", "block", "hills and blocks"])
def test_the_flags_of_the_legs_together_are_those_of_the_robot(sim, poses, kind):
    n = 4000
    ground = hills() if "hills" in kind else Ground()
    if ground.rows == 0:
        ground.heights = array(np.zeros((1, 1)))
    if "block" in kind:
        ground.blocks = blocks(n)
    robot = standing_robots(n)
    robot.joint_q = poses
    track(robot, sim, ground=ground)
    flags, clearance = (wp.zeros(n, dtype=dtype, device="cpu") for dtype in (int, float))
    geometry = sim.physics.dynamics.robot.geometry
    wp.launch(collision_kernel, n, [geometry, ground, poses, 43, 0.0], [flags, clearance], device="cpu")
    by_leg, expected = robot.collisions.numpy(), flags.numpy()
    np.testing.assert_array_equal(np.bitwise_or.reduce(by_leg, axis=0), expected)
    np.testing.assert_array_equal(seen(robot, sim)[3], expected)
    for bit in range(8):  # every kind of contact is there, and is not everywhere
        share = np.mean(expected & (1 << bit) != 0)
        assert 0.005 < share < 0.995, bit
    assert 0.05 < np.mean(expected == 0) < 0.95 or "block" in kind
    assert (np.count_nonzero(by_leg, axis=0) < 4).mean() > 0.2  # legs differ


def test_links_closer_than_the_margin_count_as_touching(sim, poses):
    n, margin = 4000, 0.02
    high = poses.numpy().copy().reshape(n, -1)
    high[:, 2] += 10.0  # nothing is near the ground
    robot = standing_robots(n)
    robot.joint_q = array(high.ravel())
    track(robot, sim, settings=contact_force(0.1, margin))
    flags, clearance = (wp.zeros(n, dtype=dtype, device="cpu") for dtype in (int, float))
    made = sim.physics.dynamics.robot
    inputs = [made.geometry, made.ground, robot.joint_q, 43, 2.0 * margin]
    wp.launch(collision_kernel, n, inputs, [flags, clearance], device="cpu")
    near, far = clearance.numpy() < margin - 1e-5, clearance.numpy() > margin + 1e-5
    found = np.bitwise_or.reduce(robot.collisions.numpy(), axis=0) != 0
    assert found[near].all() and not found[far].any()
    assert (near & (flags.numpy() == 0)).sum() > 20  # the margin tells some that do not touch


def test_blocks_are_larger_by_their_margin_for_links_but_not_for_paws(sim, poses):
    n, margin = 4000, 0.03
    found = []
    for drawn, settings in ((0.0, margin), (margin, 0.0), (0.0, 0.0)):
        ground, robot = hills(), standing_robots(n)
        ground.blocks, robot.joint_q = blocks(n, drawn), poses
        track(robot, sim, ground=ground, settings=contact_force(0.1, obstacle_margin=settings))
        found.append((robot.collisions.numpy().copy(), robot.paw_height.numpy().copy()))
    (flags, heights), (grown, _), (json_value, level) = found
    np.testing.assert_array_equal(flags, grown)
    assert (flags & json_value == json_value).all() and (flags != json_value).any(axis=0).sum() > 20
    np.testing.assert_array_equal(heights, level)
