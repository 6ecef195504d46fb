"""Settings of our PPO as those of rsl-rl's runner."""

from __future__ import annotations

from typing import Any

from jumper_warp.rl.cfg import PpoCfg


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
