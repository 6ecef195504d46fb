"""Adapters from the environment to `gymnasium.vector.VectorEnv` and, with one world, to `gymnasium.Env`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from numbers import Integral
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
import warp as wp
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from jumper_warp.envs.arrays import to_numpy
from jumper_warp.envs.env import Env
from jumper_warp.envs.vec_env import RAW_LIMIT
from jumper_warp.robot.model import PHYSICS_DT
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.utils.checks import MOST_SEED, check_count, check_flags, check_type
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.envs.camera import WorldCamera

Obs = Any  # Observations of all worlds: an array (num_envs, columns), or a dict of them by group
RENDERING: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / (SUBSTEPS * PHYSICS_DT))}


class GymVectorEnv(gymnasium.vector.VectorEnv):
    """Gymnasium vector environment made from an `Env` with one task; later steps do not change returned values.

    Infos by `autoreset_mode`; masks such as `_final_obs` (num_envs,) mark the worlds whose episode ended in the step:
        SAME_STEP: a step that ends an episode also resets it, which is fastest. When one ended, the infos have
            final_obs, (num_envs,) objects: last observations of the ended episodes, None elsewhere; and
            final_info: `termination`, (num_envs,) index in `endings` (names of terminations), -1 elsewhere; and
            `episode` with return `r`, length `l` [steps] and duration `t` [s of wall time], 0 elsewhere.
        NEXT_STEP: the step after the end ignores the world's action and resets it, with a reward of 0.
        DISABLED: `reset(options={"reset_mask": ...})` resets ended episodes. Both other modes have `termination` above.
    With tensors=True all returned values are torch tensors on `device`, nothing waits for the device, and the infos of
    every step have all entries, `final_obs` as observations of all worlds.
    With render_mode="rgb_array", `render` draws the robots, for wrappers such as Gymnasium's vector `RecordVideo`.
    """

    def __init__(
        self,
        env: Env,
        *,
        all_groups: bool = False,
        tensors: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (640, 480),
        render_envs: int = 16,
    ) -> None:
        """Make a Gymnasium vector environment from `env`; call `reset` before the first step.

        all_groups: observations are a dict with the groups `actor` and `critic`, else those of `actor` only. tensors,
        autoreset_mode: see the class; the modes' values "SameStep", "NextStep", "Disabled" are accepted too.
        render_mode: "rgb_array", or None to draw nothing. render_size: width and height of an image [px]. render_envs:
        number of worlds drawn, from the first on.
        Raises InputError (a ValueError): env is another object, has no auto_reset or several tasks; another
        render_mode, a size outside 16 to 7680 px, or render_envs no whole number of at least 1. ValueError: another
        autoreset_mode.
        """
        check_type("env", env, Env)
        if render_mode not in (None, "rgb_array"):
            raise InputError(f"render_mode must be 'rgb_array' or None, got {render_mode!r}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        _check_size(render_size)
        render_envs = check_count("render_envs", render_envs)
        check_flags(all_groups=all_groups, tensors=tensors)
        if not env.auto_reset:
            raise InputError("Gymnasium's adapter needs an environment with auto_reset")
        if len(env.tasks) > 1:
            raise InputError(f"Gymnasium's adapter needs an environment of one task, this one has {len(env.tasks)}")
        self.env = env
        self.num_envs = env.num_envs
        self.device = env.device
        self.metadata = {**RENDERING, "autoreset_mode": self.autoreset_mode}
        self.endings = env.task.termination_names
        self._all_groups = all_groups
        self.tensors = tensors
        self._was_reset = False
        self.render_mode = render_mode
        self._size = render_size
        self._drawn = min(render_envs, self.num_envs)
        self._to_reset = None if self.autoreset_mode is AutoresetMode.SAME_STEP else env.use_reset_mask()
        self._ended = self._converted(torch.zeros(self.num_envs, dtype=torch.bool, device=self.device))
        """(num_envs,) bool, worlds whose episode the last step ended."""
        rows = (torch.zeros((3, self.num_envs), dtype=torch.float64, device=self.device) for _ in range(2))
        self._sums, self._increments = map(self._converted, rows)
        """(3, num_envs) return, steps and wall time [s] of running episodes and of the last step; of SAME_STEP only."""
        self._increments[1] = 1.0
        self._last_time = 0.0  # [s]
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
        options: `reset_mask`, (num_envs,) bool, resets only these worlds, without a seed.
        Raises InputError (a ValueError): other options, no mask, or one of no world. gymnasium.error.Error: not a seed.
        """
        self._check_open()
        check_type("options", options, Mapping | None)
        mask = self._checked_mask(dict(options or {}))
        super().reset(seed=seed)
        if seed is not None:
            seed %= MOST_SEED + 1
        obs, _ = self.env.reset(seed, worlds=mask)
        begun = self._ended | True if mask is None else mask
        self._ended = self._ended & ~begun
        self._was_reset = True
        self._sums = self._sums * ~begun
        self._last_time = time.perf_counter()
        return self._observation(obs), {}

    def step(self, actions: Any) -> tuple[Obs, Any, Any, Any, dict[str, Any]]:
        """Advance one policy step; return (observations, rewards, terminations, truncations, infos), see the class.

        actions: (num_envs, 12) array or tensor, clamped to -1..1.
        Raises InputError (a ValueError): actions of another shape, dtype or device. gymnasium.error.ResetNeeded: not
        reset, or, with arrays and without automatic resets, an ended episode was not.
        """
        self._check_open()
        if not self._was_reset:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        if self.autoreset_mode is AutoresetMode.DISABLED and not self.tensors and self._ended.any():
            raise gymnasium.error.ResetNeeded('reset ended episodes with options={"reset_mask": mask}')
        begun = self._ended if self.autoreset_mode is AutoresetMode.NEXT_STEP else None
        if begun is not None and self._to_reset is not None:
            self._to_reset.copy_(torch.as_tensor(begun))
        step = self.env.step(actions if isinstance(actions, torch.Tensor) else self._checked_actions(actions))
        reward = self._converted(torch.nan_to_num(step.reward, nan=0.0, posinf=0.0, neginf=0.0))
        terminated, truncated = (self._converted(flag.clone()) for flag in (step.terminated, step.truncated))
        if begun is not None:
            reward, terminated, truncated = reward * ~begun, terminated & ~begun, truncated & ~begun
        self._ended = ended = terminated | truncated
        if self._to_reset is None:
            now = time.perf_counter()
            self._increments[0] = reward
            self._increments[2] = now - self._last_time
            self._last_time = now
            self._sums += self._increments
        infos = self._infos(step.extras["final_obs"], ended) if self.tensors or ended.any() else {}
        return self._observation(step.obs), reward, terminated, truncated, infos

    def _infos(self, final_obs: dict[str, torch.Tensor], ended: Any) -> dict[str, Any]:
        """Return the infos of a step, such as final observations. See the class; final_obs: by group, before resets."""
        termination = self._converted(self._termination.where(torch.as_tensor(ended, device=self.device), -1))
        if self._to_reset is not None:
            return {"termination": termination, "_termination": _copied(ended)}
        final = self._observation(final_obs)
        episodes = self._sums * ended
        self._sums -= episodes
        lengths = episodes[1].long() if isinstance(episodes, torch.Tensor) else episodes[1].astype(np.int64)
        return {
            "final_obs": final if self.tensors else self._final_rows(final, ended),
            "_final_obs": _copied(ended),
            "final_info": {
                "termination": termination,
                "_termination": _copied(ended),
                "episode": {"r": episodes[0], "l": lengths, "t": episodes[2]},
                "_episode": _copied(ended),
            },
            "_final_info": _copied(ended),
        }

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
        """Raise Gymnasium's ClosedEnvironmentError if `close` was called."""
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError("the environment is closed")

    def _checked_mask(self, options: dict[str, Any]) -> Any:
        """Return a checked mask of worlds to reset, or None. Raises InputError: other options, or no mask."""
        mask = options.pop("reset_mask", None)
        if options:
            raise InputError(f"reset takes no options but 'reset_mask', got {', '.join(map(repr, options))}")
        if mask is None:
            return None
        array = np.asarray(to_numpy(mask))
        if array.shape != (self.num_envs,) or array.dtype != bool or not array.any():
            raise InputError(
                f"reset_mask must be bool of shape ({self.num_envs},) with a True, got {array.dtype} of {array.shape}"
            )
        return torch.as_tensor(array, device=self.device) if self.tensors else array

    def _checked_actions(self, actions: Any) -> torch.Tensor:
        """Return actions as a float32 tensor on the device. Raises InputError: another shape, or not numbers."""
        array = np.asarray(actions)
        shape = self.action_space.shape
        if array.shape != shape or array.dtype.kind not in "fiu":
            raise InputError(f"actions must be numbers of shape {shape}, got {array.dtype} of shape {array.shape}")
        return torch.from_numpy(np.array(array, dtype=np.float32)).to(self.env.device)

    def _converted(self, tensor: torch.Tensor) -> Any:
        """Return a tensor in the form that the user chose: unchanged with `tensors`, else as a NumPy array."""
        return tensor if self.tensors else tensor.cpu().numpy()

    def _observation(self, groups: dict[str, torch.Tensor]) -> Obs:
        """Return copies of observations in the form of the observation space."""
        if not self._all_groups:
            return self._converted(groups["actor"].clone())
        return {group: self._converted(groups[group].clone()) for group in ("actor", "critic")}

    def _final_rows(self, obs: Obs, worlds: np.ndarray) -> np.ndarray:
        """Return the last observations of ended episodes as an object array (num_envs,), None for other worlds.

        worlds: (num_envs,) bool, where an episode ended.
        """
        rows = np.full(self.num_envs, None, dtype=object)
        for world in np.flatnonzero(worlds):
            rows[world] = {group: values[world] for group, values in obs.items()} if self._all_groups else obs[world]
        return rows


