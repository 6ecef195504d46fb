"""A user's task in a separate file, from training to a recording."""

import hashlib
import json
import shutil
import sys
from pathlib import Path

import pytest

from cli_helpers import run
from jumper_warp.cli import main as cli
from jumper_warp.kernels.jump import rewards
from jumper_warp.policies.policy import Policy, load_policy
from jumper_warp.recipe import Recipe
from jumper_warp.registry import TASKS, load_task_module, make_task
from jumper_warp.tasks.saving import TaskError

LEVEL_JUMP = Path(__file__).parents[1] / "helpers" / "level_jump.py"
TASK = '''\
"""Two jumps with a `base_at_rest` that is not the project's."""

from dataclasses import replace
from typing import Any

import warp as wp

from jumper_warp import make_task, mdp
from jumper_warp.registry import register_task
from jumper_warp.rl.cfg import PpoCfg

@wp.func
def base_at_rest(robot: mdp.RobotView, state: Any, height: float) -> float:
    return robot.height / height

@wp.func
def too_high(robot: mdp.RobotView, state: Any, height: float) -> bool:
    return robot.height > height

def tame_jump():
    task = make_task("vertical-jump")
    return replace(task, name="tame-jump", rewards=(mdp.RewardTerm(base_at_rest, 2.0, height=0.5), *task.rewards[:3]))

def low_jump():
    task = tame_jump()
    return replace(task, name="low-jump", terminations=(*task.terminations, mdp.TerminationTerm(too_high, height=3.0)))

register_task("tame-jump", tame_jump, ppo=PpoCfg(gamma=0.9), aliases=("Tame",))
register_task("low-jump", low_jump, ppo=PpoCfg(gamma=0.9))
'''
TRAIN = ["--num-envs", "4", "--max-iterations", "1", "--no-tensorboard", "--device", "cpu", "--ppo.num-steps", "2"]
TRAIN += ["--ppo.minibatches", "2", "--ppo.hidden", "8", "--env.rewards.base-at-rest.height", "0.4"]


def unload_tasks():
    """Unregister the user's tasks and remove their module."""
    for name in ("my_jumps", "own_faults"):
        sys.modules.pop(name, None)
    for name in ("tame-jump", "low-jump", "level-jump"):
        TASKS.pop(name, None)


@pytest.fixture(autouse=True)
def unloaded_after_test():
    """Unload the user's tasks after each test."""
    yield
    unload_tasks()


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Path, a string, of the file TASK, which defines the user's tasks."""
    path = tmp_path_factory.mktemp("user") / "my_jumps.py"
    path.write_text(TASK)
    return str(path)


@pytest.fixture(scope="module")
def runs(path, tmp_path_factory):
    """Folder of a short training of each of the user's tasks, by task name."""
    root, folders = tmp_path_factory.mktemp("logs"), {}
    for name in ("tame-jump", "low-jump"):
        cli.main(["train", "--task-module", path, name, *TRAIN, "--log-root", str(root)])
        (folders[name],) = (root / name).iterdir()
    unload_tasks()
    return folders


def play(source, *args):
    """Return the arguments of `jumper play` for a short recording of a policy or run."""
    return ["play", str(source), "--height", "0.6", "--seconds", "0.1", "--device", "cpu", *args]


def test_list_shows_tasks_of_a_module_and_policies(capsys, path):
    code, out, _ = run(capsys, "list", f"--task-module={path}")
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert code == 0 and "tame-jump" in lines
    assert "vertical-jump-standing stand, and jump to a height vertical_jump" in lines


def test_training_saves_functions_by_module_and_name(runs):
    config = json.loads((runs["tame-jump"] / "config.json").read_text())
    (base_at_rest,) = (term for term in config["env"]["task"]["rewards"] if term["name"] == "base_at_rest")
    assert (base_at_rest["func"], base_at_rest["height"]) == ("my_jumps:base_at_rest", 0.4)
    assert config["train"]["ppo"]["gamma"] == 0.9 and config["train"]["task"] == "tame-jump"


