import dataclasses
import math

import numpy as np
import pytest
import torch
import warp as wp

from columns import MOTOR_COORDS, Z
from jump_helpers import (
    edit_coordinates,
    edit_episodes,
    ending_names,
    episodes_of,
    make_env,
    only,
    random_actions,
)  # fmt: skip
from jump_oracle import expected_terms, robot_of
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.kernels.jump.state import FLIGHT, LANDED, STANCE, JumpState
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.registry import make_task
from jumper_warp.robot.grounds import platform
from jumper_warp.tasks.terms import RewardTerm
from randomization_helpers import read

TASK = make_task("vertical-jump")
N = 32
REST = torch.zeros((N, 12))
CROUCH = torch.tensor([0.0, 0.6, 0.6] * 4).repeat(N, 1)
STRETCH = torch.tensor([0.0, -1.0, -1.0] * 4).repeat(N, 1)


@wp.func
def my_own_term(robot: RobotView, state: JumpState, scale: float) -> float:
    """Height of the base times a scale."""
    return scale * robot.pos[2]


def stand(env: Env, **fields) -> None:
    """Reset all worlds, and overwrite fields of their states."""
    env.reset()
    edit_episodes(env, **fields)


@pytest.fixture(scope="module")
def env():
    """Return N nominal worlds without noise that start in the default pose; the tests begin with `stand`."""
    return make_env(N, reset=only("default"))


# ---------------------------------------------------------------- rewards and terminations


@pytest.fixture(scope="module")
def rollout():
    """Return logged and expected terms of jumps from all starts, (steps, terms, worlds), with rewards and phases."""
    env = make_env(64, seed=3)
    logged, expected, rewarded, phases = [], [], [], []
    noise = 0.2 * random_actions(64, 150)
    for step in range(150):
        action = noise[step] + (CROUCH if step % 75 < 40 else STRETCH)[:1]
        before = robot_of(env)
        env.auto_reset = False
        env.step(action)
        after = robot_of(env)
        logged.append(env.skills[0].term_value.numpy().copy())
        expected.append(expected_terms(TASK, before, after, action.clamp(-1.0, 1.0).numpy().T))
        rewarded.append(env.reward.clone().numpy())
        phases.append(after["phase"])
        env._reset_worlds(env._part(), wp.clone(env.episodes.done))
    return np.array(logged), np.array(expected), np.array(rewarded), np.array(phases)


def test_the_rollout_contains_every_phase_and_pays_every_term(rollout):
    logged, _, _, phases = rollout
    assert {int(STANCE), int(FLIGHT), int(LANDED)} == set(np.unique(phases).tolist())
    paid = {term.name for term, values in zip(TASK.rewards, logged.transpose(1, 0, 2), strict=True) if values.any()}
    assert paid == {term.name for term in TASK.rewards}


@pytest.mark.parametrize("index", range(len(TASK.rewards)), ids=[term.name for term in TASK.rewards])
def test_a_logged_term_equals_the_numpy_oracle(rollout, index):
    logged, expected, _, _ = rollout
    scale = np.abs(expected[:, index]).max()
    np.testing.assert_allclose(logged[:, index], expected[:, index], rtol=2e-3, atol=2e-4 * scale)


ENDING_CASES = {
    "success": {"phase": LANDED, "phase_steps": 59, "steps": 5000},  # at the same time as too_long
    "low_base": {},
    "moved_away": {"start": (0.3, 0.0, 0.3)},
    "no_jump": {"steps": 180, "command_step": 0},
    "too_long": {"phase": LANDED, "phase_steps": -2000, "steps": 1199},
}


@pytest.mark.parametrize("termination", ENDING_CASES)
def test_a_termination_ends_the_episode(env, termination):
    stand(env, command_step=1000)
    edit_episodes(env, 3, **ENDING_CASES[termination])
    if termination == "low_base":
        edit_coordinates(env, 3, q={2: 0.05})
    env.step(REST)
    assert ending_names(env) == ["" if world != 3 else termination for world in range(N)]
    assert env.done.tolist() == [float(world == 3) for world in range(N)]
    without_failure = termination in ("success", "too_long")
    assert env.timeout.tolist() == [float(world == 3 and without_failure) for world in range(N)]


