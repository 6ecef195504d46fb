"""Gradients of an environment's steps: values against steps without gradients, gradients against differences."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from jumper_warp import mdp
from jumper_warp.envs.env import Env
from jumper_warp.envs.gradient_check import GradientCheck
from jumper_warp.envs.gradients import EnvGradients
from jumper_warp.kernels.mdp.rewards import root
from jumper_warp.policies.policy import Policy
from jumper_warp.registry import make_task
from jumper_warp.robot.overlay import RobotOverlay, load_overlay
from jumper_warp.trajectory.gauss_newton import Network, Tape, per_world_gradients
from jumper_warp.utils.errors import InputError

POLICIES = {
    "vertical-jump": "vertical_jump",
    "horizontal-jump": "horizontal_jump",
    "velocity-rough": "walking",
    "attitude": "attitude",
}


@cache
def network(task):
    """Return the network of a shipped policy for a task, opened once."""
    return Network(Policy.load(POLICIES[task]))


def steps_of(env, count, actions):
    """Yield the environment's steps with a policy's actions, at 0.9 of their size: none is at its limit."""
    obs = env.obs
    for _ in range(count):
        step = env.step(0.9 * actions(obs))
        yield step
        obs = step.obs["actor"]


@pytest.mark.parametrize("name", ["vertical-jump", "horizontal-jump"])
def test_values_are_bitwise_those_of_steps_without_gradients(name):
    """The worlds have random masses, friction, motors, offsets, latency, filter and pushes, in all phases of a jump."""
    act = network(name).act
    env = Env(make_task(name).on_level_ground(), 6, seed=3, device="cpu")
    env.reset()
    start = env.state_dict()
    plain = [(step.reward.clone(), step.obs["actor"].clone()) for step in steps_of(env, 12, act)]
    env.load_state_dict(start)
    with env.gradients() as gradients:
        for (reward, obs), step in zip(plain, steps_of(env, 12, act), strict=True):
            assert torch.equal(step.reward, reward) and torch.equal(step.obs["actor"], obs)
            running = env.done == 0.0
            assert running.any()
            # [m] and [rad], [rad], [1], [m/s] and [rad/s], [N m]
            tolerances = {"q": 1.0e-4, "initial_target": 1.0e-6, "action": 0.0, "qd": 2.0e-2, "torque": 5.0e-2}
            for part, atol in tolerances.items():
                parts = (getattr(state, part)[..., running] for state in (gradients.simulated, gradients.state))
                torch.testing.assert_close(*parts, rtol=0.0, atol=atol, msg=part)
    env.load_state_dict(start)
    for (reward, _), step in zip(plain, steps_of(env, 2, act), strict=False):
        assert torch.equal(step.reward, reward) and not step.reward.requires_grad


@pytest.mark.parametrize("robot", ["heavy", "long_jumper"])
def test_rollout_of_another_robot_is_that_of_its_environment(robot):
    """With latencies of 20 to 32 ms, targets of two policy steps before still act."""
    overlay = RobotOverlay({}, {"latency": (20.0, 32.0)}, robot=load_overlay(robot).robot)
    env = Env(make_task("velocity-flat", overlay), 6, seed=3, device="cpu", robot=overlay)
    env.reset()
    actions = torch.from_numpy(np.random.default_rng(0).uniform(-0.5, 0.5, (6, 6, 12))).float()
    with env.gradients() as gradients:
        for action in actions:
            env.step(action)
            for part, atol in {"q": 1.0e-4, "qd": 5.0e-2}.items():
                parts = (getattr(state, part) for state in (gradients.simulated, gradients.state))
                torch.testing.assert_close(*parts, rtol=0.0, atol=atol, msg=part)
    assert not env.done.any()


@pytest.mark.parametrize("name", POLICIES)
def test_gradients_of_all_rewards_match_differences(name):
    """Within 1 % of a term's largest change; at most 5 % of the samples are at a kink."""
    act = network(name).act
    env = Env(make_task(name).on_level_ground(), 13, seed=1, device="cpu")
    env.reset()
    with env.gradients() as gradients, torch.no_grad():
        check = GradientCheck(gradients)
        for i, _ in enumerate(steps_of(env, 60, act)):
            if i % 5 == 4:
                check.update()
    changes = [term for term, (_, differences) in check.results().items() if np.abs(differences).max() > 1.0e-7]
    assert len(changes) >= 0.6 * len(env.task.rewards)
    discrete = {"torque_sign_changes"}
    assert check.faults().keys() <= discrete


