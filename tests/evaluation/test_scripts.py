"""Parsing of scripts, and one-line errors of malformed ones."""

from pathlib import Path

import pytest

from jumper_warp.evaluation.scripts import ScriptStep, parse_script
from jumper_warp.utils.errors import InputError

EXAMPLE = Path(__file__).parents[2] / "assets" / "scripts" / "walk_jump_walk.json"


def test_parse_script_returns_values_times_and_goals_of_every_kind_of_command():
    script = parse_script(
        [{"walk": [0.5, 0, 0.3]}, {"walk": [0, 1, 0], "seconds": 4}, {"stand": 1.5}, {"jump_up": 0.75},
         {"jump_to": [0.85, -0.1]}, {"jump_onto": [1.3, 0.1]}]
    )  # fmt: skip
    assert script == (
        ScriptStep("walk", (0.5, 0.0, 0.3), 2.0), ScriptStep("walk", (0.0, 1.0, 0.0), 4.0),
        ScriptStep("stand", seconds=1.5), ScriptStep("jump_up", (0.75,)), ScriptStep("jump_to", (0.85, -0.1)),
        ScriptStep("jump_onto", (1.3, 0.1)),
    )  # fmt: skip
    assert [step.goal for step in script] == [
        (0.5, 0.0, 0.3), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.75), (0.85, -0.1, 0.0),
        (1.3, 0.1, 0.0),
    ]  # fmt: skip
    assert [step.jumps for step in script] == [False, False, False, True, True, True]


@pytest.mark.parametrize(
    "command",
    [{"stand": True}, {"walk": [0, 0, 1], "seconds": "2"}, {"walk": [0, 0]}, {"stand": float("nan")}, {"fly": 1}],
)
def test_command_of_another_type_is_refused_by_its_number(command):
    with pytest.raises(InputError, match="command 2") as refusal:
        parse_script([{"stand": 1.0}, command])
    assert "\n" not in str(refusal.value)
