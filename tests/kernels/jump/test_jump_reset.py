import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from columns import MOTOR_COORDS, MOTOR_DOFS, POS, QUAT, Z
from jump_helpers import (
    DEFAULT_ANGLE,
    DEG,
    START_MODES,
    begin_by,
    edit_episodes,
    episodes_of,
    make_env,
    only,
    set_levels,
)
from jump_starts import PAW_RADIUS, collision_flags, paws_and_velocities
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE
from jumper_warp.registry import make_task
from jumper_warp.tasks.jump.cfg import Level, ResetCfg, StartProbability

N = 4096
TASK = make_task("vertical-jump")
G = 9.81  # [m/s^2]
ALL_MODES = ResetCfg(start_probability=StartProbability(0.3, 0.1, in_flight=0.25, touchdown=0.2, after_landing=0.15))


@pytest.fixture(scope="module")
def all_modes_env():
    """Return an environment whose episodes begin in every kind of start state."""
    return make_env(N, reset=ALL_MODES)


@pytest.fixture(scope="module", params=range(len(TASK.levels)), ids=lambda level: f"level{level}")
def sampled(request, all_modes_env):
    """Reset N worlds at one level; return (environment, fields of episodes, joint_q (N, 43), joint_qd (N, 38))."""
    env = all_modes_env
    edit_episodes(env, level=request.param)
    env.reset()
    return env, episodes_of(env), env.sim.joint_q().astype(float), env.sim.joint_qd().astype(float)


@pytest.fixture(scope="module")
def other_env():
    """Return an environment whose settings tests change, by `reset_env`."""
    return make_env(N, seed=1)


@pytest.fixture
def reset_with(other_env):
    """Return a function (reset settings, *levels) that resets all worlds so, and returns the environment."""

    def reset_env(reset, *levels):
        begin_by(other_env, reset)
        set_levels(other_env, *(levels or TASK.levels))
        other_env.reset()
        return other_env

    return reset_env


def covers_range(values, lower, upper, reach=0.02):
    """Return whether values stay in a range and come within the fraction `reach` of its width of both ends."""
    width = upper - lower
    inside = values.min() >= lower - 1e-5 and values.max() <= upper + 1e-5
    return inside and values.min() <= lower + reach * width and values.max() >= upper - reach * width


def worlds_with_mode(episodes, start_mode, count=60):
    """Return the indices of the first `count` worlds that began in a start mode."""
    return np.flatnonzero(episodes["start_mode"] == START_MODES.index(start_mode))[:count]


def test_phase_and_counters_fit_the_start_mode(sampled):
    _, episodes, _, qd = sampled
    phases = np.array([STANCE, STANCE, FLIGHT, FLIGHT, LANDED])[episodes["start_mode"]]
    np.testing.assert_array_equal(episodes["phase"], phases)
    for name in ("steps", "idle_steps", "took_off", "touched_down", "at_apex", "streak"):
        assert not episodes[name].any(), name
    on_feet = episodes["start_mode"] < 2  # standing, default
    assert covers_range(episodes["command_step"][on_feet], 0, 30) and not episodes["command_step"][~on_feet].any()
    landed = episodes["phase"] == LANDED
    assert covers_range(episodes["phase_steps"][landed], 0, 17) and not episodes["phase_steps"][~landed].any()
    # max_height of a falling or landed robot is the commanded height
    passed = landed | ((episodes["phase"] == FLIGHT) & (qd[:, Z] <= 0.0))
    np.testing.assert_array_equal(episodes["apex_passed"], passed)
    np.testing.assert_allclose(episodes["max_height"][passed], episodes["goal"][passed, 2], rtol=2e-7)


def test_goals_and_starts_are_within_the_level(sampled):
    env, episodes, q, _ = sampled
    level = env.task.levels[episodes["level"][0]]
    assert covers_range(episodes["goal"][:, Z], level.goal_lower[Z], level.goal_upper[Z])
    standing = worlds_with_mode(episodes, "standing", N)
    assert covers_range(q[standing, Z], *level.base_height)
    np.testing.assert_array_equal(episodes["start"], q[:, POS].astype(np.float32))
    default = q[worlds_with_mode(episodes, "default", N)][:, MOTOR_COORDS]
    np.testing.assert_array_equal(default, np.broadcast_to(DEFAULT_ANGLE.astype(np.float32), default.shape))


@pytest.mark.parametrize("start_mode", ["standing", "in_flight", "touchdown", "after_landing"])
def test_base_place_and_attitude_cover_their_ranges(sampled, start_mode):
    _, episodes, q, qd = sampled
    worlds = worlds_with_mode(episodes, start_mode, N)
    for column in (*q[worlds, :2].T / 0.05, *Rotation.from_quat(q[worlds, QUAT]).as_euler("ZYX").T / (5.0 * DEG)):
        assert covers_range(column, -1.0, 1.0)
    assert not qd[worlds, :2].any() and not qd[worlds, 3:6].any()


