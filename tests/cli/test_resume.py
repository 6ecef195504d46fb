"""`jumper train --resume` uses the settings saved with the run; flags override them."""

import json
import shutil

import pytest

from cli_helpers import run as command
from jumper_warp.cli import main as cli
from jumper_warp.cli.train import parse_train
from jumper_warp.rl.checkpoint import load_checkpoint, save_checkpoint
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.training import make_env

SMALL = ["--ppo.num-steps", "2", "--ppo.minibatches", "2", "--ppo.hidden", "8"]
SAVED = ["--num-envs", "4", "--max-iterations", "1", "--seed", "3", "--save-interval", "7", "--no-noise",
       "--no-randomize", "--history", "1", "--env.gravity", "3.71", "--env.rewards.base-at-rest.weight", "-0.5",
       "--ppo.gamma=0.9"]  # fmt: skip
HERE = ["--device", "cpu", "--no-tensorboard"]


def train(capsys, *args):
    """Run `jumper train vertical-jump`; return exit code, standard output, and the lines of standard error."""
    code, out, err = command(capsys, "train", "vertical-jump", *HERE, *args)
    return code, out.strip(), err


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """Folder of a training run with settings that differ from the defaults."""
    root = tmp_path_factory.mktemp("logs")
    springs = root / "springs.json"
    RobotOverlay({"spring_stiffness": (600.0,), "spring_length": (0.1,)}).save(springs)
    cli.main(["train", "vertical-jump", *HERE, *SMALL, *SAVED, "--robot", str(springs), "--log-root", str(root)])
    springs.unlink()  # the run saves its robot
    (folder,) = (root / "vertical-jump").iterdir()
    return folder


@pytest.fixture
def run(begun, tmp_path):
    """Copy of the run's folder that a test may change."""
    return shutil.copytree(begun, tmp_path / "logs" / "vertical-jump" / "run")


def config(folder):
    """Return the saved configuration of a run."""
    return json.loads((folder / "config.json").read_text())


def changed_settings(lines):
    """Return the lines `setting old -> new`, which `jumper train` prints for settings that differ from the run's."""
    return [line for line in lines if " -> " in line]


def test_resume_uses_the_settings_of_the_run(capsys, run, begun):
    code, folder, err = train(capsys, "--resume", "latest", "--log-root", str(run.parents[1]), "--max-iterations", "2")
    assert (code, folder) == (0, str(run)) and changed_settings(err) == ["max-iterations 1 -> 2"]
    before, after = config(begun), config(run)
    assert after["env"] == before["env"] and (after["env"]["noise"], after["env"]["randomize"]) == (False, False)
    assert after["env"]["task"]["gravity"] == 3.71 and after["env"]["robot"]["values"]["spring_stiffness"] == [600.0]
    session = ("max_iterations", "resume", "log_root")
    assert all(after["train"][name] == value for name, value in before["train"].items() if name not in session)
    assert (run / "checkpoints" / "iteration_000002.pt").is_file()


def test_flags_override_saved_settings_and_print_each_change(capsys, run):
    flags = ["--env.gravity", "9.81", "--env.rewards.base-at-rest.weight", "-0.25", "--ppo.gamma", "0.95"]
    flags += ["--env.reset.tilt", "2"]
    code, _, err = train(capsys, "--resume", str(run), "--max-iterations", "2", *flags)
    assert code == 0 and changed_settings(err) == [
        "max-iterations 1 -> 2", "ppo.gamma 0.9 -> 0.95", "env.reset.tilt 5.0 -> 2.0",
        "env.rewards.base-at-rest.weight -0.5 -> -0.25", "env.gravity 3.71 -> 9.81",
    ]  # fmt: skip
    after = config(run)
    assert after["env"]["task"]["gravity"] == 9.81 and after["train"]["ppo"]["gamma"] == 0.95
    assert after["train"]["num_envs"] == 4


