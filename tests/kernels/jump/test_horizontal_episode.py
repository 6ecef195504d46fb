import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from columns import XY
from jump_helpers import DEG, edit_coordinates, edit_episodes, ending_names, episodes_of, make_env, only, random_actions
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE
from jumper_warp.registry import make_task

TASK = make_task("horizontal-jump")
N = 64
REST = torch.zeros((N, 12))
NEXT_JUMP = np.arange(10, 20)
"""Indices of the worlds that get another goal."""


@pytest.fixture(scope="module")
def env():
    """Return N nominal worlds without noise, default pose, any heading; a next jump is planned above level 0."""
    return make_env(N, task=task_with_next_jump(1.0), reset=only("default", heading=180.0), seed=4)


def task_with_next_jump(probability):
    """Return the task with this `next_jump_probability` at all levels but level 0."""
    later = (dataclasses.replace(level, next_jump_probability=probability) for level in TASK.levels[1:])
    return dataclasses.replace(TASK, levels=(TASK.levels[0], *later))


def set_standing(env, **fields):
    """Begin episodes in the default pose, without a command or next jump, and overwrite fields of all."""
    env.auto_reset = True
    env.reset()
    edit_episodes(env, **({"command_step": 1000, "next_jump_step": 0} | fields))


def yaw_of(arrays):
    """Return the yaw of all bases [rad], (worlds,); arrays: of `Env.task_arrays`."""
    return Rotation.from_quat(arrays["base_quat"]).as_euler("ZYX")[:, 0]


def to_yaw_frame(vectors, yaw):
    """Return vectors (worlds, 3) in axes turned about z by yaw [rad], (worlds,)."""
    return Rotation.from_euler("z", yaw[:, None]).inv().apply(vectors)


def angle_between(first, second):
    """Return the absolute difference of two angles [rad] on the circle, 0 to pi."""
    return np.abs(np.angle(np.exp(1j * (first - second))))


def test_observations_and_rewards_do_not_depend_on_the_heading_of_the_world():
    """Two robots, one turned by 137 degrees, jump off under the same random actions."""
    env = make_env(2, task=TASK)
    turn = 137.0 * DEG
    goals = np.tile([0.8, 0.2, 0.0], (2, 1))
    env.evaluation_reset(jump_commands(goals, 0.1, env.step_dt), headings=np.array([0.0, turn]))
    phases = set()
    for step, action in enumerate(random_actions(1, 30, seed=2)):
        action = 0.5 * action
        action[:, [1, 2, 4, 5, 7, 8, 10, 11]] += 0.8 if step < 12 else -1.0  # transversal motors: squat, then push
        env.step(action.repeat(2, 1))
        for obs in (env.obs, env.critic_obs):
            torch.testing.assert_close(obs[1], obs[0], atol=2e-3, rtol=2e-3)
        assert env.reward[1].item() == pytest.approx(env.reward[0].item(), abs=2e-3, rel=2e-3)
        assert env.done[0] == env.done[1]
        arrays = env.task_arrays()
        assert arrays["phase"][0] == arrays["phase"][1] and arrays["termination"][0] == arrays["termination"][1]
        phases.add(int(arrays["phase"][0]))
    assert phases == {int(STANCE), int(FLIGHT)}
    expected = Rotation.from_euler("z", turn).apply(arrays["base_pos"][0])
    np.testing.assert_allclose(arrays["base_pos"][1], expected, atol=1e-4)
    assert angle_between(*yaw_of(arrays)) == pytest.approx(turn, abs=1e-3)


@pytest.mark.parametrize("turn", [0.0, 90.0, 180.0])
def test_an_evaluation_starts_with_its_heading_and_goal_before_the_command(turn):
    env = make_env(2, task=TASK)
    goals = np.array([[0.8, 0.2, 0.0], [0.3, -0.1, 0.0]])
    env.evaluation_reset(jump_commands(goals, 0.5, env.step_dt), headings=turn * DEG)
    arrays = env.task_arrays()
    np.testing.assert_allclose(arrays["goal"][:, XY] @ [[math.cos(turn * DEG), -math.sin(turn * DEG)],
                                                        [math.sin(turn * DEG), math.cos(turn * DEG)]],
                               [[0.8, 0.2], [0.3, -0.1]], atol=1e-5)  # fmt: skip
    np.testing.assert_allclose(arrays["heading"], turn * DEG, atol=1e-6)
    assert angle_between(yaw_of(arrays), turn * DEG).max() < 1e-5
    assert not env.obs[:, :2].any()  # goal_x, goal_y: 0 before the command after 0.5 s
    assert (arrays["next_jump_step"] == 0).all()


def set_landed(env, **fields):
    """Let all robots stand as if landed 12 policy steps ago, with different positions, steps and jumps."""
    set_standing(env, level=1)
    edit_episodes(env, phase=LANDED, phase_steps=12, apex_passed=1, steps=np.arange(N), command_step=0)
    edit_episodes(env, jumps=np.arange(N) % 3)
    edit_episodes(env, **fields)
    for world in range(N):
        edit_coordinates(env, world, q={0: 0.1 * world, 1: -0.2 * world})


