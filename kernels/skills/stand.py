"""Standing between two skills: the motor targets go in a straight line from what was held to the default pose."""

import warp as wp

from ..mdp.env import Nothing, Scene, SkillSettings
from ..mdp.random import Draw
from ..mdp.reset import store_pose
from ..mdp.view import RobotArrays, RobotView

wp.set_module_options({"enable_backward": False})

BLEND = wp.constant(24)  # policy steps from the targets that were held to the default pose


@wp.struct
class StandState:
    """State of one world's stand."""

    goal: wp.vec3  # [m] of the jump to come: place relative to base and heading, base height at the apex
    steps: int  # policy steps since it began


@wp.func
def advance_stand(view: RobotView, task: StandState) -> StandState:
    """Count a policy step."""
    new = task
    new.steps = task.steps + 1
    return new


@wp.func
def reset_stand(
    robot: RobotArrays, scene: Scene, skill: SkillSettings, old: StandState, settings: Nothing, level: Nothing,
    draw: Draw,
) -> StandState:  # fmt: skip
    """Begin in the default pose at rest."""
    store_pose(robot, scene, draw.world, 0.0, 0.0)
    return StandState()


@wp.func
def give_stand(view: RobotView, scene: Scene, task: StandState, values: wp.vec4, heading: float) -> StandState:
    """Tell the goal of the jump to come [m]: x, y relative to base and heading, base height at the apex."""
    new = task
    new.goal = wp.vec3(values[0], values[1], values[2])
    return new


@wp.func
def kept(view: RobotView, task: StandState) -> float:
    """Share of the last action that the next one keeps [1]: a straight line to zero in BLEND policy steps."""
    left = wp.max(BLEND - task.steps, 0)
    return float(wp.max(left - 1, 0)) / float(wp.max(left, 1))


@wp.func
def no_error(view: RobotView, task: StandState) -> float:
    """Nothing is to be learnt here."""
    return 0.0


@wp.func
def no_episode(task: StandState) -> bool:
    """No episode counts."""
    return False
