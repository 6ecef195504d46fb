"""Faults in a user's task are refused when the task is made, in one line with file and line."""

import sys
from pathlib import Path

import pytest

import hold_height
from jumper_warp.tasks.functions import is_own, place_of
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
        ("robot.torque_ratio", "robot.torqe_ratio", "weak_motors: `torqe_ratio` is not an attribute of"),
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
        *((STEPS, f"{STEPS}    {name}: float\n", f"own_faults.py:16: field {name!r}: `Env.task_arrays` has")
           for name in ("level", "done", "termination", "base_pos", "base_vel", "base_quat")),
        ("        return level", "        pass", "values of HoldLevelCfg must return HoldLevel, it returns NoneType"),
        ("    struct = HoldLevel\n", "", "levels[0]: HoldLevelCfg must have the attributes struct and values()"),
        ("(10.0, 40.0)", "15.0", "hold-height: action_scale must be (float, float), got 15.0"),
    ],
)  # fmt: skip
def test_own_fault_is_refused_by_the_task_in_one_line(right, wrong, message, make):
    with pytest.raises(InputError) as refusal:
        make(right, wrong)
    assert message in str(refusal.value)


def test_term_of_a_module_without_name_is_a_users(tmp_path):
    path = tmp_path / "cell.py"
    term = "@wp.func\ndef one(robot: mdp.RobotView) -> float:\n    return 1.0\n"
    path.write_text(f"import warp as wp\nfrom jumper_warp import mdp\n{term}")
    names = {}
    exec(compile(path.read_text(), path, "exec"), names)  # as code that generates rewards
    assert is_own(names["one"]) and place_of(names["one"]) is not None