def goals_ahead(arrays):
    """Return the vector from base to goal [m], ahead, to the left and 0, (worlds, 3); arrays: of `Env.task_arrays`."""
    return to_yaw_frame((arrays["goal"] - arrays["base_pos"]) * [1.0, 1.0, 0.0], yaw_of(arrays))


def test_a_next_jump_begins_at_its_step_in_its_worlds_only(env):
    """It begins in stance at the robot's position, is commanded at once, and its goal is observed."""
    set_landed(env)
    edit_episodes(env, NEXT_JUMP, next_jump_step=13, level=np.arange(10) % 4 + 1)
    before = env.task_arrays()
    env.step(REST)
    after = env.task_arrays()
    np.testing.assert_array_equal(np.flatnonzero(after["phase"] == STANCE), NEXT_JUMP)
    assert not after["done"].any()
    np.testing.assert_array_equal(after["jumps"] - before["jumps"], np.isin(np.arange(N), NEXT_JUMP))
    for name in ("phase_steps", "idle_steps", "apex_passed", "peak_tilt", "took_off", "touched_down", "at_apex"):
        assert not after[name][NEXT_JUMP].any(), name
    np.testing.assert_array_equal(after["start"][NEXT_JUMP], after["base_pos"][NEXT_JUMP])
    np.testing.assert_array_equal(after["max_height"][NEXT_JUMP], after["base_pos"][NEXT_JUMP, 2])
    assert angle_between(after["heading"], yaw_of(after))[NEXT_JUMP].max() < 1e-5
    np.testing.assert_array_equal(after["steps"], np.arange(1, N + 1))
    np.testing.assert_array_equal(after["command_step"][NEXT_JUMP], after["steps"][NEXT_JUMP])
    np.testing.assert_allclose(env.obs[:, :2].numpy(), goals_ahead(after)[:, :2], atol=1e-5)
    others = np.setdiff1d(np.arange(N), NEXT_JUMP)
    for name in ("goal", "start", "heading", "command_step", "jumps", "next_jump_step"):
        np.testing.assert_array_equal(after[name][others], before[name][others])
    np.testing.assert_array_equal(after["phase_steps"][others], 13)


def test_goals_of_next_jumps_cover_the_levels_box_ahead_of_the_robot(env):
    ahead, level = [], []
    for _ in range(8):
        set_landed(env, next_jump_step=13, level=1 + np.arange(N) % 4)
        env.step(REST)
        after = env.task_arrays()
        assert (after["phase"] == STANCE).all()
        ahead.append(goals_ahead(after))
        level.append(after["level"])
    ahead, level = np.concatenate(ahead), np.concatenate(level)
    for number in range(1, 5):
        here, box = ahead[level == number], TASK.levels[number]
        for axis in (0, 1):
            lower, upper = box.goal_lower[axis], box.goal_upper[axis]
            assert here[:, axis].min() >= lower - 1e-5 and here[:, axis].max() <= upper + 1e-5
            assert np.ptp(here[:, axis]) > 0.85 * (upper - lower)


def test_a_next_jump_changes_no_robot_state_and_only_the_observed_goal():
    pair = [make_env(N, task=task_with_next_jump(1.0), reset=only("default"), seed=4) for _ in range(2)]
    for env, when in zip(pair, (13, 0), strict=True):
        edit_episodes(env, level=1, phase=LANDED, phase_steps=12, next_jump_step=when)
        for action in 0.3 * random_actions(N, 5):
            env.step(action)
    jumping, resting = pair
    assert (jumping.task_arrays()["jumps"] == 1).all() and not resting.task_arrays()["jumps"].any()
    np.testing.assert_array_equal(jumping.sim.joint_q(), resting.sim.joint_q())
    np.testing.assert_array_equal(jumping.sim.joint_qd(), resting.sim.joint_qd())
    assert torch.equal(jumping.obs[:, 2:], resting.obs[:, 2:])
    assert not torch.equal(jumping.obs[:, :2], resting.obs[:, :2])  # goal_x, goal_y


def test_a_third_jump_is_planned_with_next_jump_probability(env):
    set_landed(env, next_jump_step=13)
    env.step(REST)
    planned = env.task_arrays()["next_jump_step"]  # next_jump_probability = 1
    assert planned.min() >= 12 and planned.max() <= 42 and len(set(planned)) > 20  # 0.2 to 0.7 s
    never = make_env(N, task=task_with_next_jump(0.0), reset=only("default"))
    set_landed(never, next_jump_step=13)
    never.step(REST)
    arrays = never.task_arrays()
    assert (arrays["phase"] == STANCE).all() and not arrays["next_jump_step"].any()


