"""Sampled ground: when an environment samples it, and the ground heights used by episodes and evaluations."""

import dataclasses

import numpy as np
import pytest
import torch

from columns import X, Z
from jump_helpers import edit_coordinates, edit_episodes, make_env, only, resets_of, resetting
from jumper_warp.envs.env import Env
from jumper_warp.kernels.jump.state import LANDED, STANCE
from jumper_warp.registry import make_task
from jumper_warp.robot.grounds import BlockCfg, platform
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.jump.cfg import GroundCfg, ResetCfg
from simulation_helpers import PAW_RADIUS, paw_centres

N = 16
REST = torch.zeros((N, 12))
HALF_SPACE = BlockCfg((5.0, 0.0), half=(4.5, 6.0), height=0.06, mass=1.0e6)
"""Fixed block, 0.06 m high, that covers the ground from x = 0.5 m on."""


def ground_task(**shares) -> TaskCfg:
    """Return the horizontal jump with far goals and sampled ground; shares: of `GroundCfg`, default: all blocks."""
    task = make_task("horizontal-jump")
    task = dataclasses.replace(task, levels=task.levels[-1:])
    return resetting(task, dataclasses.replace(task.reset.settings, ground=GroundCfg(**(shares or {"block": 1.0}))))


def blocks_of(env: Env) -> np.ndarray:
    """Return the blocks on the ground of all worlds, a structured array."""
    return env.sim.dynamics.robot.ground.blocks.numpy()


# ---------------------------------------------------------------- sampling


def test_a_randomised_environment_samples_ground_from_the_first_reset_on():
    env = Env(ground_task(), N, device="cpu")
    assert not blocks_of(env)["exists"].any() and len(blocks_of(env)) == N
    env.reset()
    assert blocks_of(env)["exists"].any()


@pytest.mark.parametrize(
    "arguments",
    [
        {"randomize": False},
        {"solver": "mujoco"},
        {"ground": platform(-0.1)},
        {"ground": None},
        {"task": ground_task(block=0.0)},
        {"task": make_task("vertical-jump")},
    ],
    ids=["nominal", "mujoco", "heightfield", "no ground", "no share", "vertical"],
)
def test_no_ground_is_sampled_otherwise(arguments):
    env = make_env(2, **({"task": ground_task(), "randomize": True} | arguments))
    assert not resets_of(env).ground.drawn and env.sim.block is None and len(blocks_of(env)) == 0


def test_a_configured_block_is_not_sampled():
    env = make_env(2, task=ground_task(), randomize=True, block=HALF_SPACE)
    found = blocks_of(env)
    assert not resets_of(env).ground.drawn and found["exists"].all()
    np.testing.assert_allclose(found["center"], [HALF_SPACE.center] * 2)
    np.testing.assert_allclose(found["height"], 0.06)


def test_an_evaluation_levels_the_ground_and_a_reset_samples_it_again():
    ground = GroundCfg(platform=0.5, block=0.5)
    env = make_env(N, task=ground_task(), reset=only("default", ResetCfg(ground=ground)), randomize=True)
    assert blocks_of(env)["exists"].any()
    env.evaluation_reset(np.tile([1.5, 0.0, 0.0], (N, 1)))
    assert not blocks_of(env)["exists"].any() and not env.task_arrays()["goal_ground"].any()
    np.testing.assert_allclose(env.sim.joint_q()[:, Z], env.sim.model.joint_q.numpy()[2], atol=1e-6)
    env.step(REST)
    assert not blocks_of(env)["exists"].any()
    env.reset()
    assert blocks_of(env)["exists"].any()


def test_an_evaluation_of_some_worlds_keeps_the_ground_of_the_others():
    env = make_env(N, task=ground_task(), randomize=True)
    before = blocks_of(env).copy()
    chosen = np.arange(N) % 2 == 0
    env.evaluation_reset([1.5, 0.0, 0.0], worlds=chosen)
    assert before["exists"][chosen].any() and before["exists"][~chosen].any()
    assert not blocks_of(env)["exists"][chosen].any()
    np.testing.assert_array_equal(blocks_of(env)[~chosen], before[~chosen])


# ---------------------------------------------------------------- evaluations and further jumps


def test_an_evaluation_starts_robots_on_the_block_below_them():
    tops = np.linspace(0.02, 0.2, N)
    block = BlockCfg((0.1, 0.0), half=(0.5, 0.5), height=tops, mass=1.0e6, friction=1.0)
    env = make_env(N, task=make_task("horizontal-jump"), block=block)
    goals = np.tile([0.55, 0.0, 0.0], (N, 1))
    goals[::2, 0] = 0.65
    env.evaluation_reset(goals)
    episodes, height = env.task_arrays(), env.sim.model.joint_q.numpy()[2] + tops
    for found in (env.sim.joint_q()[:, Z], episodes["start"][:, Z], episodes["max_height"]):
        np.testing.assert_allclose(found, height, atol=1e-6)
    # the block ends at x = 0.6 m
    np.testing.assert_allclose(episodes["goal_ground"], np.where(np.arange(N) % 2, tops, 0.0), atol=1e-6)
    np.testing.assert_allclose(env.obs[:, 2], env.sim.model.joint_q.numpy()[2], atol=1e-5)
    for _ in range(20):
        env.step(REST)
        assert not env.done.any() and not env.robot.diverged.numpy().any()
    env.sim.write_bodies()
    np.testing.assert_allclose(paw_centres(env.sim)[..., Z], tops[:, None] + PAW_RADIUS + np.zeros(4), atol=2e-3)