def test_metrics_are_means_over_ended_episodes(env):
    stand(env, command_step=1000)
    env.metrics()
    edit_episodes(env, slice(0, 3), phase=LANDED, phase_steps=59, max_height=0.8, goal=(0.0, 0.0, 0.77))
    edit_episodes(env, slice(3, 7), steps=200, command_step=0)
    edit_episodes(env, slice(7, 9), phase=LANDED, phase_steps=59, start_mode=4)  # start_mode landed: not counted
    env.step(REST)
    total = env.skills[0].term_value.numpy()[:, :9].sum(axis=1)
    metrics = env.metrics()
    assert metrics["Metrics/success"] == pytest.approx(3.0 / 7.0)
    assert metrics["Metrics/error_of_successes_m"] == pytest.approx(0.03, abs=1e-6)
    assert metrics["Episode_Termination/success"] == pytest.approx(5.0 / 9.0)
    assert metrics["Episode_Termination/no_jump"] == pytest.approx(4.0 / 9.0)
    for term, value in zip(TASK.rewards, total, strict=True):
        assert metrics[f"Episode_Reward/{term.name}"] == pytest.approx(value / 9.0 / 20.0, rel=1e-4, abs=1e-7)
    cleared = env.metrics()
    undefined = {name for name, value in cleared.items() if math.isnan(value)}
    assert undefined == {"Metrics/success", "Metrics/error_of_successes_m"}  # without an ended episode
    assert not any(value for name, value in cleared.items() if not name.startswith(("Curriculum", *undefined)))


# ---------------------------------------------------------------- curriculum


def finish(env, worlds, success: bool) -> None:
    """End the episodes of some worlds by success or failure."""
    wanted = env.task_arrays()["goal"][worlds, 2]
    landed = {"phase": LANDED, "phase_steps": 59, "max_height": wanted}
    edit_episodes(env, worlds, **(landed if success else {"phase": STANCE, "steps": 999, "command_step": 0}))
    env.step(REST)
    assert env.done[worlds].all()


@pytest.mark.parametrize("start_mode", [2, 3, 4])
@pytest.mark.parametrize("success", [True, False])
def test_starts_in_flight_touchdown_or_landed_do_not_count_for_the_curriculum(env, start_mode, success):
    stand(env, level=1, streak=3, command_step=1000)
    edit_episodes(env, [0], start_mode=start_mode)
    finish(env, [0], success)
    assert (episodes_of(env)["level"][0], episodes_of(env)["streak"][0]) == (1, 3)


# ---------------------------------------------------------------- resets


def twins(**arguments):
    """Return two equal environments after some equal steps."""
    pair = [make_env(N, seed=5, noise=True, randomize=True, **arguments) for _ in range(2)]
    for action in random_actions(N, 3):
        for env in pair:
            env.step(action)
    return pair


def test_a_reset_changes_no_other_world():
    one, other = twins()
    edit_episodes(one, 7, phase=LANDED, phase_steps=59)
    for env in (one, other):
        env.step(REST)
    assert one.done[7] == 1.0
    rest = [world for world in range(N) if world != 7 and other.done[world] == 0.0]
    assert len(rest) > N // 2
    for name in ("obs", "final_obs", "reward"):
        assert torch.equal(getattr(one, name)[rest], getattr(other, name)[rest]), name
    np.testing.assert_array_equal(one.sim.joint_q()[rest], other.sim.joint_q()[rest])
    np.testing.assert_array_equal(one.sim.joint_qd()[rest], other.sim.joint_qd()[rest])
    np.testing.assert_array_equal(one.episodes.step_count.numpy()[rest], other.episodes.step_count.numpy()[rest])
    drawn = read(other)
    for name, values in read(one).items():
        np.testing.assert_array_equal(values[..., rest], drawn[name][..., rest], err_msg=name)
    assert (one.skills[0].states.numpy()[rest] == other.skills[0].states.numpy()[rest]).all()


def test_final_obs_is_the_last_observation_and_obs_the_first_of_the_next_episode():
    one, other = twins()
    other.auto_reset = False
    for env in (one, other):
        edit_episodes(env, slice(0, 5), phase=LANDED, phase_steps=59)
        env.step(REST)
    ended = one.done == 1.0
    assert ended[:5].all() and not ended.all()
    assert torch.equal(one.final_obs, other.final_obs)  # those of an equal environment without auto_reset
    assert torch.equal(one.obs[~ended], one.final_obs[~ended])
    assert (one.obs[ended] != one.final_obs[ended]).any(dim=1).all()
    height = one.sim.joint_q()[:, Z]
    observed_height = one.obs[:, 2].numpy()
    assert np.abs(observed_height - height).max() <= 0.005 + 1e-6  # [m], the bound of its noise


def test_a_reset_clears_histories_and_counters():
    env = make_env(N, reset=only("standing"), seed=2)
    for action in random_actions(N, 10):
        env.step(action)
    edit_episodes(env, phase=LANDED, phase_steps=59, idle_steps=7)
    env.step(random_actions(N, 1)[0])
    assert env.done.all()
    arrays, robot = env.task_arrays(), env.robot
    for name in ("steps", "phase", "phase_steps", "idle_steps", "took_off", "touched_down", "at_apex", "apex_passed"):
        assert not arrays[name].any(), name
    for name in ("action", "prev_action", "prev_prev_action", "prev_rate", "torque", "prev_torque", "paw_force",
                 "impulse", "contact_time", "air_time", "touchdown_speed", "peak_force", "prev_lin_vel"):  # fmt: skip
        assert not getattr(robot, name).numpy().any(), name
    assert not env.obs[:, -12:].any() and env.final_obs[:, -12:].any()
    angles = env.sim.joint_q()[:, MOTOR_COORDS]
    np.testing.assert_array_equal(robot.filtered_target.numpy().T, angles)
    np.testing.assert_array_equal(env.delays.target_history.numpy(), np.broadcast_to(angles.T, (8, 12, N)))


