import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jump_helpers import (
    DEG,
    NUM_START_MODES,
    begin_by,
    edit_episodes,
    episodes_of,
    make_env,
    only,
    resets_of,
    set_levels,
)
from jump_starts import PAW_RADIUS, PLACES, Starts, covers, paws_and_velocities
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE
from jumper_warp.registry import make_task
from solver_helpers import MOTOR_Q, MOTOR_V

N = 4096
G = 9.81
LANDING_HEIGHT = 0.30  # [m]
CORNER = 0.05 * np.sqrt(2.0)  # [m] how far the start of a jump lies from the origin at most


def land(pos: np.ndarray, vel: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Return place [m] and time [s] at which point masses fall through a height, by small steps."""
    pos, vel, dt = pos.copy(), vel.copy(), 2.0e-3
    found, when = np.full_like(pos, np.nan), np.full(len(pos), np.nan)
    for step in range(600):
        after = pos + dt * vel - [0.0, 0.0, 0.5 * G * dt**2]
        through = np.isnan(when) & (pos[:, 2] >= height) & (after[:, 2] < height)
        share = (pos[:, 2] - height) / np.maximum(pos[:, 2] - after[:, 2], 1e-12)
        found[through] = (pos + share[:, None] * (after - pos))[through]
        when[through] = dt * (step + share[through])
        pos, vel = after, vel - [0.0, 0.0, G * dt]
    return found, when


@pytest.fixture(scope="module", params=PLACES)
def env(request):
    return make_env(N, task=make_task(request.param), seed=1)


@pytest.fixture(scope="module")
def starts(env):
    """Beginnings of every scheme, (scheme) -> Starts, and those of jumps from the very origin, (exact scheme)."""
    found = {start_mode: Starts(env, start_mode) for start_mode in NUM_START_MODES}
    return found | {
        f"exact {start_mode}": Starts(env, start_mode, exact=True)
        for start_mode in ("in_flight", "touchdown", "after_landing")
    }


def test_schemes_have_the_tasks_shares(env):
    begin_by(env, dataclasses.replace(resets_of(env), balance_by="resets"))
    edit_episodes(env, level=np.arange(N) % len(env.task.levels))
    env.reset()
    shares = np.bincount(episodes_of(env)["start_mode"], minlength=6) / N
    # 0.02: default poses that stand in for what cannot be drawn
    assert np.abs(shares - [0.40, 0.15, 0.15, 0.15, 0.05, 0.10]).max() < 4.0 * np.sqrt(0.25 / N) + 0.02


@pytest.mark.parametrize("start_mode", NUM_START_MODES)
def test_no_state_collides_or_crosses_the_motor_limits(starts, start_mode):
    assert not starts[start_mode].flags.any()
    angles = starts[start_mode].q[:, MOTOR_Q].reshape(-1, 4, 3)
    assert np.abs(angles[..., 0]).max() <= 15.0 * DEG + 1e-4
    sums = angles[..., 1:].sum(axis=2)
    assert sums.min() >= -1e-4 and sums.max() <= 220.0 * DEG + 1e-4


@pytest.mark.parametrize("start_mode", [name for name in NUM_START_MODES if name != "default"])
def test_the_default_pose_rarely_stands_in(starts, start_mode):
    assert starts[start_mode].fallbacks < 0.02


@pytest.mark.parametrize("start_mode", NUM_START_MODES)
def test_headings_cover_the_circle(env, starts, start_mode):
    found = starts[start_mode]
    heading = found.episodes["heading"]
    assert covers(heading, -np.pi, np.pi, 0.01)
    shares = np.histogram(heading, np.linspace(-np.pi, np.pi, 9))[0] / len(heading)
    assert np.abs(shares - 0.125).max() < 5.0 * np.sqrt(0.125 * 0.875 / len(heading))
    body = (found.heading.inv() * Rotation.from_quat(found.q[:, 3:7])).as_euler("ZYX")
    if start_mode in ("in_flight", "touchdown", "pushing"):  # nose down in the mean
        down = env.task.reset.settings.takeoff_pitch[1] * DEG
        assert covers(body[:, 1], -5.0 * DEG, down + 5.0 * DEG, 0.1)
        body[:, 1] = body[:, 0]
    half = 0.0 if start_mode == "default" else 5.0 * DEG
    assert np.abs(body[:, [0, 2]]).max() <= half + 1e-4
    if start_mode not in ("standing", "default"):
        assert covers(body[:, 0], -half, half) and covers(body[:, 1], -half, half) and covers(body[:, 2], -half, half)


def test_only_forward_jumps_begin_pitched_forward(env, starts):
    body = (starts["standing"].heading.inv() * Rotation.from_quat(starts["standing"].q[:, 3:7])).as_euler("ZYX")
    mean = 10.0 * DEG if env.task.name == "horizontal-jump" else 0.0
    assert covers(body[:, 1], -5.0 * DEG, mean + 5.0 * DEG, 0.1)
    # 0.15: what cannot be reached leaning back is drawn again, pitched down more often
    assert body[:, 1].mean() == pytest.approx(0.5 * mean, abs=0.15 * mean + 4.0 * 5.0 * DEG / np.sqrt(len(body)))


@pytest.mark.parametrize("start_mode", NUM_START_MODES)
def test_goals_lie_in_the_levels_box_or_ellipse_turned_by_the_heading(env, starts, start_mode):
    found = starts[start_mode]
    ahead = found.heading.inv().apply(found.goal)
    for number, level in enumerate(env.task.levels):
        here = ahead[found.level == number]
        for axis in (0, 1):
            assert covers(here[:, axis], level.goal_lower[axis], level.goal_upper[axis], 0.05)
        if level.elliptical:
            reach = np.where(here < 0.0, np.negative(level.goal_lower), level.goal_upper)[:, :2]
            radius = np.linalg.norm(here[:, :2] / reach, axis=1)
            assert radius.max() <= 1.0 + 1e-4 and np.histogram(radius, 4, (0.0, 1.0))[0].min() > 0
    assert not found.episodes["goal"][:, 2].any()


def test_phases_and_the_command_fit_the_scheme(starts):
    for start_mode, phase in zip(NUM_START_MODES, (STANCE, STANCE, FLIGHT, FLIGHT, LANDED, STANCE), strict=True):
        episodes = starts[start_mode].episodes
        assert (episodes["phase"] == int(phase)).all()
        if start_mode in ("standing", "default"):
            assert set(episodes["command_step"]) == set(range(31))
        else:
            assert not episodes["command_step"].any()
        if phase == LANDED:
            assert set(episodes["phase_steps"]) == set(range(18))
        else:
            assert not episodes["phase_steps"].any()
        for name in ("steps", "jumps", "took_off", "touched_down", "idle_steps"):
            assert not episodes[name].any(), name


def test_standing_paws_are_on_the_ground_within_their_boxes(env, starts):
    found = starts["standing"]
    paws = found.paws_around(np.zeros_like(found.pos))
    np.testing.assert_allclose(found.paws[..., 2], PAW_RADIUS, atol=2e-4)
    assert covers(paws[..., 0], 0.20, 0.22)
    assert covers(paws[:, :2, 1], 0.15, 0.17) and covers(paws[:, 2:, 1], 0.20, 0.22)
    level = np.array([level.base_height for level in env.task.levels])[found.level]
    behind, aside = found.split((np.zeros(3) - found.pos) * [1.0, 1.0, 0.0])
    low = (level[:, 1] - found.pos[:, 2]) / (level[:, 1] - level[:, 0])
    lean = env.task.reset.settings.lean
    assert (behind >= -CORNER - 1e-5).all() and (behind <= lean * low + CORNER + 1e-5).all()
    assert np.abs(aside).max() <= CORNER + 1e-5 and behind[low > 0.9].max() > 0.8 * lean
    assert (found.episodes["start"][:, :2] == 0.0).all()  # where the paws are, however the robot leans
    for number, level in enumerate(env.task.levels):
        assert covers(found.pos[found.level == number, 2], *level.base_height)
    assert not found.qd.any()


def test_landed_robots_are_around_their_goal_with_paws_at_rest_on_the_ground(starts):
    found = starts["after_landing"]
    np.testing.assert_allclose(found.paws[..., 2], PAW_RADIUS, atol=2e-4)
    paws = found.paws_around(found.goal)
    assert covers(paws[..., 0], 0.20, 0.22)
    assert covers(paws[:, :2, 1], 0.15, 0.17) and covers(paws[:, 2:, 1], 0.20, 0.22)
    assert covers(found.pos[:, 2], 0.30, 0.45)
    assert covers(-found.vel[:, 2], 0.0, 1.0) and not found.vel[:, :2].any()
    exact = starts["exact after_landing"]
    ahead, aside = exact.split((exact.pos - exact.goal) * [1.0, 1.0, 0.0])
    assert covers(ahead, -0.15, 0.10) and np.abs(aside).max() < 1e-5
    error = np.linalg.norm((found.pos - found.goal)[:, :2], axis=1)
    assert error.max() < 0.15 + CORNER + 1e-5


def test_pushes_lead_over_their_takeoff_to_the_goal(env):
    """A push of 0.2 m at 15 m/s^2 ends in the takeoff of a projectile to the goal."""
    found = Starts(env, "pushing", exact=True, push_length=(0.2, 0.2), push_acceleration=(15.0, 15.0))
    speed = np.linalg.norm(found.vel, axis=1)
    moving = (speed > 0.05) & (found.distance > 0.4)
    assert moving.mean() > 0.1
    way = found.vel[moving] / speed[moving, None]
    leaving = np.sqrt(speed[moving] ** 2 + 2.0 * 15.0 * 0.2)
    takeoff = found.pos[moving] + 0.2 * way
    assert takeoff[:, 2].min() >= 0.40 - 1e-4 and takeoff[:, 2].max() <= 0.45 + 1e-4
    place, _ = land(takeoff, leaving[:, None] * way, LANDING_HEIGHT)
    np.testing.assert_allclose(place[:, :2], found.goal[moving, :2], atol=1e-3)
    assert (found.episodes["start"][:, :2] == 0.0).all()


def test_paws_of_a_push_rest_on_the_ground_around_the_start(starts):
    found = starts["pushing"]
    np.testing.assert_allclose(found.paws[..., 2], PAW_RADIUS, atol=2e-4)
    paws = found.paws_around(np.zeros_like(found.pos))
    assert covers(paws[..., 0], 0.20, 0.22)
    assert np.linalg.norm(found.vel, axis=1).max() > 3.0  # nearly a takeoff


def test_joints_of_a_push_move_so_that_the_paws_do_not(env):
    begin_by(env, only("pushing", resets_of(env)))
    env.reset()
    worlds = np.flatnonzero(episodes_of(env)["start_mode"] == NUM_START_MODES.index("pushing"))[:40]
    _, velocities = paws_and_velocities(env, worlds)
    assert np.abs(velocities).max() < 1e-3 and np.abs(env.sim.joint_qd()[worlds, :3]).max() > 1.0


def test_shares_of_time_are_met_however_long_episodes_are():
    """Jumps that begin standing last 3 s here, in flight 1.5 s, landed 1 s: of resets the shares are others."""
    length = np.array([180, 120, 90, 60, 60, 45])
    task = make_task("horizontal-jump")
    env = make_env(64, task=task, seed=3)
    resets, schemes = np.zeros(6), []
    for _ in range(120):
        schemes.append(episodes_of(env)["start_mode"])
        resets += np.bincount(schemes[-1], minlength=6)
        edit_episodes(env, steps=length[schemes[-1]])
        env.episodes.done.fill_(1.0)
        env.reset()
    wanted = np.array([0.40, 0.15, 0.15, 0.15, 0.05, 0.10])
    time = resets * length
    np.testing.assert_allclose(time / time.sum(), wanted, atol=0.02)
    assert resets[4] / resets.sum() > 1.3 * wanted[4]
    own = np.array([np.bincount(column, minlength=6) for column in np.array(schemes).T]) * length
    assert np.abs(own / own.sum(axis=1, keepdims=True) - wanted).max() < 0.08  # of every single world
    counted = episodes_of(env)["steps_per_mode"]
    assert np.abs(counted.sum() - time.sum()) < 1.0


def test_flights_lead_to_the_goal(starts):
    found, spread = starts["exact in_flight"], starts["in_flight"]
    place, _ = land(found.pos, found.vel, LANDING_HEIGHT)
    assert not np.isnan(place).any()
    miss = place - found.goal
    far = found.distance >= 0.1
    np.testing.assert_allclose(miss[far, :2], 0.0, atol=5e-4)
    np.testing.assert_allclose(miss[:, :2], 0.0, atol=5e-4)  # those of the nearest goals go straight up
    miss = (land(spread.pos, spread.vel, LANDING_HEIGHT)[0] - spread.goal)[spread.distance >= 0.1]
    assert covers(miss[:, 0], -0.05, 0.05) and covers(miss[:, 1], -0.05, 0.05)


def test_flights_take_off_within_their_angles_but_not_too_high(starts):
    found = starts["exact in_flight"]
    _, left = land(found.pos, found.vel, LANDING_HEIGHT)
    # the share of the flight that has passed is 0.02 to 0.10
    up = [found.vel[:, 2] + G * left * share / (1.0 - share) for share in (0.02, 0.10)]
    forward = np.linalg.norm(found.vel[:, :2], axis=1)
    apex = found.pos[:, 2] + np.maximum(found.vel[:, 2], 0.0) ** 2 / (2.0 * G)
    assert apex.max() <= 1.0 + 1e-4
    free = (apex < 0.999) & (found.distance > 0.15)
    shallowest, steepest = (np.degrees(np.arctan2(v, forward)) for v in up)
    assert shallowest[free].max() <= 75.0 + 0.1 and steepest[free].min() >= 35.0 - 0.1
    assert np.ptp(0.5 * (shallowest + steepest)[free]) > 35.0
    start = [found.pos[:, 2] - v * t + 0.5 * G * t**2 for v, t in zip(up, (left / 49.0, left / 9.0), strict=True)]
    assert np.maximum(*start).min() >= 0.40 - 1e-3 and np.minimum(*start).max() <= 0.45 + 1e-3


def test_flights_begin_with_bent_legs_and_paws_off_the_ground(starts):
    found = starts["in_flight"]
    angles = found.q[:, MOTOR_Q].reshape(-1, 4, 3)
    assert covers(angles[..., 1:], 40.0 * DEG, 80.0 * DEG)
    assert covers(angles[..., 0], -10.0 * DEG - 0.03, 10.0 * DEG + 0.03, 0.1)
    assert found.paws[..., 2].min() >= PAW_RADIUS + 0.01 - 1e-4
    assert not found.qd[:, MOTOR_V].any() and not found.qd[:, 3:6].any()


def test_touchdowns_lead_to_the_goal_once_their_lag_is_made_up(env, starts):
    found = starts["exact touchdown"]
    place, left = land(found.pos, found.vel, LANDING_HEIGHT)
    assert left.min() >= 0.03 - 2e-3 and left.max() <= 0.15 + 2e-3
    lag, aside = found.split((found.goal - place) * [1.0, 1.0, 0.0])
    far = found.distance >= 0.1
    assert covers(lag[far], *env.task.reset.settings.touchdown_behind) and np.abs(aside[far]).max() < 5e-4
    assert lag[~far].max(initial=0.0) <= 0.20 + 5e-4 and np.abs(aside).max() < 5e-4
    shares = np.histogram(lag[far], np.linspace(*env.task.reset.settings.touchdown_behind, 4))[0] / far.sum()
    assert shares.min() > 0.1  # long lags are out of the legs' reach more often, above all sideways
    spread = starts["touchdown"]
    lag, aside = spread.split((spread.goal - land(spread.pos, spread.vel, LANDING_HEIGHT)[0]) * [1.0, 1.0, 0.0])
    far = spread.distance >= 0.1
    assert lag[far].min() >= 0.05 - CORNER and lag[far].max() <= 0.20 + CORNER and np.abs(aside).max() <= CORNER + 5e-4


def test_touchdowns_have_their_paws_ahead_of_the_base_towards_the_goal(env, starts):
    behind = env.task.reset.settings.touchdown_behind
    found = starts["touchdown"]
    # the paws' boxes are centred on the projectile to 1 cm in x and y
    ahead, aside = found.split((found.paws.mean(axis=1) - found.pos) * [1.0, 1.0, 0.0])
    assert ahead.min() > behind[0] - 0.0142 and ahead.max() < behind[1] + 0.0142
    assert np.abs(aside).max() < 0.0142
    assert ahead.mean() > behind[0] + 0.25 * (behind[1] - behind[0])


def test_touchdowns_reach_for_the_ground_but_not_below_it(starts):
    found = starts["touchdown"]
    depth, height = found.pos[:, 2, None] - found.paws[..., 2], found.pos[:, 2, None]
    assert np.ptp(found.paws[..., 2], axis=1).max() < 2e-4
    assert found.paws[..., 2].min() >= 0.05 - 1e-4
    assert depth.max() <= 0.45 + 1e-4 and (depth >= np.minimum(0.30, height - 0.05) - 2e-4).all()
    assert (found.pos[:, 2] > LANDING_HEIGHT - 1e-4).all() and not found.qd[:, MOTOR_V].any()


def test_touchdowns_fall(starts):
    found = starts["touchdown"]
    # begun up to 0.15 s before the landing: what does not fall yet flies for less than 0.3 s, so it took off with less
    # than 1.14 m/s upward from 0.1 m above the landing, at 35 degrees or more, for less than 0.49 m, up to 0.35 m ahead
    assert (found.vel[found.distance > 0.84, 2] < 0.0).all()
    assert (found.vel[found.distance > 0.2, 2] < 0.0).mean() > 0.99  # 0.9993 of 300,000


def test_another_goal_is_planned_past_the_first_level_only(env, starts):
    planned = np.concatenate([starts[start_mode].episodes["next_jump_step"] for start_mode in NUM_START_MODES])
    level = np.concatenate([starts[start_mode].level for start_mode in NUM_START_MODES])
    assert not planned[level == 0].any()
    share = (planned[level > 1] > 0).mean()  # the first goals have two levels of starts
    assert not planned[level == 1].any()
    assert share == pytest.approx(0.175, abs=4.0 * np.sqrt(0.175 * 0.825 / (level > 1).sum()))
    assert covers(planned[planned > 0], 12.0, 42.0, 0.05)  # 0.2 to 0.7 s
    set_levels(env, *(dataclasses.replace(level, next_jump_probability=0.0) for level in env.task.levels))
    env.reset()
    assert not episodes_of(env)["next_jump_step"].any()
