import dataclasses
import re

import pytest

from jumper_warp.cli.main import main
from jumper_warp.cli.train import parse_train
from jumper_warp.compare.training import train_arm
from jumper_warp.registry import load_task_module
from jumper_warp.rl.metrics_file import last_metrics
from jumper_warp.rl.runner import Observer
from jumper_warp.utils.errors import InputError

SMALL = "--no-randomize --no-noise --history 1 --ppo.hidden 16 --num-envs 8 --log-interval 1 --save-interval 1"
TASK = """
from dataclasses import replace
from jumper_warp import make_task
from jumper_warp.registry import register_task


def heavier_height():
    task = make_task("vertical-jump")
    return replace(task, name="heavier-height", rewards=(task.rewards[0].replace(weight=300.0), *task.rewards[1:]))


register_task("heavier-height", heavier_height)
"""
FUNCTION = """
from dataclasses import replace
import warp as wp
from jumper_warp import make_task, mdp
from jumper_warp.registry import register_task


@wp.func
def height(robot: mdp.RobotView, state: mdp.JumpState) -> float:
    return robot.pos[2]


def tall():
    task = make_task("vertical-jump")
    return replace(task, name="tall", rewards=(*task.rewards, mdp.RewardTerm(height, weight=1.0)))


register_task("tall", tall)
"""


def recipe(root, *flags):
    arguments = [*SMALL.split(), "--device", "cpu", "--seeds", "1", "2", "--run-name", "arm", "--log-root", str(root)]
    return parse_train(["vertical-jump", *arguments, *flags])[0]


class Interruption(Observer):
    """Observer that interrupts a training at an iteration, and notes the ones before."""

    def __init__(self, iteration=None):
        self.iteration = iteration
        self.seen = []

    def after_iteration(self, runs):
        if runs[1].iteration == self.iteration:
            raise KeyboardInterrupt
        self.seen.append(runs[1].iteration)


def test_a_finished_arm_is_kept_and_a_stopped_one_continues(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        train_arm(recipe(tmp_path, "--max-iterations", "3"), [Interruption(2)])
    continued = Interruption()
    folder = train_arm(recipe(tmp_path, "--max-iterations", "3"), [continued])
    assert continued.seen == [3]
    assert last_metrics(folder / "seed_2")["iteration"] == 3
    assert train_arm(recipe(tmp_path, "--max-iterations", "3"), [Interruption(3)]) == folder  # it does not train
    assert len(list((tmp_path / "vertical-jump").iterdir())) == 1


def test_an_arm_with_other_settings_is_refused(tmp_path):
    train_arm(recipe(tmp_path, "--max-iterations", "1"))
    with pytest.raises(InputError, match=r"trained with another env\.rewards\.jump-height\.weight"):
        train_arm(recipe(tmp_path, "--max-iterations", "1", "--env.rewards.jump-height.weight", "7"))
    with pytest.raises(InputError, match="seeds"):
        train_arm(recipe(tmp_path, "--max-iterations", "1", "--seeds", "1", "2", "3"))
    renamed = recipe(tmp_path, "--max-iterations", "1", "--env.rewards.jump-height.weight", "7")
    renamed = dataclasses.replace(renamed, train=dataclasses.replace(renamed.train, run_name="other"))
    assert train_arm(renamed).name.endswith("_other")


def test_an_arm_whose_file_has_changed_is_refused(tmp_path):
    path = tmp_path / "file_of_an_arm.py"
    path.write_text(FUNCTION)
    load_task_module(str(path))
    flags = f"{SMALL} --device cpu --max-iterations 1 --seeds 1 2 --run-name arm --log-root {tmp_path}".split()
    arm = parse_train(["tall", *flags])[0]
    assert train_arm(arm) == train_arm(arm)
    path.write_text(FUNCTION.replace("robot.pos[2]", "2.0 * robot.pos[2]"))
    with pytest.raises(InputError, match="trained with another file_of_an_arm"):
        train_arm(arm)


def test_an_arm_with_a_space_in_its_name_is_kept(tmp_path):
    arm = recipe(tmp_path, "--max-iterations", "1", "--run-name", "two words")
    assert train_arm(arm) == train_arm(arm)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seeds", "seed", "unexpected keyword argument 'seed'"),
        ("[1, 2]", '"12"', "seeds must be"),
        ('half = ""', 'half = { task = "vertical-jump", flag = "" }', "arm half: .*'flag'"),
        ("friction", "frict", "unexpected keyword argument 'frict'"),
    ],
)
def test_a_malformed_file_of_arms_is_refused_before_training(tmp_path, capsys, old, new, message):
    text = 'title = "T"\ntask = "vertical-jump"\nseeds = [1, 2]\nconditions = { friction = 0.7 }\narms.half = ""\n'
    (tmp_path / "arms.toml").write_text(f'log_root = "{tmp_path}/logs"\n' + text.replace(old, new))
    with pytest.raises(SystemExit):
        main(["compare", "--file", str(tmp_path / "arms.toml")])
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "logs").exists()


def test_a_file_of_arms_is_trained_and_compared(tmp_path, capsys):
    (tmp_path / "arms_of_a_file.py").write_text(TASK)
    path = tmp_path / "arms.toml"
    path.write_text(f"""
title = "Weights of the height"
task = "vertical-jump"
flags = "{SMALL} --device cpu --max-iterations 1"
seeds = [1, 2]
log_root = "{tmp_path}/logs"
modules = ["arms_of_a_file.py"]
primary = "fall_rate"
arms.base = ""
arms.half = "--env.rewards.jump-height.weight 100"
arms.heavier = {{ task = "heavier-height" }}
evaluation = {{ num_jumps = 4, height_range = [0.5, 0.6] }}
conditions = {{ friction = 0.7, device = "cpu" }}
""")
    out = tmp_path / "out"
    main(["compare", "--file", str(path), "--out", str(out)])
    printed = capsys.readouterr().out
    assert [name in printed for name in ("base", "half", "heavier", "fall_rate")] == [True] * 4
    page = (out / "comparison.md").read_text()
    assert page.startswith("# Weights of the height")
    assert "| env.rewards.jump-height.weight | 40.0 | 100.0 | 300.0 |" in page
    assert "friction 0.7" in page


def test_try_prints_the_terms_of_a_change_and_its_base(tmp_path, capsys):
    (tmp_path / "tried_height.py").write_text(TASK.replace("heavier", "tried"))
    flags = ["--max-iterations", "1", "--num-envs", "8", "--seeds", "1", "2", "--device", "cpu"]
    main(["try", str(tmp_path / "tried_height.py"), *flags, "--out", str(tmp_path / "out")])
    lines = capsys.readouterr().out.splitlines()
    (row,) = (line.split() for line in lines if "Episode_Reward/jump_height" in line)
    assert float(row[2]) == pytest.approx(7.5 * float(row[1]), rel=0.05)
    assert (tmp_path / "out/try.png").exists()
    assert "not which task is better" in lines[-2]
