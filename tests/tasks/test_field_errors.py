"""Faults in a user's task are refused when the task is made, in one line with file and line."""

import sys
from pathlib import Path

import pytest

import hold_height
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.sources import module_from_file

STEPS = "    steps: int  # policy steps since the episode began\n"


@pytest.fixture
def make(tmp_path, monkeypatch):
    """Function (right, wrong) that makes the task of the file hold_height.py, with one text replaced; (line, task)."""

    def make(right, wrong):
        text = Path(hold_height.__file__).read_text(encoding="utf-8")
        assert right in text
        path = tmp_path / "own_faults.py"
        path.write_text(text.replace(right, wrong, 1))
        monkeypatch.setitem(sys.modules, "own_faults", None)  # removed after the test
        return module_from_file("own_faults", path).hold_height()

    return make


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("state.age + 1", "state.ago + 1", "advance_hold: `ago` is not an attribute of"),
        ("new.near =", "new.nera =", "advance_hold: unknown field nera"),
    ],
)
def test_unknown_field_is_refused_with_its_place(right, wrong, message, make):
    text = Path(hold_height.__file__).read_text(encoding="utf-8")
    line = text[: text.index(right)].count("\n") + 1
    with pytest.raises(InputError) as refusal:
        make(right, wrong)
    assert str(refusal.value).startswith(f"own_faults.py:{line}, function {message}")


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("    return True", "    return 1.0", "own_faults.py:135, function every_episode: The function"),
        ("values: wp.vec4", "values: wp.vec3",
         "own_faults.py:99: give_hold must take (RobotView, Scene, HoldState, a vector of 4, float32)"),
        ("mdp.rewards.psi(robot", "mdp.rewards.psy(robot", "own_faults.py:141, function near_goal: Could not find"),
        (STEPS, "", "own_faults.py:16: the state HoldState of hold-height needs a field steps: int"),
        (STEPS, f"{STEPS}    level: float\n", "own_faults.py:16: field 'level': `Env.task_arrays` has"),
        ("(10.0, 40.0)", "15.0", "hold-height: action_scale must be (float, float), got 15.0"),
    ],
)  # fmt: skip
def test_own_fault_is_refused_by_the_task_in_one_line(right, wrong, message, make):
    with pytest.raises(InputError) as refusal:
        make(right, wrong)
    assert message in str(refusal.value)
