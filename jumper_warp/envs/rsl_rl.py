"""The environment as rsl-rl's VecEnv, and a training with rsl-rl."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from jumper_warp.envs.vec_env import VecTask
from jumper_warp.rl.networks import sanitise
from jumper_warp.rl.ppo import PpoCfg


class RslRlVecEnv(VecEnv):
    """Adapter. What it returns are copies, because rsl-rl keeps references over the next step."""

    def __init__(self, env: VecTask, metrics_every: int, max_episode_length: int = 1200) -> None:
        """Args:

        env: Its worlds restart by themselves.
        metrics_every: Steps between two readings of the environment's metrics, which wait for the device.
        max_episode_length: Policy steps after which no episode goes on; only reported.
        """
        self.env = env
        self.num_envs, self.num_actions = env.num_envs, env.num_actions
        self.max_episode_length = max_episode_length
        self.device = env.device
        self.cfg = env.config()
        self._episode_length = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)
        self._metrics_every = metrics_every
        self._steps = 0

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """(num_envs,) steps since each episode began; assigning copies."""
        return self._episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self._episode_length.copy_(value)

    def get_observations(self) -> TensorDict:
        """Return the observations as groups `policy` and `critic`, finite and bounded."""
        groups = {"policy": sanitise(self.env.obs), "critic": sanitise(self.env.critic_obs)}
        return TensorDict(groups, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance by a policy period; actions (num_envs, num_actions)."""
        env = self.env
        env.step(actions)
        self._steps += 1
        self._episode_length.add_(1).mul_((1.0 - env.done).long())
        extras: dict[str, Any] = {"time_outs": env.timeout.clone()}
        if self._steps % self._metrics_every == 0:
            extras["log"] = {f"/{name}": value for name, value in env.metrics().items()}
        reward = torch.nan_to_num(env.reward, nan=0.0, posinf=0.0, neginf=0.0)
        return self.get_observations(), reward, env.done.long(), extras


def rsl_rl_config(cfg: PpoCfg, save_interval: int, seed: int) -> dict[str, Any]:
    """Return rsl-rl's configuration with the same settings; it knows no value normalisation and no reward scale."""
    network = {"class_name": "MLPModel", "hidden_dims": list(cfg.hidden), "activation": cfg.activation}
    network["obs_normalization"] = True
    noise = {"class_name": "GaussianDistribution", "init_std": cfg.init_std, "std_type": "log"}
    return {
        "num_steps_per_env": cfg.num_steps,
        "save_interval": save_interval,
        "seed": seed,
        "check_for_nan": False,
        "logger": "tensorboard",
        "obs_groups": {"actor": ["policy"], "critic": ["critic" if cfg.asymmetric else "policy"]},
        "actor": {**network, "distribution_cfg": noise},
        "critic": dict(network),
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": cfg.epochs,
            "num_mini_batches": cfg.minibatches,
            "learning_rate": cfg.lr,
            "schedule": "adaptive" if cfg.desired_kl > 0.0 else "fixed",
            "desired_kl": cfg.desired_kl,
            "gamma": cfg.gamma,
            "lam": cfg.lam,
            "entropy_coef": cfg.entropy_coef,
            "clip_param": cfg.clip,
            "value_loss_coef": cfg.value_coef,
            "max_grad_norm": cfg.max_grad_norm,
            "use_clipped_value_loss": cfg.clip_value,
        },
    }


def train_rsl_rl(
    env: VecTask, cfg: PpoCfg, iterations: int, save_interval: int, seed: int, folder: Path | None
) -> OnPolicyRunner:
    """Train with rsl-rl's PPO and return its runner; without a folder it writes nothing."""
    env.reset()
    adapter = RslRlVecEnv(env, metrics_every=cfg.num_steps)
    config = rsl_rl_config(cfg, save_interval, seed)
    runner = OnPolicyRunner(adapter, config, log_dir=folder and str(folder), device=str(env.device))
    runner.learn(iterations)
    return runner
