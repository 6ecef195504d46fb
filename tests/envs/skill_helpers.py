"""Handovers between the vertical jump and holding a height."""

import warp as wp

from hold_height import HoldState
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp.view import RobotView


@wp.func
def jump_requested(robot: RobotView, state: HoldState, requested: bool) -> bool:
    """Change from holding to jumping when requested."""
    return requested


@wp.func
def hold_requested(robot: RobotView, state: JumpState, requested: bool) -> bool:
    """Change from jumping to holding when requested."""
    return requested


@wp.func
def begin_jump(robot: RobotView, state: HoldState) -> JumpState:
    """Return the state of a jump on the spot, 0.6 m above the held height, commanded at step 1000."""
    new = JumpState()
    new.start = robot.pos
    new.max_height = robot.pos[2]
    new.goal = wp.vec3(robot.pos[0], robot.pos[1], 0.6 + state.goal)
    new.command_step = 1000
    return new


@wp.func
def begin_hold(robot: RobotView, state: JumpState) -> HoldState:
    """Return the state of holding a base height of 0.3 m."""
    new = HoldState()
    new.goal = 0.3
    return new
