import dataclasses

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from jump_helpers import (
    DEFAULT_ANGLE,
    MOTOR_SLOTS,
    begin_by,
    edit_episodes,
    episodes_of,
    make_env,
    only,
    resets_of,
    resetting,
)
from jump_starts import PAW_RADIUS, PLACES, Starts, collision_flags, covers
from jumper_warp.kernels.jump.state import STANCE
from jumper_warp.registry import make_task
from jumper_warp.tasks.jump.cfg import GroundCfg, Level
from jumper_warp.tasks.randomization import RandomizationCfg
from simulation_helpers import WEIGHT, paw_centres, paw_forces

N = 8192
PAWS = np.array([0.24, 0.22])  # [m] ahead and beside, at most: the default pose reaches farther ahead, squats beside
MARGIN, ROOM, CLEARANCE = 0.05, 0.30, 0.12  # [m]
DROP, RISE, MASS, FRICTION = (0.03, 0.20), (0.02, 0.08), (5.0, 100.0), (0.3, 1.0)  # [m], [m], [kg], [1]
KINDS = {"platform": GroundCfg(platform=1.0), "block": GroundCfg(block=1.0)}
WIDE = tuple(Level((-1.5, -1.5, 0.0), (1.5, 1.5, 0.0), height) for height in ((0.22, 0.35), (0.30, 0.45)))
"""Goals all around, most of them far enough for an edge on the way."""
FAR = (Level((1.8, -0.2, 0.0), (2.2, 0.2, 0.0), (0.22, 0.35)),)
"""Goals with room for an edge on the way at any heading."""


def extents(heading):
    """Half extents [m] along world x and y of the rectangle of the paws, by its corners, (worlds, 2)."""
    corners = PAWS * [[1, 1], [1, -1], [-1, 1], [-1, -1]]
    c, s = np.cos(heading), np.sin(heading)
    turn = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    return np.abs(np.einsum("wij,cj->wci", turn, corners)).max(axis=1)


def drawn_blocks(env):
    """Fields of every world's block."""
    values = env._scene.ground.blocks.numpy()
    return {name: values[name].astype(float) for name in values.dtype.names}


class Scenes(Starts):
    """Thousands of starts on one kind of ground; the attributes of `Starts`, and of those `taken` the block's too."""

    def __init__(self, env, kind, start_mode):
        super().__init__(env, start_mode, ground=KINDS[kind])
        self.block = {name: values[self.drawn] for name, values in drawn_blocks(env).items()}
        self.foot = extents(self.episodes["heading"])
        self.taken = self.block["exists"] == 1
        rows = np.arange(len(self.goal))
        self.across = np.argmax(np.abs(self.goal[:, :2]), axis=1)  # axis across which a block's near side lies
        self.way, self.reach = np.abs(self.goal[rows, self.across]), self.foot[rows, self.across]

    def of_block(self, name):
        return self.block[name][self.taken]


def drawing_env(name, count, ground, seed=2, reset=None, **changes):
    """Environment whose starts have a drawn ground, its robots nominal."""
    task = dataclasses.replace(make_task(name), randomization=RandomizationCfg.off(), **changes)
    reset = dataclasses.replace(reset or task.reset.settings, ground=ground)
    return make_env(count, task=resetting(task, reset), seed=seed, randomize=True)


@pytest.fixture(scope="module", params=PLACES)
def env(request):
    levels = {"levels": WIDE} if request.param == "omnidirectional-jump" else {}
    return drawing_env(request.param, N, GroundCfg(platform=0.5, block=0.5), **levels)


@pytest.fixture(scope="module")
def scenes(env):
    """(kind, scheme) -> Scenes"""
    return {
        (kind, start_mode): Scenes(env, kind, start_mode) for kind in KINDS for start_mode in ("standing", "default")
    }


@pytest.fixture(params=["standing", "default"])
def on_platform(scenes, request):
    return scenes["platform", request.param]


@pytest.fixture(params=["standing", "default"])
def to_block(scenes, request):
    return scenes["block", request.param]


def test_all_paws_stand_on_the_platform_away_from_its_edges(on_platform):
    taken = on_platform.taken
    paws, height = on_platform.paws[taken], on_platform.of_block("height")
    assert taken.sum() > 500 and covers(height, *DROP)
    np.testing.assert_allclose(paws[..., 2], height[:, None] + PAW_RADIUS + np.zeros(4), atol=2e-4)
    inside = on_platform.of_block("half")[:, None] - np.abs(paws[..., :2])
    assert inside.min() >= MARGIN - 2e-4
    np.testing.assert_allclose(on_platform.paws[~taken][..., 2], PAW_RADIUS, atol=2e-4)


def test_edges_of_a_platform_are_somewhere_within_the_room(on_platform):
    beyond = on_platform.of_block("half") - on_platform.foot[on_platform.taken]
    assert covers(beyond[:, 0], MARGIN, ROOM) and covers(beyond[:, 1], MARGIN, ROOM)
    assert np.abs(np.corrcoef(beyond.T)[0, 1]) < 0.2
    assert not on_platform.of_block("center").any() and not on_platform.of_block("start").any()
    assert not on_platform.of_block("velocity").any()


