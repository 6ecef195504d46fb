"""Open-loop jump of a robot (squat, hold, full extension), the measure of the heights that it can reach."""

from __future__ import annotations

import functools
from collections.abc import Callable

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


class OpenLoopJump:
    """Simulation of a robot's open-loop jump with the motors and the filter of the vertical jump."""

    def __init__(self, robot: RobotOverlay, solver: SolverName = "jumper", *, visuals: bool = False) -> None:
        """Prepare the simulation; visuals: whether it has the shapes that viewers see."""
        self.pose = robot.description.pose("default")
        self.sim = Simulation(
            1, solver=solver, robot=robot, device="cpu", visuals=visuals,
            motors=motors_for(jumping_motors(18.0, lateral_torque=10.0), robot.description),
            command_filter=filter_for(vertical_jump_filter(), robot.description),
        )  # fmt: skip

    def run(self, after_step: Callable[[], None] = lambda: None) -> float:
        """Simulate the jump once, and return the largest height of the base [m] from the extension on.

        after_step: called after every policy step.
        """
        apex = 0.0
        for step, level in enumerate(LEVELS):
            self.sim.set_targets(self.pose + np.tile([0.0, level, level], 4) * np.pi / 2.0)
            self.sim.step()
            after_step()
            if step >= STAND + RAMP + HOLD:
                apex = max(apex, float(self.sim.joint_q()[0, 2]))
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
    return measures_of(described(robot.robots(), robot.description), OpenLoopJump(robot).run())
