"""Simulated recordings for identification: random targets, a robot that follows them, and sensors with noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from jumper_warp.identification.initial_states import HANGING_HEIGHT, InitialStates, stance
from jumper_warp.identification.motions import DEGREES, NoiseLevels, RecordedMotion
from jumper_warp.identification.replay import MotionReplay, Record
from jumper_warp.identification.residuals import channel_noise
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.rotations import from_rotation_vector, multiply

Kind = Literal["hung chirp", "standing chirp", "small jump"]
KINDS: tuple[Kind, ...] = ("hung chirp", "hung chirp", "standing chirp", "small jump")
"""Kinds of the motions in one set."""
TICK = 1.0 / 60.0  # [s] between targets
SAMPLES = 4  # rows of a motion per tick: 240 Hz
REST = 0.75  # [s] in the first pose before a motion is recorded, in which the robot comes to rest


@dataclass(frozen=True, eq=False)
class Plan:
    """Planned motor targets of an identification motion. Motors by leg FL, FR, BL, BR, each lateral, outer, inner."""

    kind: Kind
    target: np.ndarray  # (ticks, 12) [rad] at 60 Hz
    torque_limit: float  # [N m] torque limit of the motor controllers

    @property
    def base(self) -> Literal["free", "fixed"]:
        """Mounting of the robot: "free" on the ground, or "fixed" to a stand on which it hangs."""
        return "fixed" if self.kind == "hung chirp" else "free"

    @property
    def rows(self) -> np.ndarray:
        """Planned motor targets [rad] at the 240 Hz of the recording, (SAMPLES * ticks, 12)."""
        return np.repeat(self.target, SAMPLES, axis=0)


def sample_plan(kind: Kind, rng: np.random.Generator, seconds: float = 1.25, torque_limit: float = 12.0) -> Plan:
    """Sample random motor targets for an identification motion of a kind, such as a small jump.

    Duration `seconds` [s]; torque_limit [N m]. Raises InputError: an unknown kind, or a duration outside 0.5 to 60 s.
    """
    ticks = round(seconds / TICK)
    if ticks < 30 or not seconds < 60.0:
        raise InputError(f"a motion must take 0.5 to 60 s, got {seconds:g}")
    if kind == "small jump":
        target = jump_targets(ticks, rng)
    elif kind in ("hung chirp", "standing chirp"):
        target = chirp_targets(ticks, rng, hung=kind == "hung chirp")
    else:
        raise InputError(f"unknown kind of motion {kind!r:.60}; expected one of {', '.join(dict.fromkeys(KINDS))}")
    return Plan(kind, target * DEGREES, torque_limit)


def chirp_targets(ticks: int, rng: np.random.Generator, hung: bool) -> np.ndarray:
    """Sample motor targets [deg] (ticks, 12) of a chirp with a random phase of each motor.

    A chirp is a sine of rising frequency: it excites slow effects (friction) and fast ones (inertia, latency). hung:
    whether the robot hangs on a stand; otherwise the motion is smaller and slower, so that it does not fall.
    """
    time = TICK * np.arange(ticks)
    slow = rng.uniform(0.3, 0.8)
    fast = rng.uniform(5.0, 9.0) if hung else rng.uniform(2.5, 4.5)
    cycles = slow * time + 0.5 * (fast - slow) * time**2 / time[-1]
    middle = rng.uniform(40.0, 55.0) if hung else rng.uniform(45.0, 60.0)
    target = np.zeros((ticks, 12))
    ramp = np.minimum(time / 0.1, 1.0)  # amplitude, 0 to 1 within 0.1 s
    for motor in range(12):
        lateral = motor % 3 == 0
        size = (rng.uniform(6.0, 11.0) if lateral else rng.uniform(9.0, 15.0)) if hung else (
            rng.uniform(2.0, 5.0) if lateral else rng.uniform(5.0, 10.0)
        )  # fmt: skip
        pace = rng.uniform(0.8, 1.2) if hung else 1.0
        wave = np.sin(2.0 * math.pi * (pace * cycles + rng.uniform()))
        target[:, motor] = (0.0 if lateral else middle) + size * ramp * wave
    return target


def jump_targets(ticks: int, rng: np.random.Generator) -> np.ndarray:
    """Sample motor targets [deg] (ticks, 12) of a squat, push-off and landing, with random offsets of each motor."""
    squat = rng.uniform(75.0, 95.0)
    push = rng.uniform(5.0, 25.0)
    land = rng.uniform(50.0, 65.0)
    # [ticks] durations of squatting, waiting, push-off
    down = 22
    hold = rng.integers(6, 12)
    up = rng.integers(9, 13)
    target = np.zeros((ticks, 12))
    for tick in range(ticks):
        if tick < down + hold:
            angle = 45.0 + (squat - 45.0) * min(1.0, tick / down)
        else:
            angle = push if tick < down + hold + up else land
        target[tick] = np.tile([0.0, angle, angle], 4)
    spread = rng.uniform(-3.0, 3.0, 12)
    return target + spread * np.minimum(np.arange(ticks) / down, 1.0)[:, None]


def initial_state(replay: MotionReplay, plan: Plan, robots: RobotValues) -> InitialStates:
    """Return the initial state of a planned motion: at rest in the first targets' pose; if free, 1 mm above ground."""
    angle = plan.target[:1] - robots.offset
    rest = np.zeros((1, 12))
    height = HANGING_HEIGHT
    quaternion = np.array([[0.0, 0.0, 0.0, 1.0]])
    if plan.base == "free":
        height = stance(replay.description, angle, rest).height[0] + 1.0e-3
    zero = np.zeros((1, 3))
    return InitialStates(np.array([[0.0, 0.0, height]]), quaternion, zero, zero, angle, rest)


