import dataclasses

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from columns import MOTOR_COORDS, POS, XY, Z
from jump_helpers import DEFAULT_ANGLE, begin_by, edit_episodes, episodes_of, make_env, only, resets_of, resetting
from jump_starts import PAW_RADIUS, PLACES, Starts, collision_flags, covers
from jumper_warp.kernels.jump.state import STANCE
from jumper_warp.registry import make_task
from jumper_warp.tasks.jump.cfg import GroundCfg, Level
from jumper_warp.tasks.randomization import RandomizationCfg
from simulation_helpers import paw_centres

N = 8192
PAWS = np.array([0.24, 0.22])  # [m] largest distance of a paw from the base, ahead (default pose) and lateral (squats)
MARGIN, ROOM, CLEARANCE = 0.05, 0.30, 0.12  # [m] MIN_EDGE_DISTANCE, and `GroundCfg` of the tasks, as the next line
DROP, RISE, MASS, FRICTION = (0.03, 0.20), (0.02, 0.08), (5.0, 100.0), (0.3, 1.0)  # [m], [m], [kg], [1]
KINDS = {"platform": GroundCfg(platform=1.0), "block": GroundCfg(block=1.0)}
WIDE = tuple(Level((-1.5, -1.5, 0.0), (1.5, 1.5, 0.0), height) for height in ((0.22, 0.35), (0.30, 0.45)))
"""Levels with goals in all directions, most of them far enough for an edge of a block before the goal."""
FAR = (Level((1.8, -0.2, 0.0), (2.2, 0.2, 0.0), (0.22, 0.35)),)
"""Level with goals far enough for an edge of a block before the goal, at any heading."""


def half_extents(heading):
    """Return the half extents [m] along world x and y, (worlds, 2), of the paws' rectangle turned by heading [rad]."""
    corners = PAWS * [[1, 1], [1, -1], [-1, 1], [-1, -1]]
    c, s = np.cos(heading), np.sin(heading)
    turn = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    return np.abs(np.einsum("wij,cj->wci", turn, corners)).max(axis=1)


def block_fields(env):
    """Return the fields of all blocks as arrays (num_envs, ...) by name."""
    values = env._scene.ground.blocks.numpy()
    return {name: values[name].astype(float) for name in values.dtype.names}


class Scenes(Starts):
    """`Starts` of one mode on one kind of ground (key of KINDS), with the blocks (a platform is one too)."""

    def __init__(self, env, kind, start_mode):
        super().__init__(env, start_mode, ground=KINDS[kind])
        self.block = {name: values[self.drawn] for name, values in block_fields(env).items()}
        self.foot = half_extents(self.episodes["heading"])  # [m] (worlds, 2)
        self.has_block = self.block["exists"] == 1
        rows = np.arange(len(self.goal))
        self.across = np.argmax(np.abs(self.goal[:, XY]), axis=1)  # axis (0 x, 1 y) that a block's near side crosses
        self.way, self.reach = np.abs(self.goal[rows, self.across]), self.foot[rows, self.across]  # [m] along it

    def block_field(self, name):
        """Return a field of the blocks that exist."""
        return self.block[name][self.has_block]


def sampled_ground_env(name, count, ground, seed=2, reset=None, **changes):
    """Return a reset environment with sampled ground (a `GroundCfg`), without other randomisation."""
    task = dataclasses.replace(make_task(name), randomization=RandomizationCfg.off(), **changes)
    reset = dataclasses.replace(reset or task.reset.settings, ground=ground)
    return make_env(count, task=resetting(task, reset), seed=seed, randomize=True)


@pytest.fixture(scope="module", params=PLACES)
def env(request):
    """Return each task's environment, which draws a platform, a block or level ground at a reset."""
    levels = {"levels": WIDE} if request.param == "horizontal-jump-standing" else {}
    return sampled_ground_env(request.param, N, GroundCfg(platform=0.5, block=0.5), **levels)


@pytest.fixture(scope="module")
def scenes(env):
    """Return the `Scenes` of every (kind, start mode)."""
    return {
        (kind, start_mode): Scenes(env, kind, start_mode) for kind in KINDS for start_mode in ("standing", "default")
    }


@pytest.fixture(params=["standing", "default"])
def platform_starts(scenes, request):
    """Return the `Scenes` with platforms under the robots, in both start modes."""
    return scenes["platform", request.param]


@pytest.fixture(params=["standing", "default"])
def block_starts(scenes, request):
    """Return the `Scenes` with blocks ahead of the robots, in both start modes."""
    return scenes["block", request.param]


def test_all_paws_stand_on_the_platform_away_from_its_edges(platform_starts):
    has_block = platform_starts.has_block
    paws, height = platform_starts.some_paws(has_block, 1000), platform_starts.block_field("height")
    assert has_block.sum() > 500 and covers(height, *DROP)
    np.testing.assert_allclose(paws[..., Z], height[: len(paws), None] + PAW_RADIUS + np.zeros(4), atol=2e-4)
    inside = platform_starts.block_field("half")[: len(paws), None] - np.abs(paws[..., XY])
    assert inside.min() >= MARGIN - 2e-4
    np.testing.assert_allclose(platform_starts.some_paws(~has_block, 300)[..., 2], PAW_RADIUS, atol=2e-4)


