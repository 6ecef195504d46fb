"""Skills of the robot: its policies with the commands they observe, and when one may take over from another.

The rules are those of the simulation's skills (`kernels/skills/handovers.py`): a jump begins at rest, and walking
follows once the robot rests after landing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from jumper_warp.deploy.control import Gains
from jumper_warp.deploy.policy import LAST_ACTION, DeployedPolicy, JumpCommand
from jumper_warp.deploy.sensors import Estimate

SQUAT_STEPS = 30  # policy steps from a jump skill's begin to its command
STAND_TIME = 0.3  # [s] of contact of each paw of a standing robot
LANDED_STEPS, RECOVER_STEPS, NO_JUMP_STEPS = 18, 60, 150
"""Policy steps after landing before which a jump never ends, after which it ends, and after which it ends without one.
"""
SLEW_RATE = 1.25  # [m/s²], [rad/s²] of the commanded velocity
NUDGE_AFTER, NUDGE_STEPS, NUDGE = 120, 30, np.array([0.25, 0.0, 0.0])
"""A robot that waits for a jump without coming to rest walks every 120 policy steps, for 30, with this velocity."""


def rotate(quaternion: np.ndarray, vector: np.ndarray, *, inverse: bool = False) -> np.ndarray:
    """Return a vector (3,) rotated by a quaternion xyzw, or by its inverse."""
    a, b, c, w = quaternion.tolist()
    if inverse:
        w = -w
    x, y, z = vector.tolist()
    u, v, t = 2.0 * (b * z - c * y), 2.0 * (c * x - a * z), 2.0 * (a * y - b * x)
    return np.array([x + w * u + b * t - c * v, y + w * v + c * u - a * t, z + w * t + a * v - b * u])


class Motion:
    """Readings of a policy step that all skills share, and how long the paws have been down."""

    def __init__(self, switch: Mapping[str, float], dt: float) -> None:
        """Start without readings; dt: time between updates [s].

        switch: section of deploy.yaml, limits of a robot at rest near the default pose.
        """
        names = ("rest_speed", "rest_spin", "rest_tilt", "max_offset")  # [m/s], [rad/s], [rad], [rad]
        self.rest_speed, self.rest_spin, self.rest_tilt, self.max_offset = (float(switch[name]) for name in names)
        self.dt, self.stood = dt, 0.0  # [s] stood: for which all paws have been down

    def update(self, estimate: Estimate, gyro: np.ndarray, q: np.ndarray, qd: np.ndarray) -> None:
        """Take the state; gyro: (3,) [rad/s], q: (12,) [rad], qd: (12,) [rad/s]."""
        self.estimate, self.gyro, self.q, self.qd = estimate, gyro, q, qd
        self.gravity = rotate(estimate.quaternion, np.array([0.0, 0.0, -1.0]), inverse=True)
        self.velocity = rotate(estimate.quaternion, estimate.velocity, inverse=True)
        self.stood = self.stood + self.dt if estimate.contact.all() else 0.0

    @property
    def heading(self) -> np.ndarray:
        """Rotation (2, 2) of horizontal vectors from the robot's heading to the world."""
        x, y, _ = rotate(self.estimate.quaternion, np.array([1.0, 0.0, 0.0]))
        return np.array([[x, -y], [y, x]]) / np.hypot(x, y)

    @property
    def at_rest(self) -> bool:
        """Whether the robot stands still."""
        slow = np.linalg.norm(self.velocity) < self.rest_speed and np.linalg.norm(self.gyro) < self.rest_spin
        return bool(self.stood > STAND_TIME and slow and self.gravity[2] < -np.cos(self.rest_tilt))

    def readings(self) -> dict[str, Any]:
        """Return the readings of `DeployedPolicy.targets` that do not depend on the command.

        height: of the base, world z [m]; lin_vel [m/s], ang_vel [rad/s], gravity: (3,), body axes; angle [rad], rate
        [rad/s]: (12,).
        """
        return {
            "height": self.estimate.position[2], "lin_vel": self.velocity, "ang_vel": self.gyro,
            "gravity": self.gravity, "angle": self.q, "rate": self.qd,
        }  # fmt: skip


