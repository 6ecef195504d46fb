import dataclasses
import json

import pytest

import hold_height
from jumper_warp.evaluation.conditions import evaluated_task
from jumper_warp.kernels.jump import rewards, terminations
from jumper_warp.policies.spec import PolicyInterface, make_interface
from jumper_warp.recipe import Recipe
from jumper_warp.registry import make_task
from jumper_warp.tasks.interface import interface
from jumper_warp.tasks.jump.cfg import GroundCfg
from jumper_warp.tasks.saving import TaskError, task_to_json
from jumper_warp.tasks.terms import RewardTerm, TerminationTerm

SHAPE = {"policy_dt": 1 / 60, "physics_dt": 1 / 480, "hidden": (256, 128, 128)}  # [s], [s], widths


def test_interface_of_the_vertical_jump_has_the_robots_values():
    spec = make_interface(interface(make_task("vertical-jump")), **SHAPE)
    assert spec.sizes == (147, 256, 128, 128, 12)
    assert spec.joint_names[:4] == ("FL_lateral", "FL_outer", "FL_inner", "FR_lateral")
    assert spec.action_scale[:3] == pytest.approx([0.261799, 1.570796, 1.570796], abs=1e-6)  # 15, 90, 90 degrees
    assert spec.default_joint_pos[3:6] == pytest.approx([0.0, 0.785398, 0.785398], abs=1e-6)  # 0, 45, 45 degrees
    assert spec.joint_stiffness == (17.0,) * 12  # [N m/rad]
    assert spec.joint_damping[:3] == (1.8, 0.8, 0.8)  # [N m s/rad]
    assert spec.torque_limit[:3] == (10.0, 18.0, 18.0)  # [N m]
    assert spec.command_filter["sum"] == {"lower": 0.0, "upper": 240.0, "lower_zone": 35.0, "upper_zone": 45.0}
    assert spec.observation_layout["lin_vel"] == {"first": 3, "end": 15, "scale": 1.0, "clip": 100.0, "history": 4}
    assert PolicyInterface.from_json(json.loads(json.dumps(spec.to_json()))) == spec


def test_observation_layout_has_scale_and_history_of_a_term():
    layout = make_interface(interface(hold_height.hold_height()), **SHAPE).observation_layout
    assert layout["height"] == {"first": 1, "end": 4, "scale": 5.0, "clip": 100.0, "history": 3}


@pytest.fixture
def saved():
    """A modified vertical-jump task, and its configuration as read from a JSON file."""
    task = make_task("vertical-jump").with_terms("rewards", jump_height={"weight": 7.0, "std_fine": 0.2})
    randomization = dataclasses.replace(task.randomization, latency=None, gains=(0.9, 1.1))
    curriculum = task.curriculum.replace(promote_after=3)
    changes = {"rewards": task.rewards[:1] + task.rewards[2:], "levels": task.levels[:2], "curriculum": curriculum}
    task = dataclasses.replace(task, randomization=randomization, **changes)
    return task, json.loads(json.dumps({"env": {"task": task_to_json(task)}}))


def whole(config):
    """Return the task in a configuration with all sections."""
    return Recipe.from_json(config, []).task


def nominal(config):
    """Return the task in a configuration for a nominal test."""
    return evaluated_task(Recipe.from_json(config, [], complete=False), randomize=False)


def test_restored_task_equals_the_saved_one(saved):
    task, config = saved
    assert whole(config) == task != make_task("vertical-jump")
    observations = dataclasses.replace(task.observations, critic=())
    assert nominal(config) == dataclasses.replace(task, rewards=(), observations=observations, events=())


def test_missing_setting_gets_its_default(saved):
    task, config = saved
    del config["env"]["task"]["curriculum"]["promote_after"]
    assert whole(config) == dataclasses.replace(task, curriculum=task.curriculum.replace(promote_after=5))


def test_refuses_an_unknown_reward_unless_rewards_are_left_out(saved):
    _, config = saved
    config["env"]["task"]["rewards"].append({"type": "jumper_warp.tasks.terms:RewardTerm", "func": "mine:my_own"})
    with pytest.raises(TaskError, match=r"task.rewards\[23\].func needs 'mine:my_own': pass the file"):
        whole(config)
    assert nominal(config).name == "vertical-jump"


def other_task(task, part):
    """Return a copy of a jump task with a reward, a termination or a ground that the stock task does not have."""
    if part == "reward":
        return dataclasses.replace(task, rewards=(*task.rewards, RewardTerm(rewards.lifted_again, -3.0, threshold=0.1)))
    if part == "termination":
        ending = TerminationTerm(terminations.left_stance, distance=0.3, success=True, time_out=True)
        return dataclasses.replace(task, terminations=(*task.terminations, ending))
    ground = GroundCfg(platform=0.25, block=0.5, drop=(0.05, 0.1), clearance=0.2)
    settings = dataclasses.replace(task.reset.settings, ground=ground)
    return dataclasses.replace(task, reset=dataclasses.replace(task.reset, settings=settings))


@pytest.mark.parametrize("part", ["reward", "termination", "ground"])
def test_restores_what_the_stock_task_does_not_have(saved, part):
    task, config = saved
    other = other_task(task, part)
    config["env"]["task"] = json.loads(json.dumps(task_to_json(other)))
    assert whole(config) == other != task
    config["env"]["task"]["reset"]["settings"].pop("ground")
    assert part != "ground" or whole(config) == task


def test_refuses_another_version_with_the_commit_that_reads_it(saved):
    _, config = saved
    for version in (4, 6):  # the present one is 5
        config["env"]["task"]["version"] = version
        with pytest.raises(TaskError, match=f"has version {version}, expected version 5; commit 7f5b55c3"):
            nominal(config)