@wp.func
def lost(robot: mdp.RobotView, state: Any) -> float:
    """Square of the first action, through a struct's vector of which one component is assigned."""
    copy = robot
    copy.prev_action[0] = robot.action[0]
    return copy.prev_action[0] * copy.prev_action[0]


@wp.func
def infinite_slope(robot: mdp.RobotView, state: Any) -> float:
    """Fourth root of a square that is 0."""
    change = robot.action[0] - robot.action[1]
    return wp.pow(change * change, 0.25)


@wp.func
def finite_slope(robot: mdp.RobotView, state: Any) -> float:
    """Root of a square that is 0, by a function whose gradient is 0 there."""
    return root(wp.pow(robot.action[0] - robot.action[1], 2.0))


def test_check_names_terms_whose_gradient_is_lost_or_not_finite():
    task = make_task("attitude")
    rewards = (*(mdp.RewardTerm(f, weight=1.0) for f in (lost, infinite_slope, finite_slope)), task.rewards[-1])
    env = Env(replace(task, name="lost", rewards=rewards), 4, device="cpu")
    env.reset()
    with env.gradients() as gradients:
        check = GradientCheck(gradients)
        env.step(torch.full((4, 12), 0.3))
        check.update()
    faults = check.faults()
    assert faults["infinite_slope"] == "not finite" and faults.keys() == {"lost", "infinite_slope"}


def returns(env, start, act, changes, gradients):
    """Return the sum of rewards of each world until its episode ends, (num_envs,), with changed actions.

    changes: (steps, num_envs, 12).
    """
    env.load_state_dict(start)
    total = torch.zeros(env.num_envs)
    running = torch.ones(env.num_envs, dtype=torch.bool)
    context = env.gradients() if gradients else torch.no_grad()
    with context:
        obs = env.obs.clone()
        for change in changes:
            step = env.step(0.9 * act(obs) + change)
            total = total + torch.where(running, step.reward, 0.0)
            running = running & ~step.terminated & ~step.truncated
            obs = step.obs["actor"].clone()
    return total


def test_returns_of_flights_match_differences_with_the_policy_in_the_loop():
    """Through rewards, observations with history, network, filter, motors and physics, between apex and touchdown.

    The apex itself changes the branch of the rewards in another step if the robot rises longer.
    """
    act = network("vertical-jump").act
    env = Env(make_task("vertical-jump"), 48, seed=1, randomize=False, noise=False, device="cpu")
    env.reset()
    for _ in steps_of(env, 45, act):
        pass
    start = env.state_dict()
    jumps = env.task_arrays()
    flying = torch.from_numpy((jumps["phase"] == 1) & (jumps["apex_passed"] == 1))
    assert flying.sum() >= 5
    changes = torch.zeros(4, 48, 12, requires_grad=True)
    total = returns(env, start, act, changes, gradients=True)
    (gradient,) = torch.autograd.grad(total.sum(), changes)
    generator = torch.Generator().manual_seed(0)
    found, expected = [], []
    for _ in range(6):
        direction = 2.0e-4 * torch.randn(4, 48, 12, generator=generator)
        ends = [returns(env, start, act, sign * direction, gradients=False) for sign in (1.0, -1.0)]
        expected.append(0.5 * (ends[0] - ends[1]).double())
        found.append((gradient * direction).sum((0, 2)).double())
    found, expected = torch.stack(found)[:, flying], torch.stack(expected)[:, flying]
    cosine = torch.nn.functional.cosine_similarity(found, expected, dim=0)
    assert cosine.median() > 0.99
    ratio = (found * expected).sum(0) / expected.square().sum(0)
    assert 0.97 < ratio.median() < 1.03


@pytest.mark.parametrize("name", ["vertical-jump", "velocity-rough"])
def test_gradients_of_observations_match_differences(name):
    """With history (vertical-jump) and latency of sensors (velocity-flat), three policy steps after an action."""
    env = Env(make_task(name), 24, seed=1, device="cpu")
    env.reset()
    start = env.state_dict()
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(env.num_obs, generator=generator)

    def observed(first, gradients):
        env.load_state_dict(start)
        with env.gradients() if gradients else torch.no_grad():
            for action in (first, *torch.zeros(2, 24, 12)):
                obs = env.step(action).obs["actor"]
        return (weights * obs).sum(1), env.done > 0.0

    first = torch.zeros(24, 12, requires_grad=True)
    total, ended = observed(first, gradients=True)
    (gradient,) = torch.autograd.grad(total.sum(), first)
    found, expected = [], []
    for _ in range(6):
        direction = 3.0e-3 * torch.randn(24, 12, generator=generator)
        ends = [observed(sign * direction, gradients=False)[0].double() for sign in (1.0, -1.0)]
        expected.append(0.5 * (ends[0] - ends[1]))
        found.append((gradient * direction).sum(1).double())
    found, expected = torch.stack(found)[:, ~ended], torch.stack(expected)[:, ~ended]
    assert found.shape[1] >= 12
    assert torch.nn.functional.cosine_similarity(found, expected, dim=0).median() > 0.99
    assert 0.97 < ((found * expected).sum(0) / expected.square().sum(0)).median() < 1.03


