"""Environment of velocity tracking, on a plane and on a map: observations, terminations, commands and metrics."""

import dataclasses

import numpy as np
import pytest
import torch

from columns import QUAT, XY, X, Y, Z
from ground_helpers import heights
from jump_helpers import edit_coordinates, ending_names, random_actions
from jumper_warp.kernels.collision.robot import SHANK_GROUND
from jumper_warp.registry import make_task
from jumper_warp.robot.terrain import TerrainCfg, terrain_map
from jumper_warp.tasks.cfg import TaskCfg
from velocity_helpers import edit, states_of, walking_env

N = 32
MAP = TerrainCfg(rows=2, tile=4.0, cell=0.1, start=0.6, border=1.0)


def on_small_map() -> TaskCfg:
    """Return velocity-rough on the terrain `MAP`."""
    rough = make_task("velocity-rough")
    settings = dataclasses.replace(rough.reset.settings, terrain=MAP)
    return dataclasses.replace(rough, reset=dataclasses.replace(rough.reset, settings=settings))


@pytest.fixture(scope="module")
def rough():
    """Return N randomised worlds of velocity-rough on a small map."""
    return walking_env(N, task=on_small_map(), randomize=True)


@pytest.fixture(scope="module")
def flat():
    """Return a walking environment of 8 worlds on flat ground."""
    return walking_env(8)


def height_at(x, y):
    """Return the height of the map [m], bilinear between nodes."""
    field = terrain_map(MAP)
    z = heights(field)
    u = np.clip((np.asarray(x) + field.hx) / 0.1, 0, z.shape[1] - 1.001)
    v = np.clip((np.asarray(y) + field.hy) / 0.1, 0, z.shape[0] - 1.001)
    i, j = v.astype(int), u.astype(int)
    fv, fu = v - i, u - j
    low = z[i, j] * (1 - fu) + z[i, j + 1] * fu
    return low * (1 - fv) + (z[i + 1, j] * (1 - fu) + z[i + 1, j + 1] * fu) * fv


def test_robots_begin_on_tiles_of_their_level(rough):
    for level in (0, 1, 2):
        edit(rough, terrain_level=level, steps=0)
        rough.reset()
        q = rough.sim.joint_q()
        rows, cols = np.floor(q[:, X] / 4.0 + 1.0), np.floor(q[:, Y] / 4.0 + 4.0)
        assert set(rows) == ({level} if level < 2 else {0, 1})
        assert len(set(cols)) >= 7 and set(states_of(rough)["terrain_level"]) == {level}
        assert np.abs(np.mod(q[:, XY], 4.0) - 2.0).max() <= 0.1 + 1e-5
        above = q[:, Z] - height_at(q[:, X], q[:, Y])
        assert above.min() > 0.29 and above.max() < 0.51
    np.testing.assert_array_equal(states_of(rough)["limit"], np.tile([4.0, 16.0], (N, 1)))


