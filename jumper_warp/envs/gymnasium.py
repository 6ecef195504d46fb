"""Adapter from the environment to `gymnasium.vector.VectorEnv`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np
import torch
import warp as wp
from gymnasium.spaces import Box, Dict
from gymnasium.vector.utils import batch_space

from jumper_warp.envs.env import Env
from jumper_warp.envs.vec_env import RAW_LIMIT, sanitise
from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.utils.checks import MOST_SEED, check_count
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.envs.camera import WorldCamera

Obs = Any  # Observations of all worlds: an array (num_envs, columns), or a dict of them by group


class GymVectorEnv(gymnasium.vector.VectorEnv):
    """`Env` of one task as a Gymnasium vector environment; ended episodes are reset in the same step; returns copies.

    Infos of a step in which episodes ended, with masks `_final_obs` and `_final_info` (num_envs,) of these worlds:
        final_obs: (num_envs,) objects, last observations of the ended episodes, None elsewhere.
        final_info: `termination`, (num_envs,) index in `endings` (names of terminations), -1 elsewhere.
    With tensors=True, actions and all returned values are torch tensors on the environment's device, nothing waits for
    the device, and infos of every step have both entries, `final_obs` as observations of all worlds.
    With render_mode="rgb_array", `render` draws the robots, for wrappers such as Gymnasium's vector `RecordVideo`.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP,
        "render_modes": ["rgb_array"],
        "render_fps": round(1.0 / (SUBSTEPS * PHYSICS_DT)),
    }

    def __init__(
        self,
        env: Env,
        *,
        all_groups: bool = False,
        tensors: bool = False,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (640, 480),
        render_envs: int = 16,
    ) -> None:
        """Wrap `env`; call `reset` before the first step.

        all_groups: observations are a dict with the groups `actor` and `critic`, else those of `actor` only. tensors:
        see the class. render_mode: "rgb_array", or None to draw nothing. render_size: width and height of an image
        [px]. render_envs: number of worlds drawn, from the first on.
        Raises InputError (a ValueError): the environment has no auto_reset, or several tasks; another render_mode, a
        size outside 16 to 7680 px, or render_envs no whole number of at least 1.
        """
        if render_mode not in (None, "rgb_array"):
            raise InputError(f"render_mode must be 'rgb_array' or None, got {render_mode!r}")
        _check_size(render_size)
        check_count("render_envs", render_envs)
        if not env.auto_reset:
            raise InputError("Gymnasium's adapter needs an environment with auto_reset")
        if len(env.tasks) > 1:
            raise InputError(f"Gymnasium's adapter needs an environment of one task, this one has {len(env.tasks)}")
        self.env, self.num_envs = env, env.num_envs
        self.endings = tuple(term.name for term in env.task.terminations)
        self._all_groups, self._tensors, self._was_reset = all_groups, tensors, False
        self.render_mode, self._size, self._drawn = render_mode, render_size, min(render_envs, self.num_envs)
        self._camera: WorldCamera | None = None  # opens at the first `render`
        self._termination = wp.to_torch(env.episodes.termination)
        widths = {"actor": env.num_obs, "critic": env.num_critic_obs}
        boxes = {group: Box(-RAW_LIMIT, RAW_LIMIT, (width,)) for group, width in widths.items()}
        self.single_observation_space = Dict([*boxes.items()]) if all_groups else boxes["actor"]
        self.single_action_space = Box(-1.0, 1.0, (env.num_actions,))
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin a new episode in every world; return (observations, infos), infos being empty.

        seed: restart all random streams as in a new environment with this seed (modulo 2**31); None: they continue.
        Raises InputError (a ValueError): there are options. gymnasium.error.Error: not a seed.
        """
        self._check_open()
        if options:
            raise InputError(f"reset takes no options, got {', '.join(map(repr, options))}")
        super().reset(seed=seed)
        if seed is not None:
            seed %= MOST_SEED + 1
        obs, _ = self.env.reset(seed)
        self._was_reset = True
        return self._observation(obs), {}

    def step(self, actions: Any) -> tuple[Obs, Any, Any, Any, dict[str, Any]]:
        """Advance one policy step; return (observations, rewards, terminations, truncations, infos), see the class.

        actions: (num_envs, 12), clamped to -1..1. Where an episode ended, the observation is that of the new episode.
        Raises InputError (a ValueError): actions of another shape or dtype. gymnasium.error.ResetNeeded: not reset.
        """
        self._check_open()
        if not self._was_reset:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        step = self.env.step(actions if self._tensors else self._checked_actions(actions))
        reward = torch.nan_to_num(step.reward, nan=0.0, posinf=0.0, neginf=0.0)
        terminated, truncated = (self._converted(flag.clone()) for flag in (step.terminated, step.truncated))
        ended, infos = terminated | truncated, {}
        if self._tensors or ended.any():
            final, termination = self._observation(step.extras["final_obs"]), self._converted(self._termination.clone())
            infos["final_obs"], infos["_final_obs"] = final if self._tensors else self._final_rows(final, ended), ended
            infos["final_info"] = {"termination": termination, "_termination": _copied(ended)}
            infos["_final_info"] = _copied(ended)
        return self._observation(step.obs), self._converted(reward), terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return an image of every world's robot, num_envs arrays (height, width, 3) uint8; None without render_mode.

        The camera follows the robot. Where an episode ended, the image shows the new one. Only the first `render_envs`
        worlds are drawn, the images of the others are black; with many worlds `RecordVideo` needs record_first_only.
        The simulation does not change. Waits for the device. Raises gymnasium.error.ResetNeeded: not reset.
        """
        self._check_open()
        if self.render_mode is None:
            gymnasium.logger.warn('nothing is drawn: make the environment with render_mode="rgb_array"')
            return None
        if not self._was_reset:
            raise gymnasium.error.ResetNeeded("call reset before the first render")
        if self._camera is None:
            from jumper_warp.envs.camera import WorldCamera

            self._camera = WorldCamera(self.env.sim, self._drawn, self._size)
        width, height = self._size
        black = np.broadcast_to(np.uint8(0), (height, width, 3))
        return (*self._camera.images(), *[black] * (self.num_envs - self._drawn))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the renderer and drop the references to the environment, called by `close`; kwargs are unused."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        del self.env, self._termination

    def _check_open(self) -> None:
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError("the environment is closed")

    def _checked_actions(self, actions: Any) -> torch.Tensor:
        """Return actions as a float32 tensor on the device. Raises InputError: another shape, or not numbers."""
        array, shape = np.asarray(actions), self.action_space.shape
        if array.shape != shape or array.dtype.kind not in "fiu":
            raise InputError(f"actions must be numbers of shape {shape}, got {array.dtype} of shape {array.shape}")
        return torch.from_numpy(np.array(array, dtype=np.float32)).to(self.env.device)

    def _converted(self, tensor: torch.Tensor) -> Any:
        """Return the tensor unchanged with `tensors`, else its values as a NumPy array."""
        return tensor if self._tensors else tensor.cpu().numpy()

    def _observation(self, groups: dict[str, torch.Tensor]) -> Obs:
        """Return copies of observations in the form of the observation space, finite and within RAW_LIMIT."""
        if not self._all_groups:
            return self._converted(sanitise(groups["actor"]))
        return {group: self._converted(sanitise(groups[group])) for group in ("actor", "critic")}

    def _final_rows(self, obs: Obs, worlds: np.ndarray) -> np.ndarray:
        """Return an object array (num_envs,): a world's observation where worlds (num_envs,) bool is set, else None."""
        rows = np.full(self.num_envs, None, dtype=object)
        for world in np.flatnonzero(worlds):
            rows[world] = {group: values[world] for group, values in obs.items()} if self._all_groups else obs[world]
        return rows


def _check_size(size: tuple[int, int]) -> None:
    """Raise InputError unless size is a width and a height of 16 to 7680 px."""
    if not (len(size) == 2 and all(isinstance(length, int) and 16 <= length <= 7680 for length in size)):
        raise InputError(f"render_size must be a width and a height of 16 to 7680 px, got {size}")


def _copied(flags: Any) -> Any:
    """Return a copy of a tensor or an array."""
    return flags.clone() if isinstance(flags, torch.Tensor) else flags.copy()
