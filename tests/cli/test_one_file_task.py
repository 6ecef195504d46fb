"""A user's task in one file, `go_to`, with its own command and observations: from training to pictures."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from cli_helpers import run
from jumper_warp import registry
from jumper_warp.cli import evaluate
from jumper_warp.cli import main as cli
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.episodes import EpisodePlayFlags
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.recorder import EnvRecorder
from jumper_warp.policies.policy import load_policy
from jumper_warp.registry import load_task_module, make_task
from jumper_warp.tasks.mirror import mirror_image, mirror_of
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import read_values
from jumper_warp.viz.picture import compose
from jumper_warp.viz.props import goal_shapes

FILE = Path(__file__).parents[1] / "helpers" / "go_to.py"
TASK = ["--task-module", str(FILE)]
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """Folder of a mirror-symmetric policy of `go-to`, trained for two iterations."""
    root, tasks = tmp_path_factory.mktemp("go_to"), dict(registry.TASKS)
    flags = "--num-envs 8 --max-iterations 2 --ppo.num-steps 8 --ppo.hidden 16 8 --ppo.symmetry actor --device cpu"
    cli.main(["train", "go-to", *TASK, *flags.split(), "--no-tensorboard", "--log-root", str(root)])
    cli.main(["export", str(root / "go-to"), "--out", str(root / "policy"), *TASK])
    yield str(root / "policy")
    registry.TASKS.clear()
    registry.TASKS.update(tasks)


def test_trained_policy_is_mirror_symmetric(policy):
    network, obs = load_policy(policy), torch.randn((5, 41), generator=torch.Generator().manual_seed(1))
    (order, signs), (motors, _) = mirror_of(make_task("go-to"), "actor"), mirror_image(make_task("go-to"), "action")
    mirrored = network.act(torch.from_numpy(signs) * obs[:, order])
    action = network.act(obs)
    torch.testing.assert_close(mirrored, action[:, motors], atol=1e-5, rtol=1e-5)
    assert (action - action[:, motors]).abs().max() > 1e-3


def test_saved_configuration_names_the_users_file_and_its_evaluation(policy):
    task = json.loads((Path(policy) / "config.json").read_text())["env"]["task"]
    assert (task["command"]["set"], task["state"]) == ("go_to:set_goal", "go_to:GoToState")
    metric = {"key": "place_error_mean_m", "field": "place_error_m", "statistic": "mean"}
    assert task["evaluation"]["metrics"][0] == {"type": "jumper_warp.tasks.evaluation:EpisodeMetric", **metric}
    assert task["observations"]["actor"][0]["mirror"] == [1, -2, 3, -4]
    with pytest.raises(InputError, match="pass the file that defines it with --task-module"):
        evaluate.run([policy], [])


def test_evaluation_reports_the_tasks_metrics(policy, tmp_path, capsys):
    flags = "--num-episodes 6 --randomize --device cpu --save-trials --out".split()
    code, out, _ = run(capsys, "evaluate", policy, *TASK, *flags, str(tmp_path))
    values, trials = read_values(tmp_path), np.load(tmp_path / "trials.npz")
    assert code == 0 and "place error, mean" in out and "yaw error, max" in out
    assert values["place_error_mean_m"] == pytest.approx(trials["place_error_m"].mean())
    assert values["yaw_error_max_rad"] == pytest.approx(trials["yaw_error_rad"].max())
    base, goal = (np.stack([trials[f"{name}{axis}"] for axis in axes], axis=1)
                  for name, axes in (("base_", ("x_m", "y_m")), ("start_goal_", ("0", "1"))))  # fmt: skip
    np.testing.assert_allclose(trials["place_error_m"], np.linalg.norm(base - goal, axis=1), atol=0.03)  # [m] a step


def test_playing_labels_the_command_and_marks_the_goal(policy, tmp_path, capsys):
    code, out, _ = run(
        capsys, "play", policy, *TASK, *"--command 0.5 -0.1 0.3 --device cpu --out".split(), str(tmp_path)
    )
    values = read_values(tmp_path)
    assert code == 0 and re.search(r"command yaw +0.3 rad\n", out) and (tmp_path / "episode.png").is_file()
    assert [values[f"command_{name}"] for name in ("x_m", "y_m", "yaw_rad")] == [[0.5], [-0.1], [0.3]]


def test_goal_half_a_metre_away_is_marked_in_a_picture_to_scale(policy):
    task = load_task_module(str(FILE)).go_to()
    log = EpisodePlayFlags(command=(0.5, -0.1, 0.3)).log(task)
    env = Env(task, 1, device="cpu", randomize=False, noise=False, auto_reset=False)
    recorder = EnvRecorder(env, log, [0])
    run_evaluation(lambda obs: torch.zeros(1, 12), env, log, on_step=recorder)
    recording = recorder.recording()
    assert recording.labels == ("episode 1, x 0.5 m, y -0.1 m, yaw 0.3 rad",)
    np.testing.assert_allclose(recording.goals, [[[0.5, -0.1, 0.0]]], atol=1e-3)
    assert [shape.name for shape in goal_shapes(recording)] == ["goal_0_0"]
    assert not compose(recording).stays


def test_command_of_a_wrong_length_is_refused_with_its_labels():
    env = Env(load_task_module(str(FILE)).go_to(), 1, device="cpu")
    with pytest.raises(InputError, match=r"commands of go-to are x \[m\], y \[m\], yaw \[rad\] \(optional\), 1 rows"):
        env.evaluation_reset([0.5])
