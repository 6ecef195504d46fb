"""Open-loop jump of a robot with an overlay."""

import pytest

from experiments import open_loop_jump
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import read_values


def test_heavier_robot_jumps_lower_without_hardware_comparison(tmp_path):
    overlay = RobotOverlay({"base_mass": (10.0,)}, source="6.43 kg, and a load")
    overlay.save(tmp_path / "heavy.json")
    args = open_loop_jump.Args(robot=tmp_path / "heavy.json", out=tmp_path, device="cpu")
    values = open_loop_jump.main(args)
    assert values == read_values(tmp_path)
    assert 0.9 < values["apex_height_m"] < 1.02  # 1.075 m without
    assert values["hardware_apex_height_m"] is None and values["robot"].endswith("heavy.json")
    assert (tmp_path / "jump.png").stat().st_size > 10_000


def test_refuses_springs_together_with_robot(tmp_path):
    with pytest.raises(InputError, match="springs or a robot"):
        open_loop_jump.Args(robot=tmp_path / "heavy.json", spring=(1000.0, 0.17))
