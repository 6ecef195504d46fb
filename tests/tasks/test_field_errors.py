"""Faults in a user's task are refused when the task is made, in one line with file and line."""

import sys
from pathlib import Path

import pytest

import hold_height
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.sources import module_from_file

STEPS = "    steps: int  # policy steps since the episode began\n"
SET = "    new = state\n    new.goal = values[0]\n    new.age = 0\n    new.lasts = 0\n    return new\n"


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
def test_unknown_field_is_refused_with_its_place_and_similar_fields(right, wrong, message, make):
    text = Path(hold_height.__file__).read_text(encoding="utf-8")
    line = text[: text.index(right)].count("\n") + 1
    with pytest.raises(InputError) as refusal:
        make(right, wrong)
    assert str(refusal.value) == f"own_faults.py:{line}, function {message}"


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        (SET, SET.replace("    return new\n", ""),
         "own_faults.py:99: hold-height command.set give_hold: the function must return HoldState, it returns nothing"),
        ("    new.lasts = settings.lasts\n    return new\n", "",
         "own_faults.py:86: hold-height reset reset_hold: the function must return HoldState, it returns nothing"),
        ("return state.lasts > 0 and state.age >= state.lasts", "state.age = 0",
         "own_faults.py:109: hold-height command.resample_due another_goal_due: the function must return bool,"),
        ("    return True", "    return 1.0", "own_faults.py:135, function every_episode: The function"),
        ("< tolerance, state.near + 1, 0)\n    return new", "< tolerance, state.near + 1, 0)",
         "own_faults.py:76: Advance advance_hold: the function must return the state, it returns nothing"),
        ("values: wp.vec4", "values: wp.vec3",
         "own_faults.py:99: give_hold must take (RobotView, Scene, HoldState, a vector of 4, float32)"),
        ("values: wp.vec4, heading: float", "values: wp.vec4",
         "command.set give_hold: the function must have 5 arguments (RobotView, Scene, HoldState, "),
        ("robot: mdp.RobotParameters, rng: mdp.RngStream,", "robot: mdp.RobotParameters, rng: mdp.Scene,",
         "EventTerm weak_motors: argument 2 of weak_motors is Scene, the task has RngStream"),
        ("mdp.rewards.psi(robot", "mdp.rewards.psy(robot", "own_faults.py:141, function near_goal: Could not find"),
        (STEPS, "", "own_faults.py:16: the state HoldState of hold-height needs a field steps: int"),
        (STEPS, STEPS.replace("int", "float"), "HoldState of hold-height needs a field steps: int"),
        *((STEPS, f"{STEPS}    {name}: float\n", f"own_faults.py:16: field {name!r}: `Env.task_arrays` has")
          for name in ("level", "done", "termination", "base_pos", "base_vel", "base_quat")),
        ("        return level", "        pass", "values of HoldLevelCfg must return HoldLevel, it returns NoneType"),
        ("    struct = HoldLevel\n", "", "levels[0]: HoldLevelCfg must have the attributes struct and values()"),
        ("(10.0, 40.0)", "15.0", "hold-height: action_scale must be (float, float), got 15.0"),
        ("(10.0, 40.0)", '(10.0, "40")', "hold-height: action_scale must be (float, float), got (10.0, '40')"),
        ("reward_floor=None", "reward_floor='0'", "hold-height: reward_floor must be float or None, got '0'"),
        ("events=(mdp.EventTerm(weak_motors, lower=0.8, upper=1.0),)",
         "events=mdp.EventTerm(weak_motors, lower=0.8, upper=1.0)", "events must be (EventTerm, ...), got EventTerm("),
        ("HoldLevelCfg((0.22, 0.42))", "HoldLevelCfg(0.22)", "levels goal must be (float, float), got 0.22"),
        ("mdp.Reset(reset_hold,", "mdp.Reset(hold_height,", "reset func must be a @wp.func, got <function hold_height"),
        ("state=HoldState", "state=HoldLevelCfg", "hold-height: state must be a @wp.struct, got <class"),
    ],
)  # fmt: skip
def test_own_fault_is_refused_by_the_task_in_one_line(right, wrong, message, make):
    with pytest.raises(InputError) as refusal:
        make(right, wrong)
    assert message in str(refusal.value)
