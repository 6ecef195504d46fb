"""Gauss-Newton on a network's weights against the same equation solved densely."""

from itertools import pairwise

import torch
from torch.func import jacrev

from jumper_warp.policies.policy import Policy
from jumper_warp.trajectory.gauss_newton import Anchor, Network, Tape, gauss_newton_step, per_world_gradients
from tests.policies.test_policy import make_interface


def small_policy(num_obs=3, hidden=(4, 5), num_actions=2):
    """Return a random policy of a few weights, seed 0, and its `Network` in double precision."""
    torch.manual_seed(0)
    sizes = (num_obs, *hidden, num_actions)
    layers = [(0.5 * torch.randn(b, a), 0.1 * torch.randn(b)) for a, b in pairwise(sizes)]
    interface = make_interface(num_obs, num_actions, hidden, activation="elu")
    policy = Policy(layers, torch.randn(num_obs), torch.rand(num_obs) + 0.5, interface)
    return policy, Network(policy, dtype=torch.float64)


def test_network_acts_as_its_policy():
    policy, network = small_policy()
    obs = 5.0 * torch.randn(20, 3)
    torch.testing.assert_close(network.act(obs.double()).float(), policy.act(obs))


def test_per_world_gradients_match_autograd():
    _, network = small_policy()
    obs, tape = torch.randn(4, 3, dtype=torch.float64), Tape()

    def losses(weights, tape=None):  # (4 worlds,)
        first = network.act(obs, weights, tape)
        again = network.act(obs + first.sum(1, keepdim=True), weights, tape)  # the second step depends on the first
        return (first * again).sum(1)

    total = losses(network.weights, tape).sum()
    expected = jacrev(losses)(network.weights)
    torch.testing.assert_close(per_world_gradients(total, tape), expected, rtol=1.0e-10, atol=1.0e-12)


def test_gauss_newton_step_matches_dense_solution():
    """The oracle solves the module's equation with its matrix; both groups of worlds are stacked."""
    _, network = small_policy()
    weights, size = network.weights, len(network.weights)
    anchor = Anchor(network, torch.randn(9, 3, dtype=torch.float64), torch.rand(9, dtype=torch.float64) + 0.1)
    moved = weights + 0.05 * torch.randn(size, dtype=torch.float64)
    jacobian, errors = torch.randn(6, size, dtype=torch.float64), torch.randn(6, dtype=torch.float64)
    importance = torch.rand(6, dtype=torch.float64)
    step = gauss_newton_step(
        moved, *([values[:2], values[2:]] for values in (jacobian, errors, importance)), anchor,
        damping=0.5, iterations=200, accuracy=1.0e-9,
    )  # fmt: skip
    residuals = anchor.residuals(moved).flatten()
    change = jacrev(lambda w: anchor.residuals(w).flatten())(moved)
    damping = 0.5 * torch.eye(size, dtype=torch.float64)
    matrix = jacobian.T @ (importance[:, None] * jacobian) + change.T @ change + damping
    right = -jacobian.T @ (importance * errors) - change.T @ residuals
    torch.testing.assert_close(step, torch.linalg.solve(matrix, right), rtol=1.0e-6, atol=1.0e-6 * float(step.norm()))


def test_anchor_costs_only_changed_actions():
    _, network = small_policy()
    anchor = Anchor(network, torch.randn(9, 3, dtype=torch.float64), torch.ones(9, dtype=torch.float64))
    assert anchor.cost(network.weights + 0.05) > 0.0 == anchor.cost(network.weights)
