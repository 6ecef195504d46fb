"""Files of `jumper compare --file` in experiments: departures from the paper, the paper's techniques, fused kernels."""

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
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.policies.policy import load_policy
from jumper_warp.registry import load_task_module
from jumper_warp.tasks.saving import task_from_json, task_to_json

FOLDER = Path(__file__).parents[2] / "experiments/departures"
FILES = sorted(path for path in FOLDER.parent.rglob("*.toml") if "[arms]" in path.read_text())


@pytest.fixture(autouse=True)
def own_tasks():
    return [load_task_module(str(FOLDER / file)) for file in ("departure_tasks.py", "../paper/readings.py")]


def trained(file, name):
    """Return the recipe of an arm of a file."""
    settings = tomllib.loads((FOLDER / file).read_text())
    arm = settings["arms"][name]
    task, flags = (settings["task"], arm) if isinstance(arm, str) else (arm["task"], "")
    return parse_train([task, *shlex.split(settings.get("flags", "")), *shlex.split(flags)])[0]


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_arm_changes_the_task_or_the_trainer_and_can_be_saved(file, own_tasks):
    settings = tomllib.loads(file.read_text())
    first = next(iter(settings["arms"]))
    kept = trained(file, first)
    for name in settings["arms"]:
        recipe = trained(file, name)
        task = recipe.task
        assert task_from_json(json.loads(json.dumps(task_to_json(task))), own_tasks) == task
        same = replace(task, name=kept.task.name) == kept.task and recipe.train.ppo == kept.train.ppo
        assert same == (name == first), name
    values = {key: tuple(each) if isinstance(each, list) else each for key, each in settings["evaluation"].items()}
    replace(kept.task.evaluation.default_flags("evaluate"), **values)
    Conditions(**settings.get("conditions", {}))


@pytest.mark.parametrize("name", ["vertical_jump", "horizontal_jump"])
def test_arms_switch_off_initialisation_estimates_and_curriculum(name):
    file = f"../paper/{name}.toml"
    task = trained(file, "full").task
    modes = vars(trained(file, "no_initialisation").task.reset.settings.start_probability)
    assert {mode for mode, probability in modes.items() if probability} == {"default"}
    blind = trained(file, "no_estimates").task
    assert {term.name for term, old in zip(blind.rewards, task.rewards, strict=True) if term != old} == {
        term.name for term in task.rewards if term.name.startswith("estimated") and term.weight
    }
    ends = [term for term, old in zip(blind.terminations, task.terminations, strict=True) if term != old]
    assert [(term.name[:9], term.numbers["tolerance"]) for term in ends] == [("predicted", 1.0e6)]
    assert set(trained(file, "no_curriculum").task.levels) == {task.levels[-1]}


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
    assert (lowest > -0.001).all() and (lowest < 0.0).all()
