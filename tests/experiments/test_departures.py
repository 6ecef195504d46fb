"""Ablations of the jumps' departures from the paper, and the experiment at a tiny size."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from columns import Z
from experiments import departures
from experiments.departures import DEPARTURES, ablation_flags, parse, train_or_load
from jumper_warp.cli.train import parse_train
from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.jumps import jump_commands
from jumper_warp.policies.policy import load_policy
from jumper_warp.registry import make_task
from jumper_warp.tasks.jump.evaluation import TERMINATIONS
from jumper_warp.tasks.saving import task_from_json, task_to_json
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import read_values


def train_settings(task, name):
    """Return the recipe of a training of `task` without the departure `name`."""
    ablation = DEPARTURES[task][name]
    return parse(ablation, departures.Args(task=task).command(ablation, 1, Path("logs")))


@pytest.mark.parametrize("task", ["vertical-jump", "horizontal-jump"])
def test_ablation_flags_are_valid_and_change_task(task):
    plain = parse_train([task])[0].task
    flags = " ".join(ablation_flags(each) for each in DEPARTURES[task].values())
    recipe, _ = parse_train([task, *flags.split()])
    changed = recipe.task
    assert task_from_json(json.loads(json.dumps(task_to_json(changed)))) == changed
    assert {"reset", "rewards", "terminations"} <= {
        key for key, part in vars(changed).items() if part != vars(plain)[key]
    }
    given = [word for word in flags.split() if word.startswith("--")]
    assert len(set(given)) == len(given) and recipe.train.task == task


def test_ablation_functions_change_only_their_departure():
    plain, changed = parse_train(["vertical-jump"])[0].task, train_settings("vertical-jump", "jumping_early").task
    names = [term.name for term in plain.terminations]
    assert [term.name for term in changed.terminations] == [name for name in names if name != "early_takeoff"]
    assert replace(changed, terminations=plain.terminations) == plain
    heights = train_settings("vertical-jump", "goals").task.levels
    assert [(level.goal_lower[2], level.goal_upper[2]) for level in heights] == [(0.6, 0.75), (0.6, 0.9), (0.6, 1.1)]
    assert {level.base_height for level in heights} == {(0.22, 0.45)}
    places = train_settings("horizontal-jump", "goals").task.levels
    assert [level.goal_upper for level in places[::2]] == [(0.55, 0, 0), (0.7, 0.1, 0), (0.85, 0.2, 0), (1.0, 0.3, 0)]
    assert [level.base_height for level in places] == 4 * [(0.22, 0.35), (0.22, 0.45)]
    assert {level.goal_lower[0] for level in places} == {0.4}
    again = train_settings("horizontal-jump", "another_goal").task.levels
    assert {level.next_jump_probability for level in again} == {0.0}


def test_ablations_of_mars_and_omnidirectional_jumps_have_levels_and_limits_of_the_papers():
    goals = DEPARTURES["horizontal-jump-mars-loose"]["goals"](make_task("horizontal-jump-mars-loose")).levels
    assert [(level.goal_lower[0], level.goal_upper[0]) for level in goals[::2]] == [
        (1.4, 1.85), (1.6, 2.25), (2.0, 3.75), (3.0, 4.75),
    ]  # fmt: skip
    assert {(level.goal_lower[1], level.goal_upper[1]) for level in goals} == {(-0.3, 0.3)} and len(goals) == 8
    recipe = train_settings("horizontal-jump-mars-loose", "limits")
    limits = recipe.task
    ends = {term.name: term.numbers for term in limits.terminations}
    assert recipe.train.init_policy == "horizontal_jump" and limits.curriculum.numbers["tolerance"] == 0.1
    assert (ends["missed_goal"]["tolerance"], ends["predicted_miss"]["tolerance"]) == (0.5, 0.55)
    earth, plain = make_task("horizontal-jump"), make_task("omnidirectional-jump")
    (touchdown,) = (term.numbers for term in earth.terminations if term.name == "turned_touchdown")
    assert ends["turned_touchdown"] == pytest.approx(touchdown, abs=1e-4)
    assert train_settings("horizontal-jump-mars-loose", "wide_kernels").task.rewards == earth.rewards
    around = DEPARTURES["omnidirectional-jump"]["reaches"](plain).levels
    assert around[-1].goal_upper == (1.4, 1.4, 0.0) and around[-1].goal_lower == (-1.4, -1.4, 0.0)
    assert around[0] == plain.levels[0]


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


def test_trainings_are_cached_evaluated_with_task_terminations_and_refuse_other_settings(tmp_path, capsys, monkeypatch):
    args = departures.Args(
        only=("jumping_early",), iterations=1, num_envs=4, num_jumps=(2, 3), num_squats=2, out=tmp_path,
        measure=False, train_flags="--ppo.num-steps 8 --ppo.minibatches 1", device="cpu", threads=1,
    )  # fmt: skip
    assert set(departures.main(args)) == {"task", "iterations", "envs"}
    assert not (tmp_path / "metrics.json").exists()
    config = next((tmp_path / "jumping_early_1").rglob("config.json")).read_text()
    assert "early_takeoff" not in [term["name"] for term in json.loads(config)["env"]["task"]["terminations"]]
    ends, run_episodes = [], departures.EvaluationRun.run_episodes
    monkeypatch.setattr(departures, "train", None)
    monkeypatch.setattr(
        departures.EvaluationRun, "run_episodes",
        lambda run, env, log: ends.append([term.name for term in env.task.terminations]) or run_episodes(run, env, log),
    )  # fmt: skip
    values = departures.main(replace(args, measure=True, threads=2))
    assert len(ends) == 4 and ends[::2] == [list(TERMINATIONS)] * 2
    assert values == read_values(tmp_path)
    assert values["nominal_holding_rate_jumping_early_1"] is not None
    assert values["nominal_success_rate_jumping_early_1"] == 0.0
    assert 0.0 < values["randomized_error_m_jumping_early_1"] < 2.0
    assert "error [mm]" in (tmp_path / "departures.txt").read_text()
    assert "randomized success rate jumping early 1" in capsys.readouterr().out
    assert {"departures.png", "departures.txt"} <= {path.name for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match="other settings"):
        departures.main(replace(args, train_flags=args.train_flags + " --ppo.gamma 0.9"))
    with pytest.raises(InputError, match="other settings"):
        departures.main(replace(args, train_flags=args.train_flags + " --env.self-collision-margin 0.001"))


def test_training_with_max_seconds_saves_checkpoint(tmp_path):
    flags = "--ppo.num-steps 8 --ppo.minibatches 1 --max-seconds 0.001"
    args = departures.Args(only=("drift",), iterations=1000, num_envs=4, train_flags=flags, device="cpu", threads=1)
    checkpoint = train_or_load("", args.command("", 1, tmp_path))
    assert checkpoint.is_file() and int(checkpoint.stem.removeprefix("iteration_")) < 1000
