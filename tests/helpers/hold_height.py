"""A user-defined task, outside of the package: hold the base at a commanded height."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from jumper_warp import mdp
from jumper_warp.robot.motors import walking_filter, walking_motors

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
def advance_hold(view: mdp.RobotView, task: HoldState, tolerance: float) -> HoldState:
    """Count steps, and those near the goal up to a tolerance [m]."""
    new = task
    new.steps = task.steps + 1
    new.age = task.age + 1
    new.near = wp.where(wp.abs(view.height - task.goal) < tolerance, task.near + 1, 0)
    return new


@wp.func
def reset_hold(
    robot: mdp.RobotArrays, scene: mdp.Scene, skill: mdp.SkillSettings, old: HoldState, settings: HoldSettings,
    level: HoldLevel, draw: mdp.Draw,
) -> HoldState:  # fmt: skip
    """Stand in the default pose with any heading."""
    mdp.store_pose(robot, scene, draw.world, mdp.between(draw, 0, -settings.heading, settings.heading), 0.0)
    new = HoldState()
    new.goal = mdp.within(draw, 1, level.goal)
    new.lasts = settings.lasts
    return new


@wp.func
def give_hold(view: mdp.RobotView, scene: mdp.Scene, task: HoldState, values: wp.vec4, heading: float) -> HoldState:
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
def draw_goal(view: mdp.RobotView, scene: mdp.Scene, task: HoldState, level: HoldLevel, draw: mdp.Draw) -> HoldState:
    """Command another height."""
    new = task
    new.goal = mdp.within(draw, 1, level.goal)
    new.age = 0
    return new


@wp.func
def height_error(view: mdp.RobotView, task: HoldState) -> float:
    """Distance from the commanded height [m]."""
    return wp.abs(view.height - task.goal)


@wp.func
def every_episode(task: HoldState) -> bool:
    """All episodes count."""
    return True


@wp.func
def near_goal(view: mdp.RobotView, task: HoldState, width: float) -> float:
    """Closeness to the commanded height; width [m]: of the kernel."""
    return mdp.rewards.psi(view.height - task.goal, width)


@wp.func
def held(view: mdp.RobotView, task: HoldState, steps: float) -> bool:
    """Near the goal for so many policy steps in a row."""
    return task.near >= int(steps)


@wp.func
def wanted_height(view: mdp.RobotView, task: HoldState) -> float:
    """The commanded height [m]."""
    return task.goal


@wp.func
def weak_motors(robot: mdp.RobotParameters, draw: mdp.Draw, lower: float, upper: float):
    """Scale the torque limit of each motor."""
    for m in range(12):
        robot.torque_ratio[m, draw.world] = mdp.between(draw, m, lower, upper)
        mdp.events.set_torque_limit(robot, draw.world, m)


def hold_height() -> mdp.TaskCfg:
    """Return the task."""
    policy = (
        mdp.ObservationTerm(wanted_height, scale=5.0),
        mdp.ObservationTerm(mdp.observations.height, noise=0.002, scale=5.0, history=3, delayed=True),
        mdp.ObservationTerm(mdp.observations.gravity, noise=0.02),
        mdp.ObservationTerm(mdp.observations.angle, noise=0.01, delayed=True),
        mdp.ObservationTerm(mdp.observations.last_action),
    )
    return mdp.TaskCfg(
        name="hold-height",
        state=HoldState,
        advance=mdp.Advance(advance_hold, tolerance=0.02),
        reset=mdp.Reset(reset_hold, HoldResetCfg()),
        command=mdp.Command(give_hold, another_goal_due, draw_goal),
        curriculum=mdp.Curriculum(height_error, tolerance=0.03, promote_after=2, counts=every_episode),
        rewards=(
            mdp.RewardTerm(near_goal, 60.0, width=0.05),
            mdp.RewardTerm(mdp.rewards.action_rate, -0.02),
        ),
        terminations=(
            mdp.TerminationTerm(mdp.terminations.came_apart),
            mdp.TerminationTerm(mdp.terminations.low_base, height=0.12),
            mdp.TerminationTerm(mdp.terminations.tilted, angle=0.8),
            mdp.TerminationTerm(held, steps=100.0, time_out=True, success=True),
            mdp.TerminationTerm(mdp.terminations.too_long, steps=120.0, time_out=True),
        ),
        policy=policy,
        critic=(*policy, mdp.ObservationTerm(mdp.observations.drawn_latency)),
        levels=(HoldLevelCfg((0.22, 0.42)), HoldLevelCfg((0.20, 0.44))),
        motors=walking_motors(),
        command_filter=walking_filter(),
        action_scale=(10.0, 40.0),
        events=(mdp.EventTerm(weak_motors, lower=0.8, upper=1.0),),
        randomization=mdp.RandomizationCfg.walking(),
        reward_floor=None,
    )
