"""Tasks of the paper in which terms follow another reading; `docs/results/paper.md` has the table of readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import warp as wp

from jumper_warp import make_task, mdp
from jumper_warp.kernels.collision.robot import BODY_GROUND, LEG_SHELL
from jumper_warp.kernels.jump import paper, rewards
from jumper_warp.registry import register_task, trainer_settings
from jumper_warp.tasks.cfg import TaskCfg


@wp.func
def landed_soft_impact(robot: mdp.RobotView, state: mdp.JumpState, limit: float) -> float:  # pyright: ignore[reportGeneralTypeIssues]
    """Reward for a soft impact, at any time after touchdown: max(0, 1 - deceleration / limit [m/s^2])."""
    if state.phase != mdp.LANDED:
        return 0.0
    return wp.max(0.0, 1.0 + paper.impact_acceleration(robot) / limit)


@wp.func
def base_collided(robot: mdp.RobotView, state: Any) -> bool:  # pyright: ignore[reportGeneralTypeIssues]
    """Terminate when the shell of the base touches the ground or a leg."""
    return (robot.collisions & (BODY_GROUND | LEG_SHELL)) != 0


SOFT_LANDING = {"soft_impact": {"func": landed_soft_impact}}
EVERY_PHASE = {
    "flight_angular_velocity": {"func": rewards.angular_velocity, "name": "angular_velocity", "waiting_scale": 1.0},
    "flight_orientation_error": {"func": paper.orientation_error, "name": "orientation_error"},
}
CHANGES: dict[str, dict[str, Mapping[str, Mapping[str, Any]]]] = {
    "vertical-jump-paper": {"soft-landing": SOFT_LANDING},
    "horizontal-jump-paper": {"soft-landing": SOFT_LANDING, "every-phase": EVERY_PHASE},
    "velocity-paper": {"base-collision": {"collided": {"func": base_collided}}},
}
"""Arguments of terms that change, by task, name of the reading, and name of the term; the new task is `TASK-NAME`."""


def changed(base: str, name: str) -> TaskCfg:
    """Return the task `base` with the changed terms of a reading; all other arguments of these terms are kept."""
    task, terms = make_task(base), CHANGES[base][name]
    ours, ends = (
        tuple(term.replace(**terms[term.name]) if term.name in terms else term for term in section)
        for section in (task.rewards, task.terminations)
    )
    return replace(task, name=f"{base}-{name}", rewards=ours, terminations=ends)


for BASE, READINGS in CHANGES.items():
    for NAME in READINGS:
        register_task(f"{BASE}-{NAME}", partial(changed, BASE, NAME), ppo=trainer_settings(BASE), about=NAME)
