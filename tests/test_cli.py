import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
from landing_helpers import still_policy
from rerun.chunk import RrdReader

from jumper_warp import cli, train_command
from jumper_warp.checkpoint import CheckpointError
from jumper_warp.evaluate import EvaluateCfg, HeightFlags, PlaceFlags
from jumper_warp.play import HeightGoals, PlaceGoals, PlayCfg, viewer_command
from jumper_warp.policy import PolicyError, load_policy, save_policy
from jumper_warp.saved_run import open_policy, restored_task
from jumper_warp.task_flags import TaskFlags
from jumper_warp.tasks import make_task
from jumper_warp.tasks.task import TaskCfg
from jumper_warp.train_command import command_line, parse_train

TRAIN = ["train", "vertical-jump", "--num-envs", "16", "--iterations", "2", "--no-tensorboard", "--device", "cpu"]
TRAIN += ["--ppo.num-steps", "4", "--ppo.minibatches", "2", "--ppo.hidden", "16", "8", "--env.games", "2"]


def run(capsys, *args):
    """Return exit code, output and error lines of a command."""
    code = 0
    try:
        cli.main(args)
    except SystemExit as end:
        code = end.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err.splitlines()


@pytest.fixture(scope="module")
def trained_run(tmp_path_factory):
    """Folder of a short training, and the policy exported from it."""
    root = tmp_path_factory.mktemp("logs")
    cli.main([*TRAIN, "--log-root", str(root)])
    (folder,) = (root / "vertical-jump").iterdir()
    cli.main(["export", str(folder)])
    return folder


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """Folder of a policy for jumps to places that holds the default pose."""
    folder = tmp_path_factory.mktemp("policies") / "still"
    save_policy(folder, still_policy("horizontal-jump"))
    return str(folder)


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from jumper_warp.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit as end: print(end.code, [m for m in ('torch', 'warp', 'newton') if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert answer.splitlines()[-1] == "0 []"
    assert all(f"  {command} " in answer for command in ("train", "play", "evaluate", "export", "list"))


@pytest.mark.parametrize(
    "command", [["train"], ["train", "vertical-jump"], ["play"], ["evaluate"], ["export"], ["list"]]
)
def test_every_command_has_help(capsys, command):
    code, out, _ = run(capsys, *command, "--help")
    assert code == 0
    assert "usage: jumper" in out


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["fly"], "no command 'fly'; there are train, play, evaluate, export, list"),
        (["train", "swim"], "unknown task 'swim'; there are vertical-jump"),
        (["train", "--iterations", "3"], "the task comes first"),
        ([*TRAIN, "--task", "other"], "give the task once"),
        ([*TRAIN, "--env.weights.jump-height", "nan"], "weight of jump_height must be finite"),
        ([*TRAIN, "--device", "abacus"], "no device 'abacus'"),
        (["play", "missing"], "no policy 'missing'"),
        (["evaluate", "missing"], "no policy 'missing'"),
        (["export", "missing/model.pt"], "missing/manifest.json: No such file or directory"),
    ],
)
def test_unusable_input_is_one_line_and_code_2(capsys, tmp_path, monkeypatch, args, message):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *args)
    assert (code, out) == (2, "")
    assert len(err) == 1 and err[0].startswith("jumper: ") and message in err[0]


