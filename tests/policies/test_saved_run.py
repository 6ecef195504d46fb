import dataclasses
import json
import math

import pytest

from jumper_warp.envs.env import plain
from jumper_warp.policies.restore import restored_task
from jumper_warp.policies.spec import PolicyError, PolicyInterface, interface_of_task
from jumper_warp.registry import make_task
from jumper_warp.tasks.cfg import GroundCfg, Rule, Term
from kernels.jump import rewards, terminations


def test_interface_of_the_vertical_jump_has_the_robots_figures():
    face = interface_of_task(make_task("vertical-jump"), policy_dt=1 / 60, physics_dt=1 / 480, hidden=(256, 128, 128))
    assert face.sizes == (48, 256, 128, 128, 12)
    assert face.joint_names[:4] == ("FL_lateral", "FL_outer", "FL_inner", "FR_lateral")
    assert face.action_scale[:3] == pytest.approx([0.261799, 1.570796, 1.570796], abs=1e-6)
    assert face.default_joint_pos[3:6] == pytest.approx([0.0, 0.785398, 0.785398], abs=1e-6)
    assert face.joint_stiffness == (17.0,) * 12
    assert face.joint_damping[:3] == (1.8, 0.8, 0.8)
    assert face.torque_limit[:3] == (10.0, 18.0, 18.0)
    assert face.command_filter["sum"] == {"lower": 0.0, "upper": 240.0, "lower_zone": 35.0, "upper_zone": 45.0}
    assert PolicyInterface.from_json(json.loads(json.dumps(face.to_json()))) == face


@pytest.fixture
def saved():
    """Configuration of a changed vertical jump, as a file holds it."""
    task = make_task("vertical-jump")
    terms = (dataclasses.replace(task.terms[0], weight=7.0, params=(0.2, 0.1)), *task.terms[2:])
    randomization = dataclasses.replace(task.randomization, latency=None, gains=(0.9, 1.1))
    task = dataclasses.replace(task, terms=terms, levels=task.levels[:2], randomization=randomization, games=3)
    return task, json.loads(json.dumps({"env": {"task": plain(task)}}))


def test_task_comes_back_from_its_configuration(saved):
    task, config = saved
    assert restored_task(config) == task
    assert task != make_task("vertical-jump")


def test_setting_that_is_not_saved_keeps_its_default(saved):
    task, config = saved
    del config["env"]["task"]["games"]
    assert restored_task(config) == dataclasses.replace(task, games=5)


def test_unknown_reward_is_left_out(saved):
    task, config = saved
    config["env"]["task"]["terms"].append({"func": "my_own", "weight": 1.0, "params": [], "once": False})
    assert restored_task(config) == task


def test_a_reward_that_the_task_does_not_use_comes_back(saved):
    task, config = saved
    term = Term(rewards.lifted_paws, -3.0, (30.0,))
    config["env"]["task"]["terms"].append(json.loads(json.dumps(plain(term))))
    assert restored_task(config) == dataclasses.replace(task, terms=(*task.terms, term))


@pytest.mark.parametrize("success", [False, True])
def test_a_rule_that_the_task_does_not_use_comes_back(saved, success):
    task, config = saved
    rule = Rule(terminations.left_stance, (0.3,), success=success)
    config["env"]["task"]["rules"].append(json.loads(json.dumps(plain(rule))))
    assert restored_task(config) == dataclasses.replace(task, rules=(*task.rules, rule))


def test_drawn_grounds_come_back_and_default_to_none(saved):
    task, config = saved
    ground = GroundCfg(platform=0.25, block=0.5, drop=(0.05, 0.1), clearance=0.2)
    config["env"]["task"]["ground"] = json.loads(json.dumps(plain(ground)))
    assert restored_task(config) == dataclasses.replace(task, ground=ground)
    del config["env"]["task"]["ground"]
    assert restored_task(config) == dataclasses.replace(task, ground=GroundCfg())


def test_a_task_from_before_its_grounds_stays_level():
    task = make_task("horizontal-jump")
    config = json.loads(json.dumps({"env": {"task": plain(task)}}))
    del config["env"]["task"]["ground"]
    assert task.ground.drawn and restored_task(config) == dataclasses.replace(task, ground=GroundCfg())


@pytest.mark.parametrize("name", ["wp", "SOON", "__doc__", "landing_error_estimate", "", "cartwheel", 3, None])
def test_a_rule_that_is_no_termination_is_refused(saved, name):
    _, config = saved
    config["env"]["task"]["rules"][1]["func"] = name
    with pytest.raises(PolicyError, match=rf"task.rules\[1\]: this version has no {name!r}"):
        restored_task(config)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.update(name="fly"), "unknown task 'fly'"),
        (lambda t: t.pop("terms"), "no task in the configuration"),
        (lambda t: t["rules"][1].update(func="os.system"), r"task.rules\[1\]: this version has no 'os.system'"),
        (lambda t: t.update(observe="other"), "task.observe: this version has"),
        (lambda t: t["reset"].update(wings=2), "task.reset: unknown setting 'wings'"),
        (lambda t: t["reset"].update(standing="much"), "task.reset.standing: expected float, got 'much'"),
        (lambda t: t["reset"].update(standing=math.nan), "task.reset.standing: must be finite"),
        (lambda t: t["motors"]["lateral"].update(kp=-1.0), "kp must be finite and not negative"),
        (lambda t: t.update(action_scale=[1.0]), "task.action_scale: expected 2 entries, got 1"),
        (lambda t: t.update(games=True), "task.games: expected int, got True"),
        (lambda t: t.update(reset=3), "task.reset: expected settings by name"),
    ],
)
def test_configuration_that_is_no_task_is_refused(saved, change, message):
    _, config = saved
    change(config["env"]["task"])
    with pytest.raises(PolicyError, match=message):
        restored_task(config)
