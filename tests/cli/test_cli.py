import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from rerun.chunk import RrdReader

from cli_helpers import curves, run
from hold_height import hold_height
from jumper_warp.cli import main as cli
from jumper_warp.cli.task_flags import flag_name, flags_of, parse_with_task, with_flags
from jumper_warp.cli.train import TrainArgs, parse_train
from jumper_warp.envs.env import Env
from jumper_warp.policies.policy import Policy, load_policy, save_policy
from jumper_warp.registry import TASKS, make_task
from jumper_warp.utils.output import read_values
from jumper_warp.viz.rerun_server import viewer_command
from landing_helpers import still_policy

TRAIN = ["train", "vertical-jump", "--num-envs", "16", "--max-iterations", "2", "--no-tensorboard", "--device", "cpu"]
TRAIN += "--ppo.num-steps 4 --ppo.minibatches 2 --ppo.hidden 16 8 --env.curriculum.promote-after 2".split()


@pytest.fixture(scope="module")
def trained_run(tmp_path_factory):
    """Folder of a short training, with its exported policy in the folder `policy`."""
    root = tmp_path_factory.mktemp("logs")
    cli.main([*TRAIN, "--log-root", str(root)])
    (folder,) = (root / "vertical-jump").iterdir()
    cli.main(["export", str(folder)])
    return folder


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """Folder of a horizontal-jump policy that holds the default pose."""
    folder = tmp_path_factory.mktemp("policies") / "still"
    save_policy(folder, still_policy("horizontal-jump"))
    return str(folder)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["fly"], "no command 'fly'; there are train, watch, finetune, play"),
        (["train", "walking"], "'walking' is a policy, not a task; its task is velocity-rough"),
        (["train", "vertical-jump", "--resume", "run"], "run: no such file or folder, no run to resume; pass"),
        (["train", "vertical-jump", "--resume", "latest", "--init-policy", "vertical_jump"], "not both"),
        ([*TRAIN, "--env.rewards.jump-height.weight", "nan"], "jump-height.weight must be a finite number"),
        ([*TRAIN, "--device", "abacus"], "no device 'abacus'"),
        (["list", "--task-module", "missing.py"], "missing.py: no such file (tasks of your own)"),
        (["play", "missing"], "no policy 'missing'"),
        (["evaluate", "velocity_rough"], "a task, not a policy; its policies: walking"),
        (["evaluate", "vertical_jump", "--height-range", "1.0", "0.5"], "height_range must be"),
        (["evaluate", "vertical_jump", "--suite", "grid"], "no suite 'grid' for policies of"),
        (["evaluate", "horizontal_jump", "--edge=0.3"], "--edge needs a test suite: add --suite platform"),
        (["evaluate", "vertical_jump", "--out", "\udcff"], "'\\udcff' is not UTF-8"),
        (["export", "vertical_jump", "--out", "x.pt"], "saved as a folder, whose name cannot end in .pt: got x.pt"),
        (["train", "vertical-jump", "--log-root", "", "--seed", "3"], "empty value after --log-root"),
        (["sysid", "x.npz", "--params", "gears"], "unknown group of parameters 'gears'"),
        (["sysid", "x.npz", "--mass", "14500"], "must be in 7.25 to 29 kg (the robot is described with 14.5 kg)"),
        (["sysid", "x.npz", "--noise.angle", "0"], "noise angle must be in 1e-06 to 90 deg"),
    ],
)
def test_invalid_input_prints_one_line_and_exits_with_2(capsys, tmp_path, monkeypatch, args, message):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *args)
    assert (code, out) == (2, "")
    assert len(err) == 1 and err[0].startswith("jumper: ") and message in err[0] and not list(tmp_path.iterdir())


def test_flag_of_a_duration_may_be_infinite_for_never(capsys):
    flags = "--env.terminations.too-long.steps inf --init-policy /none --num-envs 2 --device cpu"
    assert run(capsys, "train", "vertical-jump", *flags.split())[2][-1] == "jumper: /none: no such folder (policy)"


# ---------------------------------------------------------------------- flags


