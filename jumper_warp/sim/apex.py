"""Open-loop jump of a robot (squat, hold, full extension), the measure of the heights that it can reach."""

from __future__ import annotations

import functools

import numpy as np

from jumper_warp.robot.measures import JUMPER_APEX, Measures, filter_for, measures_of, motors_for
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.robot.values import described
from jumper_warp.sim.simulation import Simulation, SolverName

RAMP, HOLD, EXTEND = 25, 50, 40  # Policy steps of the ramp into the squat, the held squat, and the full extension
STAND = 31  # Policy steps in the default pose before the ramp, as many as before the command in a sweep
COAST = 30  # Policy steps after the extension, within which the apex has passed
LEVELS = np.repeat([0.0, np.nan, 1.0, -1.0, 0.0], [STAND, RAMP, HOLD, EXTEND, COAST])
LEVELS[STAND : STAND + RAMP] = np.arange(RAMP) / RAMP
"""[1] Action of the transversal motors at every policy step of the open-loop jump: 1 squat, -1 extension."""


def open_loop_apex(robot: RobotOverlay, solver: SolverName = "jumper", seconds: float = 0.0) -> float:
    """Simulate the open-loop jump with the motors and the filter of the vertical jump; return the largest height [m].

    seconds: time to coast beyond `COAST`. The base never rises if the robot falls.
    """
    description = robot.description
    sim = Simulation(
        1, solver=solver, robot=robot, device="cpu", visuals=False,
        motors=motors_for(jumping_motors(18.0, lateral_torque=10.0), description),
        command_filter=filter_for(vertical_jump_filter(), description),
    )  # fmt: skip
    pose, apex = description.pose("default"), 0.0
    for step, level in enumerate([*LEVELS, *np.zeros(round(60.0 * seconds))]):
        sim.set_targets(pose + np.tile([0.0, level, level], 4) * np.pi / 2.0)
        sim.step()
        if step >= STAND + RAMP + HOLD:
            apex = max(apex, float(sim.joint_q()[0, 2]))
    return apex


@functools.cache
def jumper_measures() -> Measures:
    """Return the Jumper's measures."""
    return measures_of(RobotOverlay({}).description, JUMPER_APEX)


@functools.lru_cache(maxsize=16)
def measure(robot: RobotOverlay) -> Measures:
    """Return the measures of a robot; its open-loop jump is simulated."""
    if robot.is_jumper:
        return jumper_measures()
    return measures_of(described(robot.robots(), robot.description), open_loop_apex(robot))
