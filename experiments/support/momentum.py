"""Momentum of the robot, from its links."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jumper_warp.evaluation.log import Metrics
from jumper_warp.utils.rotations import INVERSE, rotate


def momentum(sim: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the links' linear [kg m/s] and angular momentum [kg m^2/s] about the robot's com, (num_worlds, 3) each.

    World axes. What the rotors spin at besides their links is left out: no link turns in answer to it.
    """
    mass, inertia, quat, arm, twist = _links(sim)
    linear = mass * twist[..., :3]
    own = np.einsum("nbij,nbj->nbi", inertia, rotate(quat * INVERSE, twist[..., 3:]))
    return linear.sum(axis=1), (np.cross(arm, linear) + rotate(quat, own)).sum(axis=1)


def rotational_inertia(sim: Any) -> np.ndarray:
    """Return the inertia [kg m^2] of the robot with locked joints about its com, world axes, (num_worlds, 3, 3)."""
    mass, inertia, quat, arm, _ = _links(sim)
    columns = []
    for axis in np.eye(3):
        own = np.einsum("nbij,nbj->nbi", inertia, rotate(quat * INVERSE, np.broadcast_to(axis, arm.shape)))
        spin = np.cross(arm, mass * np.cross(axis, arm)) + rotate(quat, own)
        columns.append(spin.sum(axis=1))
    return np.stack(columns, axis=-1)


def _links(sim: Any) -> tuple[np.ndarray, ...]:
    """Return of all links mass [kg], inertia [kg m^2], orientation (xyzw), arm [m] from the robot's com, and twist."""
    model, n = sim.model, sim.num_worlds
    sim.physics.write_bodies()
    frame = sim.state.body_q.numpy().reshape(n, -1, 7).astype(float)
    twist = sim.state.body_qd.numpy().reshape(n, -1, 6).astype(float)
    mass = model.body_mass.numpy().reshape(n, -1, 1).astype(float)
    inertia = model.body_inertia.numpy().reshape(n, -1, 3, 3).astype(float)
    com = frame[..., :3] + rotate(frame[..., 3:], model.body_com.numpy().reshape(n, -1, 3).astype(float))
    arm = com - (mass * com).sum(axis=1, keepdims=True) / mass.sum(axis=1, keepdims=True)
    return mass, inertia, frame[..., 3:], arm, twist


@dataclass
class MomentumRecorder:
    """Follows the momentum of all robots; call it after every policy step."""

    env: Any
    angular: list[np.ndarray] = field(default_factory=list)
    """[kg m^2/s] (num_envs, 3) after every policy step, world axes."""

    def __call__(self, *_: Any) -> None:
        """Add the moment."""
        self.angular.append(momentum(self.env.sim)[1])

    def metrics(self, apart: np.ndarray, inertia: np.ndarray) -> Metrics:
        """Return drifts of robots that did not come apart; inertia [kg m^2]: (num_envs, 3, 3) about the com."""
        drift = np.array(self.angular)[:, ~apart]
        turned = np.linalg.solve(inertia[~apart], drift.sum(axis=0)[..., None])[..., 0] * self.env.step_dt
        size, by = np.linalg.norm(drift, axis=-1), np.degrees(np.linalg.norm(turned, axis=-1))
        return {
            "max_angular_momentum_nm_s": float(size.max()),
            "mean_angular_momentum_at_end_nm_s": float(size[-1].mean()),
            "mean_turn_by_drift_deg": float(by.mean()),
            "max_turn_by_drift_deg": float(by.max()),
        }