def flag_of(name):
    """Return the flag of a term's parameter by its dotted name, such as rewards.jump_height.weight."""
    section, term, key = name.rsplit(".", 2)
    middle = "" if section in ("advance", "curriculum") else f".{flag_name(term)}"
    return f"--env.{section}{middle}.{flag_name(key)}"


@pytest.mark.parametrize("name", ["vertical-jump", "horizontal-jump", "hold-height"])
def test_flag_sets_each_term_parameter(name):
    task = hold_height() if name == "hold-height" else make_task(name)
    sampled = tuple(f"events.{term.name}." for term in task.randomization.events())  # flags: --env.randomization
    args, expected = [], {}
    for name, i in task.params.names.items():
        if not name.startswith(sampled):
            expected[name] = task.params.values[i] + 1.0  # other than the default
            value = f"{expected[name]:.17g}"  # upper follows lower: two values of one flag
            args += [value] if name.endswith("_s.upper") else [flag_of(name.replace("_s.lower", "_s")), value]
    params = parsed(task, args).params
    for name, value in expected.items():
        assert params.values[params.index(name)] == value, name
    assert len(expected) > 40


def parsed(task, args):
    """Return a copy of the task with settings changed by --env flags."""
    return parse_with_task(TrainArgs(), task, "train", args, ())[1]


@pytest.mark.parametrize("name", [*TASKS, "hold-height"])
def test_default_flags_do_not_change_the_task(name):
    task = hold_height() if name == "hold-height" else make_task(name)
    assert with_flags(task, flags_of(task)) == task == parsed(task, [])


def test_flags_set_training_and_task_settings_outside_terms():
    flags = (
        " --env.observations.actor.gravity.history 2 --env.reset.start-probability.standing 0.45"
        " --env.reset.start-probability.default 0.2 --env.reset.ground.drop 0.1 0.2"
        " --env.levels.1.next-jump-probability 0.5 --env.motors.lateral.kp 11 --env.command-filter.sum.upper 200"
        " --env.randomization.latency None --env.action-scale 10 80 --env.contact-force 0.2 --env.reward-floor None"
        " --ppo.gamma 0.9 --no-noise --solver mujoco"
    )
    recipe = parse_train(["Olympus-Vertical-Jump", *flags.split()])[0]
    task = recipe.task
    assert {term.name: term for term in task.observations.actor}["gravity"].options["history"] == 2
    assert task.reset.settings.start_probability.standing == 0.45 and task.reset.settings.ground.drop == (0.1, 0.2)
    assert task.levels[1].next_jump_probability == 0.5 and task.levels[0] == make_task("vertical-jump").levels[0]
    assert task.motors.lateral.kp == 11.0 and task.command_filter.sum.upper == 200.0
    assert task.randomization.latency is None and task.action_scale == (10.0, 80.0)
    assert (task.contact_force, task.reward_floor) == (0.2, None)
    assert recipe.train.ppo.gamma == 0.9 and recipe.train.task == "vertical-jump"
    assert (recipe.solver, recipe.noise, recipe.randomize) == ("mujoco", False, True)


def test_history_flag_sets_history_of_noisy_observations():
    task = parse_train(["vertical-jump", "--history", "2"])[0].task
    steps = {term.name: term.options["history"] for term in task.observations.actor}
    assert [steps[name] for name in ("lin_vel", "ang_vel", "gravity", "angle", "last_action")] == [2] * 5
    assert steps["wanted_height"] == steps["rate"] == 1
    assert task.observations.critic == make_task("vertical-jump").observations.critic


