"""Comparison with Pinocchio of the described robot and an overlay, and its sensitivity to a wrong mass."""

import numpy as np
import pytest

from dynamics_oracle import differences, jumper_quantities, pinocchio_quantities, random_states
from jumper_warp.robot.overlay import RobotOverlay

OVERLAY = RobotOverlay(
    {
        "base_mass": (8.43,), "base_com": (0.02, -0.01, 0.03), "base_inertia": (1.4,),
        "link_mass": (1.2, 0.7, 1.3, 0.9, 1.1), "armature": tuple(np.linspace(0.003, 0.006, 12)),
    }
)  # fmt: skip


@pytest.mark.parametrize("overlay", [RobotOverlay({}), OVERLAY], ids=["described", "overlay"])
def test_dynamics_agree_with_pinocchio_to_single_precision(overlay):
    states = random_states(8, 0)
    ours, theirs = (of(overlay.robots(), states) for of in (jumper_quantities, pinocchio_quantities))
    assert len(ours) == 5 and max(differences(ours[name], theirs[name])[1] for name in ours) < 1.0e-6


def test_one_percent_mass_error_changes_acceleration_but_not_jacobian():
    right, wrong, states = OVERLAY.robots(), OVERLAY.robots(), random_states(4, 1)
    wrong.base_mass *= 1.01
    actual, expected = jumper_quantities(right, states), pinocchio_quantities(wrong, states)
    relative = differences(actual["joint_acceleration"], expected["joint_acceleration"])[1]
    assert 1.0e-4 < relative < 1.0e-1
    assert differences(actual["paw_jacobian"], expected["paw_jacobian"])[1] < 1.0e-6
