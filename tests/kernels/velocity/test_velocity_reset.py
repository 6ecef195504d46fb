"""How episodes of velocity tracking begin, by a thousand draws; Pinocchio tells where the paws are."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jump_starts import PAW_RADIUS, collision_flags, paws_and_velocities
from jumper_warp.registry import make_task
from mdp_helpers import DEFAULT_ANGLE
from solver_helpers import MOTOR_Q
from velocity_helpers import edit, states_of, walking_env

N = 1024
TASK = make_task("velocity-flat")
RESET = TASK.reset.settings
CALM = {"error_xy": 60.0, "error_yaw": 60.0, "settled": 600.0, "steps": 1200, "episode_steps": 1200}  # 0.13 m/s


@pytest.fixture(scope="module")
def env():
    return walking_env(N)


@pytest.fixture
def begun(env):
    """The environment where every world has just begun its first episode: coordinates and rates besides."""
    env.reset(seed=1)
    return env, env.sim.joint_q().astype(float), env.sim.joint_qd().astype(float)


def moving_starts(q, qd):
    """Which worlds do not begin in the default pose."""
    return np.abs(qd).max(axis=1) > 0.0


def test_bases_are_where_they_should_be(begun):
    _, q, qd = begun
    drawn = moving_starts(q, qd)
    assert 0.80 < drawn.mean() < 0.92  # a tenth by choice, and where no draw could be taken
    assert 0.30 < q[drawn, 2].min() < 0.31 and q[drawn, 2].max() < 0.50
    assert np.abs(q[:, :2]).max() <= 0.1
    turn = Rotation.from_quat(q[:, 3:7]).as_euler("ZYX", degrees=True)
    assert np.abs(turn[drawn, 1:]).max() < 5.0 + 1e-3 and np.abs(turn[drawn, 1:]).max() > 4.5
    assert np.histogram(turn[:, 0], 8, (-180.0, 180.0))[0].min() > 0.08 * N
    np.testing.assert_allclose(q[~drawn][:, MOTOR_Q] - DEFAULT_ANGLE, 0.0, atol=1e-5)


def test_paws_are_on_the_ground_or_above_it_where_forward_kinematics_finds_them(begun):
    env, q, qd = begun
    paws, _ = paws_and_velocities(env, np.flatnonzero(moving_starts(q, qd)))
    above = paws[..., 2] - PAW_RADIUS
    down = np.abs(above) < 2e-4
    assert (down | ((above > 0.0098) & (above < 0.1002))).all()
    assert 0.62 < down.mean() < 0.78  # seven tenths, less what could not be taken


def test_paws_on_the_ground_are_at_rest(begun):
    env, q, qd = begun
    drawn = moving_starts(q, qd)
    paws, velocities = paws_and_velocities(env, np.flatnonzero(drawn))
    down = np.abs(paws[..., 2] - PAW_RADIUS) < 2e-4
    speed = np.linalg.norm(velocities, axis=2)
    # but for near-singular legs, whose inverse Jacobian is damped
    assert np.quantile(speed[down], 0.99) < 1e-4 and speed[down].max() < 0.1 and np.median(speed[~down]) > 0.1
    assert np.abs(qd[drawn, 3:6]).max() > 0.4


def test_nothing_touches_what_it_must_not(begun):
    assert not collision_flags(begun[0]).any()


def test_commands_are_drawn_within_the_first_reach(begun):
    env, _, _ = begun
    state = states_of(env)
    command, standing = state["command"], state["standing"] == 1
    assert 0.08 < standing.mean() < 0.17 and not command[standing].any()
    turning = ~standing & ~command[:, :2].any(axis=1)
    assert 0.02 < turning.mean() < 0.09
    walking = command[~standing & ~turning]
    assert np.abs(walking).max() <= 0.8 and np.abs(walking).max(axis=0).min() > 0.75
    assert state["command_lasts"].min() >= 119 and state["command_lasts"].max() <= 360


def test_commands_of_the_last_level_reach_far_ahead_but_not_across_as_well(env):
    edit(env, command_level=10, steps=0)
    env.reset()
    command = states_of(env)["command"]
    ahead, back, aside, turning = TASK.levels[0].last_range
    assert 0.9 * ahead < command[:, 0].max() <= ahead and command[:, 0].min() >= -back
    assert 0.85 * aside < np.abs(command[:, 1]).max() <= aside
    assert 0.85 * turning < np.abs(command[:, 2]).max() <= turning
    fast = command[:, 0] > 0.7 * ahead
    assert fast.sum() > 40
    left = np.sqrt(np.maximum(1.0 - (command[fast, 0] / ahead) ** 2, 0.04))
    assert (np.abs(command[fast, 1]) <= aside * left + 1e-5).all()


@pytest.mark.parametrize(
    ("fields", "ended", "level", "falls"),
    [(CALM, 1.0, 4, 0.0), (CALM | {"error_xy": 200.0}, 1.0, 3, 0.0),
     (CALM | {"steps": 700}, 1.0, 2, 1.0), (CALM | {"steps": 700}, 0.0, 3, 0.0),
     (CALM | {"steps": 0}, 1.0, 3, 0.0), (CALM | {"steps": 700, "limit": (1e-3, 1e-3)}, 1.0, 3, 0.0)],
    ids=["followed", "not followed", "fell", "cut off", "not begun", "left the map"],
)  # fmt: skip
def test_levels_follow_how_the_episode_went(env, fields, ended, level, falls):
    q = env.sim.joint_q().copy()
    q[:, :2] = 0.05
    env.sim.state.joint_q.assign(q.ravel())
    edit(env, command_level=3, falls=0.0, limit=(0.0, 0.0))
    edit(env, **fields)
    env.done.fill_(ended)
    env.reset()
    state = states_of(env)
    assert set(state["command_level"]) == {level} and set(state["falls"]) == {falls}
    assert not state["steps"].any() and not state["settled"].any() and not state["error_xy"].any()


def test_what_was_counted_goes_on_and_the_rest_begins_anew(env):
    counted = ("sum_xy", "sum_yaw", "sum_settled", "score", "all_steps", "minutes", "seconds_walking", "touchdowns",
               "apexes")  # fmt: skip
    values = {name: 2.0 + i for i, name in enumerate(counted)}
    edit(env, **CALM, **values, falls=0.0)
    env.reset()
    state = states_of(env)
    for name, value in values.items():
        assert set(state[name]) == {value}
    assert not state["recent"].any() and not state["recent_steps"].any()


def test_a_seed_begins_as_it_began_before_levels_included(env):
    env.reset(seed=5)
    first, q = states_of(env), env.sim.joint_q().copy()
    edit(env, command_level=7, falls=3.0)
    env.reset(seed=5)
    np.testing.assert_array_equal(env.sim.joint_q(), q)
    for name, values in states_of(env).items():
        np.testing.assert_array_equal(values, first[name], name)


def test_reset_ranges_are_taken_from_the_task():
    still = {"tilt": 0.0, "lin_vel": 0.0, "ang_vel": 0.0, "default_pose_probability": 0.0, "swing_probability": 0.0}
    settings = dataclasses.replace(RESET, height=(0.40, 0.41), gait=2.0, episode=5.0, **still)
    values = settings.values(1.0 / 60.0)
    assert values.episode_steps == 300 and values.pace == pytest.approx(1.0 / 30.0)
    assert tuple(values.height) == pytest.approx((0.40, 0.41)) and values.map.rows == 0
    assert values.heading == pytest.approx(np.pi)
