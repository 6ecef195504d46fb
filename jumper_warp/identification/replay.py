"""Recorded targets replayed in many worlds, each with parameters and a start of its own, in double precision."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
import warp as wp

from jumper_warp.diff.bodies import PAIRS
from jumper_warp.diff.rollout import Rollout
from jumper_warp.kernels import layout
from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.model import build_model
from jumper_warp.robot.motors import MotorCfg
from jumper_warp.robot.values import LINK_KINDS, RobotValues
from jumper_warp.sim.slices import WorldRange
from jumper_warp.utils.rotations import rotate
from jumper_warp.utils.threads import checked_threads

TOLERANCE = 1.0e-10
"""[m/s] Of the contact iteration, whose error differences inherit."""


@dataclass
class Starts:
    """States at the first row, N worlds."""

    position: np.ndarray
    """(N, 3) [m] Of the base's origin, world frame."""
    quaternion: np.ndarray
    """(N, 4) xyzw."""
    velocity: np.ndarray
    """(N, 3) [m/s] Of the base's origin, world frame."""
    spin: np.ndarray
    """(N, 3) [rad/s] World frame."""
    angle: np.ndarray
    """(N, 12) [rad] True motor angles."""
    rate: np.ndarray
    """(N, 12) [rad/s]"""


@dataclass
class Record:
    """What happens in a replay: R rows, N worlds. True values, without the errors of sensors."""

    angle: np.ndarray
    """(R, 12, N) [rad]"""
    rate: np.ndarray
    """(R, 12, N) [rad/s]"""
    torque: np.ndarray
    """(R, 12, N) [N m]"""
    position: np.ndarray
    """(R, 3, N) [m]"""
    quaternion: np.ndarray
    """(R, 4, N) xyzw"""
    valid: np.ndarray
    """(N,) bool, whether the world stayed finite."""