def test_platforms_are_at_rest_at_the_origin_with_independent_uniform_extents(platform_starts):
    beyond = platform_starts.block_field("half") - platform_starts.foot[platform_starts.has_block]
    assert covers(beyond[:, 0], MARGIN, ROOM) and covers(beyond[:, 1], MARGIN, ROOM)
    assert np.abs(np.corrcoef(beyond.T)[0, 1]) < 0.2
    assert not platform_starts.block_field("center").any() and not platform_starts.block_field("start").any()
    assert not platform_starts.block_field("velocity").any()


def test_base_height_above_a_platform_is_that_of_the_level_or_the_default_pose(env, scenes):
    sample = scenes["platform", "standing"]
    above, counts = sample.pos[:, Z] - np.where(sample.has_block, sample.block["height"], 0.0), []
    for number, level in enumerate(env.task.levels):
        chosen = sample.has_block & (sample.level == number)
        counts.append(chosen.sum())
        assert counts[-1] == 0 or covers(above[chosen], *level.base_height, 6.0 / counts[-1])
    assert max(counts) > 300, counts
    sample = scenes["platform", "default"]
    above = sample.pos[:, Z] - np.where(sample.has_block, sample.block["height"], 0.0)
    np.testing.assert_allclose(above, env.sim.model.joint_q.numpy()[2], atol=1e-5)


def test_a_platform_exists_only_where_paws_land_clear_of_it(platform_starts):
    has_block = platform_starts.has_block
    apart = np.abs(platform_starts.goal[:, XY]) - 2.0 * platform_starts.foot  # [m] between paws at start and goal
    gap = (apart[has_block] - platform_starts.block_field("half") + platform_starts.foot[has_block]).max(axis=1)
    assert gap.min() >= CLEARANCE - 1e-4 and gap.min() < CLEARANCE + 0.02
    widest = apart.max(axis=1) - MARGIN  # [m] gap to the smallest platform
    assert not has_block[widest < CLEARANCE - 1e-4].any()
    assert has_block[widest > CLEARANCE + ROOM - MARGIN + 1e-4].all()
    assert 0.1 < has_block.mean() < 0.9


def test_a_block_extends_beyond_all_paws_at_the_goal_by_independent_distances(block_starts):
    has_block = block_starts.has_block
    outermost = np.abs(block_starts.goal[has_block, :2] - block_starts.block_field("center"))
    inside = block_starts.block_field("half") - outermost - block_starts.foot[has_block]  # [m] paws from the edges
    assert has_block.sum() > 500 and inside.min() >= MARGIN - 1e-4
    rows = np.arange(has_block.sum())
    lateral = inside[rows, 1 - block_starts.across[has_block]]
    assert covers(lateral, MARGIN, ROOM)
    far = np.abs(block_starts.block_field("center")) + block_starts.block_field("half")
    behind = far[rows, block_starts.across[has_block]] - block_starts.way[has_block] - block_starts.reach[has_block]
    assert covers(behind, MARGIN, ROOM) and np.abs(np.corrcoef(behind, lateral)[0, 1]) < 0.2


def test_robots_stand_on_the_floor_outside_the_block(block_starts):
    has_block = block_starts.has_block
    paws, others = block_starts.some_paws(has_block, 1000), block_starts.some_paws(~has_block, 300)
    np.testing.assert_allclose(np.concatenate([paws, others])[..., Z], PAW_RADIUS, atol=2e-4)
    center, half = (block_starts.block_field(name)[: len(paws), None] for name in ("center", "half"))
    outside = (np.abs(paws[..., XY] - center) - half).max(axis=2)  # [m] from the block
    assert outside.min() >= MARGIN - 2e-4


def test_square_root_of_the_near_sides_position_between_the_paws_is_uniform(block_starts):
    has_block, rows = block_starts.has_block, np.arange(block_starts.has_block.sum())
    axis = block_starts.across[has_block]
    sign = np.sign(block_starts.goal[has_block][rows, axis])
    near = sign * block_starts.block_field("center")[rows, axis] - block_starts.block_field("half")[rows, axis]
    first = block_starts.reach[has_block] + MARGIN
    last = block_starts.way[has_block] - block_starts.reach[has_block] - CLEARANCE
    assert (near >= first - 1e-4).all() and (near <= last + 1e-4).all()
    wide = last - first > 0.05  # [m]
    fraction = ((near - first) / (last - first))[wide]
    assert kstest(np.sqrt(fraction.clip(0.0)), "uniform").pvalue > 1e-3
    assert set(axis) == {0, 1} and set(sign) == {-1.0, 1.0}