class GymEnv(gymnasium.Env):
    """One robot as a Gymnasium environment; `gymnasium.make` returns it. The vector environment is far faster.

    Infos of a step that ends the episode have `termination`, the name of the termination.
    """

    def __init__(self, env: Env, **arguments: Any) -> None:
        """Make a Gymnasium environment from `env` with one world.

        arguments: all_groups, render_mode and render_size as of `GymVectorEnv`. Raises InputError (a ValueError): more
        than one world, or as `GymVectorEnv`.
        """
        check_type("env", env, Env)
        if env.num_envs != 1:
            raise InputError(f"gymnasium.make needs one world, got {env.num_envs}; gymnasium.make_vec takes num_envs")
        self._envs = GymVectorEnv(env, autoreset_mode=AutoresetMode.DISABLED, **arguments)
        self.metadata = dict(RENDERING)
        self.render_mode = self._envs.render_mode
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin a new episode; return (observation, infos), infos being empty. See `GymVectorEnv.reset`."""
        super().reset(seed=seed)
        obs, infos = self._envs.reset(seed=seed, options=options)
        return _first(obs), infos

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance one policy step; action: (12,), clamped to -1..1. See `GymVectorEnv.step`."""
        obs, reward, terminated, truncated, infos = self._envs.step(np.asarray(to_numpy(action))[None])
        infos = {"termination": self._envs.endings[infos["termination"][0]]} if infos else {}
        return _first(obs), float(reward[0]), bool(terminated[0]), bool(truncated[0]), infos

    def render(self) -> Any:
        """Return an image (height, width, 3) uint8, see `GymVectorEnv.render`; None without render_mode."""
        images = self._envs.render()
        return None if images is None else images[0]

    def close(self) -> None:
        """Close the renderer and drop the references to the environment."""
        self._envs.close()


def _first(obs: Obs) -> Any:
    """Return the first world's observation, from observations of all worlds."""
    return {group: values[0] for group, values in obs.items()} if isinstance(obs, dict) else obs[0]


def _check_size(size: tuple[int, int]) -> None:
    """Raise InputError unless size is a width and a height of 16 to 7680 px."""
    if not (np.shape(size) == (2,) and all(isinstance(length, Integral) and 16 <= length <= 7680 for length in size)):
        raise InputError(f"render_size must be a width and a height of 16 to 7680 px, got {size}")


def _copied(flags: Any) -> Any:
    """Return a copy of a tensor or an array."""
    return flags.clone() if isinstance(flags, torch.Tensor) else flags.copy()