def test_numbers_set_after_a_step_do_not_change_its_gradient():
    gradients = []
    for later in (False, True):
        env = Env(make_task("vertical-jump"), 3, seed=1, device="cpu")
        env.reset()
        action = torch.zeros(3, 12, requires_grad=True)
        with env.gradients():
            reward = env.step(action).reward.sum()
            if later:
                env.set("rewards.joint_symmetry.weight", 0.0)
            gradients.append(torch.autograd.grad(reward, action)[0])
    assert torch.equal(*gradients) and gradients[0].any()


def test_gradients_by_weights_of_each_world_sum_to_the_gradient_of_the_total():
    net = network("vertical-jump")
    env = Env(make_task("vertical-jump"), 3, seed=1, device="cpu")
    env.reset()
    weights, tape = net.weights.clone().requires_grad_(), Tape()
    with env.gradients():
        total = sum(step.reward.sum() for step in steps_of(env, 5, lambda obs: net.act(obs, weights, tape)))
    rows = per_world_gradients(total, tape)
    (gradient,) = torch.autograd.grad(total, weights)
    torch.testing.assert_close(rows.sum(0), gradient, rtol=1.0e-3, atol=1.0e-4 * float(gradient.abs().max()))
    assert float(gradient.norm()) > 0.0


def test_no_gradient_crosses_a_reset_or_restart():
    env = Env(make_task("vertical-jump"), 4, seed=1, device="cpu")
    env.reset()
    with env.gradients() as gradients:
        first = torch.zeros(4, 12, requires_grad=True)
        env.step(first)
        bad = torch.zeros(4, 12)
        bad[1] = float("nan")  # ends the episode
        step = env.step(bad)
        assert step.terminated.tolist() == [False, True, False, False]
        after = env.step(torch.zeros(4, 12))
        (gradient,) = torch.autograd.grad(after.reward.sum() + after.obs["actor"].sum(), first)
        assert gradient.isfinite().all()
        assert (gradient.abs().sum(1) > 0.0).tolist() == [True, False, True, True]
        gradients.restart()
        assert not env.step(torch.zeros(4, 12)).reward.requires_grad


@pytest.mark.parametrize("begin", ["reset", "evaluation_reset", "load_state_dict"])
def test_a_reset_within_the_context_begins_at_its_state(begin):
    env = Env(make_task("vertical-jump"), 4, seed=1, device="cpu")
    env.reset()
    start = env.state_dict()
    arguments = {"reset": (), "evaluation_reset": ([0.0, 0.0, 0.9, 0.0],), "load_state_dict": (start,)}[begin]
    with env.gradients() as gradients:
        for _ in range(3):
            env.step(torch.full((4, 12), 0.5).requires_grad_())
        getattr(env, begin)(*arguments)
        step = env.step(torch.zeros(4, 12))
        assert not step.reward.requires_grad
        torch.testing.assert_close(gradients.simulated.q, gradients.state.q, rtol=0.0, atol=1.0e-4)


def test_second_derivatives_and_two_contexts_are_refused():
    env = Env(make_task("vertical-jump"), 2, seed=1, device="cpu")
    env.reset()
    action = torch.zeros(2, 12, requires_grad=True)
    with env.gradients() as gradients:
        reward = env.step(action).reward.sum()
        with pytest.raises(InputError, match="create_graph"):
            torch.autograd.grad(reward, action, create_graph=True)
        with pytest.raises(InputError, match="in use already"), EnvGradients(env):
            pass
        assert env.gradients_of_step is gradients
    assert env.gradients_of_step is None
    with pytest.raises(InputError, match="SolverJumper"):
        Env(make_task("vertical-jump"), 1, solver="mujoco", device="cpu").gradients()
