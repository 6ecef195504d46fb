"""The flag --robot applies a robot overlay to training, evaluation and play; `jumper robot` makes folders of robots."""

import json

import pytest

from jumper_warp.cli.main import UsageError, main
from jumper_warp.cli.robot import run as robot
from jumper_warp.cli.train import parse_train
from jumper_warp.evaluation.conditions import env_of_recipe
from jumper_warp.evaluation.run import EvaluationArgs, torque_limit
from jumper_warp.policies.policy import Policy
from jumper_warp.robot.description import load_description
from jumper_warp.robot.folder import read_robot, table_of
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.training import make_env
from jumper_warp.utils.output import read_values

HEAVY = 3.0
"""[kg] Mass added to the base."""


def base_mass(env):
    """Return the mass of the first robot's base [kg]."""
    return float(env.sim.model.body_mass.numpy()[0])


@pytest.fixture(scope="module")
def overlay(tmp_path_factory):
    """File of a robot overlay with a base heavier by HEAVY and 0.8 of the gain kp."""
    file = tmp_path_factory.mktemp("robot") / "identified.json"
    values = {"base_mass": (float(RobotOverlay({}).robots().base_mass[0, 0]) + HEAVY,), "kp": 12 * (0.8,)}
    RobotOverlay(values, {"base_mass": (-0.1, 0.1)}).save(file)
    return file


@pytest.mark.parametrize("command", ["evaluate", "play"])
def test_heavier_robot_jumps_less_high(overlay, tmp_path, command):
    count = ["--num-jumps", "3", "--height-range", "0.7", "1.2"] if command == "evaluate" else ["--height", "1.1"]
    metrics, apex = {}, {}
    for name, flags in (("described", []), ("identified", ["--robot", str(overlay)])):
        main([command, "vertical_jump", *count, *flags, "--out", str(tmp_path / name), "--device", "cpu"])
        metrics[name] = read_values(tmp_path / name)
        apex[name] = metrics[name]["apex_m"][0] if command == "play" else metrics[name]["apex_max_m"]
    assert apex["identified"] < apex["described"] - 0.02  # [m]
    if command == "evaluate":
        assert metrics["identified"]["robot"] == str(overlay) and "robot" not in metrics["described"]


def test_torque_limit_metric_includes_the_overlay(tmp_path):
    RobotOverlay({"saturation": 4 * (0.5, 0.9, 0.9)}).save(tmp_path / "weak.json")
    args = EvaluationArgs(robot=tmp_path / "weak.json", device="cpu")
    policy = Policy.load("vertical_jump")
    nominal, weak = (torque_limit(env_of_recipe(policy.recipe(), 1, a)) for a in (EvaluationArgs(), args))
    assert nominal == 18.0 and weak == pytest.approx(16.2)  # [N m], transversal motors: 0.9 · 18


def test_training_uses_and_saves_the_overlay(overlay):
    env = make_env(parse_train(["vertical-jump", "--robot", str(overlay), "--no-randomize"])[0], 2, 0, "cpu")
    saved = RobotOverlay.from_json(json.loads(json.dumps(env.config()))["robot"])
    assert base_mass(env) == pytest.approx(saved.values["base_mass"][0]) and saved.values["kp"][0] == 0.8
    assert saved.randomization == {"base_mass": (-0.1, 0.1)}


def test_new_folder_of_an_overlay_names_the_values_that_it_loses(tmp_path, capsys):
    values = {"latency": (0.004,), "base_mass": (9.0,), "kp": (0.9,) * 12, "armature": (*[0.02] * 11, 0.03)}
    RobotOverlay(values, {"gains": (0.9, 1.1)}).save(tmp_path / "overlay.json")
    robot(["new", str(tmp_path / "mine"), "--from", str(tmp_path / "overlay.json")])
    assert capsys.readouterr().out.splitlines()[0].endswith("of motor: latency, armature, randomization")


def test_new_folder_of_an_overlay_names_the_legs_whose_own_values_it_loses(tmp_path, capsys):
    table = table_of(load_description(), "Jumper")
    table["FR"] = {"outer_shank_mass": {**table["front"]["outer_shank_mass"], "value": 1.0}}
    RobotOverlay({"base_mass": (7.0,)}, robot=table).save(tmp_path / "overlay.json")
    robot(["new", str(tmp_path / "mine"), "--from", str(tmp_path / "overlay.json")])
    assert capsys.readouterr().out.splitlines()[0].endswith("of motor: FR")


def test_new_folder_of_a_robot_is_checked_and_drawn(tmp_path, capsys):
    robot(["new", str(tmp_path / "mine"), "--from", "heavy"])
    table = read_robot(tmp_path / "mine")
    assert table["name"] == "mine" and table["front"]["thigh"]["value"] == 0.245
    table["body"]["inertia"]["value"] = [0.1, 0.1, 0.9, 0.0, 0.0, 0.0]
    (tmp_path / "mine" / "robot.json").write_text(json.dumps(table))
    robot(["check", str(tmp_path / "mine"), "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert "40.000 kg" in printed and "implausible: body: no body has mass" in printed
    assert (tmp_path / "out" / "robot.png").is_file() and (tmp_path / "out" / "jump.rrd").is_file()
    with pytest.raises(UsageError, match="exists"):
        robot(["new", str(tmp_path / "mine")])
