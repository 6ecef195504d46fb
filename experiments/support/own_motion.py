"""Identification of a changed robot from the motion of one jump: added mass, friction, gravity and torque limits.

Every policy step of the recorded motion begins a short simulation from the recorded state. Least squares fit its end to
the recorded one by Gauss-Newton, with finite differences: all windows and robots are worlds of one rollout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import warp as wp

from jumper_warp.diff.rollout import Rollout
from jumper_warp.envs.env import Env
from jumper_warp.kernels.layout import BASE, GRAVITY, LEG_ROWS, MU_DYNAMIC, MU_STATIC
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.model import PHYSICS_DT, build_model
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.utils.rotations import from_rotation_vector, multiply

WINDOW = 3  # Policy steps of a simulation
WINDOWS = 60  # Number of windows of each robot, from the first steps of its motion at most
PRIOR = np.array([3.0, 0.7, 3.0, *(12 * (0.4,))])  # Standard deviations: kg, ln, m/s^2, ln
NOISE = np.repeat([0.002, 0.005, 0.005, 0.03, 0.1, 0.3], [3, 4, 12, 3, 3, 12])[:, None]
"""Standard deviations of errors that count as noise: position [m], quaternion, motor angles [rad], and their rates."""
MEASURED = np.repeat([0.005, 0.025, 0.052, 0.1, 0.1, 0.175], [3, 4, 12, 3, 3, 12])[:, None]
"""Standard deviations of the noise of measured states, as in `jumper_warp.tasks.observations`."""
MEASURED_NOISE = np.hypot(NOISE, MEASURED * np.repeat([0.3, 0.5, 1.0], [19, 6, 12])[:, None])  # after `measured`
OUTLIER = 3.0  # Error over the noise from which an error counts linearly: contacts that begin at another time
ITERATIONS = 5
DIFFERENCE = 1.0e-2  # Of a parameter, in standard deviations of its prior


@dataclass
class Record:
    """Recorded motion of robots, a row per policy step; the last axis of arrays is the robot."""

    q: list[np.ndarray] = field(default_factory=list)  # (19, n) as in `Trajectory`
    qd: list[np.ndarray] = field(default_factory=list)  # (18, n)
    initial_target: list[np.ndarray] = field(default_factory=list)  # (steps, 12, n) [rad]
    target: list[np.ndarray] = field(default_factory=list)  # (12, n) [rad] before the command filter
    running: list[np.ndarray] = field(default_factory=list)  # (n,) whether the robot has not failed before


@dataclass
class RobotChange:
    """Identified changes of n robots."""

    theta: np.ndarray
    """(15, n) Added mass [kg], ln of the factor on friction, added gravity [m/s^2], ln of factors on torque limits."""

    def means(self) -> dict[str, float]:
        """Return means over the robots by name and unit."""
        mass, friction, gravity, *torque = self.theta.mean(1)
        return {"added_mass_kg": mass, "friction_factor": float(np.exp(friction)), "gravity_m_s2": EARTH + gravity,
                "smallest_torque_factor": float(np.exp(min(torque)))}  # fmt: skip


def recorder_of(env: Env, act: Callable) -> tuple[Record, Callable]:
    """Return a record, and a function that acts as `act` and adds a row to it."""
    record = Record()
    lateral, transversal = np.radians(env.task.action_scale)
    scale = np.tile([lateral, transversal, transversal], 4)[:, None]
    failed = np.zeros(env.num_envs, dtype=bool)

    def acting(obs: torch.Tensor) -> torch.Tensor:
        """Return the actions, and record the state before them."""
        nonlocal failed
        robots = env.snapshot()
        action = act(obs)
        for name in ("q", "qd", "initial_target"):
            getattr(record, name).append(getattr(robots, name).cpu().numpy().copy())
        default = robots.default_angle.cpu().numpy()[:, None]
        record.target.append(default + scale * action.clamp(-1.0, 1.0).cpu().numpy().T)
        failed = failed | (env.task_arrays()["termination"] >= 0)
        record.running.append(~failed)
        return action

    return record, acting


def averaged(values: np.ndarray, moved: np.ndarray, near: int) -> np.ndarray:
    """Return values (steps, ...) averaged over `near` steps before and after; moved: their motion since the start."""
    still = values - moved
    return moved + np.stack([still[max(0, i - near) : i + near + 1].mean(0) for i in range(len(still))])


def measured(record: Record, rng: np.random.Generator) -> Record:
    """Return a copy of a record whose states have the noise of the policy's observation, and are smoothed.

    Measured velocities tell how positions and angles move between policy steps, so these can be averaged.
    """
    q, qd = np.array(record.q), np.array(record.qd)
    noise = MEASURED * rng.standard_normal((len(q), len(MEASURED), q.shape[2]))
    turned = multiply(from_rotation_vector(2.0 * noise[:, 3:6].mT), q[:, 3:7].mT).mT
    q = np.concatenate([q[:, :3] + noise[:, :3], turned, q[:, 7:] + noise[:, 7:19]], axis=1)
    qd += noise[:, 19:]
    spin = np.pad(qd[:, 3:6], ((0, 0), (0, 1), (0, 0)))
    rates = np.concatenate([qd[:, :3], 0.5 * multiply(spin.mT, q[:, 3:7].mT).mT, qd[:, 6:]], axis=1)
    q = averaged(q, PHYSICS_DT * SUBSTEPS * (np.cumsum(rates, 0) - 0.5 * rates), 8)
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    qd[:, :6] = averaged(qd[:, :6], np.zeros_like(qd[:, :6]), 1)
    return replace(record, q=list(q), qd=list(qd))


def changed_columns(table: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Return the columns of a parameter table (rows, n) with changes theta (15, n) of robots."""
    changed = table.copy()
    changed[int(BASE)] += theta[0]
    for leg in range(4):
        for row in (int(MU_DYNAMIC), int(MU_STATIC)):
            changed[leg * int(LEG_ROWS) + row] *= np.exp(theta[1])
    changed[int(GRAVITY) + 2] -= theta[2]
    return changed


