"""Adapter from the Gymnasium vector environment to Stable-Baselines3's `VecEnv`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from jumper_warp.envs.gymnasium import GymVectorEnv
from jumper_warp.utils.checks import check_type
from jumper_warp.utils.errors import InputError


class Sb3VecEnv(VecEnv):
    """Adapter of `GymVectorEnv` to Stable-Baselines3's `VecEnv`.

    The info of a world whose episode ended has terminal_observation, `TimeLimit.truncated`, termination (its name) and
    episode (return `r`, length `l` [steps], duration `t` [s]); the others' are empty.
    """

    def __init__(self, envs: GymVectorEnv) -> None:
        """Adapt `envs` to Stable-Baselines3.

        Raises InputError: it is another object, returns tensors, or its autoreset mode is not SAME_STEP.
        """
        check_type("envs", envs, GymVectorEnv)
        if envs.tensors or envs.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise InputError("Stable-Baselines3 needs arrays and autoreset_mode 'SameStep'")
        self.envs = envs
        self._actions = np.zeros(0)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        """Begin a new episode in every world, with the seed of the last `seed` call; return the observations."""
        obs, _ = self.envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions (num_envs, 12) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance one policy step; return (observations, rewards, dones, infos), see the class."""
        obs, rewards, terminated, truncated, all_infos = self.envs.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        dones = terminated | truncated
        for world in np.flatnonzero(dones):
            final = all_infos["final_info"]
            infos[world] = {
                "terminal_observation": all_infos["final_obs"][world],
                "TimeLimit.truncated": bool(truncated[world]),
                "termination": self.envs.endings[final["termination"][world]],
                "episode": {name: values[world].item() for name, values in final["episode"].items()},
            }
        return obs, rewards, dones, infos

    def close(self) -> None:
        """Close the environment."""
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return an image of every world's robot, see `GymVectorEnv.render`."""
        return self.envs.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[object]:
        """Return the vector environment's attribute once for each of the worlds `indices`, by default all."""
        return [getattr(self.envs, attr_name)] * self._count(indices)

    def set_attr(self, attr_name: str, value: object, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the vector environment; the worlds share it."""
        setattr(self.envs, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: object, indices: VecEnvIndices = None, **method_kwargs: object
    ) -> list[object]:
        """Call a method of the vector environment once; return its result for each of the worlds `indices`."""
        return [getattr(self.envs, method_name)(*method_args, **method_kwargs)] * self._count(indices)

    def env_is_wrapped(self, wrapper_class: object, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each of the worlds `indices`, by default all, as no world has a wrapper of its own."""
        return [False] * self._count(indices)

    def _count(self, indices: VecEnvIndices) -> int:
        """Return the number of worlds that `indices` selects."""
        return len(list(self._get_indices(indices)))