def test_export_does_not_need_the_module(capsys, runs, tmp_path):
    code, _, err = run(capsys, "export", str(runs["low-jump"]), "--out", str(tmp_path / "policy"))
    policy = load_policy(tmp_path / "policy")
    assert (code, err) == (0, [f"{runs['low-jump']}: best checkpoint, iteration {policy.config['iteration']}"])
    assert "my_jumps" not in sys.modules
    assert policy.interface.task == "low-jump" and policy.interface == Policy.load(runs["low-jump"]).interface
    assert run(capsys, "export", str(tmp_path / "policy"), "--out", str(tmp_path / "low.onnx"))[::2] == (0, [])


def test_play_does_not_need_training_functions(capsys, runs, tmp_path):
    code, _, err = run(capsys, *play(runs["tame-jump"], "--out", str(tmp_path)))
    assert code == 0, err
    assert (tmp_path / "jump.rrd").is_file() and "my_jumps" not in sys.modules


def test_play_refuses_missing_termination_function(capsys, runs, path, tmp_path):
    code, _, err = run(capsys, *play(runs["low-jump"]))
    assert code == 2 and len(err) == 1 and "needs 'my_jumps:too_high': pass the file" in err[0]
    assert "--task-module" in err[0] and "my_jumps" not in sys.modules
    assert run(capsys, *play(runs["low-jump"], "--task-module", path, "--out", str(tmp_path)))[0] == 0


def test_recipe_uses_the_users_reward_function(runs, path):
    config = Policy.load(runs["tame-jump"]).config
    with pytest.raises(TaskError, match=r"task.rewards\[0\].func needs 'my_jumps:base_at_rest'"):
        Recipe.from_json(config, [])
    module = load_task_module(path)
    task = Recipe.from_json(config, [module]).task
    assert task.rewards[0].func is module.base_at_rest is not rewards.base_at_rest
    assert task == make_task("tame-jump").with_terms("rewards", base_at_rest={"height": 0.4})


def test_resume_warns_about_a_changed_file_and_keeps_settings(capsys, runs, path, tmp_path):
    folder, edited = tmp_path / "tame-jump" / "run", tmp_path / "edited" / "my_jumps.py"
    shutil.copytree(runs["tame-jump"], folder)
    edited.parent.mkdir()
    edited.write_text(TASK.replace("robot.height / height", "robot.height / (2.0 * height)"))
    args = ["--device", "cpu", "--max-iterations", "2", "--resume", str(folder)]
    code, _, err = run(capsys, "train", "tame-jump", "--task-module", str(edited), *args)
    assert code == 0, err
    warning = "my_jumps has changed since the run was saved: its current functions are used with the saved settings"
    assert err.count(warning) == 1 and "max-iterations 1 -> 2" in err
    config = json.loads((folder / "config.json").read_text())
    assert config["sources"] == {"my_jumps": hashlib.sha256(edited.read_bytes()).hexdigest()}
    assert (folder / "sources/my_jumps.py").read_bytes() == edited.read_bytes()
    assert config["env"]["task"]["rewards"][0]["height"] == 0.4 and config["train"]["num_envs"] == 4
    assert (folder / "checkpoints" / "iteration_000002.pt").is_file()


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("import warp as wp\n", "import warp as wp\nimport not_there\n", "own_faults.py:7: ModuleNotFoundError"),
        ("import warp as wp\n", "import warp as wp\nraise SystemExit(0)\n", "must not exit when it is imported"),
        ("robot: mdp.RobotView, state: Any, scale: float", "robot, state, scale",
         "own_faults.py:12: WarpCodegenError: Incomplete argument annotations"),
        ("tilt(robot)", "tilt(robot.quad)", "function level: `quad` is not an attribute of"),
        ("tilt(robot)", "tlt(robot)", "own_faults.py:15, function level: "),
        ('task, name="level', 'task, action_scale=15.0, name="level', "action_scale must be (float, float), got 15.0"),
    ],
)  # fmt: skip
def test_error_in_a_users_file_prints_one_line(right, wrong, message, tmp_path, capsys):
    text, path = LEVEL_JUMP.read_text(encoding="utf-8"), tmp_path / "own_faults.py"
    assert right in text
    path.write_text(text.replace(right, wrong, 1))
    args = [*"--device cpu --num-envs 4 --max-iterations 1".split(), "--log-root", str(tmp_path)]
    code, _, err = run(capsys, "train", "level-jump", "--task-module", str(path), *args)
    lines = [row for row in err if row.startswith("jumper:")]
    assert code == 2 and len(lines) == 1 and message in lines[0]
