"""Rewards of turning in free flight, calculated by hand."""

import math

import pytest

from jump_helpers import Table, functions, make_view
from jumper_warp.kernels.attitude import rewards
from jumper_warp.kernels.attitude.state import AttitudeState
from mdp_helpers import DEFAULT_ANGLE

reward = Table(functions(rewards, "approach attitude hold landing_posture spin"), float, AttitudeState)


@pytest.mark.parametrize(
    ("name", "numbers", "expected"),
    [
        ("approach", {}, 0.1 * 60.0),  # from 0.6 to 0.5 rad in a policy step
        ("attitude", {"std": 0.25}, math.exp(-4.0)),
        ("hold", {"std": 1.0, "std_ang_vel": 1.3}, math.exp(-0.25 - 1.0)),
        ("landing_posture", {"std": 1.0, "std_posture": 0.1}, math.exp(-0.25 - 4.0)),
        ("spin", {}, 1.69),
    ],
)
def test_rewards_equal_hand_calculations(name, numbers, expected):
    view, state = make_view(angle=DEFAULT_ANGLE + 0.2, ang_vel=(0.3, 0.4, 1.2)), AttitudeState()
    state.error, state.old_error = 0.5, 0.6
    assert reward(name, view, state, **numbers) == pytest.approx(expected, rel=1e-5)
