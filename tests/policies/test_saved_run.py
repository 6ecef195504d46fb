import dataclasses
import json

import pytest

import hold_height
from jumper_warp.policies.spec import PolicyInterface, make_interface
from jumper_warp.recipe import Recipe
from jumper_warp.registry import make_task
from jumper_warp.tasks.interface import interface
from jumper_warp.tasks.saving import task_to_json

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
    return Recipe.from_json(config, [], complete=False).tested_task(randomize=False)


def test_restored_task_equals_the_saved_one(saved):
    task, config = saved
    assert whole(config) == task != make_task("vertical-jump")
    assert nominal(config) == dataclasses.replace(
        task, rewards=(), observations=dataclasses.replace(task.observations, critic=()), events=()
    )
