"""The environment as Gymnasium sees a vector of environments."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
import warp as wp
from gymnasium.spaces import Box, Dict
from gymnasium.vector.utils import batch_space

from jumper_warp.envs.env import Env
from jumper_warp.envs.vec_env import RAW_LIMIT, sanitise
from jumper_warp.utils.checks import MOST_SEED
from jumper_warp.utils.errors import InputError

Obs = Any
"""Observations of all worlds: an array (num_envs, columns), or a dict of them by group."""


class GymVectorEnv(gymnasium.vector.VectorEnv):
    """Adapter. An episode that ends begins anew in the same step; what is returned are copies.

    Infos of a step in which episodes ended, besides masks `_final_obs` and `_final_info` of the worlds concerned:
        final_obs: (num_envs,) the old episode's last observations, None elsewhere.
        final_info: `termination`, (num_envs,) index in `endings` of the termination.
    With tensors=True, actions and all that is returned are torch tensors on the environment's device, and nothing waits
    for it. Infos of every step then have both, `final_obs` with a row for every world.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP,
        "render_modes": [],
    }

    def __init__(self, env: Env, *, all_groups: bool = False, tensors: bool = False) -> None:
        """Take over an environment; call `reset` before the first step.

        all_groups: observations are all groups by name, not only what the policy sees. tensors: see the class.
        Raises ValueError: the environment's worlds do not restart by themselves, or it has several tasks.
        """
        if not env.auto_reset:
            raise InputError("Gymnasium's adapter needs an environment with auto_reset")
        if len(env.tasks) > 1:
            raise InputError(f"Gymnasium's adapter needs an environment of one task, this one has {len(env.tasks)}")
        self.env, self.num_envs = env, env.num_envs
        self.endings = tuple(term.name for term in env.task.terminations)
        self._all_groups, self._tensors, self._began = all_groups, tensors, False
        self._termination = wp.to_torch(env.episodes.termination)
        widths = {"actor": env.num_obs, "critic": env.num_critic_obs}
        boxes = {group: Box(-RAW_LIMIT, RAW_LIMIT, (width,)) for group, width in widths.items()}
        self.single_observation_space = Dict([*boxes.items()]) if all_groups else boxes["actor"]
        self.single_action_space = Box(-1.0, 1.0, (env.num_actions,))
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin a new episode in every world; return observations, and infos (none).

        seed: all goes as in a new environment of this seed (modulo 2**31); None: the draws go on. options: none exist.
        Raises ValueError: there are options. gymnasium.error.Error: not a seed.
        """
        self._check_open()
        if options:
            raise InputError(f"reset takes no options, got {', '.join(map(repr, options))}")
        super().reset(seed=seed)
        if seed is not None:
            seed %= MOST_SEED + 1
        obs, _ = self.env.reset(seed)
        self._began = True
        return self._shown(obs), {}

    def step(self, actions: Any) -> tuple[Obs, Any, Any, Any, dict[str, Any]]:
        """Advance by a policy period; return observations, rewards, terminations, truncations and infos.

        actions: (num_envs, 12), clamped to -1..1. Observations are those of the new episode where one has ended.
        Raises ValueError: actions of another shape, or no numbers. gymnasium.error.ResetNeeded: no `reset` came before.
        """
        self._check_open()
        if not self._began:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        step = self.env.step(actions if self._tensors else self._checked(actions))
        reward = torch.nan_to_num(step.reward, nan=0.0, posinf=0.0, neginf=0.0)
        terminated, truncated = (self._given(flag.clone()) for flag in (step.terminated, step.truncated))
        ended, infos = terminated | truncated, {}
        if self._tensors or ended.any():
            final, termination = self._shown(step.extras["final_obs"]), self._given(self._termination.clone())
            infos["final_obs"], infos["_final_obs"] = final if self._tensors else self._rows(final, ended), ended
            infos["final_info"] = {"termination": termination, "_termination": _copy(ended)}
            infos["_final_info"] = _copy(ended)
        return self._shown(step.obs), self._given(reward), terminated, truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Let the environment go; its memory is free when nobody else holds it."""
        del self.env, self._termination

    def _check_open(self) -> None:
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError("the environment is closed")

    def _checked(self, actions: Any) -> torch.Tensor:
        array, shape = np.asarray(actions), self.action_space.shape
        if array.shape != shape or array.dtype.kind not in "fiu":
            raise InputError(f"actions must be numbers of shape {shape}, got {array.dtype} of shape {array.shape}")
        return torch.from_numpy(np.array(array, dtype=np.float32)).to(self.env.device)

    def _given(self, tensor: torch.Tensor) -> Any:
        return tensor if self._tensors else tensor.cpu().numpy()

    def _shown(self, groups: dict[str, torch.Tensor]) -> Obs:
        """Return copies as the observation space has them, finite and bounded."""
        if not self._all_groups:
            return self._given(sanitise(groups["actor"]))
        return {group: self._given(sanitise(groups[group])) for group in ("actor", "critic")}

    def _rows(self, obs: Obs, worlds: np.ndarray) -> np.ndarray:
        """Return the observation of each of some worlds as an object, None for others."""
        rows = np.full(self.num_envs, None, dtype=object)
        for world in np.flatnonzero(worlds):
            rows[world] = {group: x[world] for group, x in obs.items()} if self._all_groups else obs[world]
        return rows


def _copy(flags: Any) -> Any:
    return flags.clone() if isinstance(flags, torch.Tensor) else flags.copy()