def replay_plan(replay: MotionReplay, plan: Plan, robots: RobotValues) -> Record:
    """Simulate one robot under planned motor targets from rest by `replay`, and return its motion at 240 Hz."""
    period = TICK / SAMPLES
    stride = 2
    rest = round(REST / period)
    rows = plan.rows
    target = np.repeat(np.concatenate([np.repeat(rows[:1], rest, axis=0), rows]), stride, axis=0)
    record = replay.run(
        robots, initial_state(replay, plan, robots), target, rows=rest + len(rows), stride=stride, dt=period / stride,
        base=plan.base, torque_limit=plan.torque_limit,
    )  # fmt: skip
    rows = {name: values[rest:].copy() for name, values in vars(record).items() if name != "valid"}
    return Record(**rows, valid=record.valid)


def measure(
    plan: Plan,
    name: str,
    record: Record,
    robots: RobotValues,
    rng: np.random.Generator | None,
    noise: NoiseLevels | None = None,
    *,
    torque: bool = False,
) -> RecordedMotion:
    """Convert a simulated motion to the recording that sensors with offsets and noise would make of it.

    Motors at 240 Hz, the base's pose every second row. name: name of the motion. record: true motion, with
    arrays (rows, values, worlds), of which world 0 is measured. robots: its sensor offsets. rng: random numbers of the
    noise, None for no noise. noise: its standard deviations; that of the orientation is of a rotation vector [rad],
    world axes. torque: whether motor torques are recorded.
    """
    levels = channel_noise(noise or NoiseLevels())
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
    unmeasured = (np.arange(rows) % 2 != 0)[:, None]
    values["position"], quaternion = (np.where(unmeasured, math.nan, x) for x in (values["position"], quaternion))
    if not torque:
        del values["torque"]
    return RecordedMotion(
        name=name, time=TICK / SAMPLES * np.arange(rows), target=plan.rows, quaternion=quaternion, base=plan.base,
        torque_limit=plan.torque_limit, notes={"kind": plan.kind}, **values,
    )  # fmt: skip