def test_flags_set_device_arrays():
    flags = "--env.rewards.jump-height.weight 25 --env.terminations.tilted.angle 0.4"
    flags += " --env.observations.actor.lin-vel.noise 0.3"
    flags += " --env.reset.tilt 9 --env.levels.0.base-height 0.3 0.31 --env.contact-force 0.7 --env.action-scale 10 80"
    task = parse_train(["vertical-jump", *flags.split()])[0].task
    env = Env(task, 2, device="cpu", randomize=False)
    skill = env.skills[0]
    numbers = skill.params.values.numpy()
    names = ("rewards.jump_height.weight", "terminations.tilted.angle", "observations.actor.lin_vel.noise")
    assert [numbers[task.params.index(name)] for name in names] == pytest.approx([25.0, 0.4, 0.3])
    assert skill.settings.numpy()["states"]["tilt"][0] == pytest.approx(np.radians(9.0))
    assert skill.levels.numpy()["base_height"][0] == pytest.approx([0.3, 0.31])
    settings = skill.settings_of_skill()
    assert settings.contact_force == pytest.approx(0.7)
    assert settings.action_scale[1] == pytest.approx(np.radians(80.0))


# ---------------------------------------------------------------------- from training to a recording


def test_exported_policy_equals_the_policy_of_the_run(trained_run):
    policy, same = load_policy(trained_run / "policy"), Policy.load(trained_run)
    assert policy.interface == same.interface and policy.interface.sizes == (147, 16, 8, 12)
    assert all(np.array_equal(policy.tensors()[name], tensor) for name, tensor in same.tensors().items())
    assert policy.recipe().task.curriculum.numbers["promote_after"] == 2
    assert policy.config["train"]["num_envs"] == 16 and policy.config["iteration"] == 2
    assert (trained_run / "policy" / "learning_curve.jsonl").read_text().count("\n") >= 1


def test_log_folder_of_a_task_stands_for_its_newest_run(trained_run, tmp_path, capsys):
    names = ("2026-01-01_00-30-00_000001+0100", "2025-12-31_19-30-00_000000-0500", "2026-01-03_00-00-00_000000+0100")
    old, new, empty = (tmp_path / "logs" / "jump" / name for name in names)  # half past midnight in New York is later
    for folder in (old, new):
        shutil.copytree(trained_run / "checkpoints", folder / "checkpoints")
    (empty / "checkpoints").mkdir(parents=True)  # a run without a checkpoint
    code, out, err = run(capsys, "export", str(new.parent))
    assert (code, out, err) == (0, f"{new / 'policy'}\n", [f"{new}: best checkpoint, iteration 2"])
    assert Policy.load(old.parent).interface == load_policy(new / "policy").interface
    code, _, err = run(capsys, "evaluate", str(new.parent), "--save-to-policy", "--device", "cpu")
    assert code == 2 and err[-1].endswith(f"{new}: a run keeps no metrics; export it first")


def test_evaluate_writes_metrics_and_saves_them_to_the_policy(trained_run, tmp_path, capsys):
    args = [*"--num-jumps 3 --noise --device cpu --save-to-policy --save-trials --out".split(), str(tmp_path)]
    code, out, _ = run(capsys, "evaluate", str(trained_run / "policy"), *args)
    metrics = read_values(tmp_path)
    assert code == 0 and "success rate" in out
    assert (metrics["noise"], metrics["stream"], metrics["success_rate"]) == (True, "reporting", 0.0)
    trials = np.load(tmp_path / "trials.npz")
    assert trials["goal_height_m"].tolist() == [0.5, 0.85, 1.2] and trials["success"].tolist() == [False] * 3
    assert read_values(trained_run / "policy") == metrics
    assert load_policy(trained_run / "policy")
    code, _, err = run(capsys, "evaluate", str(trained_run / "policy"), *args, "--stream", "selection")
    assert code == 2 and err[-1].endswith("save_to_policy is for the stream reporting, got selection")


def test_play_records_each_step_of_each_robot(trained_run, tmp_path, capsys):
    args = ["--height", "0.6", "0.9", "--seconds", "0.25", "--device", "cpu", "--out", str(tmp_path)]
    code, out, _ = run(capsys, "play", str(trained_run), *args)
    assert code == 0 and "0.9 m" in out and f"recording  {tmp_path / 'jump.rrd'}" in out
    series = {name.split("/")[-1]: values for name, values in curves(tmp_path / "jump.rrd").items()}
    assert [len(series[f"base, {name} [m]"]) for name in ("0.60 m", "0.90 m")] == [15, 15]  # 0.25 s at 60 Hz
    assert series["command, 0.90 m [m]"] == pytest.approx([0.9] * 15)
    assert 0.2 < series["base, 0.60 m [m]"][0] < 0.5


