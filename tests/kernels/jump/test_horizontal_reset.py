import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from columns import ANG_VEL, MOTOR_COORDS, MOTOR_DOFS, QUAT, XY, X, Y, Z
from jump_helpers import DEG, START_MODES, begin_by, edit_episodes, episodes_of, make_env, only, resets_of, set_levels
from jump_starts import PAW_RADIUS, PLACES, Starts, covers, paws_and_velocities
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE
from jumper_warp.registry import make_task

N = 4096
G = 9.81  # [m/s^2]
LANDING_HEIGHT = 0.30  # [m] of the base
CORNER = 0.05 * np.sqrt(2.0)  # [m] largest horizontal offset of the base, from `base_xy` 0.05


def land(pos: np.ndarray, vel: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Return position (n, 3) [m] and time (n,) [s] at which point masses fall through `height` [m], NaN if never.

    pos [m], vel [m/s]: (n, 3). Oracle of the ballistic formulas: steps of 2 ms, linear within a step.
    """
    pos, vel, dt = pos.copy(), vel.copy(), 2.0e-3
    place, when = np.full_like(pos, np.nan), np.full(len(pos), np.nan)
    for step in range(600):
        after = pos + dt * vel - [0.0, 0.0, 0.5 * G * dt**2]
        through = np.isnan(when) & (pos[:, Z] >= height) & (after[:, Z] < height)
        fraction = (pos[:, Z] - height) / np.maximum(pos[:, Z] - after[:, Z], 1e-12)
        place[through] = (pos + fraction[:, None] * (after - pos))[through]
        when[through] = dt * (step + fraction[through])
        pos, vel = after, vel - [0.0, 0.0, G * dt]
    return place, when


@pytest.fixture(scope="module", params=PLACES)
def env(request):
    """Return an environment of each task with a horizontal goal."""
    return make_env(N, task=make_task(request.param), seed=1)


@pytest.fixture(scope="module")
def starts(env):
    """Return the `Starts` of every mode by its name, and without base offset by "exact " and its name."""
    samples = {start_mode: Starts(env, start_mode) for start_mode in START_MODES}
    return samples | {
        f"exact {start_mode}": Starts(env, start_mode, exact=True)
        for start_mode in ("in_flight", "touchdown", "after_landing")
    }


def test_start_modes_have_the_tasks_probabilities(env):
    begin_by(env, dataclasses.replace(resets_of(env), balance_by="resets"))
    edit_episodes(env, level=np.arange(N) % len(env.task.levels))
    env.reset()
    fractions = np.bincount(episodes_of(env)["start_mode"], minlength=6) / N
    shares = {"horizontal-jump": [0.40, 0.15, 0.15, 0.15, 0.05, 0.10]}
    shares["horizontal-jump-standing"] = [0.30, 0.15, 0.15, 0.10, 0.20, 0.10]
    # 0.02: default poses in place of samples that are invalid in all attempts
    assert np.abs(fractions - shares[env.task.name]).max() < 4.0 * np.sqrt(0.25 / N) + 0.02


@pytest.mark.parametrize("start_mode", START_MODES)
def test_no_state_collides_or_crosses_the_motor_limits_and_few_samples_are_invalid(starts, start_mode):
    assert not starts[start_mode].flags.any() and (start_mode == "default" or starts[start_mode].fallbacks < 0.02)
    angles = starts[start_mode].q[:, MOTOR_COORDS].reshape(-1, 4, 3)
    assert np.abs(angles[..., 0]).max() <= 15.0 * DEG + 1e-4
    sums = angles[..., 1:].sum(axis=2)
    assert sums.min() >= -1e-4 and sums.max() <= 220.0 * DEG + 1e-4


def test_starts_may_exceed_the_filters_limit_up_to_the_resets_own():
    task = make_task("horizontal-jump-standing")
    limits = dataclasses.replace(task.command_filter.transversal, upper=110.0)
    lower = dataclasses.replace(task.command_filter, transversal=limits)
    env = make_env(N, task=dataclasses.replace(task, command_filter=lower), seed=1)
    angles = Starts(env, "standing").q[:, MOTOR_COORDS].reshape(-1, 4, 3)[..., 1:] / DEG
    assert 120.0 < angles.max() <= task.reset.settings.transversal_limit + 0.01


@pytest.mark.parametrize("start_mode", START_MODES)
def test_headings_cover_the_circle_and_attitudes_their_ranges(env, starts, start_mode):
    sample = starts[start_mode]
    heading = sample.episodes["heading"]
    assert covers(heading, -np.pi, np.pi, 0.01)
    fractions = np.histogram(heading, np.linspace(-np.pi, np.pi, 9))[0] / len(heading)
    assert np.abs(fractions - 0.125).max() < 5.0 * np.sqrt(0.125 * 0.875 / len(heading))
    body = (sample.heading.inv() * Rotation.from_quat(sample.q[:, QUAT])).as_euler("ZYX")
    if start_mode in ("in_flight", "touchdown", "pushing"):  # nose down in the mean
        down = env.task.reset.settings.takeoff_pitch[1] * DEG
        assert covers(body[:, 1], -5.0 * DEG, down + 5.0 * DEG, 0.1)
        body[:, 1] = body[:, 0]  # pitch is checked: leave it out below
    half = 0.0 if start_mode == "default" else 5.0 * DEG
    assert np.abs(body[:, [0, 2]]).max() <= half + 1e-4
    if start_mode not in ("standing", "default"):
        assert covers(body[:, 0], -half, half) and covers(body[:, 1], -half, half) and covers(body[:, 2], -half, half)


def test_only_horizontal_jumps_stand_pitched_forward(env, starts):
    body = (starts["standing"].heading.inv() * Rotation.from_quat(starts["standing"].q[:, QUAT])).as_euler("ZYX")
    mean = 10.0 * DEG if env.task.name == "horizontal-jump" else 0.0
    assert covers(body[:, 1], -5.0 * DEG, mean + 5.0 * DEG, 0.1)
    # 0.15: samples that lean back are rejected more often, which raises the mean pitch
    assert body[:, 1].mean() == pytest.approx(0.5 * mean, abs=0.15 * mean + 4.0 * 5.0 * DEG / np.sqrt(len(body)))


@pytest.mark.parametrize("start_mode", START_MODES)
def test_goals_lie_in_the_levels_box_or_ellipse_turned_by_the_heading(env, starts, start_mode):
    sample = starts[start_mode]
    ahead = sample.heading.inv().apply(sample.goal)
    shares = []  # of the half axes, in all ellipses
    for number, level in enumerate(env.task.levels):
        here = ahead[sample.level == number]
        if not level.elliptical:
            for axis in (X, Y):
                assert covers(here[:, axis], level.goal_lower[axis], level.goal_upper[axis], 0.05)
            continue
        half_axes = np.where(here < 0.0, np.negative(level.goal_lower), level.goal_upper)[:, XY]
        shares.append(here[:, XY] / half_axes)
        radius = np.linalg.norm(shares[-1], axis=1)
        assert radius.max() <= 1.0 + 1e-4 and np.histogram(radius, 4, (0.0, 1.0))[0].min() > 0
    if shares:
        assert all(covers(share, -1.0, 1.0, 0.02) for share in np.concatenate(shares).T)
    assert not sample.episodes["goal"][:, Z].any()


def test_phases_and_the_command_fit_the_start_mode(env, starts):
    for start_mode, phase in zip(START_MODES, (STANCE, STANCE, FLIGHT, FLIGHT, LANDED, STANCE), strict=True):
        episodes = starts[start_mode].episodes
        assert (episodes["phase"] == int(phase)).all()
        if start_mode in ("standing", "default"):
            settings = env.task.reset.settings
            waits = episodes["command_step"] > 30  # longer than 0.5 s
            assert set(episodes["command_step"][~waits]) == set(range(31))
            share = waits.mean() / (1.0 - 30.0 / 240.0)  # of long waits, which are 0 to 4 s
            assert share == pytest.approx(settings.long_wait_probability, abs=0.08)
            assert episodes["command_step"].max() <= 60.0 * settings.long_wait
        else:
            assert not episodes["command_step"].any()
        if phase == LANDED:
            assert set(episodes["phase_steps"]) == set(range(18))  # less than 0.3 s
        else:
            assert not episodes["phase_steps"].any()
        for name in ("steps", "jumps", "took_off", "touched_down", "idle_steps"):
            assert not episodes[name].any(), name


def test_standing_starts_have_paws_in_their_boxes_and_lean_back_the_lower_they_are(env, starts):
    sample = starts["standing"]
    paws = sample.paws_around(np.zeros_like(sample.pos))
    np.testing.assert_allclose(sample.paws[..., Z], PAW_RADIUS, atol=2e-4)
    assert covers(paws[..., X], 0.20, 0.22)
    assert covers(paws[:, :2, 1], 0.15, 0.17) and covers(paws[:, 2:, 1], 0.20, 0.22)
    level = np.array([level.base_height for level in env.task.levels])[sample.level]
    behind, aside = sample.split((np.zeros(3) - sample.pos) * [1.0, 1.0, 0.0])
    low = (level[:, 1] - sample.pos[:, Z]) / (level[:, 1] - level[:, 0])
    lean = env.task.reset.settings.lean
    assert (behind >= -CORNER - 1e-5).all() and (behind <= lean * low + CORNER + 1e-5).all()
    assert np.abs(aside).max() <= CORNER + 1e-5 and behind[low > 0.9].max() > 0.8 * lean
    assert (sample.episodes["start"][:, XY] == 0.0).all()  # middle of the paws, not the leaning base
    for number, level in enumerate(env.task.levels):
        assert covers(sample.pos[sample.level == number, 2], *level.base_height)
    assert not sample.qd.any()


def test_landed_starts_are_around_their_goal_with_paws_on_the_ground_and_move_down(starts):
    sample = starts["after_landing"]
    np.testing.assert_allclose(sample.paws[..., Z], PAW_RADIUS, atol=2e-4)
    paws = sample.paws_around(sample.goal)
    assert covers(paws[..., X], 0.20, 0.22)
    assert covers(paws[:, :2, 1], 0.15, 0.17) and covers(paws[:, 2:, 1], 0.20, 0.22)
    assert covers(sample.pos[:, Z], 0.30, 0.45)
    assert covers(-sample.vel[:, Z], 0.0, 1.0) and not sample.vel[:, XY].any()
    exact = starts["exact after_landing"]
    ahead, aside = exact.split((exact.pos - exact.goal) * [1.0, 1.0, 0.0])
    assert covers(ahead, -0.15, 0.10) and np.abs(aside).max() < 1e-5
    error = np.linalg.norm((sample.pos - sample.goal)[:, :2], axis=1)
    assert error.max() < 0.15 + CORNER + 1e-5


def test_pushing_starts_accelerate_to_a_takeoff_whose_flight_ends_at_the_goal(env):
    """A push of 0.2 m at 15 m/s^2 ends in the takeoff of a projectile to the goal, integrated by `land`."""
    sample = Starts(env, "pushing", exact=True, push_length=(0.2, 0.2), push_acceleration=(15.0, 15.0))
    speed = np.linalg.norm(sample.vel, axis=1)
    moving = (speed > 0.05) & (sample.distance > 0.4)
    assert moving.mean() > 0.1
    along = sample.vel[moving] / speed[moving, None]
    takeoff_speed = np.sqrt(speed[moving] ** 2 + 2.0 * 15.0 * 0.2)
    takeoff = sample.pos[moving] + 0.2 * along
    assert takeoff[:, Z].min() >= 0.40 - 1e-4 and takeoff[:, Z].max() <= 0.45 + 1e-4
    place, _ = land(takeoff, takeoff_speed[:, None] * along, LANDING_HEIGHT)
    np.testing.assert_allclose(place[:, XY], sample.goal[moving, :2], atol=1e-3)
    assert (sample.episodes["start"][:, XY] == 0.0).all()


def test_paws_of_a_push_rest_on_the_ground_around_the_start(starts):
    sample = starts["pushing"]
    np.testing.assert_allclose(sample.paws[..., Z], PAW_RADIUS, atol=2e-4)
    paws = sample.paws_around(np.zeros_like(sample.pos))
    assert covers(paws[..., X], 0.20, 0.22)
    assert np.linalg.norm(sample.vel, axis=1).max() > 3.0  # [m/s] nearly a takeoff


@pytest.mark.parametrize("start_mode", ["pushing", "after_landing"])
def test_paws_on_the_ground_are_at_rest_while_the_base_moves(env, start_mode):
    begin_by(env, only(start_mode, resets_of(env)))
    env.reset()
    worlds = np.flatnonzero(episodes_of(env)["start_mode"] == START_MODES.index(start_mode))[:40]
    _, velocities = paws_and_velocities(env, worlds)
    assert np.abs(velocities).max() < 1e-3 and np.abs(env.sim.joint_qd()[worlds, :3]).max() > 0.9


def test_start_modes_take_their_fractions_of_policy_steps_whatever_their_episode_length():
    """Jumps that begin standing last 3 s, in flight 1.5 s, landed 1 s, so fractions of resets and of steps differ."""
    length = np.array([180, 120, 90, 60, 60, 45])  # policy steps of an episode, by start mode
    task = make_task("horizontal-jump")
    env = make_env(64, task=task, seed=3)
    resets, modes = np.zeros(6), []
    for _ in range(120):
        modes.append(episodes_of(env)["start_mode"])
        resets += np.bincount(modes[-1], minlength=6)
        edit_episodes(env, steps=length[modes[-1]])
        env.episodes.done.fill_(1.0)
        env.reset()
    expected = np.array([0.40, 0.15, 0.15, 0.15, 0.05, 0.10])
    time = resets * length
    np.testing.assert_allclose(time / time.sum(), expected, atol=0.02)
    assert resets[4] / resets.sum() > 1.3 * expected[4]
    by_world = np.array([np.bincount(column, minlength=6) for column in np.array(modes).T]) * length
    assert np.abs(by_world / by_world.sum(axis=1, keepdims=True) - expected).max() < 0.08
    counted = episodes_of(env)["steps_per_mode"]
    assert np.abs(counted.sum() - time.sum()) < 1.0


def test_ballistic_flights_end_at_the_goal(starts):
    sample, spread = starts["exact in_flight"], starts["in_flight"]
    place, _ = land(sample.pos, sample.vel, LANDING_HEIGHT)
    assert not np.isnan(place).any()
    miss = place - sample.goal
    np.testing.assert_allclose(miss[:, XY], 0.0, atol=5e-4)
    miss = (land(spread.pos, spread.vel, LANDING_HEIGHT)[0] - spread.goal)[spread.distance >= 0.1]
    assert covers(miss[:, X], -0.05, 0.05) and covers(miss[:, Y], -0.05, 0.05)


def test_flights_take_off_within_the_ranges_of_angle_height_and_apex(starts):
    sample = starts["exact in_flight"]
    _, left = land(sample.pos, sample.vel, LANDING_HEIGHT)
    # [m/s] takeoff speeds for 0.02 and 0.10, the ends of `flight_time`, of the flight's duration passed
    up = [sample.vel[:, Z] + G * left * fraction / (1.0 - fraction) for fraction in (0.02, 0.10)]
    forward = np.linalg.norm(sample.vel[:, XY], axis=1)
    apex = sample.pos[:, Z] + np.maximum(sample.vel[:, Z], 0.0) ** 2 / (2.0 * G)
    assert apex.max() <= 1.0 + 1e-4
    free = (apex < 0.999) & (sample.distance > 0.15)
    shallowest, steepest = (np.degrees(np.arctan2(v, forward)) for v in up)
    assert shallowest[free].max() <= 75.0 + 0.1 and steepest[free].min() >= 35.0 - 0.1
    assert np.ptp(0.5 * (shallowest + steepest)[free]) > 35.0
    start = [sample.pos[:, Z] - v * t + 0.5 * G * t**2 for v, t in zip(up, (left / 49.0, left / 9.0), strict=True)]
    assert np.maximum(*start).min() >= 0.40 - 1e-3 and np.minimum(*start).max() <= 0.45 + 1e-3


def test_flights_begin_with_resting_bent_legs_and_paws_off_the_ground(starts):
    sample = starts["in_flight"]
    angles = sample.q[:, MOTOR_COORDS].reshape(-1, 4, 3)
    assert covers(angles[..., 1:], 40.0 * DEG, 80.0 * DEG)
    assert covers(angles[..., 0], -10.0 * DEG - 0.03, 10.0 * DEG + 0.03, 0.1)
    assert sample.paws[..., Z].min() >= PAW_RADIUS + 0.01 - 1e-4
    assert not sample.qd[:, MOTOR_DOFS].any() and not sample.qd[:, ANG_VEL].any()


def test_touchdown_starts_lag_behind_the_flight_to_the_goal_by_touchdown_behind(env, starts):
    sample = starts["exact touchdown"]
    place, left = land(sample.pos, sample.vel, LANDING_HEIGHT)
    assert left.min() >= 0.03 - 2e-3 and left.max() <= 0.15 + 2e-3
    lag, aside = sample.split((sample.goal - place) * [1.0, 1.0, 0.0])
    far = sample.distance >= 0.1
    assert covers(lag[far], *env.task.reset.settings.touchdown_behind) and np.abs(aside[far]).max() < 5e-4
    assert lag[~far].max(initial=0.0) <= 0.20 + 5e-4 and np.abs(aside).max() < 5e-4
    fractions = np.histogram(lag[far], np.linspace(*env.task.reset.settings.touchdown_behind, 4))[0] / far.sum()
    assert fractions.min() > 0.1  # long lags are rejected more often
    spread = starts["touchdown"]
    lag, aside = spread.split((spread.goal - land(spread.pos, spread.vel, LANDING_HEIGHT)[0]) * [1.0, 1.0, 0.0])
    far = spread.distance >= 0.1
    assert lag[far].min() >= 0.05 - CORNER and lag[far].max() <= 0.20 + CORNER and np.abs(aside).max() <= CORNER + 5e-4


def test_touchdown_starts_have_their_paws_ahead_of_the_base_towards_the_goal(env, starts):
    behind = env.task.reset.settings.touchdown_behind
    sample = starts["touchdown"]
    # the paws' boxes are centred on the projectile to 1 cm in x and y
    ahead, aside = sample.split((sample.paws.mean(axis=1) - sample.pos) * [1.0, 1.0, 0.0])
    assert ahead.min() > behind[0] - 0.0142 and ahead.max() < behind[1] + 0.0142
    assert np.abs(aside).max() < 0.0142
    assert ahead.mean() > behind[0] + 0.25 * (behind[1] - behind[0])


def test_touchdown_starts_have_resting_paws_at_one_height_above_the_ground(starts):
    sample = starts["touchdown"]
    depth, height = sample.pos[:, 2, None] - sample.paws[..., Z], sample.pos[:, 2, None]
    assert np.ptp(sample.paws[..., Z], axis=1).max() < 2e-4
    assert sample.paws[..., Z].min() >= 0.05 - 1e-4
    assert depth.max() <= 0.45 + 1e-4 and (depth >= np.minimum(0.30, height - 0.05) - 2e-4).all()
    assert (sample.pos[:, Z] > LANDING_HEIGHT - 1e-4).all() and not sample.qd[:, MOTOR_DOFS].any()


def test_touchdown_starts_of_far_goals_fall(starts):
    sample = starts["touchdown"]
    # starts are up to 0.15 s before the landing: a base that still rises flies for less than 0.3 s, so it took off with
    # less than 1.14 m/s upward from 0.1 m above the landing, at 35 degrees or more: over less than 0.49 + 0.35 m
    assert (sample.vel[sample.distance > 0.84, 2] < 0.0).all()
    assert (sample.vel[sample.distance > 0.2, 2] < 0.0).mean() > 0.99  # 0.9993 of 300,000


def test_a_next_jump_is_planned_above_the_first_levels_with_its_probability(env, starts):
    planned = np.concatenate([starts[start_mode].episodes["next_jump_step"] for start_mode in START_MODES])
    level = np.concatenate([starts[start_mode].level for start_mode in START_MODES])
    assert not planned[level == 0].any()
    fraction = (planned[level > 1] > 0).mean()  # the first goals have two levels of starts
    assert not planned[level == 1].any()
    assert fraction == pytest.approx(0.175, abs=4.0 * np.sqrt(0.175 * 0.825 / (level > 1).sum()))
    assert covers(planned[planned > 0], 12.0, 42.0, 0.05)  # 0.2 to 0.7 s
    set_levels(env, *(dataclasses.replace(level, next_jump_probability=0.0) for level in env.task.levels))
    env.reset()
    assert not episodes_of(env)["next_jump_step"].any()
