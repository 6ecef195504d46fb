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

    goal: float  # [m] commanded height of the base
    steps: int  # policy steps since the episode began
    age: int  # policy steps since the command
    lasts: int  # policy steps from command to command, 0: one for the whole episode
    near: int  # policy steps in a row near the goal


@wp.struct
class HoldSettings:
    """Settings of the reset, as the kernels read them."""

    heading: float  # [rad] largest, to either side
    lasts: int  # policy steps from command to command


@wp.struct
class HoldLevel:
    """Level of the curriculum, as the kernels read it."""

    goal: wp.vec2  # [m] range of commands


@dataclass(frozen=True)
class HoldResetCfg:
    """Settings of the reset."""

    heading: float = 3.0
    """[rad] Largest, to either side."""
    lasts: float = 0.5
    """[s] Time between commands."""

    struct = HoldSettings

    def values(self, step_dt: float) -> Any:
        """Return the kernels' `HoldSettings`."""
        settings = HoldSettings()
        settings.heading, settings.lasts = self.heading, round(self.lasts / step_dt)
        return settings


@dataclass(frozen=True)
class HoldLevelCfg:
    """Level of the curriculum."""

    goal: Pair
    """[m] Range of commands."""

    struct = HoldLevel

    def values(self) -> Any:
        """Return the kernels' `HoldLevel`."""
        level = HoldLevel()
        level.goal = wp.vec2(*self.goal)
        return level


@wp.func
def advance_hold(robot: mdp.RobotView, state: HoldState, tolerance: float) -> HoldState:
    """Count policy steps, and consecutive steps within a tolerance [m] of the goal."""
    new = state
    new.steps = state.steps + 1
    new.age = state.age + 1
    new.near = wp.where(wp.abs(robot.height - state.goal) < tolerance, state.near + 1, 0)
    return new


@wp.func
def reset_hold(
    robot: mdp.RobotArrays, scene: mdp.Scene, skill: mdp.SkillSettings, old: HoldState, settings: HoldSettings,
    level: HoldLevel, rng: mdp.RngStream,
) -> HoldState:  # fmt: skip
    """Reset the robot to the default pose with a random heading, and sample a goal."""
    mdp.write_default_pose(robot, scene, rng.world, mdp.uniform(rng, 0, -settings.heading, settings.heading), 0.0)
    new = HoldState()
    new.goal = mdp.uniform_range(rng, 1, level.goal)
    new.lasts = settings.lasts
    return new


@wp.func
def give_hold(robot: mdp.RobotView, scene: mdp.Scene, state: HoldState, values: wp.vec4, heading: float) -> HoldState:
    """Command the height values[0] [m] until the next command."""
    new = state
    new.goal = values[0]
    new.age = 0
    new.lasts = 0
    return new


@wp.func
def another_goal_due(state: HoldState) -> bool:
    """Return whether the next command is due."""
    return state.lasts > 0 and state.age >= state.lasts


@wp.func
def sample_goal(
    robot: mdp.RobotView, scene: mdp.Scene, state: HoldState, level: HoldLevel, rng: mdp.RngStream
) -> HoldState:
    """Sample a new command of the height."""
    new = state
    new.goal = mdp.uniform_range(rng, 1, level.goal)
    new.age = 0
    return new


@wp.func
def height_error(robot: mdp.RobotView, state: HoldState) -> float:
    """Return the distance of the base from the commanded height [m]."""
    return wp.abs(robot.height - state.goal)


@wp.func
def every_episode(state: HoldState) -> bool:
    """Return that every episode counts for the curriculum."""
    return True


@wp.func
def near_goal(robot: mdp.RobotView, state: HoldState, width: float) -> float:
    """Return the closeness to the commanded height, 0 to 1; width [m]: width of the reward kernel."""
    return mdp.rewards.psi(robot.height - state.goal, width)


@wp.func
def held(robot: mdp.RobotView, state: HoldState, steps: float) -> bool:
    """Return whether the base was near the goal for `steps` consecutive policy steps."""
    return state.near >= int(steps)


@wp.func
def wanted_height(robot: mdp.RobotView, state: HoldState) -> float:
    """Return the commanded height [m]."""
    return state.goal


@wp.func
def weak_motors(robot: mdp.RobotParameters, rng: mdp.RngStream, lower: float, upper: float):
    """Scale the torque limit of each motor."""
    for m in range(12):
        robot.torque_ratio[m, rng.world] = mdp.uniform(rng, m, lower, upper)
        mdp.events.set_torque_limit(robot, rng.world, m)


def hold_height() -> mdp.TaskCfg:
    """Return the task `hold-height`."""
    actor = (
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
        command=mdp.Command(give_hold, another_goal_due, sample_goal),
        curriculum=mdp.Curriculum(height_error, tolerance=0.03, promote_after=2, counts=every_episode),
        rewards=(mdp.RewardTerm(near_goal, 60.0, width=0.05), mdp.RewardTerm(mdp.rewards.action_rate, -0.02)),
        terminations=(
            mdp.TerminationTerm(mdp.terminations.diverged),
            mdp.TerminationTerm(mdp.terminations.low_base, height=0.12),
            mdp.TerminationTerm(mdp.terminations.tilted, angle=0.8),
            mdp.TerminationTerm(held, steps=100.0, time_out=True, success=True),
            mdp.TerminationTerm(mdp.terminations.too_long, steps=120.0, time_out=True),
        ),
        observations=mdp.ObservationsCfg(
            actor=actor, critic=(*actor, mdp.ObservationTerm(mdp.observations.drawn_latency))
        ),
        levels=(HoldLevelCfg((0.22, 0.42)), HoldLevelCfg((0.20, 0.44))),
        motors=walking_motors(),
        command_filter=walking_filter(),
        action_scale=(10.0, 40.0),
        events=(mdp.EventTerm(weak_motors, lower=0.8, upper=1.0),),
        randomization=mdp.RandomizationCfg.walking(),
        reward_floor=None,
    )
