"""Replay of recorded motor targets in parallel worlds with different robots and initial states, in double precision.

Finite differences of the motions give Jacobians; in single precision rounding would dominate them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import warp as wp

from jumper_warp.diff.rollout import Rollout
from jumper_warp.identification.initial_states import InitialStates
from jumper_warp.kernels import layout
from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.measures import motors_for
from jumper_warp.robot.model import build_model
from jumper_warp.robot.motors import MotorCfg, jumping_motors
from jumper_warp.robot.values import LINK_KINDS, RobotValues
from jumper_warp.sim.dynamics import WorldRange
from jumper_warp.utils.rotations import rotate
from jumper_warp.utils.threads import checked_threads

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # entries of packed second moments of mass
TOLERANCE = 1.0e-10  # [m/s] tolerance of the contact iteration, whose error finite differences of replays inherit


@dataclass
class Record:
    """True motions (without sensor errors) of N robots in a replay, R rows; motors by leg FL, FR, BL, BR."""

    angle: np.ndarray  # (R, 12, N) [rad] motor angles; of each leg lateral, outer, inner
    rate: np.ndarray  # (R, 12, N) [rad/s] motor rates
    torque: np.ndarray  # (R, 12, N) [N m] motor torques in the physics step after the row
    position: np.ndarray  # (R, 3, N) [m] of the base's origin, world frame
    quaternion: np.ndarray  # (R, 4, N) xyzw, base to world
    valid: np.ndarray  # (N,) bool, whether the world stayed finite; the other worlds stay at their first row


class MotionReplay:
    """Simulation of robots that follow recorded motor targets, in parallel worlds; keeps each `Rollout` for reuse."""

    def __init__(
        self, *, description: RobotDescription | None = None, device: wp.DeviceLike = None, threads: int | None = None
    ):
        """Store the robot, by default the project's, and the number of CPU threads for later simulations."""
        self.description = load_description() if description is None else description
        self.world_steps = 0  # Physics steps of all worlds so far
        self._device = device
        self._threads = checked_threads(threads)
        self._rollouts: dict[tuple[int, float], tuple[Rollout, np.ndarray]] = {}

    def run(
        self,
        robots: RobotValues,
        starts: InitialStates,
        target: np.ndarray,
        *,
        rows: int,
        stride: int,
        dt: float,
        lead: int = 0,
        base: Literal["free", "fixed"] = "free",
        gains: Literal["jumping", "walking"] = "jumping",
        torque_limit: float = 18.0,
    ) -> Record:
        """Simulate N robots from given initial states under the same motor targets, and return their motions.

        One world for each of `robots` and `starts`, without initial contact impulses. target: motor targets [rad], one
        row for each physics step of dt [s], (lead + steps, 12); the first `lead` are sent before the start; each acts
        after the latency. rows: number of rows, `stride` physics steps apart; row 0 is the start. base: "fixed" holds
        the base at its initial pose. gains: of the described motors, which the ratios of `robots` scale. torque_limit
        [N m]: of all described motors, at most their peak torque; scaled by the ratios of `robots` to the description.
        """
        # the last row's torques take one more step
        count = len(starts.angle)
        steps = (rows - 1) * stride + 1
        rollout, nominal = self._rollout(count, dt)
        motors = MotorCfg.from_description(self.description, gains, np.inf, np.inf)  # saturated at the peak torques
        shares = [min(1.0, torque_limit / motor.peak_torque) for motor in self.description.motors]
        write_motors(rollout.parameters, motors, replace(robots, saturation=robots.saturation * shares))
        rollout.parameters["table"].assign(parameter_table(nominal, robots))
        rollout.hold(base == "fixed")
        com_velocity = starts.velocity + np.cross(starts.spin, rotate(starts.quaternion, robots.base_com))
        q = np.concatenate([starts.position, starts.quaternion, starts.angle], axis=1)
        qd = np.concatenate([com_velocity, starts.spin, starts.rate], axis=1)
        arrived = delayed_targets(target, robots.latency[:, 0] / dt, lead, steps)
        trajectory = rollout.run(*(rollout.array(np.ascontiguousarray(values)) for values in (arrived, q.T, qd.T)))
        self.world_steps += count * (steps - 1)
        q, qd, torque = (getattr(trajectory, name).numpy()[:steps:stride] for name in ("q", "qd", "torque"))
        valid = np.isfinite(q).all(axis=(0, 1)) & np.isfinite(qd).all(axis=(0, 1))
        for values in (q, qd, torque):  # a world that diverges stays at its start
            values[..., ~valid] = values[:1, ..., ~valid]
        return Record(q[:, 7:], qd[:, 6:], torque, q[:, :3], q[:, 3:7], valid)

    def _rollout(self, count: int, dt: float) -> tuple[Rollout, np.ndarray]:
        """Return the cached simulation of `count` worlds, and the described robot's parameter table, (321, 1)."""
        if (count, dt) not in self._rollouts:
            model = build_model(count, description=self.description, visuals=False, device=self._device)
            motors = motors_for(jumping_motors(), self.description)  # `run` replaces all but the over-speed protection
            rollout = Rollout(
                model, description=self.description, double=True, dt=dt, substeps=1, tolerance=TOLERANCE,
                motors=motors, threads=self._threads,
            )  # fmt: skip
            parts = max(1, min(self._threads, count // 4))  # slices smaller than a simulation's pay off here
            edges = [round(count * i / parts) for i in range(parts + 1)]
            rollout.slices = [WorldRange(a, b - a) for a, b in itertools.pairwise(edges)]
            self._rollouts[count, dt] = rollout, rollout.parameters["table"].numpy()[:, :1].copy()
        return self._rollouts[count, dt]


def delayed_targets(target: np.ndarray, latency: np.ndarray, lead: int, steps: int) -> np.ndarray:
    """Return the motor targets that act in each physics step, delayed by the latency of each robot, (steps, 12, N).

    target: sent targets (S, 12). latency: (N,) [physics steps], may be fractional: a step uses the mean target over its
    duration, which is continuous in the latency. lead: rows of `target` before the first step.
    """
    delay, world = np.unique(latency, return_inverse=True)
    whole = np.floor(delay).astype(int)
    part = delay - whole
    newest = lead + np.arange(steps)[:, None] - whole
    newer, older = (target[np.clip(newest - i, 0, len(target) - 1)] for i in (0, 1))
    return np.swapaxes((1.0 - part)[:, None] * newer + part[:, None] * older, 1, 2)[..., world]


def write_motors(parameters: dict[str, wp.array], motors: MotorCfg, robots: RobotValues) -> None:
    """Write gains, limits and sensor offsets of N robots' motors to the parameters of a rollout, (12, N) each.

    Gains, torque limits and peak torques of `robots` are factors on those of `motors`; speeds and offsets are values.
    """
    kinds = [motors.lateral, motors.transversal, motors.transversal] * 4
    for name in ("kp", "kd", "saturation", "peak"):
        parameters[name].assign(np.array([getattr(kind, name) for kind in kinds])[:, None] * getattr(robots, name).T)
    for name in ("no_load_speed", "cutoff_speed", "offset"):
        parameters[name].assign(np.ascontiguousarray(getattr(robots, name).T))


def parameter_table(nominal: np.ndarray, robots: RobotValues) -> np.ndarray:
    """Return masses, joints and friction of N robots as the table that the kernels read, (321, N).

    Rows as in `kernels.layout`; nominal: as described, (321, 1). A link's moments are mass, first and second moment
    about its origin: all scale with its mass. For the base, second moments about its centre of mass scale with the mass
    and with `base_inertia`, and are then shifted to the origin.
    """
    table = np.repeat(nominal, len(robots.base_mass), axis=1)
    mass = robots.base_mass[:, 0]
    com = robots.base_com.T
    nominal_mass = table[layout.BASE]
    nominal_moment = table[layout.BASE + 1 : layout.BASE + 4]
    for row, (i, j) in enumerate(PAIRS, int(layout.BASE) + 4):
        central = table[row] - nominal_moment[i] * nominal_moment[j] / nominal_mass
        table[row] = central * robots.base_inertia[:, 0] * mass / nominal_mass + mass * com[i] * com[j]
    table[layout.BASE] = mass
    table[layout.BASE + 1 : layout.BASE + 4] = mass * com
    for leg in range(4):
        rows = table[leg * int(layout.LEG_ROWS) : (leg + 1) * int(layout.LEG_ROWS)]
        motors = slice(3 * leg, 3 * leg + 3)
        for link in range(len(LINK_KINDS)):
            rows[link * layout.MOMENT_ROWS : (link + 1) * layout.MOMENT_ROWS] *= robots.link_mass[:, link]
        rows[layout.ARMATURE : layout.ARMATURE + 3] = robots.armature[:, motors].T
        rows[layout.FRICTION : layout.FRICTION + 3] = robots.motor_friction[:, motors].T
        rows[layout.KNEE_DAMPING : layout.KNEE_DAMPING + 2] = robots.knee_damping[:, 0]
        rows[[layout.MU_DYNAMIC, layout.MU_STATIC]] = robots.paw_friction[:, 0]
        rows[layout.SPRING], rows[layout.SPRING + 1] = robots.spring_stiffness[:, 0], robots.spring_length[:, 0]
    return table