def test_the_squat_of_a_jump_commanded_at_once_is_the_height_above_the_ground():
    """The first jump, in the default pose, and the next one, of a base over ground of z = -0.1 m."""
    env = make_env(1, ground=platform(-0.1, edge=0.1))
    env.evaluation_reset([0.0, 0.0, 0.8, 0.0])
    env.step(REST[:1])
    assert env.task_arrays()["squat"] == pytest.approx(env.task_arrays()["base_pos"][:, 2], abs=1e-6)
    edit_coordinates(env, 0, q={0: 1.0})
    edit_episodes(env, phase=LANDED)
    env.step(REST[:1])
    env.command([0.0, 0.0, 0.8, 0.0])
    env.step(REST[:1])
    assert env.task_arrays()["squat"] == pytest.approx(env.task_arrays()["base_pos"][:, 2] + 0.1, abs=1e-6)


def test_an_evaluation_starts_all_worlds_in_the_default_pose(env):
    goals = np.zeros((N, 3))
    goals[:, Z] = np.linspace(0.5, 1.2, N)  # [m]
    delays = np.arange(N) / 120.0  # [s] every second delay is between two policy steps
    env.evaluation_reset(jump_commands(goals, delays, env.step_dt))
    arrays = env.task_arrays()
    np.testing.assert_allclose(arrays["goal"], goals, atol=1e-6)
    assert (np.abs(arrays["command_step"] - 60.0 * delays) <= 0.5).all() and not arrays["steps"].any()
    np.testing.assert_array_equal(env.sim.joint_q(), env.sim.model.joint_q.numpy().reshape(N, -1))
    np.testing.assert_allclose(env.obs[:, 0], goals[:, Z], atol=1e-6)  # the first observation is the commanded height


def test_an_ended_episode_of_an_evaluation_counts_once(env):
    env.reset(seed=0)
    env.evaluation_reset([0.0, 0.0, 0.8])
    edit_episodes(env, phase=LANDED, phase_steps=59)
    for _ in range(4):
        env.step(REST)
    assert env.done.all()
    np.testing.assert_array_equal(env.skills[0].counters.termination_count.numpy().sum(axis=0), 1)


def test_resets_by_a_mask_sample_other_starts_each_time():
    env = Env(TASK, N, device="cpu")
    mask = env.use_reset_mask()
    env.reset()
    mask.fill_(1.0)
    starts = [env.step(REST).obs["actor"].clone() for _ in range(3)]
    assert not any((a == b).all(dim=1).any() for a, b in zip(starts[1:], starts[:-1], strict=True))


# ---------------------------------------------------------------- reproducibility and solvers


def test_standing_has_the_same_pose_and_reward_on_both_solvers():
    """The robot stands for half a second."""
    ends = []
    for solver in ("jumper", "mujoco"):
        env = make_env(2, reset=only("default", command_delay=0.0), solver=solver)
        total = torch.zeros(2)
        for _ in range(30):
            env.step(torch.zeros((2, 12)))
            total += env.reward
        assert not env.done.any() and env.task_arrays()["phase"].tolist() == [STANCE] * 2
        ends.append((env.obs[:, 2:].clone(), total))
        assert env.sim.paw_force.numpy()[:, 0, 2].sum() == pytest.approx(14.5 * 9.81, rel=0.05)
    assert torch.abs(ends[0][0] - ends[1][0]).max() < 0.1
    assert torch.abs(ends[0][0][:, :1] - ends[1][0][:, :1]).max() < 0.005
    np.testing.assert_allclose(ends[0][1], ends[1][1], rtol=0.05)


# ---------------------------------------------------------------- configuration


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dataclasses.replace(TASK, rewards=(*TASK.rewards, TASK.rewards[0])), "names of terms must be unique"),
        (lambda: dataclasses.replace(TASK, terminations=()), "diverged"),
        (lambda: RewardTerm(my_own_term, 1.0, scale=1.0, width=1.0), "unknown parameter 'width'"),
        (lambda: RewardTerm(my_own_term, 1.0), "parameter 'scale' is missing"),
        (lambda: dataclasses.replace(TASK.levels[0], goal_upper=(0.0, 0.0, 0.1)), "must be finite and rise"),
    ],
)
def test_refuses_invalid_configurations(make, message):
    with pytest.raises(ValueError, match=message):
        make()
