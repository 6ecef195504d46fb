"""Training with rsl-rl's PPO instead of this package's."""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rsl_rl.env import VecEnv as RslRlEnv
from rsl_rl.runners import OnPolicyRunner

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.utils.files import write_atomically


def rsl_rl_config(cfg: PpoCfg, save_interval: int, seed: int) -> dict[str, Any]:
    """Convert PPO settings to a configuration of rsl-rl, without value normalisation and reward scale.

    The environment must have the observation groups `actor` and `critic`. save_interval: iterations per checkpoint.
    """
    same = {name: getattr(cfg, name) for name in ("desired_kl", "gamma", "lam", "entropy_coef", "max_grad_norm")}
    network = {"class_name": "MLPModel", "hidden_dims": list(cfg.hidden), "activation": cfg.activation}
    network["obs_normalization"] = True
    noise = {"class_name": "GaussianDistribution", "init_std": cfg.init_std, "std_type": "log"}
    return {
        "num_steps_per_env": cfg.num_steps,
        "save_interval": save_interval,
        "seed": seed,
        "check_for_nan": False,
        "logger": "tensorboard",
        "obs_groups": {"actor": ["actor"], "critic": ["critic" if cfg.asymmetric_critic else "actor"]},
        "actor": {**network, "distribution_cfg": noise},
        "critic": dict(network),
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": cfg.epochs,
            "num_mini_batches": cfg.minibatches,
            "learning_rate": cfg.lr,
            "schedule": "adaptive" if cfg.desired_kl > 0.0 else "fixed",
            "clip_param": cfg.clip,
            "value_loss_coef": cfg.value_coef,
            "use_clipped_value_loss": cfg.clip_value,
            **same,
        },
    }


class _EndOfTraining(Exception):
    """Signal that leaves rsl-rl's training loop."""


def _save(runner: OnPolicyRunner, path: str, infos: dict | None = None) -> None:
    """Write a checkpoint of rsl-rl's runner as `OnPolicyRunner.save`, but atomically. Raises OSError with the path."""
    buffer = io.BytesIO()
    torch.save({**runner.alg.save(), "iter": runner.current_learning_iteration, "infos": infos}, buffer)
    write_atomically(Path(path), buffer.getvalue())


def train_rsl_rl(
    env: RslRlEnv, cfg: PpoCfg, iterations: int, save_interval: int, seed: int, folder: Path | None = None,
    end_in: Callable[[int], Path | None] | None = None,
) -> OnPolicyRunner:  # fmt: skip
    """Train a policy with rsl-rl's PPO, and return rsl-rl's runner.

    env: environment in rsl-rl's interface, already reset. folder: for checkpoints and TensorBoard events (None: no
    files). end_in: function of the number of iterations so far, called after each; a folder that it returns ends the
    training, with a checkpoint there.
    """
    config = rsl_rl_config(cfg, save_interval, seed)
    runner = OnPolicyRunner(env, config, log_dir=folder and str(folder), device=str(env.device))
    logger: Any = runner.logger
    log, runner.save = logger.log, partial(_save, runner)  # pyright: ignore[reportAttributeAccessIssue]

    def log_and_check(**values: Any) -> None:
        """Log an iteration; save a checkpoint and raise _EndOfTraining if the training is over."""
        last = end_in(runner.current_learning_iteration + 1) if end_in else None
        if last in (None, folder):  # in a deleted folder TensorBoard's writer raises
            log(**values)
        if last:
            runner.save(str(last / f"model_{runner.current_learning_iteration}.pt"))
            raise _EndOfTraining

    logger.log = log_and_check  # rsl-rl calls it once in each iteration, and has no other way to end early
    with suppress(_EndOfTraining):
        runner.learn(iterations)
    return runner