class Replay:
    """Worlds that replay motor targets: a `Rollout` for each number of worlds and physics step, made at first use."""

    def __init__(
        self, *, description: RobotDescription | None = None, device: wp.DeviceLike = None, threads: int | None = None
    ):
        """Prepare; threads: of a CPU."""
        self.description = load_description() if description is None else description
        self.world_steps = 0
        """Physics steps of all worlds up to here."""
        self._device, self._threads = device, checked_threads(threads)
        self._rollouts: dict[tuple[int, float], tuple[Rollout, np.ndarray]] = {}

    def run(
        self,
        robots: RobotValues,
        starts: Starts,
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
        """Return what N worlds do, `robots` and `starts` of each, without contact history.

        target: motor targets [rad] of every physics step of dt [s], (lead + steps, 12), held from step to step; a
        latency asks for `lead` steps before the start. rows: to record, `stride` physics steps apart; row 0 is the
        start. base: "fixed" holds the base where it starts. gains, torque_limit [N m]: of the description, which the
        ratios of `robots` scale.
        """
        count, steps = len(starts.angle), (rows - 1) * stride + 1  # the last row's torques take one more step
        rollout, nominal = self._rollout(count, dt)
        motors = MotorCfg.from_description(self.description, gains, torque_limit, torque_limit)
        write_motors(rollout.parameters, motors, robots)
        rollout.parameters["table"].assign(parameter_table(nominal, robots))
        rollout.hold(base == "fixed")
        com_velocity = starts.velocity + np.cross(starts.spin, rotate(starts.quaternion, robots.base_com))
        q = np.concatenate([starts.position, starts.quaternion, starts.angle], axis=1)
        qd = np.concatenate([com_velocity, starts.spin, starts.rate], axis=1)
        aim = delayed(target, robots.latency[:, 0] / dt, lead, steps)
        made = rollout.run(*(rollout.array(np.ascontiguousarray(values)) for values in (aim, q.T, qd.T)))
        self.world_steps += count * (steps - 1)
        q, qd, torque = (getattr(made, name).numpy()[:steps:stride] for name in ("q", "qd", "torque"))
        valid = np.isfinite(q).all(axis=(0, 1)) & np.isfinite(qd).all(axis=(0, 1))
        for values in (q, qd, torque):  # a world that breaks stays at its start
            values[..., ~valid] = values[:1, ..., ~valid]
        return Record(q[:, 7:], qd[:, 6:], torque, q[:, :3], q[:, 3:7], valid)

    def _rollout(self, count: int, dt: float) -> tuple[Rollout, np.ndarray]:
        """Return the worlds, and the parameter table of the described robot, (321, 1)."""
        if (count, dt) not in self._rollouts:
            model = build_model(count, description=self.description, visuals=False, device=self._device)
            rollout = Rollout(
                model, description=self.description, double=True, dt=dt, substeps=1, tolerance=TOLERANCE,
                threads=self._threads,
            )  # fmt: skip
            parts = max(1, min(self._threads, count // 4))  # threads pay for fewer worlds than in a simulation
            edges = [round(count * i / parts) for i in range(parts + 1)]
            rollout.slices = [WorldRange(a, b - a) for a, b in itertools.pairwise(edges)]
            self._rollouts[count, dt] = rollout, rollout.parameters["table"].numpy()[:, :1].copy()
        return self._rollouts[count, dt]


def delayed(target: np.ndarray, latency: np.ndarray, lead: int, steps: int) -> np.ndarray:
    """Return what motors follow in each step, (steps, 12, N): the mean over the step of the late targets (S, 12).

    latency [steps], (N,), any fraction, so that targets are continuous in it; lead: steps of `target` before the first.
    """
    late, world = np.unique(latency, return_inverse=True)
    whole = np.floor(late).astype(int)
    part = late - whole
    newest = lead + np.arange(steps)[:, None] - whole
    newer, older = (target[np.clip(newest - i, 0, len(target) - 1)] for i in (0, 1))
    return np.swapaxes((1.0 - part)[:, None] * newer + part[:, None] * older, 1, 2)[..., world]


def write_motors(parameters: dict[str, wp.array], motors: MotorCfg, robots: RobotValues) -> None:
    """Write the constants of the motors of N robots."""
    kinds = [motors.lateral, motors.transversal, motors.transversal] * 4
    ratios = {"kp": robots.kp, "kd": robots.kd, "saturation": robots.saturation, "peak": np.ones_like(robots.kp)}
    for name, ratio in ratios.items():
        parameters[name].assign(np.array([getattr(kind, name) for kind in kinds])[:, None] * ratio.T)
    for name in ("no_load_speed", "cutoff_speed", "offset"):
        parameters[name].assign(np.ascontiguousarray(getattr(robots, name).T))


def parameter_table(nominal: np.ndarray, robots: RobotValues) -> np.ndarray:
    """Return the parameter table of N robots, (321, N); nominal: of the described one, (321, 1)."""
    table = np.repeat(nominal, len(robots.base_mass), axis=1)
    mass, com = robots.base_mass[:, 0], robots.base_com.T
    old_mass, old_first = table[layout.BASE], table[layout.BASE + 1 : layout.BASE + 4]
    for row, (i, j) in enumerate(PAIRS, int(layout.BASE) + 4):
        central = table[row] - old_first[i] * old_first[j] / old_mass
        table[row] = central * robots.base_inertia[:, 0] * mass / old_mass + mass * com[i] * com[j]
    table[layout.BASE], table[layout.BASE + 1 : layout.BASE + 4] = mass, mass * com
    for leg in range(4):
        rows, motors = table[leg * int(layout.LEG_ROWS) : (leg + 1) * int(layout.LEG_ROWS)], slice(3 * leg, 3 * leg + 3)
        for link in range(len(LINK_KINDS)):
            rows[link * layout.MOMENT_ROWS : (link + 1) * layout.MOMENT_ROWS] *= robots.link_mass[:, link]
        rows[layout.ARMATURE : layout.ARMATURE + 3] = robots.armature[:, motors].T
        rows[layout.FRICTION : layout.FRICTION + 3] = robots.motor_friction[:, motors].T
        rows[layout.KNEE_DAMPING : layout.KNEE_DAMPING + 2] = robots.knee_damping[:, 0]
        rows[[layout.MU_DYNAMIC, layout.MU_STATIC]] = robots.paw_friction[:, 0]
        rows[layout.SPRING], rows[layout.SPRING + 1] = robots.spring_stiffness[:, 0], robots.spring_length[:, 0]
    return table
