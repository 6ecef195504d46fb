"""Measure how fast training is and where its time is spent, and write metrics.

    python experiments/benchmark_training.py --envs 4096 8192 16384 --out outputs/benchmark_training

Speeds are policy steps of 1/60 s per second, 8 physics steps each, of all environments together. The solver is timed
with standing robots. The environment, with randomisation and noise, is timed with random actions and with a policy's
jumps; training has learned actions. rsl-rl-lib
trains on the same environment through the package's adapter. Outcomes are checked before the timing.

`--eager` also times PPO without the fused kernels. `--only-ppo` times PPO only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import warp as wp

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.utils.output import output_dir
from jumper_warp.utils.runtime import configure_device
from support.scripts import ThreadArgs, report, run_script
from support.speed import time_parts, time_ppo, time_rsl_rl


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the benchmark of training."""

    envs: tuple[int, ...] | None = None
    """Numbers of environments for solver and environment (default: 4096 8192 16384 on a GPU, 64 on a CPU)."""
    train_envs: int | None = None
    """Number of environments for training and profile (default: 8192 on a GPU, 64 on a CPU)."""
    steps: int = 200  # Policy steps in a repetition
    repeats: int = 5  # Number of repetitions of a timing; the median is reported
    iterations: int = 10  # Number of timed training iterations of each trainer
    rsl_rl: bool = True  # Train with rsl-rl-lib too
    num_steps: int = 32  # Policy steps of each environment in an iteration
    eager: bool = False  # Time PPO without the fused kernels too
    only_ppo: bool = False  # Time PPO only


def main(args: Args) -> dict:
    """Time solver, environment and trainers as the flags select, write and return the metrics.

    `env_step_us`: median wall time of a policy step of all `train_envs` environments, with random actions [µs].
    `ppo_collect_s`, `ppo_update_s`: mean times in an iteration [s]. `collect_env_share`: `num_steps` times
    `env_step_us`, as a fraction of `ppo_collect_s` [1]. `ppo_over_rsl_rl`: ratio of steps per second [1]. Other keys:
    see `time_parts`, `time_ppo` and `time_rsl_rl`. Metrics that the flags do not select are missing, and the printed
    summary skips their keys.
    """
    info = configure_device(args.device, args.threads)
    folder = output_dir("benchmark_training", args.out)
    gpu = wp.get_device(args.device).is_cuda
    envs = args.envs or ((4096, 8192, 16384) if gpu else (64,))
    train_envs = args.train_envs or (8192 if gpu else 64)
    values: dict = {"device": info.name, "envs": list(envs), "train_envs": train_envs, "num_steps": args.num_steps}
    if not args.only_ppo:
        values |= time_parts(envs, train_envs, args.steps, args.repeats, args.device)
    cfg = PpoCfg(num_steps=args.num_steps)
    values |= time_ppo(train_envs, cfg, args.iterations, args.device)
    if args.eager:
        metrics = time_ppo(train_envs, replace(cfg, fused=False), args.iterations, args.device)
        values |= {f"{metric}_eager": value for metric, value in metrics.items()}
    if not args.only_ppo:
        values["collect_env_share"] = args.num_steps * 1.0e-6 * values["env_step_us"] / values["ppo_collect_s"]
    if args.rsl_rl and not args.only_ppo:
        values |= time_rsl_rl(train_envs, args.num_steps, args.iterations, args.device)
        values["ppo_over_rsl_rl"] = values["ppo_steps_per_s"] / values["rsl_rl_steps_per_s"]
    keys = ["ppo_steps_per_s", f"env_steps_per_s_policy_{train_envs}"]
    keys += [f"{part}_steps_per_s_{train_envs}" for part in ("env", "solver")]
    keys += ["ppo_collect_s", "ppo_update_s", "rsl_rl_steps_per_s", "ppo_over_rsl_rl"]
    return report(args, folder, values, f"Training with {train_envs:,} environments, {info.name}", keys)


if __name__ == "__main__":
    run_script(main, Args)
