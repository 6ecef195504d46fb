import dataclasses
import math

import newton
import numpy as np
import pytest

from columns import MOTOR_COORDS, MOTOR_DOFS, POS, QUAT, X, Y, Z
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
from simulation_helpers import loop_gap

N = 4096
TASK = make_task("vertical-jump")
G = 9.81  # [m/s^2]
ALL_MODES = ResetCfg(start_probability=StartProbability(0.3, 0.1, in_flight=0.25, touchdown=0.2, after_landing=0.15))
PROBABILITIES = np.array([0.3, 0.1, 0.25, 0.2, 0.15])


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


def euler(quat):
    """Return roll, pitch, yaw [rad], (n, 3), of quaternions xyzw, (n, 4), as Rz(yaw) Ry(pitch) Rx(roll)."""
    x, y, z, w = quat.T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return np.stack([roll, pitch, np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))], axis=1)


def worlds_with_mode(episodes, start_mode, count=60):
    """Return the indices of the first `count` worlds that began in a start mode."""
    return np.flatnonzero(episodes["start_mode"] == START_MODES.index(start_mode))[:count]


def test_start_modes_have_their_probabilities(sampled):
    _, episodes, _, _ = sampled
    fractions = np.bincount(episodes["start_mode"], minlength=5) / N
    assert np.abs(fractions - PROBABILITIES).max() < 4.0 * np.sqrt(0.25 / N)


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
    for axis in (0, 1):
        assert covers_range(q[worlds, axis], -0.05, 0.05)
        assert covers_range(euler(q[worlds, 3:7])[:, axis], -5.0 * DEG, 5.0 * DEG)
    assert covers_range(euler(q[worlds, 3:7])[:, 2], -5.0 * DEG, 5.0 * DEG)
    np.testing.assert_allclose(np.linalg.norm(q[worlds, 3:7], axis=1), 1.0, atol=1e-6)
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


@pytest.mark.parametrize("start_mode", ["standing", "default", "after_landing"])
def test_paws_of_grounded_starts_are_at_rest_on_the_ground_within_their_boxes(sampled, start_mode):
    env, episodes, _, _ = sampled
    worlds = worlds_with_mode(episodes, start_mode)
    position, velocity = paws_and_velocities(env, worlds)
    np.testing.assert_allclose(position[..., Z], PAW_RADIUS, atol=2e-4)
    np.testing.assert_allclose(velocity, 0.0, atol=2e-3)
    if start_mode != "default":
        # [m] of each paw outward of the middle, along x and y; paws FL, FR, BL, BR
        spots = position * np.array([[1, 1, 1], [1, -1, 1], [-1, 1, 1], [-1, -1, 1]])
        front, back = slice(0, 2), slice(2, 4)
        assert covers_range(spots[..., X], 0.20, 0.22, 0.1)
        assert covers_range(spots[:, front, Y], 0.15, 0.17, 0.1) and covers_range(spots[:, back, Y], 0.20, 0.22, 0.1)


def test_landed_starts_move_down_with_moving_legs(sampled):
    _, episodes, q, qd = sampled
    worlds = worlds_with_mode(episodes, "after_landing", N)
    assert covers_range(-qd[worlds, 2], 0.0, 1.0) and covers_range(q[worlds, 2], 0.30, 0.42)
    assert np.abs(qd[worlds][:, MOTOR_DOFS]).max() > 1.0


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


def test_flights_cover_the_leg_ranges_and_touchdowns_reach_for_the_ground(sampled):
    env, episodes, q, _ = sampled
    angles = q[worlds_with_mode(episodes, "in_flight", N)][:, MOTOR_COORDS].reshape(-1, 4, 3)
    assert np.abs(angles[..., 0]).max() <= 10.0 * DEG + 0.03 + 1e-5
    assert covers_range(angles[..., 1:], 0.0, 90.0 * DEG)
    worlds = worlds_with_mode(episodes, "touchdown")
    height = paws_and_velocities(env, worlds)[0][..., 2]
    depth = q[worlds, 2][:, None] - height
    assert height.min() >= 0.05 - 1e-4
    assert depth.min() >= 0.30 - 1e-4 and depth.max() <= 0.45 + 1e-4
    assert np.ptp(height, axis=1).max() < 1e-4


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


def test_worlds_start_at_different_positions(sampled):
    _, episodes, q, _ = sampled
    moving = episodes["start_mode"] != START_MODES.index("default")
    assert len(np.unique(q[moving, :3], axis=0)) == moving.sum()


def test_kinematic_loops_of_starts_are_closed():
    env = make_env(64, reset=ALL_MODES)
    state = env.sim.state
    env.sim.write_bodies()
    newton.eval_fk(env.sim.model, state.joint_q, state.joint_qd, state)
    assert loop_gap(env.sim).max() < 1e-5


@pytest.mark.parametrize("start_mode", ["standing", "in_flight", "touchdown", "after_landing"])
def test_the_default_pose_rarely_replaces_invalid_samples(reset_with, start_mode):
    env = reset_with(only(start_mode), Level((0.0, 0.0, 0.45), (0.0, 0.0, 1.2), (0.22, 0.45)))
    assert np.mean(env.task_arrays()["start_mode"] == START_MODES.index("default")) < 0.005


def test_an_unreachable_start_becomes_the_default_pose():
    # a base 0.7 m above paws on the ground: beyond the legs' length
    level = Level((0.0, 0.0, 0.5), (0.0, 0.0, 0.6), (0.7, 0.8))
    env = make_env(16, reset=only("standing"), task=dataclasses.replace(TASK, levels=(level,)))
    assert env.task_arrays()["start_mode"].tolist() == [START_MODES.index("default")] * 16
    np.testing.assert_array_equal(env.sim.joint_q(), env.sim.model.joint_q.numpy().reshape(16, -1))


