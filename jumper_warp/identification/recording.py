"""Motions for identification: targets drawn at random, carried out by simulated robots, and measured with noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import warp as wp

from jumper_warp.identification.motions import DEGREES, Motion, NoiseLevels
from jumper_warp.identification.replay import Record, Replay, Starts
from jumper_warp.identification.stance import HANGING_HEIGHT, stance
from jumper_warp.robot.description import load_description
from jumper_warp.robot.motors import MotorCfg
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.simulation import Simulation, SolverName, motor_values
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.rotations import from_rotation_vector, multiply

Kind = Literal["hung chirp", "standing chirp", "small jump"]
KINDS: tuple[Kind, ...] = ("hung chirp", "hung chirp", "standing chirp", "small jump")
"""One set of motions."""
TICK = 1.0 / 60.0
"""[s] From target to target."""
SAMPLES = 4
"""Rows of a motion in a tick: 240 Hz."""
REST = 0.75
"""[s] In which a robot comes to rest in the first pose before a motion is recorded."""
HELD = 1.0e4
"""[kg] Of a base that is held in a simulation, which puts it back after each step."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Targets for a motion."""

    kind: Kind
    target: np.ndarray
    """(ticks, 12) [rad]"""
    torque_limit: float
    """[N m]"""

    @property
    def base(self) -> Literal["free", "fixed"]:
        """Whether the robot stands, or hangs from a stand."""
        return "fixed" if self.kind == "hung chirp" else "free"

    @property
    def rows(self) -> np.ndarray:
        """Targets of the rows at 240 Hz, (SAMPLES ticks, 12)."""
        return np.repeat(self.target, SAMPLES, axis=0)


def plot_plan(kind: Kind, rng: np.random.Generator, seconds: float = 1.25, torque_limit: float = 12.0) -> Plan:
    """Return a random plan of a kind."""
    ticks = round(seconds / TICK)
    if ticks < 30 or not seconds < 60.0:
        raise InputError(f"a motion must take 0.5 to 60 s, got {seconds:g}")
    if kind == "small jump":
        target = jump_targets(ticks, rng)
    elif kind in ("hung chirp", "standing chirp"):
        target = chirp_targets(ticks, rng, hung=kind == "hung chirp")
    else:
        raise InputError(f"no kind of motion {kind!r:.60}; there are {', '.join(dict.fromkeys(KINDS))}")
    return Plan(kind, target * DEGREES, torque_limit)


def chirp_targets(ticks: int, rng: np.random.Generator, hung: bool) -> np.ndarray:
    """Return targets [deg] that swing faster and faster, each motor in its own phase; paws on the ground keep still."""
    time = TICK * np.arange(ticks)
    slow, fast = rng.uniform(0.3, 0.8), rng.uniform(5.0, 9.0) if hung else rng.uniform(2.5, 4.5)
    turns = slow * time + 0.5 * (fast - slow) * time**2 / time[-1]
    middle = rng.uniform(40.0, 55.0) if hung else rng.uniform(45.0, 60.0)
    target = np.zeros((ticks, 12))
    begin = np.minimum(time / 0.1, 1.0)  # from rest
    for motor in range(12):
        lateral = motor % 3 == 0
        size = (rng.uniform(6.0, 11.0) if lateral else rng.uniform(9.0, 15.0)) if hung else (
            rng.uniform(2.0, 5.0) if lateral else rng.uniform(5.0, 10.0),
        )  # fmt: skip
        pace = rng.uniform(0.8, 1.2) if hung else 1.0
        wave = np.sin(2.0 * math.pi * (pace * turns + rng.uniform()))
        target[:, motor] = (0.0 if lateral else middle) + size * begin * wave
    return target


def jump_targets(ticks: int, rng: np.random.Generator) -> np.ndarray:
    """Return targets [deg] of a squat, a push-off and a landing, each leg a little different."""
    squat, push, land = rng.uniform(75.0, 95.0), rng.uniform(5.0, 25.0), rng.uniform(50.0, 65.0)
    down, hold, up = 22, rng.integers(6, 12), rng.integers(9, 13)
    target = np.zeros((ticks, 12))
    for tick in range(ticks):
        if tick < down + hold:
            angle = 45.0 + (squat - 45.0) * min(1.0, tick / down)
        else:
            angle = push if tick < down + hold + up else land
        target[tick] = np.tile([0.0, angle, angle], 4)
    spread = rng.uniform(-3.0, 3.0, 12)
    return target + spread * np.minimum(np.arange(ticks) / down, 1.0)[:, None]


def start_of(replay: Replay, plan: Plan, robots: RobotValues) -> Starts:
    """Return the pose of the first targets, at rest, paws on the ground or the base held."""
    angle, rest = plan.target[:1] - robots.offset, np.zeros((1, 12))
    height, quaternion = HANGING_HEIGHT, np.array([[0.0, 0.0, 0.0, 1.0]])
    if plan.base == "free":
        height = stance(replay.description, angle, rest).height[0] + 1.0e-3
    zero = np.zeros((1, 3))
    return Starts(np.array([[0.0, 0.0, height]]), quaternion, zero, zero, angle, rest)


def replay_plan(replay: Replay, plan: Plan, robots: RobotValues, refine: int = 1) -> Record:
    """Return what a robot does in a plan after it came to rest, rows at 240 Hz; refine: steps in 1/480 s."""
    period = TICK / SAMPLES
    stride = 2 * refine
    rest = round(REST / period)
    rows = plan.rows
    target = np.repeat(np.concatenate([np.repeat(rows[:1], rest, axis=0), rows]), stride, axis=0)
    record = replay.run(
        robots, start_of(replay, plan, robots), target, rows=rest + len(rows), stride=stride, dt=period / stride,
        base=plan.base, torque_limit=plan.torque_limit,
    )  # fmt: skip
    rows = {name: values[rest:].copy() for name, values in vars(record).items() if name != "valid"}
    return Record(**rows, valid=record.valid)


