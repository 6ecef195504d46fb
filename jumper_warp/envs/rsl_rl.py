"""Adapter from the environment to rsl-rl's `VecEnv`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import torch
from rsl_rl.env import VecEnv as RslRlEnv
from tensordict import TensorDict

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.utils.checks import check_count, check_type
from jumper_warp.utils.files import write_atomically


class EnvConfig(dict):
    """Configuration of an environment, in the form that rsl-rl's loggers expect."""

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration's entries as a plain dict."""
        return dict(self)


class RslRlVecEnv(RslRlEnv):
    """Adapter of this package's `VecEnv` to rsl-rl's class of that name; returns copies, since rsl-rl keeps them."""

    cfg: EnvConfig

    def __init__(self, env: VecEnv, metrics_every: int = 24, max_episode_length: int = 1200) -> None:
        """Adapt `env` to rsl-rl; if `env` was not reset yet, call `reset` of the adapter before training.

        metrics_every: policy steps between two reads of the metrics, which wait for the device; with the number of
            steps per iteration they are logged once per iteration. max_episode_length: policy steps; only reported.
        Raises InputError: `env` is no `VecEnv`, or one of the numbers is no whole number of at least 1.
        """
        check_type("env", env, VecEnv)
        self.env = env
        self.num_envs = env.num_envs
        self.num_actions = env.num_actions
        self.max_episode_length = check_count("max_episode_length", max_episode_length, sys.maxsize)
        self.device = env.device
        self.cfg = EnvConfig(env.config())
        self._episode_length = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)
        self._metrics_every = check_count("metrics_every", metrics_every, sys.maxsize)
        self._steps = 0

    @property
    def unwrapped(self) -> RslRlVecEnv:
        """The adapter itself; rsl-rl reads the duration of a policy step as `unwrapped.step_dt`."""
        return self

    @property
    def step_dt(self) -> float:
        """Duration of a policy step [s]."""
        return self.cfg["policy_dt_s"]

    def write_config(self, folder: str | Path, activation: str = "elu") -> None:
        """Write `config.json` (environment, activation), needed to evaluate, play and export rsl-rl's checkpoints.

        folder: made if it is missing; activation: of the actor's network. Raises OSError: the file cannot be written.
        """
        Path(folder).mkdir(parents=True, exist_ok=True)
        config = {"env": self.cfg, "train": {"ppo": {"activation": activation}}}
        write_atomically(Path(folder) / "config.json", json.dumps(config, indent=1).encode())

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Count of policy steps in each running episode, (num_envs,) int64; assigning it does not affect their ends."""
        return self._episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self._episode_length.copy_(value)

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Begin a new episode in every world; return its first observations, and extras (none)."""
        self.env.reset()
        self._episode_length.zero_()
        return self.get_observations(), {}

    def get_observations(self) -> TensorDict:
        """Return the observations as groups `actor` and `critic`, finite and bounded."""
        groups = {"actor": self.env.obs.clone(), "critic": self.env.critic_obs.clone()}
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance one policy step; return (observations, rewards (num_envs,), dones (num_envs,) int64, extras).

        actions: (num_envs, num_actions). Observations of ended episodes are those of the new one. extras: `time_outs`
        (num_envs,), 1 where the episode ended without failure, and every `metrics_every` steps `log`, the metrics by
        name. Rewards are finite: NaN or infinity counts as 0. `VecEnv` guarantees finite observations, but not finite
        rewards. Raises InputError as `Env.step`.
        """
        env = self.env
        env.step(actions)
        self._steps += 1
        self._episode_length.add_(1).mul_((1.0 - env.done).long())
        extras: dict[str, Any] = {"time_outs": env.timeout.clone()}
        if self._steps % self._metrics_every == 0:
            extras["log"] = env.metrics()
        reward = torch.nan_to_num(env.reward, nan=0.0, posinf=0.0, neginf=0.0)
        return self.get_observations(), reward, env.done.long(), extras