def test_standing_starts_sample_heading_and_forward_pitch_and_turn_paws_with_the_heading(reset_with):
    env = reset_with(only("standing", heading=180.0, forward_pitch=10.0))
    angles = euler(env.sim.joint_q()[:, QUAT].astype(float))
    # a mean from 0 to 10 degrees, and 5 degrees to either side of it
    assert covers_range(angles[:, 1], -5.0 * DEG, 15.0 * DEG, 0.05)
    spread = math.sqrt(2.0 * 10.0**2 / 12.0) * DEG
    assert angles[:, 1].mean() == pytest.approx(5.0 * DEG, abs=4.0 * spread / math.sqrt(N))
    assert angles[:, 1].std() == pytest.approx(spread, rel=4.0 / math.sqrt(2.0 * N))
    assert angles[:, 2].min() < -3.1 and angles[:, 2].max() > 3.1
    position, _ = paws_and_velocities(env, np.arange(30))
    # paws stand around the origin, turned with the heading
    ahead = (position[:, 0, :2] + position[:, 1, :2] - position[:, 2, :2] - position[:, 3, :2]) / 4.0
    turn = np.arctan2(ahead[:, 1], ahead[:, 0]) - angles[:30, 2]
    assert np.abs((turn + np.pi) % (2.0 * np.pi) - np.pi).max() < 8.0 * DEG


def test_goals_of_worlds_past_the_last_level_are_those_of_a_uniform_level(reset_with):
    env = reset_with(ResetCfg())
    edit_episodes(env, level=len(TASK.levels))
    env.reset()
    goals, levels = env.task_arrays()["goal"][:, Z], set(env.task_arrays()["level"])
    edit_episodes(env, level=0)
    lower, upper = [np.array([getattr(level, end)[2] for level in TASK.levels]) for end in ("goal_lower", "goal_upper")]
    heights = np.linspace(0.4, 1.3, 19)  # [m] at which distribution functions are compared
    expected = sum(np.clip((heights - a) / (b - a), 0.0, 1.0) for a, b in zip(lower, upper, strict=True)) / len(lower)
    below = np.mean(goals[:, None] < heights, axis=0)
    assert np.abs(below - expected).max() < 4.0 * np.sqrt(0.25 / N)
    assert levels == {len(TASK.levels)}


def test_settings_reach_the_kernels_by_name_in_radians_and_steps():
    starts = StartProbability(standing=0.5, default=0.25, in_flight=0.125, after_landing=0.125)
    cfg = ResetCfg(start_probability=starts, tilt=180.0, paw_depth=(0.25, 0.5))
    delays = {"command_delay": 0.25, "long_wait": 1.5, "long_wait_probability": 0.25, "next_jump_delay": (0.5, 1.0)}
    ranges = dataclasses.replace(cfg, **delays).values(1.0 / 60.0).states
    assert list(ranges.start_probability) == [0.5, 0.25, 0.125, 0.0, 0.125, 0.0] and ranges.by_steps == 0
    pushing = dataclasses.replace(starts, after_landing=0.0, pushing=0.125)
    timed = dataclasses.replace(cfg, start_probability=pushing, balance_by="steps").values(1.0 / 60.0).states
    assert list(timed.start_probability) == [0.5, 0.25, 0.125, 0.0, 0.0, 0.125] and timed.by_steps == 1
    assert ranges.tilt == pytest.approx(math.pi) and list(ranges.takeoff_angle) == pytest.approx([0.872665, 1.308997])
    assert list(ranges.paw_depth) == [0.25, 0.5]
    assert (ranges.command_delay, ranges.long_wait, ranges.long_wait_probability) == (15, 90, 0.25)
    assert list(ranges.next_jump_delay) == pytest.approx([30.0, 60.0])


def test_level_values_reach_the_kernel_struct_by_name():
    level = Level(
        (0.25, -0.5, 0.0), (0.5, 0.75, 1.0), (0.125, 0.375), next_jump_probability=0.75, elliptical=True
    ).values()
    assert level.elliptical == 1
    assert (list(level.goal_lower), list(level.goal_upper)) == ([0.25, -0.5, 0.0], [0.5, 0.75, 1.0])
    assert (list(level.base_height), level.next_jump_probability) == ([0.125, 0.375], 0.75)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: StartProbability(standing=-0.1, default=1.1), "start_probability must be >= 0 and add up to 1"),
        (lambda: StartProbability(standing=0.9), "start_probability must be >= 0 and add up to 1"),
        (lambda: ResetCfg(paw_depth=(0.45, 0.3)), r"paw_depth must be \(lower, upper\), got \(0.45, 0.3\)"),
        (lambda: ResetCfg(landed_speed=(0.0, math.inf)), "landed_speed must be in .*, got inf"),
        (lambda: ResetCfg(base_xy=math.nan), "base_xy must be in .*, got nan"),
        (lambda: ResetCfg(command_delay=-0.1), "command_delay must not be negative, got -0.1"),
        (lambda: ResetCfg(long_wait_probability=1.1), r"long_wait_probability must be in \[0, 1\], got 1.1"),
        (lambda: ResetCfg(next_jump_delay=(-0.1, 0.2)), "next_jump_delay must not be negative"),
        (lambda: ResetCfg(balance_by="worlds"), "balance_by must be resets or steps, got 'worlds'"),
        (lambda: dataclasses.replace(TASK.levels[0], next_jump_probability=1.1), "next_jump_probability must be in"),
    ],
)
def test_refuses_invalid_starts_and_levels(make, message):
    with pytest.raises(ValueError, match=message):
        make()
