"""Momentum and rotational inertia of the robot, computed from its links."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.rotations import CONJUGATE, rotate


def momentum(sim: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Return the linear [kg m/s] and angular momentum [kg m^2/s] about the robot's COM, (num_worlds, 3) each.

    sim: a `Simulation`. World axes. The spin of rotors relative to their links, which turns no link, is not included.
    """
    mass, inertia, quat, arm, twist = _links(sim)
    linear = mass * twist[..., :3]
    spin = np.einsum("nbij,nbj->nbi", inertia, rotate(quat * CONJUGATE, twist[..., 3:]))
    return linear.sum(axis=1), (np.cross(arm, linear) + rotate(quat, spin)).sum(axis=1)


def rotational_inertia(sim: Simulation) -> np.ndarray:
    """Return the inertia [kg m^2] of the robot with locked joints about its COM, world axes, (num_worlds, 3, 3)."""
    mass, inertia, quat, arm, _ = _links(sim)
    columns = []
    for axis in np.eye(3):
        spin = np.einsum("nbij,nbj->nbi", inertia, rotate(quat * CONJUGATE, np.broadcast_to(axis, arm.shape)))
        angular = np.cross(arm, mass * np.cross(axis, arm)) + rotate(quat, spin)
        columns.append(angular.sum(axis=1))
    return np.stack(columns, axis=-1)


class LinkStates(NamedTuple):
    """Masses, poses and velocities of all links, (num_worlds, links, ...) each."""

    mass: np.ndarray  # (..., 1) [kg]
    inertia: np.ndarray  # (..., 3, 3) [kg m^2] about the link's COM, link axes
    quat: np.ndarray  # (..., 4) orientation, xyzw
    arm: np.ndarray  # (..., 3) [m] from the robot's COM to the link's COM, world axes
    twist: np.ndarray  # (..., 6) velocity of the COM [m/s] and angular velocity [rad/s], world axes


def _links(sim: Simulation) -> LinkStates:
    """Return the present state of all links of a `Simulation`; waits for the device."""
    model, n = sim.model, sim.num_worlds
    sim.write_bodies()
    pose = sim.state.body_q.numpy().reshape(n, -1, 7).astype(float)
    twist = sim.state.body_qd.numpy().reshape(n, -1, 6).astype(float)
    mass = model.body_mass.numpy().reshape(n, -1, 1).astype(float)
    inertia = model.body_inertia.numpy().reshape(n, -1, 3, 3).astype(float)
    com = pose[..., :3] + rotate(pose[..., 3:], model.body_com.numpy().reshape(n, -1, 3).astype(float))
    arm = com - (mass * com).sum(axis=1, keepdims=True) / mass.sum(axis=1, keepdims=True)
    return LinkStates(mass, inertia, pose[..., 3:], arm, twist)
