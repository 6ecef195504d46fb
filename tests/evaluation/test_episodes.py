from dataclasses import replace

import numpy as np
import pytest

from jumper_warp.cli import evaluate, play
from jumper_warp.evaluation.episodes import EpisodeFlags, episode_metrics
from jumper_warp.policies.policy import save_policy
from jumper_warp.registry import make_task
from jumper_warp.tasks.evaluation import EpisodeEvaluation, EpisodeMetric
from jumper_warp.tasks.saving import task_to_json
from jumper_warp.utils.output import read_values
from landing_helpers import still_policy
from metric_helpers import saved_metrics, values

DT = 0.5  # [s] Policy step of the stub
TASK = replace(make_task("vertical-jump"), evaluation=EpisodeEvaluation())
ENDS = [term.name for term in TASK.terminations]  # Names by index of the termination
pytestmark = pytest.mark.usefixtures("one_thread")


class StubEnv:
    """An environment whose arrays are set by the test."""

    num_envs, step_dt = 4, DT

    def __init__(self):
        self.arrays = {"base_pos": np.tile([1.0, 0.0, 0.3], (4, 1)), "termination": np.full(4, -1)}

    def evaluation_reset(self, commands):  # stub of Env
        self.commands = commands

    def task_arrays(self):  # stub of Env
        return self.arrays

    def set(self, **changes):  # arrays by name, (4, ...)
        for name, value in changes.items():
            self.arrays[name] = np.array(value)


@pytest.fixture
def episodes():
    """Four episodes: success after a step, a fall after two, one still running, one that diverges."""
    log, env = EpisodeFlags(4, command=(0.5, 0.1)).log(TASK, 0), StubEnv()
    log.begin(env)
    assert env.commands.tolist() == [[0.5, 0.1, 0.0]] * 4
    env.set(termination=[0, -1, -1, ENDS.index("diverged")])
    env.set(base_pos=[[1.5, 0.0, 0.4], [1.0, 0.1, 0.2], [1.0, 0.0, 0.3], [np.nan, 0.0, 9.0]])
    assert not log.record_step(env)
    env.set(termination=[ENDS.index("tilted"), ENDS.index("low_base"), -1, -1])
    env.set(base_pos=[[9.0, 9.0, 9.0], [1.0, 0.4, 0.0], [1.0, 0.0, 0.3], [9.0, 9.0, 9.0]])
    assert not log.record_step(env)
    return log


def test_episode_metrics_match_hand_computed_values(episodes):
    expected = {
        "length_mean_s": (0.5 + 1.0 + 1.0 + 0.5) / 4,
        "success_termination_rate": 0.25,
        "failure_termination_rate": 0.5,
        "base_height_mean_m": (0.4 + 0.1 + 0.3 + 9.0) / 4,
        "base_height_at_end_mean_m": (0.4 + 0.0 + 0.3 + 9.0) / 4,
        "distance_from_start_mean_m": (0.5 + 0.4 + 0.0) / 3,
        "moved_x_signed_mean_m": 0.5 / 3,
        "moved_y_signed_mean_m": 0.1,
        "ended_by_success_rate": 0.25,
        "ended_by_low_base_rate": 0.25,
        "ended_by_no_end_rate": 0.25,
        "ended_by_diverged_rate": 0.25,
    }
    assert values(episode_metrics(episodes)) == pytest.approx(expected)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """Folder of a policy that holds the default pose, of a task with the general evaluation `episode`."""
    folder, still = tmp_path_factory.mktemp("policy") / "still", still_policy("horizontal-jump")
    task = replace(make_task("horizontal-jump"), name="any-task", evaluation=EpisodeEvaluation())
    still.config = {"env": {"task": task_to_json(task)}}
    still.interface = replace(still.interface, task="any-task")
    save_policy(folder, still)
    return str(folder)


def test_policy_of_any_task_is_evaluated_with_metrics_and_trials(policy, tmp_path):
    evaluate.run(
        [
            policy,
            *"--num-episodes 3 --command 0.5 0 0 30 --seconds 4 --save-trials --device cpu --out".split(),
            str(tmp_path),
        ],
        [],
    )
    saved, trials = read_values(tmp_path), np.load(tmp_path / "trials.npz")
    assert (saved["task"], saved["ended_by_no_jump_rate"]) == ("any-task", 1.0)
    assert saved["base_height_mean_m"] == pytest.approx(0.35, abs=0.02)
    assert saved["length_mean_s"] < 4.0 and saved["failure_termination_rate"] == 1.0
    assert trials["end"].tolist() == ["no_jump"] * 3 and trials["command_x_m"].tolist() == [0.5] * 3