@pytest.mark.parametrize(
    ("fields", "begins"),
    [({"phase_steps": 11}, 0), ({"phase": STANCE}, 0), ({"phase": FLIGHT}, 0), ({"phase_steps": 20}, 1)],
    ids=["before its step", "in stance", "in flight", "overdue"],
)
def test_a_next_jump_begins_from_its_step_on_after_landing(env, fields, begins):
    set_landed(env, **({"next_jump_step": 13} | fields))
    env.step(REST)
    running = env.done.numpy() == 0.0
    np.testing.assert_array_equal(env.task_arrays()["jumps"][running], (np.arange(N) % 3 + begins)[running])
    assert running.any() or not begins


def test_an_episode_that_ends_in_the_step_of_a_next_jump_is_reset(env):
    set_landed(env, next_jump_step=60, phase_steps=59)
    env.step(REST)
    after = env.task_arrays()
    assert env.done.all() and not after["jumps"].any() and not after["steps"].any()


def test_a_goal_of_env_command_is_observed_at_once_in_chosen_worlds_only(env):
    set_landed(env)
    env.step(REST)
    before = env.obs.clone()
    chosen = np.arange(N) % 2 == 0
    env.command(np.tile([0.7, -0.2, 0.0], (N, 1)), chosen)
    np.testing.assert_allclose(env.obs[chosen, :2].numpy(), np.tile([0.7, -0.2], (N // 2, 1)), atol=1e-5)
    assert torch.equal(env.obs[~chosen], before[~chosen])


@pytest.mark.parametrize("first", [0, 1], ids=["before the first step", "later"])
def test_a_command_begins_a_jump_in_chosen_landed_worlds_only(env, first):
    """Before the first step it sets the goal of a standing robot too."""
    set_landed(env, steps=first * (1 + np.arange(N)), jumps=0)
    phase = np.array([STANCE, FLIGHT, LANDED, LANDED])[np.arange(N) % 4]
    edit_episodes(env, phase=phase, idle_steps=3, apex_passed=1, touched_down=0)
    chosen = np.arange(N) % 8 < 6
    goals = np.stack([np.linspace(0.3, 1.5, N), np.linspace(-0.3, 0.3, N), np.zeros(N)], axis=1)
    before, q, qd = env.task_arrays() | episodes_of(env), env.sim.joint_q().copy(), env.sim.joint_qd().copy()
    env.command(goals, chosen)
    after = env.task_arrays() | episodes_of(env)
    begun, stands = chosen & (phase == LANDED), chosen & (phase == STANCE) & (first == 0)
    assert 0 < begun.sum() < chosen.sum()
    for name in episodes_of(env):
        np.testing.assert_array_equal(after[name][~(begun | stands)], before[name][~(begun | stands)], name)
    np.testing.assert_allclose(goals_ahead(after)[begun | stands], goals[begun | stands], atol=1e-5)
    assert (after["phase"][begun] == STANCE).all() and not after["phase_steps"][begun].any()
    np.testing.assert_array_equal(after["command_step"][begun | stands], after["steps"][begun | stands])
    np.testing.assert_array_equal(after["jumps"], begun)
    np.testing.assert_array_equal(env.sim.joint_q(), q)
    np.testing.assert_array_equal(env.sim.joint_qd(), qd)


@pytest.mark.parametrize(("miss", "near"), [(0.0, True), (0.095, True), (0.105, False), (0.4, False)])
def test_a_jump_is_a_success_if_its_landing_error_is_within_a_tenth_of_a_metre(env, miss, near):
    set_standing(env, level=1, streak=4 * (np.arange(N) % 2))  # the fifth success in a row raises the level
    position = env.task_arrays()["base_pos"]
    edit_episodes(env, phase=LANDED, phase_steps=59, goal=position + [0.6 * miss, -0.8 * miss, 0.0])  # ends at 60
    env.metrics()
    env.step(REST)
    assert ending_names(env) == ["success"] * N and (env.timeout == 1.0).all()
    assert episodes_of(env)["streak"].tolist() == [int(near), 0] * (N // 2)
    assert episodes_of(env)["level"].tolist() == [1, 1 + near] * (N // 2)
    metrics = env.metrics()
    assert metrics["Metrics/success"] == float(near)
    error = miss if near else math.nan  # [m]
    assert metrics["Metrics/error_of_successes_m"] == pytest.approx(error, abs=3e-3, nan_ok=True)


@pytest.mark.parametrize(
    ("termination", "episode"),
    [("too_long", {"steps": 1199, "phase_steps": 10}), ("no_jump", {"phase": STANCE, "steps": 500, "command_step": 0})],
)
def test_other_terminations_at_the_goal_are_no_success(env, termination, episode):
    set_standing(env, level=1, streak=2)
    edit_episodes(env, goal=env.task_arrays()["base_pos"], **({"phase": LANDED} | episode))
    env.metrics()
    env.step(REST)
    assert ending_names(env) == [termination] * N
    assert not episodes_of(env)["streak"].any() and env.metrics()["Metrics/success"] == 0.0
