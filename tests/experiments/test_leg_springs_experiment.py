"""Experiment with springs between the knees at a tiny size."""

import pytest

from experiments import leg_springs
from jumper_warp.utils.output import read_values


def test_springs_raise_the_apex(tmp_path):
    args = leg_springs.Args(stiffness=(0.0, 500.0), squat_angles=(120.0,), filter="stock", out=tmp_path, device="cpu")
    values = leg_springs.main(args)
    assert read_values(tmp_path) == values
    without, with_springs = values["stock_apex_m"]
    assert without == pytest.approx(1.075, abs=0.01) and with_springs == pytest.approx(1.243, abs=0.01)
    assert values["stock_highest_apex_height_m"] == with_springs and (tmp_path / "springs.png").is_file()
