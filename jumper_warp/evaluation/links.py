"""Poses and velocities of all links of an environment's robots, on either solver."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env


class Links:
    """Reads all links, from base and motor coordinates; the simulation is left as it is."""

    def __init__(self, env: Env) -> None:
        """Allocate a state of the environment's model."""
        self._sim, self._state = env.sim, env.sim.model.state()

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return pose (num_envs, links, 7) and twist (num_envs, links, 6) of every link; waits for the device."""
        here, there = self._state, self._sim.state
        wp.copy(here.joint_q, there.joint_q)
        wp.copy(here.joint_qd, there.joint_qd)
        self._sim.physics.dynamics.full_state(here.joint_q, here.joint_qd, here.body_q, here.body_qd)
        n = self._sim.num_worlds
        return here.body_q.numpy().reshape(n, -1, 7), here.body_qd.numpy().reshape(n, -1, 6)
