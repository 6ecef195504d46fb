"""A field that a struct does not have is refused with file, line, function and a similar name."""

import sys
from pathlib import Path

import pytest

import hold_height
from jumper_warp.envs.env import Env
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.sources import module_from_file


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("state.age + 1", "state.ago + 1", "advance_hold: HoldState has no field 'ago'; did you mean 'age'?"),
        ("new.near =", "new.nera =", "advance_hold: unknown field 'nera'; did you mean 'near'?"),
        ("robot.height - state.goal, w", "robot.heigth, w",
         "near_goal: RobotView has no field 'heigth'; did you mean 'height'?"),
        ("state.near >=", "state.x >=", "held: HoldState has no field 'x'; it has goal, steps, age, lasts, near"),
        ("robot.torque_ratio", "robot.torqe_ratio",
         "weak_motors: RobotParameters has no field 'torqe_ratio'; did you mean 'torque_ratio'?"),
        ("return state.goal", "return robot.lin_vel.q", "wanted_height: unknown field 'q'"),
        ("level.goal = ", "level.gaol = ", "values: unknown field 'gaol'; did you mean 'goal'?"),
        ("settings.heading, ", "settings.heeding, ", "values: unknown field 'heeding'; did you mean 'heading'?"),
    ],
)  # fmt: skip
def test_unknown_field_is_refused_with_its_place_and_similar_fields(right, wrong, message, tmp_path, monkeypatch):
    text = Path(hold_height.__file__).read_text(encoding="utf-8")
    assert right in text
    line = text[: text.index(right)].count("\n") + 1
    path = tmp_path / "unknown_field.py"
    path.write_text(text.replace(right, wrong, 1))
    monkeypatch.setitem(sys.modules, "unknown_field", None)  # removed after the test
    module = module_from_file("unknown_field", path)
    with pytest.raises(InputError) as refusal:
        Env(module.hold_height(), 1, device="cpu")
    assert str(refusal.value) == f"unknown_field.py:{line}, function {message}"
