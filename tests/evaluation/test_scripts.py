"""Parsing of scripts, and one-line errors of malformed ones."""

import json
from pathlib import Path

import pytest

from jumper_warp.evaluation.scripts import ScriptStep, parse_script, read_script
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


def test_example_script_walks_and_jumps():
    kinds = [step.kind for step in read_script(EXAMPLE)]
    assert kinds.index("jump_up") < kinds.index("jump_to") and kinds[0] == "walk" and kinds[-1] == "stand"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"walk": [1, 0, 0]}, "a script is a list"),
        ([], "a script is a list"),
        (["walk"], "command 1 must have one of walk, stand, jump_up, jump_to, jump_onto, got walk"),
        ([{"fly": 1}], "command 1 must have one of"),
        ([{"stand": 1}, {"walk": [0, 0, 0], "stand": 1}], "command 2 must have one of"),
        ([{"walk": [0, 0]}], "command 1: walk takes 3 numbers within 10, got"),
        ([{"walk": [0, 0, 11]}], "walk takes 3 numbers within 10"),
        ([{"walk": [0, 0, True]}], "walk takes 3 numbers"),
        ([{"walk": [0, 0, 0], "seconds": 0}], "seconds must be positive"),
        ([{"walk": [0, 0, 0], "secnds": 1}], "walk has no 'secnds'"),
        ([{"jump_up": 0.7, "seconds": 1}], "jump_up has no 'seconds'"),
        ([{"jump_up": -0.7}], "jump_up needs a positive height"),
        ([{"jump_to": 0.7}], "jump_to takes 2 numbers"),
        ([{"jump_to": ["a", 0]}], "jump_to takes 2 numbers"),
        ([{"stand": 400}, {"stand": 400}], "take 800 s, at most 600"),
        ([{"stand": 1}] * 1001, "1 to 1000 commands"),
    ],
)
def test_parse_script_refuses_malformed_commands_in_one_line(content, message):
    with pytest.raises(InputError) as caught:
        parse_script(content)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [(None, "no such file (script of commands"), ("[{", "not JSON"), ('[{"stand": NaN}]', "NaN is not a finite number"),
     (json.dumps([{"stand": 0}]), "command 1: seconds must be positive"), ("[" * 100_000, "not JSON"),
     (" " * (2**20 + 1), "larger than 1 MiB")],
)  # fmt: skip
def test_unusable_script_file_is_named_in_one_line_error(tmp_path, text, message):
    path = tmp_path / "script.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_script(path)
    assert message in str(caught.value) and str(path) in str(caught.value) and "\n" not in str(caught.value)