def goals_of(policy, folder, *flags):
    """Evaluate a policy in four episodes; return its metrics, and the sampled goals x, y [m], (4, 2), or None."""
    evaluate.run([policy, *"--num-episodes 4 --seconds 0.2 --save-trials --device cpu".split(), *flags,
                  "--out", str(folder)], [])  # fmt: skip
    trials = np.load(folder / "trials.npz")
    goals = [trials[name] for name in ("start_goal_0", "start_goal_1") if name in trials]
    return saved_metrics(folder), np.stack(goals, axis=1) if goals else None


def test_commands_are_drawn(policy, tmp_path):
    metrics, goals = goals_of(policy, tmp_path / "a")
    levels = make_task("horizontal-jump").levels
    distance, start = np.linalg.norm(goals, axis=1), 0.3  # [m] of the goals from the origin; of the starts at most
    assert len(np.unique(distance)) == 4 and metrics["length_mean_s"].trials == 4
    assert min(level.goal_lower[0] for level in levels) - start <= distance.min()
    assert distance.max() <= max(level.goal_upper[0] for level in levels) + start
    np.testing.assert_array_equal(goals_of(policy, tmp_path / "b")[1], goals)
    for flags in (("--seed", "1"), ("--stream", "selection")):
        assert not np.isin(goals_of(policy, tmp_path / flags[0], *flags)[1], goals).any()


def test_identical_episodes_are_one_trial(policy, tmp_path, capsys):
    metrics, goals = goals_of(policy, tmp_path / "a", "--command", "0.5")
    assert goals is None and metrics["length_mean_s"].trials == metrics["success_termination_rate"].trials == 1
    printed = capsys.readouterr()
    out = " ".join(printed.out.split())
    assert "all 4 episodes are identical" in printed.err and "1 episode, " in out and "ended by time limit 100 %" in out
    assert goals_of(policy, tmp_path / "b", "--command", "0.5", "--randomize")[0]["length_mean_s"].trials == 4
    assert "identical" not in capsys.readouterr().err


def test_policy_of_any_task_is_recorded(policy, tmp_path, capsys):
    play.run([policy, *"--seconds 0.25 --device cpu --out".split(), str(tmp_path)], [])
    assert (tmp_path / "episode.rrd").stat().st_size > 1000
    values, printed = read_values(tmp_path), capsys.readouterr()
    assert values["end"] == ["no_end"] and np.linalg.norm([values["start_goal_0"][0], values["start_goal_1"][0]]) > 0.1
    assert "time limit" in printed.out and "start goal" in printed.out and "beyond" not in printed.err


@pytest.mark.parametrize("marker", ["goal", "peak_tilt"])
def test_metrics_and_goal_are_of_the_state_at_the_end_of_each_episode(marker):
    """The first world's episode ends after a step; then its state is that of another episode."""
    kinds = {"mean": "peak_tilt", "max": "peak_tilt", "rate": "jumps"}
    own = tuple(EpisodeMetric(kind, name, kind) for kind, name in kinds.items())
    task = replace(TASK, evaluation=EpisodeEvaluation(own, marker))
    log, env, goal = EpisodeFlags(4, command=(0.5, 0.1)).log(task, 0), StubEnv(), np.zeros((4, 3))
    env.set(goal=goal, peak_tilt=np.zeros(4), jumps=np.zeros(4, dtype=int))
    log.begin(env)
    env.set(termination=[0, -1, -1, -1], goal=goal + 1.0, peak_tilt=[0.4, 0.2, 0.1, 0.1], jumps=[1, 0, 0, 0])
    log.record_step(env)
    env.set(termination=[-1, 0, 0, 0], goal=goal + 2.0, peak_tilt=[9.0, 0.2, 0.1, 0.1], jumps=[0, 0, 2, 0])
    assert log.record_step(env)
    measured, marks = values(episode_metrics(log)), log.marks()
    assert [measured[kind] for kind in kinds] == pytest.approx([0.2, 0.4, 0.5])
    assert log.columns()["jumps"] == [1, 0, 2, 0] and list(log.main_metrics) == ["mean", "max", "rate"]
    if marker == "goal":
        assert marks["goals"].shape == (4, 1, 3) and marks["goals"][:, 0, 0].tolist() == [1.0, 2.0, 2.0, 2.0]
    else:
        assert marks["heights"].tolist() == [0.4, 0.2, 0.1, 0.1]