def write_changes(env: Env, change: RobotChange) -> None:
    """Apply changes to the robots of an environment, one column each."""
    table = wp.to_torch(env.sim.dynamics.robot.table)
    table.copy_(torch.as_tensor(changed_columns(table.cpu().numpy(), change.theta)))
    saturation = wp.to_torch(env.sim.motors.saturation)
    saturation.mul_(torch.as_tensor(np.exp(change.theta[3:]), dtype=saturation.dtype))


def identify(record: Record, nominal: Env, rng: np.random.Generator | None = None) -> RobotChange:
    """Return the changes of the recorded robots from the nominal ones of an environment of as many robots.

    rng: of the noise with which the motion is measured (default: it is exact).
    """
    record, noise = (record, NOISE) if rng is None else (measured(record, rng), MEASURED_NOISE)
    robots = nominal.snapshot()
    n = nominal.num_envs
    steps = len(record.q) - WINDOW
    first = np.arange(20, steps)
    first = first[np.linspace(0, len(first) - 1, min(WINDOWS, len(first))).astype(int)]
    worlds = n * len(first)
    task = nominal.task
    rollout = Rollout(build_model(worlds, visuals=False, device="cpu"), task.motors, task.command_filter)
    table = np.repeat(robots.parameters["table"].cpu().numpy(), len(first), axis=1)
    saturation = np.repeat(robots.parameters["saturation"].cpu().numpy(), len(first), axis=1)

    def at(rows: list[np.ndarray], later: int = 0) -> np.ndarray:
        """Return recorded arrays of all robots' windows, (values, robots * windows)."""
        return np.stack([rows[i + later] for i in first], axis=-1).reshape(*rows[0].shape[:-1], -1)

    q, qd, initial_target = (at(rows) for rows in (record.q, record.qd, record.initial_target))
    targets = np.stack([at(record.target, i) for i in range(WINDOW)])
    ends = np.concatenate([at(record.q, WINDOW), at(record.qd, WINDOW)])
    counts = np.stack([record.running[i + WINDOW] for i in first], axis=-1).reshape(-1)

    def residuals(theta: np.ndarray) -> np.ndarray:
        """Return errors over the noise, (37, n, windows)."""
        wide = np.repeat(theta, len(first), axis=1)
        rollout.parameters["table"].assign(changed_columns(table, wide).astype(np.float32))
        rollout.parameters["saturation"].assign((saturation * np.exp(wide[3:])).astype(np.float32))
        motion = rollout.run(targets, q, qd, initial_target=initial_target)
        found = np.concatenate([motion.q.numpy()[-1], motion.qd.numpy()[-1]])
        error = np.nan_to_num((found - ends) / noise) * counts
        return error.reshape(len(error), n, len(first))

    theta = np.zeros((len(PRIOR), n))
    for _ in range(ITERATIONS):
        error = residuals(theta)
        weight = np.sqrt(np.minimum(1.0, OUTLIER / np.maximum(np.abs(error), 1.0e-9)))
        rows = []
        for i, scale in enumerate(PRIOR):
            moved = theta.copy()
            moved[i] += DIFFERENCE * scale
            rows.append((residuals(moved) - error) / DIFFERENCE)
        jacobian = np.stack(rows) * weight
        normal = np.einsum("ijnw,kjnw->nik", jacobian, jacobian) + np.eye(len(PRIOR))
        right = np.einsum("ijnw,jnw->ni", jacobian, error * weight) + (theta / PRIOR[:, None]).T
        step = np.linalg.solve(normal, right[..., None])[..., 0].T
        theta = theta - np.clip(step, -1.0, 1.0) * PRIOR[:, None]
    return RobotChange(theta)