def test_a_billion_worlds_are_refused_before_anything_is_built(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(train_command, "JumpEnv", lambda *_, **__: pytest.fail("the environment was built"))
    code, out, err = run(capsys, *TRAIN, "--num-envs", "1000000000", "--log-root", str(tmp_path))
    assert (code, out, len(err)) == (2, "", 2) and err[0].startswith("device cpu")
    assert err[1].startswith("jumper: num_envs 1000000000 needs about ") and err[1].endswith(" would fit")
    assert not list(tmp_path.iterdir())


def test_bare_command_shows_usage_with_code_2(capsys):
    code, out, _ = run(capsys)
    assert code == 2 and out.startswith("usage: jumper COMMAND")


def test_fault_inside_a_library_is_not_hidden(monkeypatch):
    monkeypatch.setitem(cli.COMMANDS, "list", lambda args: np.zeros(3).reshape(2))
    with pytest.raises(ValueError, match="cannot reshape"):
        cli.main(["list"])


def test_interrupt_exits_with_130(capsys, monkeypatch):
    def interrupted(args):
        raise KeyboardInterrupt

    monkeypatch.setitem(cli.COMMANDS, "list", interrupted)
    assert run(capsys, "list")[0] == 130


# ---------------------------------------------------------------------- flags


def test_every_setting_of_a_task_has_a_flag():
    flags = {spec.name for spec in dataclasses.fields(TaskFlags)}
    code = {"name", "observe", "columns", "error", "ppo"}  # those of PPO are --ppo flags
    tables = {"terms", "rules"}
    assert {spec.name for spec in dataclasses.fields(TaskCfg)} - code - tables == flags - {
        "weights", "term_params", "rule_params",
    }  # fmt: skip


def test_flags_left_alone_leave_the_task_alone():
    task = make_task("vertical-jump")
    assert TaskFlags.of(task).apply(task) == task


def test_flags_change_training_and_task():
    flags = (
        "--env.weights.jump-height 25 --env.term-params.jump-height 0.2 0.1 0.3 --env.rule-params.wrong-height 0.07 "
        "--env.reset.standing 0.5 --ppo.gamma 0.9 --env.randomization.latency None --no-noise --solver mujoco"
    )
    args, task = parse_train(["Olympus-Vertical-Jump", *flags.split()])
    assert (task.terms[0].weight, task.terms[0].params) == (25.0, (0.2, 0.1, 0.3))
    assert {rule.name: rule.params for rule in task.rules}["wrong_height"] == (0.07,)
    assert task.reset.standing == 0.5 and task.randomization.latency is None
    assert args.cfg.ppo.gamma == 0.9 and args.cfg.task == "vertical-jump"
    assert (args.solver, args.noise, args.randomize) == ("mujoco", False, True)


def test_the_command_that_goes_on_is_the_one_that_was_typed():
    typed = ["push", "--resume", "old run", "--task", "a b", "--resume=older", "--num-envs", "4"]
    assert command_line(typed) == "jumper train push --task 'a b' --num-envs 4"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: EvaluateCfg("p", jumps=0), "jumps must be at least 1"),
        (lambda: HeightFlags(lower=1.0, upper=0.5), "heights must be"),
        (lambda: HeightFlags(lower=0.0), "heights must be"),
        (lambda: PlaceFlags(x=(1.0, 0.5)), "x must be in"),
        (lambda: PlaceFlags(heading=float("inf")), "heading must be finite or any"),
        (lambda: EvaluateCfg("p", in_range=(1.0, 0.5)), "in_range must be in"),
        (lambda: HeightGoals(height=()), "height takes 1 to 64"),
        (lambda: HeightGoals(height=(-1.0,)), "height takes 1 to 64"),
        (lambda: PlaceGoals(goal=((float("nan"), 0.0),)), "goal takes up to 64"),
        (lambda: PlaceGoals(then=((0.5, 0.0),) * 65), "then takes up to 64"),
        (lambda: PlayCfg("p", seconds=0.0), "seconds must be in"),
    ],
)
def test_impossible_settings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# ---------------------------------------------------------------------- from training to a recording


def test_exported_policy_is_that_of_the_run(trained_run):
    policy, same = load_policy(trained_run / "policy"), open_policy(trained_run)
    assert policy.interface == same.interface and policy.interface.sizes == (48, 16, 8, 12)
    assert all(np.array_equal(policy.tensors()[name], tensor) for name, tensor in same.tensors().items())
    assert restored_task(policy.config).games == 2
    assert policy.config["train"]["num_envs"] == 16 and policy.config["iteration"] == 2
    assert (trained_run / "policy" / "learning_curve.jsonl").read_text().count("\n") >= 1