def test_a_block_exists_exactly_where_its_near_side_fits(block_starts):
    room = block_starts.way - 2.0 * block_starts.reach - MARGIN - CLEARANCE
    assert block_starts.has_block[room > 1e-4].all() and not block_starts.has_block[room < -1e-4].any()
    assert 0.1 < block_starts.has_block.mean() < 0.9


def test_blocks_start_at_rest_with_uniform_heights_masses_and_frictions(block_starts):
    for name, (lower, upper) in (("height", RISE), ("mass", MASS), ("friction", FRICTION)):
        fraction = (block_starts.block_field(name) - lower) / (upper - lower)
        assert fraction.min() >= -1e-5 and fraction.max() <= 1.0 + 1e-5
        assert kstest(fraction, "uniform").pvalue > 1e-3, name
    np.testing.assert_array_equal(block_starts.block_field("center"), block_starts.block_field("start"))
    assert not block_starts.block_field("velocity").any()


@pytest.mark.parametrize("kind", KINDS)
def test_no_start_collides_and_goal_ground_is_the_blocks_height_or_0_beside_a_platform(scenes, kind):
    for start_mode in ("standing", "default"):
        sample = scenes[kind, start_mode]
        assert not sample.flags.any() and sample.fallbacks < 0.005
        expected = np.where(sample.has_block & (kind == "block"), sample.block["height"], 0.0)
        np.testing.assert_allclose(sample.episodes["goal_ground"], expected, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("start_mode", ["in_flight", "touchdown", "after_landing"])
def test_starts_after_takeoff_have_no_block_even_after_an_episode_with_one(env, kind, start_mode):
    for start in ("default", start_mode):
        begin_by(env, only(start, resets_of(env), ground=KINDS[kind]))
        edit_episodes(env, level=len(env.task.levels) - 1)
        env.reset()
        assert block_fields(env)["exists"].any() == (start == "default")
    assert not episodes_of(env)["goal_ground"].any() and not collision_flags(env).any()


def test_kinds_of_ground_are_sampled_with_their_probabilities():
    env = sampled_ground_env(
        "horizontal-jump", N, GroundCfg(platform=0.3, block=0.45), levels=FAR, reset=only("default")
    )
    block = block_fields(env)
    platform = (block["exists"] == 1) & (block["mass"] > 1.0e5)  # [kg] of a fixed block
    sliding = (block["exists"] == 1) & (block["mass"] < 1.0e3)
    sample = np.array([platform.mean(), sliding.mean(), 1.0 - block["exists"].mean()])
    expected = np.array([0.3, 0.45, 0.25])
    assert np.abs(sample - expected).max() < 4.0 * np.sqrt(0.25 / N)


def test_only_worlds_with_a_new_episode_sample_new_ground():
    env = sampled_ground_env("horizontal-jump", 64, KINDS["block"], levels=FAR, reset=only("default"))
    first = block_fields(env)
    edit_episodes(env, [3, 5], steps=5000)  # beyond the time limit
    env.step(torch.zeros((64, 12)))
    assert env.done.nonzero().ravel().tolist() == [3, 5]
    second = block_fields(env)
    changed = (first["mass"] != second["mass"]) | (first["half"] != second["half"]).any(axis=1)
    assert changed.nonzero()[0].tolist() == [3, 5]


def hold(env, steps=20):
    """Command the present motor angles for `steps` policy steps; fail if an episode ends or a world diverges."""
    angles = env.sim.joint_q()[:, MOTOR_COORDS]
    scale = np.radians(np.tile([15.0, 90.0, 90.0], 4))  # action scale of the task
    action = torch.from_numpy((angles - DEFAULT_ANGLE) / scale).float()
    for _ in range(steps):
        env.step(action)
        assert not env.done.any() and not env.robot.diverged.numpy().any()
    env.sim.write_bodies()


@pytest.mark.parametrize("start_mode", ["standing", "default"])
def test_robots_and_platforms_stay_at_rest(start_mode):
    env = sampled_ground_env(
        "horizontal-jump", 64, KINDS["platform"], levels=FAR, reset=only(start_mode, heading=180.0)
    )
    edit_episodes(env, command_step=1000)  # later than the test's steps
    block, before = block_fields(env), env.sim.joint_q()
    assert block["exists"].all()
    hold(env)
    np.testing.assert_allclose(
        paw_centres(env.sim)[..., Z], block["height"][:, None] + PAW_RADIUS + np.zeros(4), atol=2e-3
    )
    assert np.abs(env.sim.joint_q()[:, POS] - before[:, :3]).max() < 0.06
    assert np.abs(env.sim.solver.block_position()).max() < 1e-6
    assert (env.task_arrays()["phase"] == STANCE).all()
    observed_height = env.obs[:, 2]
    np.testing.assert_allclose(observed_height, env.sim.joint_q()[:, Z] - block["height"], atol=1e-5)
