"""`jumper train` refuses flags that the trainer does not use."""

import pytest

from cli_helpers import run
from jumper_warp.cli.train import parse_train
from jumper_warp.rl.cfg import PpoCfg


@pytest.mark.parametrize(
    ("trainer", "flags"),
    [("rsl-rl", ["--ppo.reward-scale", "0.6"]), ("rsl-rl", ["--wandb=mine", "--ppo.no-graphs", "--ppo.min_lr=1e-5"])],
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