def test_robots_are_as_high_above_the_platform_as_their_level_says(env, scenes):
    found = scenes["platform", "standing"]
    above, counts = found.pos[:, 2] - np.where(found.taken, found.block["height"], 0.0), []
    for number, level in enumerate(env.task.levels):
        mine = found.taken & (found.level == number)
        counts.append(mine.sum())
        assert counts[-1] == 0 or covers(above[mine], *level.base_height, 6.0 / counts[-1])
    assert max(counts) > 300, counts
    found = scenes["platform", "default"]
    above = found.pos[:, 2] - np.where(found.taken, found.block["height"], 0.0)
    np.testing.assert_allclose(above, env.sim.model.joint_q.numpy()[2], atol=1e-5)


def test_paws_land_clear_of_the_platform_where_there_is_one(on_platform):
    apart = np.abs(on_platform.goal[:, :2]) - 2.0 * on_platform.foot  # between the rectangles before and after
    gap = (apart[on_platform.taken] - on_platform.of_block("half") + on_platform.foot[on_platform.taken]).max(axis=1)
    assert gap.min() >= CLEARANCE - 1e-4 and gap.min() < CLEARANCE + 0.02
    widest = apart.max(axis=1) - MARGIN
    assert not on_platform.taken[widest < CLEARANCE - 1e-4].any()
    assert on_platform.taken[widest > CLEARANCE + ROOM - MARGIN + 1e-4].all()
    assert 0.1 < on_platform.taken.mean() < 0.9


def test_a_block_is_under_all_paws_at_the_goal(to_block):
    taken = to_block.taken
    off = np.abs(to_block.goal[taken, :2] - to_block.of_block("center")) + to_block.foot[taken]
    inside = to_block.of_block("half") - off
    assert taken.sum() > 500 and inside.min() >= MARGIN - 1e-4
    rows = np.arange(taken.sum())
    beside = inside[rows, 1 - to_block.across[taken]]
    assert covers(beside, MARGIN, ROOM)
    far = np.abs(to_block.of_block("center")) + to_block.of_block("half")
    behind = far[rows, to_block.across[taken]] - to_block.way[taken] - to_block.reach[taken]
    assert covers(behind, MARGIN, ROOM) and np.abs(np.corrcoef(behind, beside)[0, 1]) < 0.2


def test_robots_stand_on_the_floor_outside_the_block(to_block):
    taken = to_block.taken
    np.testing.assert_allclose(to_block.paws[..., 2], PAW_RADIUS, atol=2e-4)
    off = np.abs(to_block.paws[taken, :, :2] - to_block.of_block("center")[:, None])
    outside = (off - to_block.of_block("half")[:, None]).max(axis=2)
    assert outside.min() >= MARGIN - 2e-4


def test_the_near_side_is_between_the_paws_before_and_after_the_jump_and_more_often_near(to_block):
    taken, rows = to_block.taken, np.arange(to_block.taken.sum())
    axis = to_block.across[taken]
    sign = np.sign(to_block.goal[taken][rows, axis])
    near = sign * to_block.of_block("center")[rows, axis] - to_block.of_block("half")[rows, axis]
    first = to_block.reach[taken] + MARGIN
    last = to_block.way[taken] - to_block.reach[taken] - CLEARANCE
    assert (near >= first - 1e-4).all() and (near <= last + 1e-4).all()
    wide = last - first > 0.05
    share = ((near - first) / (last - first))[wide]
    assert kstest(np.sqrt(share.clip(0.0)), "uniform").pvalue > 1e-3
    assert set(axis) == {0, 1} and set(sign) == {-1.0, 1.0}


def test_there_is_a_block_exactly_where_there_is_room(to_block):
    room = to_block.way - 2.0 * to_block.reach - MARGIN - CLEARANCE
    assert to_block.taken[room > 1e-4].all() and not to_block.taken[room < -1e-4].any()
    assert 0.1 < to_block.taken.mean() < 0.9


def test_blocks_have_uniform_heights_masses_and_frictions(to_block):
    for name, (lower, upper) in (("height", RISE), ("mass", MASS), ("friction", FRICTION)):
        share = (to_block.of_block(name) - lower) / (upper - lower)
        assert share.min() >= -1e-5 and share.max() <= 1.0 + 1e-5
        assert kstest(share, "uniform").pvalue > 1e-3, name
    np.testing.assert_array_equal(to_block.of_block("center"), to_block.of_block("start"))
    assert not to_block.of_block("velocity").any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("start_mode", ["standing", "default"])
def test_no_start_collides(scenes, kind, start_mode):
    found = scenes[kind, start_mode]
    assert not found.flags.any() and found.fallbacks < 0.005