def test_session_settings_are_not_restored(run):
    args = parse_train(["vertical-jump", "--resume", str(run)])[0].train
    assert (args.device, args.tensorboard, args.threads, args.resume) == (None, True, None, str(run))
    assert (args.seed, args.save_interval, args.num_envs, args.max_iterations) == (3, 7, 4, 1)


def test_robot_flag_overrides_the_robot_of_the_run(run, tmp_path):
    RobotOverlay({"spring_stiffness": (700.0,), "spring_length": (0.1,)}).save(tmp_path / "stiffer.json")
    overridden = parse_train(["vertical-jump", "--resume", str(run), "--robot", str(tmp_path / "stiffer.json")])[0]
    for recipe, stiffness in ((parse_train(["vertical-jump", "--resume", str(run)])[0], 600.0), (overridden, 700.0)):
        assert make_env(recipe, 2, 0, "cpu").overlay.values["spring_stiffness"] == (stiffness,)


def test_solver_of_the_run_is_restored_and_missing_settings_have_defaults(run):
    path = run / "checkpoints" / "iteration_000001.pt"
    state = load_checkpoint(path)
    saved = json.loads(state["config"])
    del saved["env"]["noise"], saved["env"]["randomize"]
    saved["env"]["solver"] = "SolverMuJoCo"
    save_checkpoint(path.parent, state | {"config": json.dumps(saved)})
    recipe = parse_train(["vertical-jump", "--resume", str(run)])[0]
    assert (recipe.solver, recipe.noise, recipe.randomize, recipe.task.gravity) == ("mujoco", True, True, 3.71)
    assert parse_train(["vertical-jump", "--resume", str(run), "--solver", "jumper"])[0].solver == "jumper"


@pytest.fixture(scope="module")
def startup(tmp_path_factory):
    """Folder of a training run that samples its robots at startup."""
    root = tmp_path_factory.mktemp("logs")
    flags = ["--num-envs", "4", "--max-iterations", "1", "--env.randomization.resample-at", "startup"]
    cli.main(["train", "vertical-jump", *HERE, *SMALL, *flags, "--log-root", str(root)])
    return next((root / "vertical-jump").iterdir())


@pytest.mark.parametrize(
    ("flags", "fixed"),
    [
        (["--env.randomization.base-mass", "2", "2"], "env.randomization.base-mass"),
        (["--env.motors.lateral.peak", "20"], "env.motors.lateral.peak"),
        (["--env.randomization.push-force", "-1", "1", "--env.gravity", "3.71"], None),
        (["--env.randomization.base-mass", "2", "2", "--env.randomization.resample-at", "reset"], None),
    ],
)
def test_refuses_changes_of_what_is_sampled_at_startup(capsys, startup, tmp_path, flags, fixed):
    run = shutil.copytree(startup, tmp_path / "run")
    code, _, err = train(capsys, "--resume", str(run), "--max-iterations", "2", *flags)
    assert code == (2 if fixed else 0)
    assert fixed is None or f"does not fit these settings: {fixed} cannot change after the start" in err[-1]


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        (["--max-iterations", "2", "--noise"], 2, "saved with noise False, this environment has noise True"),
        (["--num-envs", "8"], 2, "does not fit these settings: "),
        (["--max-iterations", "2", "--robot", "late.json"], 2, "robot.values.latency cannot change after the start"),
        ([], 0, "the training is complete at iteration 1: raise --max-iterations 1 to continue"),
    ],
)
def test_last_line_names_what_does_not_fit_the_run(capsys, run, monkeypatch, flags, code, message):
    monkeypatch.chdir(run)
    overlay = config(run)["env"]["robot"] | {"values": {"latency": [0.008]}}
    (run / "late.json").write_text(json.dumps(overlay))
    found, _, err = train(capsys, "--resume", str(run), *flags)
    assert found == code and message in err[-1]


def test_refuses_run_of_another_task(capsys, run):
    _, _, err = command(capsys, "train", "horizontal-jump", "--resume", str(run))
    assert "of a run of vertical-jump, not of horizontal-jump" in err[-1]
