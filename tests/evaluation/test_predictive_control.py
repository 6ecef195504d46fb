import numpy as np

from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.predictive_control import PredictiveController, start_of
from jumper_warp.policies.policy import Policy
from jumper_warp.robot.overlay import RobotOverlay

WEAK = RobotOverlay({"saturation": (1.0, 1.0, 0.5, *(9 * (1.0,)))})  # Half the torque of the left front inner motor


def robots(policy, overlay=None, count=1):
    recipe = policy.recipe()
    change = recipe.task.evaluation.prepare_task
    return env_of_recipe(recipe, count, Conditions(device="cpu"), change=change, robot=overlay)


def jumps(env, act, goals):
    log = JumpLog(np.array(goals)[:, None], env.task.termination_names, headings=0.5)
    run_evaluation(act, env, log)
    return log.success[:, 0]


def test_robots_with_a_weak_motor_are_rescued():
    policy = Policy.load("sighted_jump")
    goals = [(1.7, 0.0), (1.8, 0.0), (1.9, 0.0)]
    env = robots(policy, WEAK, len(goals))
    lost = ~jumps(env, policy.act, goals)
    controller = PredictiveController(env, policy, robots(policy, WEAK, len(goals)), scales=(1.0,), threads=1)
    saved = jumps(env, controller.act, goals)
    assert lost.sum() >= 2
    assert (saved & lost).sum() >= 2  # not all: rounding decides on single jumps


def test_state_of_the_robot_is_not_changed_and_assumed_parameters_stay():
    policy = Policy.load("horizontal_jump")
    env = robots(policy, WEAK)
    assumed = robots(policy)
    controller = PredictiveController(env, policy, assumed, scales=(1.0,), threads=1)
    env.evaluation_reset([0.5, 0.0, 0.0, 0.0])
    before = env.state_dict()
    controller.begin()
    controller._rests_with_policy()
    after = env.state_dict()
    assert all((before[name] == after[name]).all() for name in before)
    assert assumed.snapshot().parameters["saturation"][2, 0] == 18.0
    assert env.snapshot().parameters["saturation"][2, 0] == 9.0


def test_plans_begin_with_the_state_of_a_robot_that_waits_for_its_own_command():
    """The policy sees its goal while it waits, so that robots with scaled goals wait otherwise."""
    policy = Policy.load("vertical_jump")
    env = robots(policy)
    controller = PredictiveController(env, policy, robots(policy), scales=(0.25,), threads=1, longest=40)
    env.evaluation_reset([0.0, 0.0, 1.0, 30.0])
    controller.begin()
    for _ in range(30):
        env.step(policy.act(env.obs))
    expected = start_of(env)
    np.testing.assert_allclose(controller.start.q, expected.q, atol=1.0e-6)
    np.testing.assert_allclose(controller.start.initial_target, expected.initial_target, atol=1.0e-6)
    np.testing.assert_allclose(controller.model.pose, expected.q[7:], atol=1.0e-6)
