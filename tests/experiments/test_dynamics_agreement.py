"""Comparison with Pinocchio of the described robot and an overlay, and its sensitivity to a wrong mass."""

import numpy as np
import pytest

from experiments import dynamics_agreement
from experiments.dynamics_agreement import jumper_quantities, pinocchio_quantities, random_states
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.utils.output import read_values

OVERLAY = RobotOverlay(
    {
        "base_mass": (8.43,), "base_com": (0.02, -0.01, 0.03), "base_inertia": (1.4,),
        "link_mass": (1.2, 0.7, 1.3, 0.9, 1.1), "armature": tuple(np.linspace(0.003, 0.006, 12)),
    }
)  # fmt: skip


@pytest.mark.parametrize("overlay", [None, OVERLAY], ids=["described", "overlay"])
def test_dynamics_agree_with_pinocchio_to_single_precision(tmp_path, overlay):
    path = None
    if overlay is not None:
        path = tmp_path / "robot.json"
        overlay.save(path)
    values = dynamics_agreement.main(dynamics_agreement.Args(robot=path, states=8, out=tmp_path))
    assert values == read_values(tmp_path)
    relative = {name: value for name, value in values.items() if name.endswith("relative_difference")}
    assert len(relative) == 5 and max(relative.values()) < 1.0e-6


def test_one_percent_mass_error_changes_acceleration_but_not_jacobian():
    right, wrong, states = OVERLAY.robots(), OVERLAY.robots(), random_states(4, 1)
    wrong.base_mass *= 1.01
    actual, expected = jumper_quantities(right, states), pinocchio_quantities(wrong, states)
    relative = dynamics_agreement.differences(actual["joint_acceleration"], expected["joint_acceleration"])[1]
    assert 1.0e-4 < relative < 1.0e-1
    assert dynamics_agreement.differences(actual["paw_jacobian"], expected["paw_jacobian"])[1] < 1.0e-6
