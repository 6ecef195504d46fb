"""Rewards that every task can use, by hand."""

import math

import numpy as np
import pytest

from jump_helpers import PHASES, Table
from jumper_warp.kernels.mdp import rewards

ROBOT = {
    "paw_force": (10.0, 20.0, 0.0, 20.0), "clipped": 0.7, "torque": np.arange(12.0), "joint_acc": 2.0 * np.arange(12.0),
    "action": np.full(12, 0.5), "prev_action": np.full(12, -0.5), "prev_prev_action": np.full(12, 0.25),
    "projected_gravity": (0.0, -math.sin(0.2), -math.cos(0.2)), "lin_vel": (0.3, -0.4, 2.0), "collisions": 16,
}  # fmt: skip
VALUES = {  # of ROBOT, in every phase: numbers, value
    "ground_force": ({"weight_force": 30.0}, 1.0), "action_clip": ({}, 0.7), "motor_torque_sq": ({}, 506.0),
    "joint_acceleration": ({}, 2024.0), "action_rate": ({}, 12.0), "action_acceleration": ({}, 12.0 * 1.75**2),
    "collision": ({}, 1.0), "level": ({"width": 0.1}, math.exp(-4.0)), "horizontal_speed_sq": ({}, 0.25),
}  # fmt: skip
reward = Table([getattr(rewards, name) for name in VALUES], float)


def test_phi_is_gaussian_and_psi_laplacian():
    for x, power in ((0.2, -1.0), (-0.6, -9.0)):
        assert rewards.phi(x, 0.2) == pytest.approx(math.exp(power))
    assert rewards.psi(-0.6, 0.2) == pytest.approx(math.exp(-3.0))


@pytest.mark.parametrize("name", VALUES)
def test_reward_by_hand(name):
    numbers, value = VALUES[name]
    reward.check(name, numbers, [(value, ROBOT, {})], PHASES)
    reward.check(name, numbers, [(float(name == "level"), {}, {})])  # of a robot at rest
