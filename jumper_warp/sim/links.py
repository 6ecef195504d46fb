"""Poses and velocities of all links of a running simulation."""

from __future__ import annotations

import numpy as np
import warp as wp

from jumper_warp.sim.simulation import Simulation


class LinkReader:
    """Reader of poses and twists of all links of a simulation, computed from the joint coordinates."""

    def __init__(self, sim: Simulation) -> None:
        """Allocate a state of the simulation's model for the poses and twists of the links."""
        self._sim, self._state = sim, sim.model.state()

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return pose (num_worlds, 21, 7) and twist (num_worlds, 21, 6) of every link, world frame.

        pose: position [m] and quaternion (xyzw); twist: velocity of the COM [m/s] and angular velocity [rad/s]. Waits
        for the device.
        """
        state, n = self._state, self._sim.num_worlds
        wp.copy(state.joint_q, self._sim.state.joint_q)
        wp.copy(state.joint_qd, self._sim.state.joint_qd)
        self._sim.physics.dynamics.full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)
        return state.body_q.numpy().reshape(n, -1, 7), state.body_qd.numpy().reshape(n, -1, 6)