class Skill(ABC):
    """A policy with its gains; `targets` returns the filtered targets of a policy step."""

    def __init__(self, policy: DeployedPolicy, gains: Gains, ranges: Mapping[str, Any]) -> None:
        """Take the policy, its gains, and the lowest and highest value of each component of the command."""
        self.policy = policy
        limits = [*ranges.values(), *[(0.0, 0.0)] * 3][:3]
        self.lowest, self.highest = np.array(limits, dtype=float).T
        self.gains = gains
        self.done = False  # whether the skill has ended

    def begin(self, values: np.ndarray, motion: Motion, target: np.ndarray) -> None:
        """Start the skill; values: (3,) of the request; target: (12,) [rad] present motor targets.

        The last action is the one that yields these targets, as in `kernels/mdp/handover.py`.
        """
        self.policy.reset()
        self.policy.action = np.clip((target - self.policy.default) / self.policy.scale, -1.0, 1.0, dtype=np.float32)
        self.done = False

    def targets(self, motion: Motion) -> np.ndarray:
        """Return the motor targets [rad], (12,). Raises InputError: a reading is implausible or not finite."""
        readings = motion.readings() | self.command(motion)
        names = [name for name in self.policy.layout if name != LAST_ACTION]
        action = self.policy.act(self.policy.observe({name: readings[name] for name in names}))
        target = self.policy.default + self.policy.scale * action
        return self.policy.filter_targets(target, motion.q, motion.qd)

    @abstractmethod
    def command(self, motion: Motion) -> dict[str, Any]:
        """Return the readings of the command."""


class Walk(Skill):
    """Walking with a commanded velocity: ahead, left [m/s], about z [rad/s]."""

    def begin(self, values: np.ndarray, motion: Motion, target: np.ndarray) -> None:
        """Start with the velocity 0; values: commanded velocity (3,)."""
        super().begin(values, motion, target)
        self.velocity = np.zeros(3)
        self.wanted = np.array(values, dtype=float)
        self.waited = 0

    def command(self, motion: Motion) -> dict[str, Any]:
        """Return the commanded velocity, which changes at SLEW_RATE."""
        step = SLEW_RATE * self.policy.interface["policy_dt"]
        self.velocity = self.velocity + np.clip(self.wanted - self.velocity, -step, step)
        return {"command": self.velocity}

    def ready_to_jump(self, motion: Motion) -> bool:
        """Return whether a jump may take over; until then stand, and walk a few steps now and then."""
        self.waited += 1
        self.wanted = NUDGE * (self.waited >= NUDGE_AFTER and self.waited % NUDGE_AFTER < NUDGE_STEPS)
        near = np.abs(motion.q - self.policy.default).max() < motion.max_offset
        return bool(motion.at_rest and not self.velocity.any() and near)


class Jump(Skill):
    """Jump to a height (`wanted_height`) or to a place (`goal`)."""

    def begin(self, values: np.ndarray, motion: Motion, target: np.ndarray) -> None:
        """Start squatting; values: height of the base at the apex [m], or place ahead and left of the base [m]."""
        super().begin(values, motion, target)
        self.height = float(values[0])
        self.goal = motion.estimate.position[:2] + motion.heading @ values[:2]
        self.steps = 0
        self.landed = 0  # policy steps since landing
        self.phase = JumpCommand(0.25 if "goal" in self.policy.layout else 0.75)  # [m/s] as in training
        self.took_off = False

    def command(self, motion: Motion) -> dict[str, Any]:
        """Return the readings of the command, and update the phase of the jump."""
        if self.steps == SQUAT_STEPS:
            self.phase.request()
        velocity = float(np.clip(motion.estimate.velocity[2], -20.0, 20.0))
        flag = self.phase.update(velocity, int(motion.estimate.contact.sum()))
        self.took_off |= self.phase.in_flight
        commanded = self.steps >= SQUAT_STEPS
        self.steps += 1
        if self.took_off and not self.phase.in_flight:
            self.landed += 1
            tilted = motion.gravity[2] > -np.cos(0.35)
            over = motion.at_rest or tilted or self.landed >= RECOVER_STEPS
            self.done = self.landed >= LANDED_STEPS and over
        elif not self.took_off and self.steps >= NO_JUMP_STEPS:
            self.done = True
        way = self.goal - motion.estimate.position[:2] if commanded else np.zeros(2)
        return {"wanted_height": self.height, "jump_command": flag, "goal": way @ motion.heading}
