"""Python examples and links of README.md and docs/gradients.md."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from jumper_warp.envs.env import Env
from jumper_warp.registry import TASKS, load_task_module, make_task

README = Path(__file__).parents[1] / "README.md"


def test_readme_examples_run_with_their_results(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    examples = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(examples) == 5
    names = {}
    for example in examples:
        if not example.startswith("# my_task.py"):
            exec(example, names)
    height = names["recorder"].recording().series["base/height [m]"]
    assert len(height) == 60
    # Motors of 17 N m/rad commanded to 1 rad give way under the weight of 14.5 kg, 35.6 N per leg: with the ankle
    # 0.175 cos(t) + sqrt(0.3^2 - (0.045 + 0.175 sin(t))^2) below the hips, virtual work balances at t = 1.232 rad,
    # ankle 0.272 m and paw 0.297 m below. (A little less is borne by the motors: shanks and paws rest on the ground.)
    assert height[-1] == pytest.approx(0.297, abs=0.02)
    assert (tmp_path / "squat.rrd").stat().st_size > 0
    assert names["step"].reward.shape == (64,)
    assert names["gradient"].shape == (10, 12) and abs(names["gradient"]).max() > 1.0e-4


def test_gradient_in_the_docs_matches_a_forward_difference_in_stiffness():
    text = (README.parent / "docs" / "gradients.md").read_text(encoding="utf-8")
    names = {}  # of the example
    exec(re.search(r"```python\n(.*?)```", text, re.DOTALL)[1], names)
    assert names["by_stiffness"].shape == (12, 64)  # [m rad/(N m)] motors, worlds
    heights = names["jump"].q.numpy()[-1, 2]  # [m] by world, at the end
    rollout = names["rollout"]
    rollout.parameters["kp"].assign(rollout.parameters["kp"].numpy() + 1.0e-4)
    higher = rollout.run(names["targets"], *rollout.standing()).q.numpy()[-1, 2]
    assert (higher - heights) / 1.0e-4 == pytest.approx(names["by_stiffness"].sum(axis=0), rel=1.0e-3)


def test_readme_task_rewards_a_standing_robot_with_a_level_base(tmp_path, monkeypatch):
    text = README.read_text(encoding="utf-8")
    (tmp_path / "my_task.py").write_text(re.search(r"```python\n(# my_task\.py.*?)```", text, re.DOTALL)[1])
    before = dict(TASKS)
    monkeypatch.delitem(sys.modules, "my_task", raising=False)
    try:
        load_task_module(str(tmp_path / "my_task.py"))
        task = make_task("level-jump")
    finally:
        TASKS.clear()
        TASKS.update(before)
        sys.modules.pop("my_task", None)
    env = Env(task, 4, randomize=False, noise=False, device="cpu")
    env.evaluation_reset([0.0, 0.0, 0.9])
    env.step(torch.zeros(4, 12))
    row = [term.name for term in task.rewards].index("level")
    # e^0 = 1 of weight 2 over a step of 1/60 s
    assert env.skills[0].term_value.numpy()[row] == pytest.approx(np.full(4, 2.0 / 60.0), rel=0.05)


def test_files_linked_in_the_readme_exist():
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README.read_text(encoding="utf-8"))
    assert links and all((README.parent / link).exists() for link in links), links
