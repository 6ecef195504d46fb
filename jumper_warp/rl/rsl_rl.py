"""Training with rsl-rl's PPO instead of this package's."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rsl_rl.env import VecEnv as RslRlEnv
from rsl_rl.runners import OnPolicyRunner

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.rl.clock import TrainingClock, is_last_iteration
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.run_folder import (
    CONFIG,
    INTERRUPTED,
    AsRslRl,
    TrainResult,
    full_config,
    new_folder,
    report_non_finite,
    rescue_folder,
    write_config,
)
from jumper_warp.rl.stop_request import StopRequest
from jumper_warp.utils.files import write_atomically
from jumper_warp.utils.locks import write_lock


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


def run_rsl_rl(cfg: TrainCfg, env: VecEnv, as_rsl_rl: AsRslRl, rank: Rank) -> TrainResult:
    """Train a policy with rsl-rl's PPO in a new run folder; result and SystemExit as `jumper_warp.rl.runner.train`."""
    folder, config = new_folder(cfg, rank), full_config(cfg, env, rank)
    print_line = partial(print, file=sys.stderr)
    print_line(f"run {folder}")
    write_config(folder, config)
    begin = time.perf_counter()
    torch.manual_seed(cfg.seed + rank.index)
    env.reset()
    adapter = as_rsl_rl(env, cfg.ppo.num_steps)
    clock, failure = TrainingClock(cfg), ""  # failure: the reason of exit status 1

    def end_in(iteration: int) -> Path | None:
        """Return the folder for the last checkpoint if the training is over after this iteration, else None."""
        nonlocal failure
        stop.can_abort = False
        over_time = clock.is_over_time()  # False before it starts
        if not clock.started:
            clock.start(rank.device)
        kept, failure = rescue_folder(folder, config, [CONFIG])
        found = report_non_finite(env, kept, config, iteration, print_line)
        if found and cfg.stop_on_nan:
            failure = failure or f"--stop-on-nan: {found[0]}"
        stop.can_abort = not is_last_iteration(iteration, cfg, bool(failure) or stop.requested or over_time)
        return None if stop.can_abort else kept

    with write_lock(folder), StopRequest() as stop:
        settings = (cfg.ppo, cfg.max_iterations, cfg.save_interval, cfg.seed, folder, end_in)
        iteration = train_rsl_rl(adapter, *settings).current_learning_iteration + 1
    if failure:
        raise SystemExit(f"jumper: {failure}")
    if stop.requested:
        raise SystemExit(INTERRUPTED)
    return TrainResult(folder, iteration, time.perf_counter() - begin, {}, {})