@pytest.mark.parametrize("kind", KINDS)
def test_an_episode_knows_the_ground_at_its_goal(scenes, kind):
    found = scenes[kind, "standing"]
    expected = np.where(found.taken, found.block["height"], 0.0) if kind == "block" else np.zeros(len(found.goal))
    np.testing.assert_allclose(found.episodes["goal_ground"], expected, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("start_mode", ["in_flight", "touchdown", "after_landing"])
def test_the_ground_is_level_where_a_jump_has_begun(env, kind, start_mode):
    for start in ("default", start_mode):
        begin_by(env, only(start, resets_of(env), ground=KINDS[kind]))
        edit_episodes(env, level=len(env.task.levels) - 1)
        env.reset()
        assert drawn_blocks(env)["exists"].any() == (start == "default")
    assert not episodes_of(env)["goal_ground"].any() and not collision_flags(env).any()


def test_kinds_are_drawn_by_their_shares_where_there_is_room():
    env = drawing_env("horizontal-jump", N, GroundCfg(platform=0.3, block=0.45), levels=FAR, reset=only("default"))
    block = drawn_blocks(env)
    platform = (block["exists"] == 1) & (block["mass"] > 1.0e5)
    sliding = (block["exists"] == 1) & (block["mass"] < 1.0e3)
    found = np.array([platform.mean(), sliding.mean(), 1.0 - block["exists"].mean()])
    expected = np.array([0.3, 0.45, 0.25])
    assert np.abs(found - expected).max() < 4.0 * np.sqrt(0.25 / N)


def test_every_episode_draws_its_ground_anew():
    env = drawing_env("horizontal-jump", 64, KINDS["block"], levels=FAR, reset=only("default"))
    first = drawn_blocks(env)
    edit_episodes(env, [3, 5], steps=5000)
    env.step(torch.zeros((64, 12)))
    assert env.done.nonzero().ravel().tolist() == [3, 5]
    second = drawn_blocks(env)
    changed = (first["mass"] != second["mass"]) | (first["half"] != second["half"]).any(axis=1)
    assert changed.nonzero()[0].tolist() == [3, 5]


def test_where_there_is_no_block_nothing_of_one_appears():
    env = drawing_env("horizontal-jump", 256, GroundCfg(platform=0.2, block=0.2), levels=FAR, reset=only("default"))
    none = drawn_blocks(env)["exists"] == 0
    for _ in range(5):
        env.step(torch.zeros((256, 12)))
        assert not env.done.any()
    after = drawn_blocks(env)
    assert none.any() and not none.all()
    for name, values in after.items():
        assert not values[none].any(), name
    assert all(np.isfinite(values).all() for values in after.values())


def hold(env, steps=20):
    """Hold the angles that the robots have for some steps, and fail where an episode ends or a world breaks."""
    angles = env.sim.joint_q()[:, 7 + MOTOR_SLOTS]
    scale = np.radians(np.tile([15.0, 90.0, 90.0], 4))
    action = torch.from_numpy((angles - DEFAULT_ANGLE) / scale).float()
    for _ in range(steps):
        env.step(action)
        assert not env.done.any() and not env.robot.diverged.numpy().any()
    env.sim.physics.write_bodies()


@pytest.mark.parametrize("start_mode", ["standing", "default"])
def test_robots_stand_still_on_platforms_which_do_not_move(start_mode):
    env = drawing_env("horizontal-jump", 64, KINDS["platform"], levels=FAR, reset=only(start_mode, heading=180.0))
    edit_episodes(env, command_step=1000)
    block, before = drawn_blocks(env), env.sim.joint_q()
    assert block["exists"].all()
    hold(env)
    np.testing.assert_allclose(
        paw_centres(env.sim)[..., 2], block["height"][:, None] + PAW_RADIUS + np.zeros(4), atol=2e-3
    )
    assert np.abs(env.sim.joint_q()[:, :3] - before[:, :3]).max() < 0.06
    assert np.abs(env.sim.solver.block_position()).max() < 1e-6
    assert (env.task_arrays()["phase"] == STANCE).all()
    np.testing.assert_allclose(env.obs[:, 2], env.sim.joint_q()[:, 2] - block["height"], atol=1e-5)


def test_robots_stand_still_on_the_block_at_their_goal():
    env = drawing_env("horizontal-jump", 64, KINDS["block"], levels=FAR, reset=only("default", heading=180.0))
    block, episodes = drawn_blocks(env), env.task_arrays()
    assert block["exists"].all()
    q = env.sim.joint_q().copy()
    q[:, :2] += episodes["goal"][:, :2]
    q[:, 2] += episodes["goal_ground"]
    env.sim.state.joint_q.assign(q.ravel())
    edit_episodes(env, command_step=1000, start=q[:, :3])
    assert not collision_flags(env).any()
    hold(env, 40)
    np.testing.assert_allclose(
        paw_centres(env.sim)[..., 2], block["height"][:, None] + PAW_RADIUS + np.zeros(4), atol=2e-3
    )
    np.testing.assert_allclose(paw_forces(env.sim)[..., 2].sum(axis=1), WEIGHT, rtol=0.05)
    assert np.abs(env.sim.solver.block_position() - block["center"]).max() < 2e-3
