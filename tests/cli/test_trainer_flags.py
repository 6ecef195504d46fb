"""`jumper train` refuses flags that the trainer does not use."""

import dataclasses

import pytest

from cli_helpers import run
from jumper_warp.cli.train import parse_train
from jumper_warp.rl.cfg import RSL_RL_UNUSED, PpoCfg, TrainCfg
from jumper_warp.rl.rsl_rl import rsl_rl_config


@pytest.mark.parametrize(
    ("trainer", "flags"),
    [("rsl-rl", ["--ppo.reward-scale", "0.6"]), ("rsl-rl", ["--wandb", "--ppo.no-graphs", "--ppo.min_lr=1e-5"])],
)
def test_refuses_flags_that_the_trainer_does_not_use(trainer, flags, capsys, tmp_path):
    code, out, err = run(
        capsys, "train", "vertical-jump", "--trainer", trainer, *flags, "--log-root", str(tmp_path / "logs")
    )
    names = ", ".join(flag.partition("=")[0].replace("_", "-") for flag in flags if flag.startswith("--"))
    assert (code, out, err) == (2, "", [f"jumper: {names}: not supported with trainer {trainer}"])
    assert not list(tmp_path.iterdir())


def test_flags_that_rsl_rl_uses_are_accepted():
    args = "vertical-jump --trainer rsl-rl --max-seconds 5 --save-interval 3 --ppo.lr 0.01 --ppo.hidden 8 8".split()
    assert parse_train(args)[0].train.max_seconds == 5.0


def test_preset_leaves_out_flags_that_the_trainer_does_not_use(capsys):
    cfg = parse_train("vertical-jump --preset laptop --trainer rsl-rl".split())[0].train
    assert (cfg.num_envs, cfg.ppo.hidden, cfg.max_iterations) == (1024, (128, 64, 64), 200)
    assert cfg.ppo.final_desired_kl == PpoCfg().final_desired_kl
    assert "final-desired-kl" not in capsys.readouterr().err
    cfg = parse_train("vertical-jump --preset laptop".split())[0].train
    assert (cfg.ppo.final_desired_kl, cfg.max_seconds) == (0.005, 0.0)


class ReadSettings:
    """Settings of PPO that record which ones are read."""

    def __init__(self):
        self.read = set()

    def __getattr__(self, name):
        self.read.add(name)
        return getattr(PpoCfg(), name)


def test_list_of_unused_settings_agrees_with_the_configuration_of_rsl_rl():
    cfg = ReadSettings()
    rsl_rl_config(cfg, 100, 1)
    names = {spec.name for spec in dataclasses.fields(PpoCfg)} - cfg.read - {"symmetry"}  # which is refused by value
    assert {f"ppo.{name}" for name in names} == {name for name in RSL_RL_UNUSED if name.startswith("ppo.")}
    assert {name for name in RSL_RL_UNUSED if "." not in name} <= {spec.name for spec in dataclasses.fields(TrainCfg)}
