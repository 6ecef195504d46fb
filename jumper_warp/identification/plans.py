"""Motions as plans: targets for chirps in the air and on the ground and for small jumps, drawn at random."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from jumper_warp.utils.errors import InputError

Kind = Literal["hung chirp", "standing chirp", "small jump"]
KINDS: tuple[Kind, ...] = ("hung chirp", "hung chirp", "standing chirp", "small jump")
"""One set of motions."""
TICK = 1.0 / 60.0
"""[s] From target to target."""
SAMPLES = 4
"""Rows of a motion in a tick: 240 Hz."""
DEGREE = math.pi / 180.0


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


def draw_plan(kind: Kind, rng: np.random.Generator, seconds: float = 1.25, torque_limit: float = 12.0) -> Plan:
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
    return Plan(kind, target * DEGREE, torque_limit)


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
            rng.uniform(2.0, 5.0) if lateral else rng.uniform(5.0, 10.0)
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