def test_evaluation_reports_and_keeps_figures(trained_run, tmp_path, capsys):
    args = ["--jumps", "3", "--noise", "--device", "cpu", "--out", str(tmp_path), "--keep"]
    code, out, _ = run(capsys, "evaluate", str(trained_run / "policy"), *args)
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert code == 0 and "success_rate_in_range" in out
    assert (figures["jumps"], figures["noise"], figures["success_rate"]) == (3, True, 0.0)
    rows = (tmp_path / "jumps.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["target_m", "0.500000", "0.850000", "1.200000"]
    assert json.loads((trained_run / "policy" / "figures.json").read_text()) == figures
    assert load_policy(trained_run / "policy")


def test_play_records_every_step_of_every_robot(trained_run, tmp_path, capsys):
    args = ["--height", "0.6", "0.9", "--seconds", "0.25", "--device", "cpu", "--out", str(tmp_path)]
    code, out, _ = run(capsys, "play", str(trained_run), *args)
    assert code == 0 and "0.900" in out
    heights = {}
    for chunk in RrdReader(tmp_path / "jump.rrd").stream().to_chunks():
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            heights[str(chunk.entity_path)] = batch.column("Scalars:scalars").to_pylist()
    found = {name.split("/")[-1].replace("\\", ""): values for name, values in heights.items()}
    assert [len(found[f"base of {world} [m]"]) for world in (0, 1)] == [15, 15]
    assert np.ravel(found["target of 1 [m]"]) == pytest.approx([0.9] * 15)
    assert 0.2 < found["base of 0 [m]"][0][0] < 0.5


def test_evaluation_of_jumps_to_places(still, tmp_path, capsys):
    args = ["--jumps", "3", "--x", "0.4", "0.8", "--heading", "90", "--device", "cpu", "--out", str(tmp_path)]
    code, out, _ = run(capsys, "evaluate", still, *args)
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert code == 0 and "success_rate_in_range" in out
    assert (figures["jumps"], figures["task"], figures["failed_by_no_jump"]) == (3, "horizontal-jump", 3)
    assert figures["mean_error_m"] == pytest.approx(0.6, abs=0.02)
    rows = [row.split(",") for row in (tmp_path / "jumps.csv").read_text().splitlines()]
    assert [row[0] for row in rows] == ["goal_x_m", "0.400000", "0.600000", "0.800000"]
    assert [float(row[2]) for row in rows[1:]] == pytest.approx([90.0] * 3, abs=1e-4)


def test_play_of_jumps_to_places_records_the_distance_and_marks_the_goals(still, tmp_path, capsys):
    goals = ["--goal", "0.8", "0.2", "--goal", "0.5", "0", "--then", "0.75", "-0.2", "--seconds", "0.25"]
    code, out, _ = run(capsys, "play", still, *goals, "--device", "cpu", "--out", str(tmp_path))
    assert code == 0 and out.count("not_begun") == 2
    found, entities = {}, set()
    for chunk in RrdReader(tmp_path / "jump.rrd").stream().to_chunks():
        entities.add(str(chunk.entity_path))
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            name = str(chunk.entity_path).split("/")[-1].replace("\\", "")
            found[name] = np.ravel(batch.column("Scalars:scalars").to_pylist())
    assert found["goal of 0 [m]"] == pytest.approx([np.hypot(0.8, 0.2)] * 15, abs=0.02)
    assert found["goal of 1 [m]"] == pytest.approx([0.5] * 15, abs=0.02)
    assert {"/scene/goal_0_0", "/scene/goal_1_0"} <= entities


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["evaluate", "--upper", "1.0"], "--upper is not for policies of horizontal-jump"),
        (["evaluate", "--lower", "0.5"], "--lower is not for policies of horizontal-jump"),  # its own default
        (["play", "--height", "0.9"], "--height is not for policies of horizontal-jump"),
        (["play", "--height", "0.6", "0.9", "1.1"], "--height is not for policies of horizontal-jump"),
        (["evaluate", "--x", "0.8", "0.4"], "x must be in"),
    ],
)
def test_flags_of_another_task_and_no_ranges_are_one_line(still, capsys, args, message):
    code, _, err = run(capsys, args[0], still, *args[1:], "--device", "cpu")
    assert code == 2 and message in err[-1]


@pytest.mark.parametrize("command", ["evaluate", "play"])
def test_folder_that_cannot_be_made_is_told_before_anything_is_simulated(tmp_path, capsys, command):
    policy = still_policy("horizontal-jump")
    names = ("other", *policy.interface.observation_names[1:])  # whose environment is refused
    policy.interface = dataclasses.replace(policy.interface, observation_names=names)
    save_policy(tmp_path / "policy", policy)
    (tmp_path / "file").touch()
    args = [command, str(tmp_path / "policy"), "--device", "cpu", "--out"]
    assert "observation is not the one" in run(capsys, *args, str(tmp_path / "new"))[2][-1]
    code, _, err = run(capsys, *args, str(tmp_path / "file"))
    assert code == 2 and "File exists" in err[-1]


def test_truncated_checkpoint_is_one_line(trained_run, tmp_path, capsys):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    for path in (trained_run / "checkpoints").iterdir():
        data = path.read_bytes()
        (folder / path.name).write_bytes(data[:-10] if path.suffix == ".pt" else data)
    code, _, err = run(capsys, "export", str(tmp_path))
    assert code == 2 and len(err) == 1 and "differs from its checksum" in err[0]
    with pytest.raises(CheckpointError):
        open_policy(tmp_path)


def test_run_keeps_no_figures(trained_run, capsys):
    code, _, err = run(capsys, "evaluate", str(trained_run), "--keep", "--device", "cpu")
    assert code == 2 and "export it first" in err[-1]


def test_policy_of_another_observation_is_not_played(trained_run, tmp_path):
    from jumper_warp.saved_run import Conditions, env_of_policy

    policy = open_policy(trained_run)
    names = ("other", *policy.interface.observation_names[1:])
    policy.interface = dataclasses.replace(policy.interface, observation_names=names)
    with pytest.raises(PolicyError, match="observation is not the one"):
        env_of_policy(policy, 1, Conditions(device="cpu"))


def test_viewer_listens_on_loopback_only(tmp_path):
    command = viewer_command(tmp_path / "jump.rrd")
    assert command[-2:] == ["--bind", "127.0.0.1"]