def simulate_plan(
    plan: Plan, robots: RobotValues | None = None, *, solver: SolverName = "jumper", dt: float = 1.0 / 480.0
) -> Record:
    """Return what a robot does in a plan after it came to rest, rows at 240 Hz, on one of the two solvers.

    Raises InputError: dt [s] does not divide 1/240 s.
    """
    period = TICK / SAMPLES
    stride = round(period / dt)
    if stride < 1 or abs(stride * dt - period) > 1.0e-6 * period:
        raise InputError(f"dt must divide 1/240 s, got {dt}")
    robots = RobotValues.nominal(1) if robots is None else robots
    held = plan.base == "fixed"
    sim = _simulation(plan, solver, robots, dt, held)
    rows = plan.rows
    rest = round(REST / period)
    target = np.concatenate([np.repeat(rows[:1], rest, axis=0), rows])
    late = float(robots.latency[0, 0]) / dt
    wanted = wp.zeros((12, 1), dtype=float, device=sim.device)
    found = []
    begin = sim.joint_q()[0, :7].copy()
    for row in range(len(target)):
        q, qd = sim.joint_q()[0].copy(), sim.joint_qd()[0].copy()
        for step in range(stride):
            now = row * stride + step
            whole = math.floor(late)
            newer, older = (target[max(now - whole - i, 0) // stride] for i in (0, 1))
            aim = (1.0 - (late - whole)) * newer + (late - whole) * older
            wanted.assign(aim[:, None].astype(np.float32))
            sim.physics.advance(1, wanted)
            if step == 0 and row >= rest:  # the torques are those that this step began with
                torque = sim.torque.numpy()[:, 0]
                found.append(np.concatenate([motor_values(q[7:27]), motor_values(qd[6:26]), torque, q[:7]]))
            if held:
                _put_back(sim, begin)
    table = np.array(found)[:, :, None]
    valid = np.array([bool(np.isfinite(table).all()) and sim.physics.diverged.numpy()[0] == 0])
    return Record(table[:, :12], table[:, 12:24], table[:, 24:36], table[:, 36:39], table[:, 39:43], valid)


def _simulation(plan: Plan, solver: SolverName, robots: RobotValues, dt: float, held: bool) -> Simulation:
    """Return the simulation of one robot in the first pose of a plan."""
    values = RobotValues(**{name: value[:1].copy() for name, value in vars(robots).items()})
    if held:
        values.base_mass[:], values.base_com[:] = HELD, 0.0
    motors = MotorCfg.from_description(load_description(), "jumping", plan.torque_limit, plan.torque_limit)
    sim = Simulation(1, solver=solver, motors=motors, dt=dt, visuals=False, robot=values, device="cpu", threads=1)
    angle = plan.target[0] - values.offset[0]
    q = sim.joint_q()[0].copy()
    q[7 + motor_values(np.arange(20))] = angle
    height = stance(load_description(), angle[None], np.zeros((1, 12))).height[0]
    q[:3] = [0.0, 0.0, HANGING_HEIGHT if held else height + 1.0e-3]
    sim.state.joint_q.assign(q.astype(np.float32))
    sim.physics.write_bodies()
    if held:
        weight = np.zeros((sim.model.body_count, 6), dtype=np.float32)
        weight[0, :3] = -HELD * sim.model.gravity.numpy().reshape(-1, 3)[0]
        sim.state.body_f.assign(weight)
    return sim


def _put_back(sim: Simulation, pose: np.ndarray) -> None:
    """Put the base back to a pose, at rest."""
    q, qd = sim.state.joint_q.numpy(), sim.state.joint_qd.numpy()
    q[:7], qd[:6] = pose, 0.0
    sim.state.joint_q.assign(q)
    sim.state.joint_qd.assign(qd)


def measured(
    plan: Plan,
    name: str,
    record: Record,
    robots: RobotValues,
    rng: np.random.Generator | None,
    noise: NoiseLevels | None = None,
    *,
    torque: bool = False,
    base_every: int = 2,
) -> Motion:
    """Return a record as sensors would read it, angles and rates at 240 Hz.

    rng: of the noise; None: without. torque: whether the motors report theirs. base_every: rows from one measurement of
    the base to the next.
    """
    levels = (noise or NoiseLevels()).of_channels()
    rows = len(plan.rows)
    values: dict[str, Any] = {
        "angle": record.angle[:, :, 0] + robots.offset[:1],
        "rate": record.rate[:, :, 0],
        "torque": record.torque[:, :, 0],
        "position": record.position[:, :, 0],
    }
    quaternion = record.quaternion[:, :, 0]
    if rng is not None:
        values = {key: x + levels[key][0] * rng.normal(size=x.shape) for key, x in values.items()}
        quaternion = multiply(from_rotation_vector(levels["orientation"][0] * rng.normal(size=(rows, 3))), quaternion)
    between = (np.arange(rows) % base_every != 0)[:, None]
    values["position"], quaternion = (np.where(between, math.nan, x) for x in (values["position"], quaternion))
    if not torque:
        del values["torque"]
    return Motion(
        name=name, time=TICK / SAMPLES * np.arange(rows), target=plan.rows, quaternion=quaternion, base=plan.base,
        torque_limit=plan.torque_limit, notes={"kind": plan.kind}, **values,
    )  # fmt: skip