def test_paw_heights_and_ground_heights_around_the_base_are_those_of_the_map(rough):
    rough.reset()
    for action in random_actions(N, 8):
        rough.step(0.2 * action)
    paws = rough.robot.paw_pos.numpy()
    wanted = paws[..., Z] - height_at(paws[..., X], paws[..., Y]) - 0.025
    is_running = rough.done.numpy() == 0.0
    assert is_running.sum() > N // 2
    np.testing.assert_allclose(rough.robot.paw_height.numpy()[:, is_running], wanted[:, is_running], atol=1e-4)

    q = rough.sim.joint_q().astype(float)
    x, y, z, w = q[:, QUAT].T
    heading = np.arctan2(2.0 * (x * y + z * w), 1.0 - 2.0 * (y * y + z * z))
    first, end = rough.skills[0].task.layout("critic")["ground_heights"]
    grid = [(0.25 * (i // 3 - 2), 0.2 * (i % 3 - 1)) for i in range(15)]
    for column, (ahead, left) in zip(range(first, end), grid, strict=True):
        px = q[:, X] + ahead * np.cos(heading) - left * np.sin(heading)
        py = q[:, Y] + ahead * np.sin(heading) + left * np.cos(heading)
        seen = rough.critic_obs[:, column].numpy()
        np.testing.assert_allclose(seen, q[:, Z] - height_at(px, py) - 0.35, atol=2e-4)
    assert np.ptp(rough.critic_obs[:, first:end].numpy(), axis=1).max() > 0.05


def test_shank_in_a_step_ends_the_episode(rough):
    """A robot is placed in front of the stairs, with its front shanks inside a step."""
    edit(rough, terrain_level=0, steps=0)
    rough.reset()
    action = torch.zeros((N, 12))
    # columns of stairs: y from 4 to 8; tile of row 1: x from 0 to 4, its rim is level up to 0.3 m
    edit_coordinates(rough, 3, q={0: 0.75, 1: 6.0, 2: 0.24, 3: 0.0, 4: 0.0, 5: 0.0, 6: 1.0})
    rough.step(action)
    assert rough.robot.collisions.numpy()[:, 3].any() or ending_names(rough)[3] == "collided"
    assert SHANK_GROUND > 0 and ending_names(rough)[3] == "collided"


def test_leaving_the_map_ends_the_episode_as_a_time_out(rough):
    edit(rough, steps=0)
    rough.reset()
    edit_coordinates(rough, 5, q={0: 4.2, 1: 0.0, 2: 0.6})
    rough.step(torch.zeros((N, 12)))
    assert ending_names(rough)[5] == "left_map"
    assert rough.timeout[5] == 1.0 and rough.done[5] == 1.0
    assert states_of(rough)["falls"][5] == 0.0


def test_commands_without_a_gait_frequency_keep_it_and_episodes_begin_with_that_of_the_task():
    env = walking_env(2, "velocity-trot")
    env.evaluation_reset(np.zeros(3))
    assert env.skills[0].states.numpy()["pace"] == pytest.approx(2.0 / 60.0)
    env.command([[0.3, 0.0, 0.0, 1.5], [0.3, 0.0, 0.0, 0.0]])
    assert env.skills[0].states.numpy()["pace"] == pytest.approx([1.5 / 60.0, 2.0 / 60.0])
    env.command([0.3, 0.0, 0.0])
    assert env.skills[0].states.numpy()["pace"] == pytest.approx([1.5 / 60.0, 2.0 / 60.0])


def test_nominal_environment_is_on_a_plane():
    env = walking_env(4, task=on_small_map())
    assert env.sim.dynamics.robot.ground.rows == 0
    assert np.abs(env.sim.joint_q()[:, XY]).max() <= 0.1 and not states_of(env)["limit"].any()


def test_metrics_are_ratios_of_sums_over_worlds(flat):
    flat.reset(seed=1)
    flat.metrics()
    worlds = np.arange(8)
    edit(flat, sum_xy=0.1 * worlds, sum_yaw=0.2 * worlds, sum_settled=2.0, falls=(worlds == 3) * 1.0, minutes=0.25,
         apexes=0.3, touchdowns=4.0, seconds_walking=2.0, score=worlds * 1.0, all_steps=10.0,
         command_level=worlds)  # fmt: skip
    metrics = flat.metrics()
    expected = {
        "Metrics/error_vel_xy_settled_m_s": 2.8 / 16.0, "Metrics/error_vel_yaw_settled_rad_s": 5.6 / 16.0,
        "Metrics/falls_per_minute": 0.5, "Metrics/swing_apex_m": 0.075, "Metrics/steps_hz": 2.0, "Metrics/score": 0.35,
        "Curriculum/command_level": 3.5,
    }  # fmt: skip
    assert {name: metrics[name] for name in expected} == pytest.approx(expected, rel=1e-5)
    assert "Metrics/error_of_successes_m_s" in metrics
    again = flat.metrics()
    assert np.isnan(again["Metrics/error_vel_xy_settled_m_s"]) and again["Curriculum/command_level"] == 3.5


def test_episode_and_command_end_at_their_own_times(flat):
    flat.reset(seed=1)
    flat.evaluation_reset(np.zeros((8, 3)))
    flat._ends_episodes = True
    edit(flat, episode_steps=100, steps=98, command_lasts=50, command_steps=10, command=(0.3, 0.0, 0.0))
    edit(flat, 0, command_steps=48)
    still = torch.zeros((8, 12))
    flat.step(still)
    assert not flat.done.any()
    state = states_of(flat)
    assert set(state["command_steps"][1:]) == {11}
    flat.step(still)
    names = ending_names(flat)
    assert set(names) == {"finished"} and flat.timeout.all()


def test_a_new_command_is_sampled_when_the_old_one_ends(flat):
    flat.evaluation_reset(np.tile([0.3, 0.1, 0.2], (8, 1)))
    flat._ends_episodes = True
    edit(flat, command_lasts=50, command_steps=49)
    flat.step(torch.zeros((8, 12)))
    state = states_of(flat)
    moving = state["standing"] == 0
    assert not state["command_steps"].any() and (state["command"] != np.float32([0.3, 0.1, 0.2])).any(axis=1).all()
    assert (state["command_lasts"] >= 119).all() and moving.any()
    flat.step(torch.zeros((8, 12)))
    np.testing.assert_array_equal(flat.obs[:, :3].numpy(), state["command"])


def test_steps_are_bitwise_reproducible_with_a_seed(rough):
    def play():
        rough.reset(seed=9)
        for action in 0.5 * random_actions(N, 10):
            rough.step(action)
        return rough.obs.clone(), rough.critic_obs.clone(), rough.reward.clone()

    for a, b in zip(play(), play(), strict=True):
        assert torch.equal(a, b)
