import math

import numpy as np
import pytest

from jump_helpers import Table, functions, make_episode, make_view
from jumper_warp.kernels.mdp import rewards

NAMES = (
    "level horizontal_speed_sq ground_force action_clip motor_torque_sq joint_acceleration action_rate "
    "action_acceleration collision"
)
reward = Table(functions(rewards, NAMES), float)
E = math.exp


def test_phi_is_gaussian_and_psi_laplacian():
    assert rewards.phi(0.2, 0.2) == pytest.approx(E(-1.0))
    assert rewards.phi(-0.6, 0.2) == pytest.approx(E(-9.0))
    assert rewards.psi(-0.6, 0.2) == pytest.approx(E(-3.0))


@pytest.mark.parametrize("phase", range(3))
def test_regularisation_terms_are_sums_of_squares_in_every_phase(phase):
    task = make_episode(phase=phase)
    view = make_view(
        paw_force=(10.0, 20.0, 0.0, 20.0),
        clipped=0.7,
        torque=np.arange(12.0),
        joint_acc=2.0 * np.arange(12.0),
        action=np.full(12, 0.5),
        prev_action=np.full(12, -0.5),
        prev_prev_action=np.full(12, 0.25),
        collisions=int(phase == 1) * 16,
    )
    assert reward("ground_force", view, task, weight_force=30.0) == pytest.approx(1.0)
    assert reward("action_clip", view, task) == pytest.approx(0.7)
    assert reward("motor_torque_sq", view, task) == pytest.approx(506.0)
    assert reward("joint_acceleration", view, task) == pytest.approx(2024.0)
    assert reward("action_rate", view, task) == pytest.approx(12.0)
    assert reward("action_acceleration", view, task) == pytest.approx(12.0 * 1.75**2)
    assert reward("collision", view, task) == float(phase == 1)


def test_level_is_gaussian_in_the_tilt_and_horizontal_motion_costs_its_squared_speed():
    view = make_view(projected_gravity=(0.0, -math.sin(0.2), -math.cos(0.2)), lin_vel=(0.3, -0.4, 2.0))
    assert reward("level", view, make_episode(), width=0.1) == pytest.approx(E(-4.0), rel=1e-3)
    assert reward("level", make_view(), make_episode(), width=0.1) == pytest.approx(1.0)
    assert reward("horizontal_speed_sq", view, make_episode()) == pytest.approx(0.25)
