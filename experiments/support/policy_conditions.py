"""Test conditions of the shipped policies: names, descriptions, settings, and for which tasks they are undefined."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jumper_warp.evaluation.attitude import AttitudeFlags
from jumper_warp.evaluation.jump_metrics import JumpFlags
from jumper_warp.evaluation.velocities import STANDING, VelocityFlags
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.tasks.cfg import TaskCfg


class TestCondition(NamedTuple):
    """Test condition in which policies are evaluated: its name in tables and its settings."""

    words: str  # Name in tables
    values: dict[str, Any]  # Fields of `Conditions`; `payload` [kg] becomes a robot overlay

    __test__ = False  # not a test class of pytest

    @property
    def title(self) -> str:
        """Name of the condition in tables, with the solver if that is SolverMuJoCo."""
        return self.words + (", SolverMuJoCo" if self.values.get("solver") == "mujoco" else "")


RANDOMISED = {"randomize": True, "noise": True}
CONDITIONS = {
    "nominal": TestCondition("nominal", {}),
    "randomised": TestCondition("randomised robots, noise, latency, pushes", RANDOMISED),
    "mujoco": TestCondition("nominal", {"solver": "mujoco"}),
    "mujoco_randomised": TestCondition("randomised robots, noise, latency, pushes", RANDOMISED | {"solver": "mujoco"}),
    "friction_0.4": TestCondition("friction 0.4", {"friction": 0.4}),
    "payload_3_kg": TestCondition("payload of 3 kg", {"payload": 3.0}),
    "gains_0.6": TestCondition("kp and kd × 0.6", {"gain_scale": (0.6, 0.6)}),
    "sensor_offset_4_deg": TestCondition("position sensors off by up to 4°", {"sensor_offset": 4.0}),
    "latency_25_ms": TestCondition("latency 25 ms", {"latency": 25.0}),
    "push_in_flight": TestCondition("randomised, pushed in flight too", RANDOMISED | {"push_in_flight": True}),
}
"""Conditions by name, in the order of the tables; all others than the named values are nominal."""


def undefined(task: TaskCfg, name: str) -> str | None:
    """Return the reason why a condition of CONDITIONS is undefined for a task, None if it is defined."""
    randomization = task.randomization
    if name == "friction_0.4" and task.evaluation.kind == "attitude":
        return "the robot floats and touches no ground"
    if name == "push_in_flight" and randomization.push_force is None and randomization.push_torque is None:
        return "its randomisation has no pushes"
    if name == "push_in_flight" and randomization.push_in_flight:
        return "its randomised robots always are"
    return None


def with_trials(flags: Any, trials: int) -> Any:
    """Return a copy of the flags of `jumper evaluate` with at least this number of trials."""
    if isinstance(flags, JumpFlags):
        return replace(flags, num_jumps=trials)
    if isinstance(flags, AttitudeFlags):
        return replace(flags, num_turns=trials)
    assert isinstance(flags, VelocityFlags)
    per_axis = next(n for n in range(2, trials) if 2 * n**3 + STANDING >= trials)
    return replace(flags, commands_per_axis=per_axis)


def commands_of(flags: Any) -> str:
    """Return the ranges of an evaluation's goals or velocity commands as text; flags: of `jumper evaluate`."""
    if isinstance(flags, AttitudeFlags):
        return f"turns by {flags.angle:g}°"
    if isinstance(flags, VelocityFlags):
        return "up to ±{:g} m/s, ±{:g} m/s, ±{:g} rad/s".format(*flags.max_velocity)
    if hasattr(flags, "height_range"):
        return "{:g} to {:g} m".format(*flags.height_range)
    sides = "" if flags.goal_y == (0.0, 0.0) else ", to the left {:g} to {:g} m".format(*flags.goal_y)
    return "{:g} to {:g} m".format(*flags.goal_x) + sides


def payload_overlay(overlay: RobotOverlay | None, mass: float) -> RobotOverlay:
    """Return a robot overlay with a point mass [kg] added at the origin of the base's frame.

    overlay: robot without payload, None: the described one. The inertia about the centre of mass stays: the part that
    the payload adds there is below 1 %.
    """
    overlay = overlay or RobotOverlay({})
    robot = overlay.robots()
    ratio = float(robot.base_mass[0, 0]) / (float(robot.base_mass[0, 0]) + mass)
    values = {
        "base_mass": (float(robot.base_mass[0, 0]) + mass,),
        "base_com": tuple(float(x) for x in ratio * np.asarray(robot.base_com[0])),
        "base_inertia": (ratio * float(robot.base_inertia[0, 0]),),
    }
    return RobotOverlay({**overlay.values, **values}, overlay.randomization, f"payload of {mass:g} kg")