def test_evaluate_horizontal_jumps(still, tmp_path, capsys):
    args = ["--num-jumps", "3", "--goal-x", "0.4", "0.8", "--heading", "90", "--device", "cpu", "--save-trials",
            "--out", str(tmp_path), "--json"]  # fmt: skip
    code, out, _ = run(capsys, "evaluate", still, *args)
    metrics = read_values(tmp_path)
    assert code == 0 and out == (tmp_path / "metrics.json").read_text()
    assert (metrics["task"], metrics["no_jump_rate"]) == ("horizontal-jump", 1.0)
    assert metrics["goal_distance_at_end_mean_m"] == pytest.approx(0.6, abs=0.02)  # mean goal: it stays in place
    trials = np.load(tmp_path / "trials.npz")
    assert trials["goal_x_m"] == pytest.approx([0.4, 0.6, 0.8])
    assert trials["heading_deg"] == pytest.approx([90.0] * 3, abs=1e-4)


def test_play_horizontal_jumps_records_distances_and_goals_and_writes_film_and_picture(still, tmp_path, capsys):
    film, folder = tmp_path / "films" / "jump.webp", tmp_path / "out"
    args = ["--goal", "0.8", "0.2", "--goal", "0.5", "0", "--next-goals", "0.75", "-0.2", "--seconds", "0.25"]
    args += ["--video", str(film), "--size", "96", "64", "--fps", "10", "--speed", "0.5", "--device", "cpu"]
    code, out, _ = run(capsys, "play", still, *args, "--out", str(folder))
    assert code == 0 and out.count("not_begun") == 2
    files = {"film": film, "picture": folder / "jump.png", "recording": folder / "jump.rrd"}
    lines = [line.split() for line in out.splitlines() if line.split() and line.split()[0] in files]
    assert lines == [[kind, str(path)] for kind, path in files.items()]
    series = {name.split("/")[-1]: values for name, values in curves(folder / "jump.rrd").items()}
    entities = {str(chunk.entity_path) for chunk in RrdReader(folder / "jump.rrd").stream().to_chunks()}
    assert series["to goal, (0.80, 0.20) m [m]"] == pytest.approx([np.hypot(0.8, 0.2)] * 15, abs=0.02)
    assert series["to goal, 0.50 m [m]"] == pytest.approx([0.5] * 15, abs=0.02)
    assert {"/scene/goal_0_0", "/scene/goal_1_0"} <= entities
    with Image.open(film) as animation, Image.open(folder / "jump.png") as picture:
        assert (animation.n_frames, animation.size, picture.size[0]) == (5, (96, 64), 1600)  # 0.23 s at half speed


def test_play_script_writes_recording_plot_and_metrics(tmp_path, capsys):
    script = tmp_path / "script.json"
    script.write_text('[{"walk": [0.5, 0, 0.3], "seconds": 0.2}, {"stand": 0.1}]')
    code, out, _ = run(capsys, "play", "--script", str(script), "--device", "cpu", "--out", str(tmp_path / "out"))
    assert code == 0 and out.startswith("several policies, play: 2 commands of") and "timeline.png" in out
    assert read_values(tmp_path / "out")["outcome"] == "done"
    assert (tmp_path / "out" / "course.rrd").stat().st_size > 10_000 and (tmp_path / "out" / "timeline.png").is_file()


def test_viewer_binds_to_loopback(tmp_path):
    command = viewer_command(tmp_path / "jump.rrd")
    assert command[command.index("--bind") + 1] == "127.0.0.1"


@pytest.mark.parametrize(("redirection", "word", "code"), [("2>/dev/full", "no", 2), ("<&- >&- 2>&-", "list", 0)])
def test_messages_that_cannot_be_written_do_not_change_the_exit_code(redirection, word, code):
    command = ["sh", "-c", f'exec "$@" {redirection}', "sh", sys.executable, "-m", "jumper_warp", word]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")
