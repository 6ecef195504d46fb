"""Samples of the start states of jumps, for tests of resets."""

from functools import cached_property

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from collision_kernels import make_collision_kernel
from columns import LIN_VEL, POS
from jump_helpers import START_MODES, begin_by, edit_episodes, episodes_of, only, resets_of
from jumper_warp.envs.env import Env
from solver_helpers import Reference, States

PLACES = ("horizontal-jump", "horizontal-jump-standing")  # Names of the tasks of jumps to landing positions
PAW_RADIUS = 0.025  # [m]


class Starts:
    """Start states of one start mode, with the levels spread over the worlds; exact: starts are at the origin."""

    def __init__(self, env: Env, start_mode: str, exact: bool = False, **settings):
        """Reset an environment; settings: other fields of its reset settings."""
        settings |= {"base_xy": 0.0} if exact else {}
        begin_by(env, only(start_mode, resets_of(env), **settings))
        self.level = np.arange(env.num_envs) % len(env.task.levels)
        edit_episodes(env, level=self.level)
        env.reset()
        episodes = episodes_of(env)
        drawn = episodes["start_mode"] == START_MODES.index(start_mode)
        self.drawn, self.fallbacks = drawn, 1.0 - drawn.mean()
        self.flags = collision_flags(env)
        self.episodes = {name: values[drawn].astype(float) for name, values in episodes.items()}
        self.q, self.qd = env.sim.joint_q()[drawn].astype(float), env.sim.joint_qd()[drawn].astype(float)
        self.level = self.level[drawn]
        self.pos, self.vel = self.q[:, POS], self.qd[:, LIN_VEL]
        self.heading = Rotation.from_euler("z", self.episodes["heading"][:, None])
        self.goal = self.episodes["goal"] * [1.0, 1.0, 0.0]
        self.distance = np.linalg.norm(self.goal, axis=1)
        self.along = self.goal / self.distance[:, None]
        self._model = env.sim.model

    @cached_property
    def paws(self) -> np.ndarray:
        """Return the centres of the paws FL, FR, BL, BR [m], world frame, (selected worlds, 4, 3)."""
        return paws_of(self._model, self.q, self.qd)

    def some_paws(self, chosen: np.ndarray, most: int) -> np.ndarray:
        """Return `paws` of at most the first `most` worlds of those chosen; chosen: bool, by world."""
        worlds = np.flatnonzero(chosen)[:most]
        return paws_of(self._model, self.q[worlds], self.qd[worlds])

    def split(self, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the components of horizontal vectors (worlds, 3) towards the goal and to its left, (worlds,)."""
        left = np.cross([0.0, 0.0, 1.0], self.along)
        return np.sum(vectors * self.along, axis=1), np.sum(vectors * left, axis=1)

    def paws_around(self, spot: np.ndarray) -> np.ndarray:
        """Return the paws relative to positions [m], (worlds, 3), in the jump's heading, mirrored to front left."""
        relative = self.paws - spot[:, None]
        rotated = np.stack([self.heading.inv().apply(relative[:, leg]) for leg in range(4)], axis=1)
        return rotated * np.array([[1, 1, 1], [1, -1, 1], [-1, 1, 1], [-1, -1, 1]])


def paws_of(model, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return the paw positions [m] by Pinocchio, (worlds, 4, 3), of rows of joint_q and joint_qd."""
    return paws_and_velocities_of(model, q, qd)[0]


def paws_and_velocities(env: Env, worlds: np.ndarray) -> np.ndarray:
    """Return positions [m] and velocities [m/s] of the paws of some worlds by Pinocchio, (2, worlds, 4, 3)."""
    return paws_and_velocities_of(env.sim.model, env.sim.joint_q()[worlds], env.sim.joint_qd()[worlds])


def paws_and_velocities_of(model, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return positions [m] and velocities [m/s] of the paws by Pinocchio, (2, worlds, 4, 3)."""
    reference, states = Reference(model), States.read(q, qd)
    paws = np.zeros((2, len(q), 4, 3))
    for i in range(len(q)):
        configuration, v = reference.state(states, i)
        paws[:, i] = reference.robot.paw_positions(configuration), reference.robot.paw_velocities(configuration, v)
    return paws


def collision_flags(env: Env) -> np.ndarray:
    """Return the collision flags of every world, (num_envs,)."""
    flags, clearance = (wp.zeros(env.num_envs, dtype=kind, device="cpu") for kind in (int, float))
    robot = env.sim.dynamics.robot
    inputs = [robot.geometry, robot.ground, env.sim.state.joint_q, 43, 0.0]
    wp.launch(make_collision_kernel(), env.num_envs, inputs, [flags, clearance], device="cpu")
    return flags.numpy()


def covers(values: np.ndarray, lower: float, upper: float, reach: float = 0.03) -> bool:
    """Return whether values stay within a range and come within a share `reach` of both its ends."""
    width = upper - lower
    inside = values.min() >= lower - 2e-4 and values.max() <= upper + 2e-4
    return inside and values.min() <= lower + reach * width and values.max() >= upper - reach * width
