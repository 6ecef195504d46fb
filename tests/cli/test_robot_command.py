"""`jumper robot`: folders of robots, their check, and refusals."""

import json

import pytest

from jumper_warp.cli.main import UsageError
from jumper_warp.cli.robot import run
from jumper_warp.robot.folder import read_robot


def test_new_folder_of_a_robot_is_checked_and_drawn(tmp_path, capsys):
    run(["new", str(tmp_path / "mine"), "--from", "heavy"])
    table = read_robot(tmp_path / "mine")
    assert table["name"] == "mine" and table["front"]["thigh"]["value"] == 0.245
    table["body"]["inertia"]["value"] = [0.1, 0.1, 0.9, 0.0, 0.0, 0.0]
    (tmp_path / "mine" / "robot.json").write_text(json.dumps(table))
    run(["check", str(tmp_path / "mine"), "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert "40.000 kg" in printed and "implausible: body: no body has mass" in printed
    assert (tmp_path / "out" / "robot.png").is_file() and (tmp_path / "out" / "jump.rrd").is_file()
    with pytest.raises(UsageError, match="exists"):
        run(["new", str(tmp_path / "mine")])
