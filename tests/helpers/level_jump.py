"""Task of a user: a vertical jump with a reward for a level base."""

from dataclasses import replace
from typing import Any

import warp as wp

from jumper_warp import make_task, mdp
from jumper_warp.registry import register_task


@wp.func
def level(robot: mdp.RobotView, state: Any, scale: float) -> float:
    """Closeness of the base to level, exp(-tilt / scale) [1]; scale [rad]."""
    return mdp.rewards.psi(mdp.tilt(robot), scale)


def level_jump():
    """Return vertical-jump with the reward `level` in addition."""
    task = make_task("vertical-jump")
    return replace(task, name="level-jump", rewards=(*task.rewards, mdp.RewardTerm(level, weight=2.0, scale=0.1)))


register_task("level-jump", level_jump)
