import numpy as np
import pytest

from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.predictive_control import start_of
from jumper_warp.policies.policy import Policy
from jumper_warp.trajectory.plan import Plan, PlanModel

STEPS = 45  # Policy steps from the command to after the touchdown


@pytest.fixture(scope="module")
def jump():
    """Return robots that wait for their command, as a snapshot and a start, and the policy's actions of the jump."""
    policy = Policy.load("sighted_jump")
    env = env_of_recipe(policy.recipe(), 2, Conditions(device="cpu"))
    env.evaluation_reset([[0.5, 0.0, 0.0, 2.0], [0.9, 0.0, 0.0, 2.0]])
    for _ in range(2):
        env.step(policy.act(env.obs))
    start = start_of(env)
    actions = []
    for _ in range(STEPS):
        actions.append(0.95 * policy.act(env.obs).clamp(-1.0, 1.0).numpy().T.astype(float))
        env.step(policy.act(env.obs))
    return env.snapshot(), start, np.stack(actions)


@pytest.mark.parametrize("height", [0.0, 0.6])
def test_gradient_of_the_cost_agrees_with_differences_in_double_precision(jump, height):
    robots, start, actions = jump
    model = PlanModel(robots, np.array([[0.6, 1.0], [0.1, 0.0], [height, height]]), double=True)
    outlook = model.simulate(actions, start)
    assert (outlook.touchdown < STEPS).all(), "no landing: the gradient is of less than a jump"
    gradient = model.gradient(outlook)
    rng = np.random.default_rng(0)
    found = []
    expected = []
    for _ in range(4):
        change = 1.0e-6 * rng.normal(size=actions.shape)
        found.append((gradient * change).sum((0, 1)))
        high, low = (model.simulate(actions + sign * change, start).cost for sign in (1.0, -1.0))
        expected.append(0.5 * (high - low))
    assert np.array(found) == pytest.approx(np.array(expected), abs=0.01 * np.abs(expected).max())


def test_improved_plan_ends_closer_to_its_goal(jump):
    robots, start, actions = jump
    goal = np.array([[0.7, 1.1], [0.0, 0.0], [0.0, 0.0]])
    model = PlanModel(robots, goal)
    before = model.simulate(actions, start)
    plan = Plan(actions.copy())
    plan.explore(model, start, STEPS, 20)
    cost = plan.improve(model, start, np.zeros(2, dtype=int), STEPS, 2)
    after = model.simulate(plan.actions, start)
    assert after.cost == pytest.approx(cost, rel=1.0e-5)

    def distance(outlook):
        return np.linalg.norm(outlook.q[-1, :2] - goal[:2], axis=0)

    assert (distance(after) < 0.6 * distance(before)).all()
