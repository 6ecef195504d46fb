"""A policy in the loop: states and observations as the environment's, gradients by its weights against differences."""

import dataclasses
from functools import cache

import numpy as np
import pytest
import torch

from jumper_warp.diff.closed_loop import ClosedLoop, heading_of
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.finetuning import FinetuneCfg, make_groups
from jumper_warp.policies.runs import open_policy
from jumper_warp.registry import make_task
from jumper_warp.trajectory.gauss_newton import Network, Tape, world_rows
from jumper_warp.utils.errors import InputError

G = 9.81


@cache
def policy(name="vertical_jump"):
    return open_policy(name)


@cache
def jumps():
    """Two nominal robots that are told to jump at once."""
    cfg = FinetuneCfg(num_goals=2, num_delayed=0, num_randomized=0, height_range=(0.85, 0.95), device="cpu")
    group = make_groups(policy(), cfg)[0]
    group.commands[:, 3] = 0.0
    return group


@pytest.mark.parametrize(("name", "acting"), [("vertical-jump", "vertical_jump"), ("horizontal-jump", "slippery_jump")])
def test_drawn_robots_move_and_see_as_in_the_environment(name, acting):
    """Masses, friction, motors, offsets, latency, filter and pushes are drawn; worlds begin all over a jump.

    Where rounding lets a motor meet its stop a physics step later, rates differ by more than here (0.07 rad/s, with
    `horizontal_jump` in one of 288 steps of a world that were looked at); these jumps have none of that.
    """
    env = Env(make_task(name).on_level_ground(), 6, seed=3, noise=False, device="cpu")
    env.reset()
    loop, network = ClosedLoop(env), Network(policy(acting))
    assert env.parameters.latency.numpy().max() > 3
    state = loop.state()
    for _ in range(12):
        state, made = loop.step(state, network.act(env.obs))
        goes_on = env.done == 0.0
        assert goes_on.any()
        for part, atol in (("q", 1.0e-4), ("before", 1.0e-6), ("action", 0.0), ("qd", 2.0e-2), ("torque", 5.0e-2)):
            torch.testing.assert_close(
                getattr(made, part)[:, goes_on], getattr(state, part)[:, goes_on], rtol=0.0, atol=atol, msg=part
            )
        told = env.obs.clone()
        for term in ("height", "lin_vel", "ang_vel", "gravity", "angle", "rate", "last_action"):
            told[:, slice(*loop.layout[term])] = 0.0
        torch.testing.assert_close(loop.observe(state, told), env.obs, rtol=0.0, atol=1.0e-5)


def test_the_way_to_a_goal_shrinks_as_the_base_gets_there():
    env = Env(make_task("horizontal-jump").on_level_ground(), 6, seed=3, noise=False, device="cpu")
    env.reset()
    loop = ClosedLoop(env)
    state = loop.state()
    told = env.obs.clone()
    told[:, :2] = torch.tensor([0.7, -0.2])

    def way(x, y):
        q = torch.cat([x[None], y[None], state.q[2:]])
        return loop.observe(state._replace(q=q), told)[:, :2].sum(0)

    by_x, by_y = torch.autograd.functional.jacobian(way, (state.q[0], state.q[1]))
    heading = heading_of(state.q[3:7].T)
    expected = torch.stack([-heading.cos(), heading.sin()]), torch.stack([-heading.sin(), -heading.cos()])
    torch.testing.assert_close(by_x, expected[0], rtol=0.0, atol=1.0e-6)
    torch.testing.assert_close(by_y, expected[1], rtol=0.0, atol=1.0e-6)


def apexes(loop, network, state, told, weights, steps=30, tape=None):
    """Return the height [m] that each world's base will reach, as a projectile after the push."""
    for _ in range(steps):
        state = loop.advance(state, network.act(loop.observe(state, told), weights, tape))
    motion = loop.motion(state)
    return motion.pos[:, 2] + motion.lin_vel[:, 2].square() / (2.0 * G)


def test_apex_by_weights_is_the_limit_of_differences_and_rows_are_of_their_worlds():
    group = jumps()
    group.begin()
    loop = ClosedLoop(group.env, double=True)
    network = Network(policy(), dtype=torch.float64)
    state, told = loop.state(), group.env.obs.double()
    weights, tape = network.weights.clone().requires_grad_(), Tape()
    found = apexes(loop, network, state, told, weights, tape=tape)
    assert (found.detach() - torch.tensor([0.85, 0.95])).abs().max() < 0.05
    rows = world_rows(found.sum(), tape)
    gradient = torch.autograd.grad(found.sum(), weights)[0]
    torch.testing.assert_close(rows.sum(0), gradient, rtol=1.0e-9, atol=1.0e-9 * float(gradient.abs().max()))
    rng = np.random.default_rng(0)
    for _ in range(3):
        direction = torch.tensor(rng.standard_normal(len(weights))) * gradient.abs()
        direction /= direction.norm()
        h = 1.0e-8  # the truncated terms fall with its square: at 1e-7 4e-5 of a derivative
        with torch.no_grad():
            ends = [apexes(loop, network, state, told, network.weights + side * h * direction) for side in (1.0, -1.0)]
        torch.testing.assert_close(
            rows @ direction, (ends[0] - ends[1]) / (2.0 * h), rtol=1.0e-6, atol=1.0e-6 * float(rows.norm(dim=1).max())
        )


def test_what_gives_no_gradients_is_refused():
    task = make_task("vertical-jump").on_level_ground()
    late = dataclasses.replace(
        task, randomization=dataclasses.replace(task.randomization, observation_latency=(0.0, 8))
    )
    with pytest.raises(InputError, match="without latency"):
        ClosedLoop(Env(late, 1, device="cpu"))
    with pytest.raises(InputError, match="on SolverJumper"):
        ClosedLoop(Env(task, 1, solver="mujoco", device="cpu"))
