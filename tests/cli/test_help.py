import pytest

from cli_helpers import run
from jumper_warp.cli.train import SHORT_HELP, parse_train
from jumper_warp.registry import TASKS, make_task

# ---------------------------------------------------------------------- jumper


@pytest.mark.parametrize("command", ["train", "train vertical-jump", "train velocity-rough", "robot new"])
def test_help_fits_60_lines(capsys, monkeypatch, command):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = run(capsys, *command.split(), "--help")
    assert code == 0 and out.count("\n") <= 60
    assert all(f" --{name}" in out for name in (SHORT_HELP if "train" in command else ["from"]))


@pytest.mark.parametrize("task", [name for name, entry in TASKS.items() if entry.presets])
def test_preset_sets_and_prints_flags_that_other_flags_do_not_override(task, capsys):
    recipe = parse_train([task.replace("-", "_"), "--num-envs", "8", "--preset", "laptop", "--noise"])[0]
    assert (recipe.train.num_envs, recipe.randomize, recipe.noise) == (8, False, True)
    line = capsys.readouterr().err
    assert line.startswith("preset laptop: --no-randomize --history 1 --ppo.hidden 128 64 64 --")
    assert "--num-envs" not in line and "--no-noise" not in line
    assert recipe.train.ppo.hidden == (128, 64, 64) and recipe.train.ppo.desired_kl == 0.02
    widths = [max(end for _, end in each.layout("actor").values()) for each in (recipe.task, make_task(task))]
    assert widths[0] < widths[1]  # one step of observations
