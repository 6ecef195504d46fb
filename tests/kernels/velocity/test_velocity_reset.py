"""Resets of velocity tracking: distributions over 1024 worlds; paw positions and velocities come from Pinocchio."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from columns import ANG_VEL, MOTOR_COORDS, QUAT, XY, Z
from jump_starts import PAW_RADIUS, collision_flags, paws_and_velocities
from jumper_warp.registry import make_task
from mdp_helpers import DEFAULT_ANGLE
from velocity_helpers import edit, states_of, walking_env

N = 1024
TASK = make_task("velocity-flat")
CALM = {"error_xy": 60.0, "error_yaw": 60.0, "settled": 600.0, "steps": 1200, "episode_steps": 1200}
"""State of a full episode with a mean error of (60 + 0.3 * 60) / 600 = 0.13 m/s, below the tolerance."""


@pytest.fixture(scope="module")
def env():
    """Return N nominal worlds of `velocity-flat` without noise."""
    return walking_env(N)


@pytest.fixture
def begun(env):
    """Reset all worlds with seed 1; return (environment, joint_q (N, 43), joint_qd (N, 38))."""
    env.reset(seed=1)
    return env, env.sim.joint_q().astype(float), env.sim.joint_qd().astype(float)


def moving_starts(q, qd):
    """Return which worlds do not start in the default pose at rest, (N,) bool."""
    return np.abs(qd).max(axis=1) > 0.0


def test_base_poses_cover_their_ranges_or_are_the_default_pose_and_do_not_collide(begun):
    env, q, qd = begun
    assert not collision_flags(env).any()
    drawn = moving_starts(q, qd)
    assert 0.80 < drawn.mean() < 0.92  # default pose: probability 0.1, or no attempt valid
    assert 0.30 < q[drawn, 2].min() < 0.31 and q[drawn, 2].max() < 0.50
    assert np.abs(q[:, XY]).max() <= 0.1
    turn = Rotation.from_quat(q[:, QUAT]).as_euler("ZYX", degrees=True)
    assert np.abs(turn[drawn, 1:]).max() < 5.0 + 1e-3 and np.abs(turn[drawn, 1:]).max() > 4.5
    assert np.histogram(turn[:, 0], 8, (-180.0, 180.0))[0].min() > 0.08 * N
    np.testing.assert_allclose(q[~drawn][:, MOTOR_COORDS] - DEFAULT_ANGLE, 0.0, atol=1e-5)


def test_paws_are_on_the_ground_or_in_the_air_with_swing_probability(begun):
    env, q, qd = begun
    paws, _ = paws_and_velocities(env, np.flatnonzero(moving_starts(q, qd)))
    above = paws[..., Z] - PAW_RADIUS
    down = np.abs(above) < 2e-4
    assert (down | ((above > 0.0098) & (above < 0.1002))).all()
    assert 0.62 < down.mean() < 0.78  # 0.7 of samples, changed a little by rejections


def test_paws_on_the_ground_are_at_rest_while_bases_turn(begun):
    env, q, qd = begun
    drawn = moving_starts(q, qd)
    paws, velocities = paws_and_velocities(env, np.flatnonzero(drawn))
    down = np.abs(paws[..., Z] - PAW_RADIUS) < 2e-4
    speed = np.linalg.norm(velocities, axis=2)
    # [m/s] except near-singular legs, whose inverse Jacobian is damped
    assert np.quantile(speed[down], 0.99) < 1e-4 and speed[down].max() < 0.1 and np.median(speed[~down]) > 0.1
    assert np.abs(qd[drawn, ANG_VEL]).max() > 0.4  # [rad/s]


def test_first_commands_have_their_kinds_limits_and_durations(begun):
    env, _, _ = begun
    state = states_of(env)
    command, standing = state["command"], state["standing"] == 1
    assert 0.08 < standing.mean() < 0.17 and not command[standing].any()  # 12 % stand
    turning = ~standing & ~command[:, XY].any(axis=1)
    assert 0.02 < turning.mean() < 0.09  # 5 % turn on the spot
    walking = command[~standing & ~turning]  # [m/s], [m/s], [rad/s], each within ±0.8
    assert np.abs(walking).max() <= 0.8 and np.abs(walking).max(axis=0).min() > 0.75
    assert state["command_lasts"].min() >= 119 and state["command_lasts"].max() <= 360  # policy steps: 2 to 6 s


def test_commands_of_the_last_level_shrink_sideways_with_the_speed_ahead(env):
    edit(env, command_level=10, steps=0)  # the widest commands; no step: the reset keeps the level
    env.reset()
    command = states_of(env)["command"]
    ahead, back, aside, turning = TASK.levels[0].last_range  # [m/s], [m/s], [m/s], [rad/s]
    x, y, yaw = command.T
    assert 0.9 * ahead < x.max() <= ahead and x.min() >= -back
    assert 0.85 * aside < np.abs(y).max() <= aside
    assert 0.85 * turning < np.abs(yaw).max() <= turning
    fast = x > 0.7 * ahead
    assert fast.sum() > 40
    shrink = np.sqrt(np.maximum(1.0 - (x[fast] / ahead) ** 2, 0.04))  # an ellipse, at least 0.2 of its width
    assert (np.abs(y[fast]) <= aside * shrink + 1e-5).all()


@pytest.mark.parametrize(
    ("fields", "ended", "level", "falls"),
    [(CALM, 1.0, 4, 0.0), (CALM | {"error_xy": 200.0}, 1.0, 3, 0.0),
     (CALM | {"steps": 700}, 1.0, 2, 1.0), (CALM | {"steps": 700}, 0.0, 3, 0.0),
     (CALM | {"steps": 0}, 1.0, 3, 0.0), (CALM | {"steps": 700, "limit": (1e-3, 1e-3)}, 1.0, 3, 0.0)],
    ids=["followed", "not followed", "fell", "cut off", "not begun", "left the map"],
)  # fmt: skip
def test_a_full_accurate_episode_raises_the_level_and_a_fall_lowers_it(env, fields, ended, level, falls):
    q = env.sim.joint_q().copy()
    q[:, XY] = 0.05
    env.sim.state.joint_q.assign(q.ravel())
    edit(env, command_level=3, falls=0.0, limit=(0.0, 0.0))
    edit(env, **fields)
    env.done.fill_(ended)
    env.reset()
    state = states_of(env)
    assert set(state["command_level"]) == {level} and set(state["falls"]) == {falls}
    assert not state["steps"].any() and not state["settled"].any() and not state["error_xy"].any()


def test_a_reset_keeps_statistics_and_clears_touchdown_history(env):
    counted = ("sum_xy", "sum_yaw", "sum_settled", "score", "all_steps", "minutes", "seconds_walking", "touchdowns",
               "apexes")  # fmt: skip
    values = {name: 2.0 + i for i, name in enumerate(counted)}
    edit(env, **CALM, **values, falls=0.0)
    env.reset()
    state = states_of(env)
    for name, value in values.items():
        assert set(state[name]) == {value}
    assert not state["recent"].any() and not state["recent_steps"].any()


def test_sampled_commands_of_the_papers_task_keep_away_from_zero():
    env = walking_env(N, task=make_task("velocity-paper"))
    env.reset(seed=1)
    command = np.abs(states_of(env)["command"])
    moving = command[(command > 0.0).all(axis=1)]
    assert 0.78 < len(moving) / N < 0.88  # 12 % stand, 5 % turn on the spot
    assert moving.min() >= 0.12 and moving.max() <= 0.75
    assert np.histogram(moving, 7, (0.12, 0.75))[0].min() > 0.12 * moving.size
