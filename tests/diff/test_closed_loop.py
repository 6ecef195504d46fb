"""Differentiable closed loop: states and observations against the environment, gradients against differences."""

from functools import cache

import numpy as np
import pytest
import torch

from columns import Z
from jumper_warp.diff.closed_loop import ClosedLoop, heading_of
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.finetuning import make_groups
from jumper_warp.evaluation.finetuning_cfg import FinetuneCfg
from jumper_warp.policies.policy import Policy
from jumper_warp.registry import make_task
from jumper_warp.trajectory.gauss_newton import Network, Tape, per_world_gradients

G = 9.81  # [m/s^2]


@cache
def policy(name="vertical_jump"):
    """Return a shipped policy, opened once."""
    return Policy.load(name)


@cache
def jumps():
    """Return a group of two nominal robots, commanded to jump to 0.85 and 0.95 m at once."""
    group = make_groups(
        policy().recipe(),
        FinetuneCfg(num_goals=2, num_delayed=0, num_randomized=0, height_range=(0.85, 0.95), device="cpu"),
    )[0]
    group.commands[:, 3] = 0.0  # [s] time of the command
    return group


@pytest.mark.parametrize(("name", "acting"), [("vertical-jump", "vertical_jump"), ("horizontal-jump", "slippery_jump")])
def test_randomised_robots_match_the_environments_states_and_observations(name, acting):
    """The worlds have random masses, friction, motors, offsets, latency, filter and pushes, in all phases of a jump.

    Rates differ by more (0.07 rad/s) where rounding lets a motor reach its stop a physics step later, as it does with
    `horizontal_jump` in one of 288 steps; these jumps reach no stop.
    """
    env = Env(make_task(name).on_level_ground(), 6, seed=3, noise=False, device="cpu")
    env.reset()
    loop, network = ClosedLoop(env), Network(policy(acting))
    assert env.parameters.latency.numpy().max() > 3
    state = loop.state()
    for _ in range(12):
        state, simulated = loop.step(state, network.act(env.obs))
        running = env.done == 0.0
        assert running.any()
        # [m] and [rad], [rad], [1], [m/s] and [rad/s], [N m]
        tolerances = {"q": 1.0e-4, "initial_target": 1.0e-6, "action": 0.0, "qd": 2.0e-2, "torque": 5.0e-2}
        for part, atol in tolerances.items():
            torch.testing.assert_close(
                getattr(simulated, part)[:, running], getattr(state, part)[:, running], rtol=0.0, atol=atol, msg=part
            )
        observed = env.obs.clone()
        for term in ("height", "lin_vel", "ang_vel", "gravity", "angle", "rate", "last_action"):
            observed[:, slice(*loop.layout[term])] = 0.0  # must come from the state alone
        torch.testing.assert_close(loop.observe(state, observed), env.obs, rtol=0.0, atol=1.0e-5)


def test_goal_offset_has_derivatives_by_the_bases_position():
    """The offset in the body's yaw frame falls by the heading's unit vectors: R(yaw)^T times -1."""
    env = Env(make_task("horizontal-jump").on_level_ground(), 6, seed=3, noise=False, device="cpu")
    env.reset()
    loop = ClosedLoop(env)
    state = loop.state()
    observed = env.obs.clone()
    observed[:, :2] = torch.tensor([0.7, -0.2])  # [m]

    def offset(x, y):  # observed offset of the goal [m], (2,) summed over worlds, from base positions (worlds,)
        q = torch.cat([x[None], y[None], state.q[2:]])
        return loop.observe(state._replace(q=q), observed)[:, :2].sum(0)

    by_x, by_y = torch.autograd.functional.jacobian(offset, (state.q[0], state.q[1]))
    heading = heading_of(state.q[3:7].T)
    expected = torch.stack([-heading.cos(), heading.sin()]), torch.stack([-heading.sin(), -heading.cos()])
    torch.testing.assert_close(by_x, expected[0], rtol=0.0, atol=1.0e-6)
    torch.testing.assert_close(by_y, expected[1], rtol=0.0, atol=1.0e-6)


def apexes(loop, network, state, observed, weights, steps=30, tape=None):
    """Return the ballistic apex height [m] (num_worlds,) after `steps` policy steps of a network with `weights`.

    observed: the environment's observations, for the commands; tape: of `Network.act`.
    """
    for _ in range(steps):
        state = loop.advance(state, network.act(loop.observe(state, observed), weights, tape))
    motion = loop.motion(state)
    return motion.pos[:, Z] + motion.lin_vel[:, Z].square() / (2.0 * G)


def test_apex_gradients_by_weights_match_central_differences():
    """Gradients by a policy's weights, of each world and of their sum, along three random directions."""
    group = jumps()
    group.begin()
    loop = ClosedLoop(group.env, double=True)
    network = Network(policy(), dtype=torch.float64)
    state, observed = loop.state(), group.env.obs.double()
    weights, tape = network.weights.clone().requires_grad_(), Tape()
    heights = apexes(loop, network, state, observed, weights, tape=tape)
    assert (heights.detach() - torch.tensor([0.85, 0.95])).abs().max() < 0.05  # [m] from the commands
    rows = per_world_gradients(heights.sum(), tape)
    gradient = torch.autograd.grad(heights.sum(), weights)[0]
    torch.testing.assert_close(rows.sum(0), gradient, rtol=1.0e-9, atol=1.0e-9 * float(gradient.abs().max()))
    rng = np.random.default_rng(0)
    for _ in range(3):
        direction = torch.tensor(rng.standard_normal(len(weights))) * gradient.abs()
        direction /= direction.norm()
        h = 1.0e-8  # the truncation error falls with its square: 4e-5 at 1e-7
        with torch.no_grad():
            ends = [
                apexes(loop, network, state, observed, network.weights + side * h * direction) for side in (1.0, -1.0)
            ]
        torch.testing.assert_close(
            rows @ direction, (ends[0] - ends[1]) / (2.0 * h), rtol=1.0e-6, atol=1.0e-6 * float(rows.norm(dim=1).max())
        )
