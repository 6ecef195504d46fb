"""Handovers between the vertical jump and holding a height."""

import warp as wp

from hold_height import HoldState
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp.view import RobotView


@wp.func
def when_asked_to_jump(view: RobotView, task: HoldState, requested: bool) -> bool:
    return requested


@wp.func
def when_asked_to_hold(view: RobotView, task: JumpState, requested: bool) -> bool:
    return requested


@wp.func
def begin_jump(view: RobotView, task: HoldState) -> JumpState:
    new = JumpState()
    new.start = view.pos
    new.max_height = view.pos[2]
    new.goal = wp.vec3(view.pos[0], view.pos[1], 0.6 + task.goal)
    new.command_step = 1000
    return new


@wp.func
def begin_hold(view: RobotView, task: JumpState) -> HoldState:
    new = HoldState()
    new.goal = 0.3
    return new
