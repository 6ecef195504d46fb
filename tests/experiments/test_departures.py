"""Ablations of the jumps' departures from the paper, in the files of experiments/departures."""

import json
import shlex
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from columns import Z
from jumper_warp.cli.train import parse_train
from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.evaluations import default_flags
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.policies.policy import load_policy
from jumper_warp.registry import load_task_module
from jumper_warp.tasks.saving import task_from_json, task_to_json

FOLDER = Path(__file__).parents[2] / "experiments/departures"
FILES = sorted(FOLDER.glob("*.toml"))


@pytest.fixture(autouse=True)
def own_tasks():
    load_task_module(str(FOLDER / "departure_tasks.py"))


def trained(file, name):
    """Return the recipe of an arm of a file."""
    settings = tomllib.loads((FOLDER / file).read_text())
    arm = settings["arms"][name]
    task, flags = (settings["task"], arm) if isinstance(arm, str) else (arm["task"], "")
    return parse_train([task, *shlex.split(settings["flags"]), *shlex.split(flags)])[0]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_arm_changes_the_task_or_the_trainer_and_can_be_saved(file):
    settings = tomllib.loads(file.read_text())
    kept = trained(file, "kept")
    for name in settings["arms"]:
        recipe = trained(file, name)
        task = recipe.task
        assert task_from_json(json.loads(json.dumps(task_to_json(task)))) == task
        same = replace(task, name=kept.task.name) == kept.task and recipe.train.ppo == kept.train.ppo
        assert same == (name == "kept"), name
    values = {key: tuple(each) if isinstance(each, list) else each for key, each in settings["evaluation"].items()}
    replace(default_flags(kept.task.evaluation, "evaluate"), **values)
    Conditions(**settings["conditions"])


@pytest.mark.parametrize("randomize", [False, True])
def test_paws_penetrate_the_ground_by_less_than_a_millimetre(randomize):
    policy = load_policy("vertical_jump")
    env = env_of_recipe(policy.recipe(), 20, Conditions(randomize=randomize, noise=randomize, device="cpu"))
    goals = np.zeros((20, 3))
    goals[:, Z] = np.linspace(0.5, 1.05, 20)
    env.evaluation_reset(jump_commands(goals, 0.5, env.step_dt))
    lowest = np.full(20, np.inf)  # [m] lowest point of a paw above the ground
    for _ in range(180):
        env.step(policy.act(env.obs))
        lowest = np.minimum(lowest, env.robot.paw_height.numpy().min(axis=0))
    assert (lowest > -0.001).all() and (lowest < -0.0003).all()