def test_an_evaluation_starts_robots_on_the_floor_outside_a_block():
    env = make_env(2, task=make_task("horizontal-jump"), block=HALF_SPACE)
    env.evaluation_reset([[0.45, 0.0, 0.0], [0.55, 0.0, 0.0]])
    np.testing.assert_allclose(env.sim.joint_q()[:, Z], env.sim.model.joint_q.numpy()[2], atol=1e-6)
    np.testing.assert_allclose(env.task_arrays()["goal_ground"], [0.0, 0.06], atol=1e-6)


def test_an_evaluation_sets_the_height_of_uneven_ground_at_its_goals():
    env = make_env(3, task=make_task("horizontal-jump"), ground=platform(-0.15, edge=0.5))
    env.evaluation_reset([[0.45, 0.0, 0.0], [0.8, 0.0, 0.0], [0.8, 0.0, 0.0]], headings=np.array([0.0, 0.0, np.pi]))
    np.testing.assert_allclose(env.task_arrays()["goal_ground"], [0.0, -0.15, 0.0], atol=1e-5)


@pytest.fixture
def landed():
    """Return an environment of robots that landed at x = 0, 0.1, ... m, before or on the block."""
    env = make_env(N, task=make_task("horizontal-jump"), reset=only("default", heading=180.0), block=HALF_SPACE)
    for world in range(N):
        edit_coordinates(env, world, q={0: 0.1 * world})
    edit_episodes(env, phase=LANDED, phase_steps=20, goal=(0.0, 0.0, 0.0), goal_ground=-7.0)
    return env


def on_block(goal: np.ndarray) -> np.ndarray:
    """Return the height [m] of the ground at goals (n, 3)."""
    return np.where(goal[:, X] > 0.5, 0.06, 0.0)


def test_the_next_jump_of_an_evaluation_has_the_ground_height_at_its_goal(landed):
    goals = np.tile([0.75, 0.3, 0.0], (N, 1))
    landed.command(goals, np.arange(N) > 1)
    found = landed.task_arrays()
    assert (found["phase"][2:] == STANCE).all() and (found["phase"][:2] == LANDED).all()
    np.testing.assert_array_equal(found["goal_ground"][:2], -7.0)
    np.testing.assert_allclose(found["goal_ground"][2:], on_block(found["goal"])[2:], atol=1e-6)
    assert len(set(found["goal_ground"][2:])) == 2


def test_the_next_jump_of_an_episode_has_the_ground_height_at_its_goal(landed):
    edit_episodes(landed, next_jump_step=5, level=4)
    landed._reset_worlds(landed._part(), landed.episodes.done)
    found = landed.task_arrays()
    assert (found["phase"] == STANCE).all() and (found["jumps"] == 1).all() and not landed.done.any()
    np.testing.assert_allclose(found["goal_ground"], on_block(found["goal"]), atol=1e-6)
    assert len(set(found["goal_ground"])) == 2


def test_the_ground_height_at_the_next_goal_uses_the_blocks_current_position(landed):
    moved = blocks_of(landed)
    moved["center"][:, X] += 20.0
    landed.sim.dynamics.robot.ground.blocks.assign(moved)
    landed.command(np.tile([0.75, 0.3, 0.0], (N, 1)))
    assert not landed.task_arrays()["goal_ground"].any()


# ---------------------------------------------------------------- the configuration


def test_ground_settings_reach_the_kernel_struct_by_name():
    cfg = GroundCfg(
        platform=0.25, block=0.5, drop=(0.125, 0.25), rise=(0.0625, 0.5), room=0.75, clearance=0.375,
        mass=(2.0, 4.0), friction=(0.5, 0.625),
    )  # fmt: skip
    ranges = cfg.ranges()
    assert (ranges.platform, ranges.block, ranges.room, ranges.clearance) == (0.25, 0.5, 0.75, 0.375)
    pairs = (ranges.drop, ranges.rise, ranges.mass, ranges.friction)
    assert [tuple(pair) for pair in pairs] == [(0.125, 0.25), (0.0625, 0.5), (2.0, 4.0), (0.5, 0.625)]


@pytest.mark.parametrize(
    ("values", "message"),
    [({"platform": 0.6, "block": 0.5}, "probabilities must be .* got 0.6, 0.5"), ({"drop": (0.2, 0.1)}, "ground drop")],
)
def test_refuses_invalid_ground_settings(values, message):
    with pytest.raises(ValueError, match=message):
        GroundCfg(**values)