@pytest.mark.parametrize("probability", [0.0, 0.25, 1.0])
def test_command_steps_are_uniform_in_the_long_range_with_its_probability(reset_with, probability):
    reset = only("default", command_delay=0.5, long_wait_probability=probability, long_wait=2.0)
    command_step = episodes_of(reset_with(reset))["command_step"]
    # uniform over steps 0 to 30 (0.5 s) or 0 to 120 (2 s)
    expected = (1.0 - probability) * (np.arange(121) < 31) / 31.0 + probability / 121.0
    counts = np.bincount(command_step, minlength=121)
    assert len(counts) == 121
    assert np.abs(np.cumsum(counts) / N - np.cumsum(expected)).max() < 1.95 / np.sqrt(N)  # Kolmogorov, 1 in 1000


@pytest.mark.parametrize("start_mode", ["in_flight", "touchdown"])
def test_apex_of_flights_is_the_commanded_height(sampled, start_mode):
    _, episodes, q, qd = sampled
    worlds = worlds_with_mode(episodes, start_mode, N)
    apex = q[worlds, 2] + qd[worlds, 2] ** 2 / (2.0 * G)
    # takeoff is 0.40 to 0.45 m high; a lower goal cannot be the apex
    goal = episodes["goal"][worlds, 2]
    reachable = goal > 0.45
    assert reachable.mean() > 0.95
    np.testing.assert_allclose(apex[reachable], goal[reachable], atol=2e-5)
    assert (q[worlds, 2] > 0.39).all()
    assert not qd[worlds][:, MOTOR_DOFS].any()
    # touchdowns begin at most 0.15 s before landing: after the apex of a jump of more than 0.3 s
    rising = np.mean(qd[worlds[goal > 0.6], 2] > 0.0)
    assert rising == 0.0 if start_mode == "touchdown" else 0.3 < rising < 0.7


def test_no_state_collides_and_paws_are_not_under_the_ground(sampled):
    env, episodes, q, _ = sampled
    assert not collision_flags(env).any()
    flying = worlds_with_mode(episodes, "in_flight")
    assert paws_and_velocities(env, flying)[0][..., 2].min() >= PAW_RADIUS + 0.01 - 1e-4
    sums = q[:, MOTOR_COORDS].reshape(N, 4, 3)[..., 1:].sum(axis=2)
    assert sums.min() >= -1e-4 and sums.max() <= 240.0 * DEG + 1e-4
    assert np.abs(q[:, MOTOR_COORDS[::3]]).max() <= 15.0 * DEG + 1e-4


def test_colliding_samples_are_rejected(reset_with):
    # bases so low that shanks lie on the ground, and thighs so far inward that they touch
    level = Level((0.0, 0.0, 0.5), (0.0, 0.0, 0.6), (0.10, 0.30))
    for reset in (only("standing"), only("in_flight", flight_transversal=(-30.0, 60.0))):
        env = reset_with(reset, level)
        assert not collision_flags(env).any()
        assert np.mean(env.task_arrays()["start_mode"] == START_MODES.index("default")) < 0.5


def test_an_unreachable_start_becomes_the_default_pose():
    # a base 0.7 m above paws on the ground: beyond the legs' length
    level = Level((0.0, 0.0, 0.5), (0.0, 0.0, 0.6), (0.7, 0.8))
    env = make_env(16, reset=only("standing"), task=dataclasses.replace(TASK, levels=(level,)))
    assert env.task_arrays()["start_mode"].tolist() == [START_MODES.index("default")] * 16
    np.testing.assert_array_equal(env.sim.joint_q(), env.sim.model.joint_q.numpy().reshape(16, -1))


@pytest.mark.parametrize(
    ("change", "message"),
    [({"start_probability": (0.9,)}, "start_probability must be >= 0 and add up to 1"),
     ({"paw_depth": (0.45, 0.3)}, r"paw_depth must be \(lower, upper\), got \(0.45, 0.3\)"),
     ({"base_xy": math.nan}, "base_xy must be in .*, got nan"),
     ({"command_delay": -0.1}, "command_delay must not be negative, got -0.1"),
     ({"balance_by": "worlds"}, "balance_by must be resets or steps, got 'worlds'")],
)  # fmt: skip
def test_refuses_invalid_starts(change, message):
    with pytest.raises(ValueError, match=message):
        ResetCfg(**{name: StartProbability(*value) if name[0] == "s" else value for name, value in change.items()})
