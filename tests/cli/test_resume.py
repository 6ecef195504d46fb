"""`jumper train --resume`: a run goes on with its own settings, and flags change them."""

import json
import shutil

import pytest
import torch

from cli_helpers import run as command
from jumper_warp.cli import main as cli
from jumper_warp.cli.train import env_maker, parse_train
from jumper_warp.registry import make_task
from jumper_warp.rl.checkpoint import load_checkpoint, save_checkpoint
from jumper_warp.robot.overlay import with_springs

SMALL = ["--ppo.num-steps", "2", "--ppo.minibatches", "2", "--ppo.hidden", "8"]
OWN = ["--num-envs", "4", "--max-iterations", "1", "--seed", "3", "--save-interval", "7", "--no-noise",
       "--no-randomize", "--history", "1", "--env.gravity", "3.71", "--env.rewards.rest.weight", "-0.5",
       "--ppo.gamma=0.9"]  # fmt: skip
HERE = ["--device", "cpu", "--no-tensorboard"]


def train(capsys, *args):
    """Return exit code, the folder that was told, and the lines of standard error."""
    code, out, err = command(capsys, "train", "vertical-jump", *HERE, *args)
    return code, out.strip(), err


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """Folder of a run whose settings are its own."""
    root = tmp_path_factory.mktemp("logs")
    springs = root / "springs.json"
    with_springs(600.0, 0.1).save(springs)
    cli.main(["train", "vertical-jump", *HERE, *SMALL, *OWN, "--robot", str(springs), "--log-root", str(root)])
    springs.unlink()  # a run knows its robot
    (folder,) = (root / "vertical-jump").iterdir()
    return folder


@pytest.fixture
def run(begun, tmp_path):
    """A copy of it."""
    return shutil.copytree(begun, tmp_path / "logs" / "vertical-jump" / "run")


def config(folder):
    return json.loads((folder / "config.json").read_text())


def changed(told):
    """Lines on what differs from the run that is resumed."""
    return [line for line in told if " -> " in line]


def test_a_run_goes_on_with_its_own_settings(capsys, run, begun):
    code, folder, told = train(capsys, "--resume", "latest", "--log-root", str(run.parents[1]), "--max-iterations", "2")
    assert (code, folder) == (0, str(run)) and changed(told) == ["max-iterations 1 -> 2"]
    before, after = config(begun), config(run)
    assert after["env"] == before["env"] and (after["env"]["noise"], after["env"]["randomize"]) == (False, False)
    assert after["env"]["task"]["gravity"] == 3.71 and after["env"]["robot"]["values"]["spring_stiffness"] == [600.0]
    session = ("max_iterations", "resume", "log_root")
    assert all(after["train"][name] == value for name, value in before["train"].items() if name not in session)
    assert (run / "checkpoints" / "iteration_000002.pt").is_file()


def test_flags_change_the_settings_and_each_change_is_told(capsys, run):
    flags = ["--env.gravity", "9.81", "--env.rewards.rest.weight", "-0.25", "--ppo.gamma", "0.95", "--noise"]
    flags += ["--env.reset.tilt", "2"]
    code, _, told = train(capsys, "--resume", str(run), "--max-iterations", "2", *flags)
    assert code == 0 and changed(told) == [
        "max-iterations 1 -> 2", "ppo.gamma 0.9 -> 0.95", "noise False -> True", "env.reset.tilt 5.0 -> 2.0",
        "env.rewards.rest.weight -0.5 -> -0.25", "env.gravity 3.71 -> 9.81",
    ]  # fmt: skip
    after = config(run)
    assert after["env"]["task"]["gravity"] == 9.81 and after["train"]["ppo"]["gamma"] == 0.95
    assert after["train"]["num_envs"] == 4


def test_settings_of_the_session_are_not_those_of_the_run(run):
    args = parse_train(["vertical-jump", "--resume", str(run)])[0].cfg
    assert (args.device, args.tensorboard, args.threads, args.resume) == (None, True, None, str(run))
    assert (args.seed, args.save_interval, args.num_envs, args.max_iterations) == (3, 7, 4, 1)


def test_the_robot_of_a_flag_takes_the_place_of_the_runs(run, tmp_path):
    with_springs(700.0, 0.1).save(tmp_path / "stiffer.json")
    given = parse_train(["vertical-jump", "--resume", str(run), "--robot", str(tmp_path / "stiffer.json")])
    for (args, task), stiffness in ((parse_train(["vertical-jump", "--resume", str(run)]), 600.0), (given, 700.0)):
        saved = env_maker(task, args)(2, 0, torch.device("cpu")).config()["robot"]
        assert saved["values"]["spring_stiffness"] == [stiffness]


def test_solver_of_the_run_is_kept(run):
    resave(run, env={"solver": "SolverMuJoCo"})
    args = parse_train(["vertical-jump", "--resume", str(run)])[0]
    assert (args.solver, args.history) == ("mujoco", None)
    assert parse_train(["vertical-jump", "--resume", str(run), "--solver", "jumper"])[0].solver == "jumper"


def resave(run, train=None, env=None, lacks=()):
    """Save the run's checkpoint with other settings; lacks: those of the environment that are not told."""
    path = run / "checkpoints" / "iteration_000001.pt"
    state = load_checkpoint(path)
    saved = json.loads(state["config"])
    saved["train"] |= train or {}
    saved["env"] = {key: value for key, value in (saved["env"] | (env or {})).items() if key not in lacks}
    save_checkpoint(path.parent, state | {"config": json.dumps(saved)})


def test_what_an_older_run_does_not_tell_has_the_flags_defaults(capsys, run):
    resave(run, lacks=("noise", "randomize"))
    args, task = parse_train(["vertical-jump", "--resume", str(run)])
    assert (args.noise, args.randomize, task.gravity) == (True, True, 3.71)
    told = train(capsys, "--resume", str(run), "--max-iterations", "2", "--no-randomize")[2]
    assert changed(told) == ["max-iterations 1 -> 2", "randomize None -> False", "noise None -> True"]


def test_nothing_left_to_train_names_the_flag(capsys, run):
    code, _, told = train(capsys, "--resume", str(run))
    assert code == 0 and told[-1] == "nothing is left to train after iteration 1: give more than --max-iterations 1"


def test_settings_that_do_not_fit_the_checkpoint_are_named(capsys, run):
    code, _, told = train(capsys, "--resume", str(run), "--num-envs", "8")
    assert code == 2 and "does not fit these settings: " in told[-1] and told[-1].endswith("(num-envs 4 -> 8)")


def test_a_run_of_another_task_is_refused(capsys, run):
    _, _, told = command(capsys, "train", "horizontal-jump", "--resume", str(run))
    assert "of a run of vertical-jump, not of horizontal-jump" in told[-1]


def test_unreadable_settings_are_refused(capsys, run):
    resave(run, train={"num_envs": "many"})
    code, _, told = train(capsys, "--resume", str(run))
    assert code == 2 and len(told) == 1 and "settings in its configuration" in told[0]


@pytest.mark.parametrize("name", ["nope", "nope/checkpoints", "nope/iteration_000001.pt", "."])
def test_no_run_is_told_in_one_line(capsys, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    code, out, told = train(capsys, "--resume", name)
    assert (code, out) == (2, "")
    assert told == [f"jumper: {name}: no run to resume; give a run's folder, one of its checkpoints, or latest"]


def test_what_cannot_be_understood_is_not_a_run(capsys):
    assert train(capsys, "--resume")[0] == 2


def test_a_new_training_has_the_tasks_settings():
    assert parse_train(["vertical-jump"])[1] == make_task("vertical-jump")
