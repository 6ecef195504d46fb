"""Flags that were renamed work under their old names, and print the new ones."""

import re
from dataclasses import dataclass, field

import pytest

from cli_helpers import run
from jumper_warp.cli.renamed_flags import join_height_range, use_new_names
from jumper_warp.cli.sysid import ExciteCfg, SysidCfg
from jumper_warp.cli.train import TrainArgs
from jumper_warp.evaluation.sweeps import HeightSweep
from jumper_warp.utils.errors import InputError


@pytest.mark.parametrize(
    ("cfg", "old", "new"),
    [
        (TrainArgs(), ["--keep", "5"], ["--max-checkpoints", "5"]),
        (TrainArgs(), ["--iterations=5"], ["--max-iterations=5"]),
        (HeightSweep(), ["--gains", "0.6", "1"], ["--gain-scale", "0.6", "1"]),
        (SysidCfg, ["x.npz", "--gains", "walking"], ["x.npz", "--gain-preset", "walking"]),
        (SysidCfg, ["x.npz", "--mass_deviation", "0.1"], ["x.npz", "--mass-std", "0.1"]),
        (ExciteCfg, ["--torque", "--noise.torque", "1"], ["--record-torque", "--noise.torque", "1"]),
        (ExciteCfg, ["--exact"], ["--no-noise"]),
    ],
)
def test_old_flag_becomes_the_new_flag_and_prints_it(cfg, old, new, capsys):
    assert use_new_names(old, cfg) == new
    (line,) = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"jumper: --[a-z-]+ is now --[a-z-]+", line)
    assert use_new_names(new, cfg) == new and not capsys.readouterr().err


def test_keeps_flag_of_a_users_task_with_an_old_name(capsys):
    @dataclass
    class OwnFlags:
        jumps: int = 1
        num_jumps: int = 2

    assert use_new_names(["--jumps", "3"], OwnFlags) == ["--jumps", "3"] and not capsys.readouterr().err


@pytest.mark.parametrize("old", ["--keep", "--keep=4", "--no-keep"])
def test_refuses_old_and_new_flag_together(old):
    with pytest.raises(InputError, match=r"^--keep is now --max-checkpoints: give only --max-checkpoints$"):
        use_new_names([old, "--max_checkpoints", "5"], TrainArgs())


def test_lower_and_upper_become_a_height_range(capsys):
    assert join_height_range(["--lower", "0.6", "--seed=1", "--upper=1"], (0.5, 1.2)) == [
        "--seed=1", "--height-range", "0.6", "1",
    ]  # fmt: skip
    assert join_height_range(["--upper", "1"], (0.5, 1.2)) == ["--height-range", "0.5", "1"]
    assert capsys.readouterr().err == "jumper: --lower and --upper are now --height-range LOWER UPPER\n" * 2
    new = ["--height-range", "0.6", "1"]
    assert join_height_range(new, (0.5, 1.2)) == new and not capsys.readouterr().err
    with pytest.raises(InputError, match="give only --height-range"):
        join_height_range([*new, "--lower", "0.5"], (0.5, 1.2))


@pytest.mark.parametrize("flag", ["--iter", "--max-iter", "--kee", "--low"])
def test_refuses_abbreviated_flags(flag, capsys):
    code, _, err = run(capsys, "train", "vertical-jump", flag, "3")
    assert code == 2 and f"no flag {flag} for" in "\n".join(err) and "is now" not in "\n".join(err)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("env.rewards.jump-height.fine", "env.rewards.jump-height.std-fine"),
        ("env.rewards.horizontal-velocity.width", "env.rewards.horizontal-velocity.speed-scale"),
        ("env.policy.lin-vel.noise", "env.observations.actor.lin-vel.noise"),
        ("env.reset.standing", "env.reset.start-probability.standing"),
        ("env.link-margin", "env.self-collision-margin"),
    ],
)
def test_training_accepts_old_flag_of_a_task(old, new, capsys):
    code, _, err = run(capsys, "train", "vertical-jump", f"--{old}", "x")  # no number: fails before the training starts
    assert code == 2 and err[0] == f"jumper: --{old} is now --{new}"


def test_command_accepts_old_flag_and_refuses_both(capsys):
    renamed = "jumper: --keep is now --max-checkpoints"
    code, _, err = run(capsys, "train", "vertical-jump", "--keep", "0")  # 0 fails before the training starts
    assert (code, err) == (2, [renamed, "jumper: max_checkpoints must be a whole number of 1 to 1000000000, got 0"])
    code, _, err = run(capsys, "train", "vertical-jump", "--keep", "2", "--max-checkpoints", "2")
    assert (code, err) == (2, [f"{renamed}: give only --max-checkpoints"])


def test_negated_flag_of_a_group_keeps_its_negation():
    @dataclass
    class Ppo:
        asymmetric_critic: bool = True

    @dataclass
    class Train:
        ppo: Ppo = field(default_factory=Ppo)

    assert use_new_names(["--ppo.no-asymmetric"], Train) == ["--ppo.no-asymmetric-critic"]
