"""Gait metrics: step frequency, swing height, contact patterns, torques and cost of transport."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jumper_warp.kernels.layout import BODIES
from jumper_warp.robot.description import LEGS
from jumper_warp.utils.metrics import Metrics, MetricValue


@dataclass
class GaitRecorder:
    """Recorder of the gait of all worlds (robots); call the object after every policy step.

    Lists have one array per sampled policy step; paws FL, FR, BL, BR.
    """

    env: Any  # The sampled `jumper_warp.envs.env.Env`
    skip: float = 2.0  # [s] Time at the start that is not sampled
    contact: list[np.ndarray] = field(default_factory=list)  # (robots, 4) Whether each paw is on the ground
    paw_height: list[np.ndarray] = field(default_factory=list)  # [m] (robots, 4) Height of paws above the ground
    force: list[np.ndarray] = field(default_factory=list)  # [N] (robots, 4) Upward force on paws
    torque: list[np.ndarray] = field(default_factory=list)  # [N m] (robots, 12) Motor torques
    power: list[np.ndarray] = field(default_factory=list)  # [W] (robots,) Sum of the positive powers of the motors
    speed: list[np.ndarray] = field(default_factory=list)  # [m/s] (robots,) Horizontal speed of the base
    steps: int = 0  # Number of policy steps so far, skipped ones included

    def __call__(self, *_: Any) -> None:
        """Append a sample of the gait, unless within `skip` of the start."""
        self.steps += 1
        if self.steps <= round(self.skip / self.env.step_dt):
            return
        robot, sim = self.env.robot, self.env.sim
        torque = robot.torque.numpy().T.astype(float)
        rate = sim.joint_qd()[:, [6 + 5 * leg + j for leg in range(4) for j in (0, 1, 3)]]  # motor joints
        self.contact.append(robot.contact_time.numpy().T > 0.0)
        self.paw_height.append(robot.paw_height.numpy().T.copy())
        self.force.append(sim.paw_force.numpy()[..., 2].T.copy())
        self.torque.append(torque)
        self.power.append(np.maximum(torque * rate, 0.0).sum(axis=1))
        self.speed.append(np.linalg.norm(sim.base_velocity()[:, :2], axis=1))

    def metrics(self, standing: np.ndarray) -> Metrics:
        """Return the gait metrics of the robots that have not fallen, {} if there are none.

        standing: (robots,) bool, the robots that have not fallen.
        """
        if not standing.any():
            return {}
        model = self.env.sim.model
        mass = model.body_mass.numpy().reshape(-1, int(BODIES)).sum(axis=1)
        weight = (mass * np.linalg.norm(model.gravity.numpy()[: len(mass)], axis=1))[standing]
        return gait_metrics(
            np.array(self.contact)[:, standing], np.array(self.paw_height)[:, standing],
            np.array(self.force)[:, standing], np.array(self.torque)[:, standing], np.array(self.power)[:, standing],
            np.array(self.speed)[:, standing], weight, self.env.step_dt,
        )  # fmt: skip


def gait_metrics(
    contact: np.ndarray, paw_height: np.ndarray, force: np.ndarray, torque: np.ndarray, power: np.ndarray,
    speed: np.ndarray, weight: np.ndarray, step_dt: float,
) -> Metrics:  # fmt: skip
    """Compute step frequency, swing height, contact patterns, torques and cost of transport of walks.

    The arrays are the lists of `GaitRecorder`, (steps, robots, ...).
    weight [N]: (robots,); step_dt [s]: policy step. The cost of transport is mean power / (weight * mean speed); None
    if a robot does not move. `share_down_<paws>` is the fraction of time in which exactly these paws touch the ground.
    """
    apexes = np.concatenate([np.zeros(0), *(swing_apexes(contact[:, i, k], paw_height[:, i, k])
                                           for i in range(contact.shape[1]) for k in range(4))])  # fmt: skip
    seconds, robots = len(contact) * step_dt, max(contact.shape[1], 1)
    touchdowns = int((contact[1:] & ~contact[:-1]).sum())
    transport = power.mean(axis=0)
    load, mean_speed = force.sum(axis=2) / weight, speed.mean(axis=0)
    metrics: dict[str, float | None] = {
        "steps_hz": touchdowns / (4.0 * robots * seconds),
        "swing_apex_median_m": float(np.median(apexes)) if len(apexes) else None,
        "cost_of_transport": float(np.mean(transport / (weight * mean_speed))) if mean_speed.min() > 0.05 else None,
        "speed_mean_m_s": float(speed.mean()),
        "torque_max_nm": float(np.abs(torque).max()),
        "torque_rms_nm": float(np.sqrt(np.mean(torque**2))),
        "paw_force_ripple": float(load.std(axis=0).mean()),
        "paw_force_max_n": float(force.max()),
    }
    codes = (contact * [1, 2, 4, 8]).sum(axis=2)  # one bit per paw
    fractions = np.bincount(codes.ravel(), minlength=16) / codes.size
    for code in np.argsort(-fractions, kind="stable"):
        if fractions[code] >= 0.005:
            paws = "_".join(leg for k, leg in enumerate(LEGS) if code >> k & 1) or "none"
            metrics[f"share_down_{paws}"] = float(fractions[code])
    return {key: MetricValue(value, contact.shape[1], None, "straight walks") for key, value in metrics.items()}


def swing_apexes(contact: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the largest height [m] in each complete swing of one paw, (swings,); contact, height [m]: (steps,)."""
    edges = np.diff(contact.astype(int))
    lifts, lands = np.flatnonzero(edges == -1) + 1, np.flatnonzero(edges == 1) + 1
    lands = lands[lands > lifts[0]] if len(lifts) else lands[:0]
    return np.array([height[a:b].max() for a, b in zip(lifts, lands, strict=False)])
