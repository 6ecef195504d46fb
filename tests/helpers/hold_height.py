"""A task of one's own, as a user writes it: hold the base at a commanded height. It touches nothing of the package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from jumper_warp.kernels.mdp import observations as mdp_observations
from jumper_warp.kernels.mdp import rewards as mdp_rewards
from jumper_warp.kernels.mdp import terminations as mdp_terminations
from jumper_warp.kernels.mdp.env import Scene, SkillSettings
from jumper_warp.kernels.mdp.parameters import RobotParameters, set_torque_limit
from jumper_warp.kernels.mdp.random import Draw, between, within
from jumper_warp.kernels.mdp.reset import store_pose
from jumper_warp.kernels.mdp.view import RobotArrays, RobotView
from jumper_warp.robot.motors import walking_filter, walking_motors
from jumper_warp.tasks.cfg import Command, Reset, TaskCfg
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.tasks.terms import Advance, Curriculum, EventTerm, ObservationTerm, RewardTerm, TerminationTerm

Pair = tuple[float, float]


@wp.struct
class HoldState:
    """State of one world's episode."""

    goal: float  # [m] wanted height of the base
    steps: int  # policy steps since the episode began
    age: int  # policy steps since the command
    lasts: int  # policy steps from command to command, 0: one for the whole episode
    near: int  # policy steps in a row near the goal


@wp.struct
class HoldSettings:
    """How an episode begins."""

    heading: float  # [rad] largest, to either side
    lasts: int  # policy steps from command to command


@wp.struct
class HoldLevel:
    """One level of the curriculum."""

    goal: wp.vec2  # [m] range of commands


@dataclass(frozen=True)
class HoldResetCfg:
    """How an episode begins."""

    heading: float = 3.0
    """[rad] Largest, to either side."""
    lasts: float = 0.5
    """[s] From command to command."""

    struct = HoldSettings

    def values(self, step_dt: float) -> Any:
        """Return the kernels' `HoldSettings`."""
        settings = HoldSettings()
        settings.heading, settings.lasts = self.heading, round(self.lasts / step_dt)
        return settings


@dataclass(frozen=True)
class HoldLevelCfg:
    """One level of the curriculum."""

    goal: Pair
    """[m] Range of commands."""

    struct = HoldLevel

    def values(self) -> Any:
        """Return the kernels' `HoldLevel`."""
        level = HoldLevel()
        level.goal = wp.vec2(*self.goal)
        return level


@wp.func
def advance_hold(view: RobotView, task: HoldState, tolerance: float) -> HoldState:
    """Count steps, and those near the goal up to a tolerance [m]."""
    new = task
    new.steps = task.steps + 1
    new.age = task.age + 1
    new.near = wp.where(wp.abs(view.height - task.goal) < tolerance, task.near + 1, 0)
    return new


@wp.func
def reset_hold(
    robot: RobotArrays, scene: Scene, skill: SkillSettings, old: HoldState, settings: HoldSettings, level: HoldLevel,
    draw: Draw,
) -> HoldState:  # fmt: skip
    """Stand in the default pose with any heading."""
    store_pose(robot, scene, draw.world, between(draw, 0, -settings.heading, settings.heading), 0.0)
    new = HoldState()
    new.goal = within(draw, 1, level.goal)
    new.lasts = settings.lasts
    return new


@wp.func
def give_hold(view: RobotView, scene: Scene, task: HoldState, values: wp.vec4, heading: float) -> HoldState:
    """Command a height [m], the first of the values, until another comes."""
    new = task
    new.goal = values[0]
    new.age = 0
    new.lasts = 0
    return new


@wp.func
def another_goal_due(task: HoldState) -> bool:
    """Whether the command has lasted long enough."""
    return task.lasts > 0 and task.age >= task.lasts


@wp.func
def draw_goal(view: RobotView, scene: Scene, task: HoldState, level: HoldLevel, draw: Draw) -> HoldState:
    """Command another height."""
    new = task
    new.goal = within(draw, 1, level.goal)
    new.age = 0
    return new


@wp.func
def height_error(view: RobotView, task: HoldState) -> float:
    """Distance from the commanded height [m]."""
    return wp.abs(view.height - task.goal)


@wp.func
def every_episode(task: HoldState) -> bool:
    """All episodes count."""
    return True


@wp.func
def near_goal(view: RobotView, task: HoldState, width: float) -> float:
    """Closeness to the commanded height; width [m]: of the kernel."""
    return mdp_rewards.psi(view.height - task.goal, width)


@wp.func
def held(view: RobotView, task: HoldState, steps: float) -> bool:
    """Near the goal for so many policy steps in a row."""
    return task.near >= int(steps)


@wp.func
def wanted_height(view: RobotView, task: HoldState) -> float:
    """The commanded height [m]."""
    return task.goal


@wp.func
def weak_motors(robot: RobotParameters, draw: Draw, lower: float, upper: float):
    """Scale the torque limit of each motor."""
    for m in range(12):
        robot.torque_ratio[m, draw.world] = between(draw, m, lower, upper)
        set_torque_limit(robot, draw.world, m)


def hold_height() -> TaskCfg:
    """Return the task."""
    policy = (
        ObservationTerm(wanted_height, scale=5.0),
        ObservationTerm(mdp_observations.height, noise=0.002, scale=5.0, history=3, delayed=True),
        ObservationTerm(mdp_observations.gravity, noise=0.02),
        ObservationTerm(mdp_observations.angle, noise=0.01, delayed=True),
        ObservationTerm(mdp_observations.last_action),
    )
    return TaskCfg(
        name="hold-height",
        state=HoldState,
        advance=Advance(advance_hold, tolerance=0.02),
        reset=Reset(reset_hold, HoldResetCfg()),
        command=Command(give_hold, another_goal_due, draw_goal),
        curriculum=Curriculum(height_error, tolerance=0.03, promote_after=2, counts=every_episode),
        rewards=(
            RewardTerm(near_goal, 60.0, width=0.05),
            RewardTerm(mdp_rewards.action_rate, -0.02),
        ),
        terminations=(
            TerminationTerm(mdp_terminations.came_apart),
            TerminationTerm(mdp_terminations.low_base, height=0.12),
            TerminationTerm(mdp_terminations.tilted, angle=0.8),
            TerminationTerm(held, steps=100.0, time_out=True, success=True),
            TerminationTerm(mdp_terminations.too_long, steps=120.0, time_out=True),
        ),
        policy=policy,
        critic=(*policy, ObservationTerm(mdp_observations.drawn_latency)),
        levels=(HoldLevelCfg((0.22, 0.42)), HoldLevelCfg((0.20, 0.44))),
        motors=walking_motors(),
        command_filter=walking_filter(),
        action_scale=(10.0, 40.0),
        events=(EventTerm(weak_motors, lower=0.8, upper=1.0),),
        randomization=RandomizationCfg.walking(),
        reward_floor=None,
    )
