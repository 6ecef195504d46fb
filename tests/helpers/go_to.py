"""A user's task in one file, outside of the package: go to a commanded place and face a commanded yaw."""

from __future__ import annotations

import warp as wp

from jumper_warp import mdp
from jumper_warp.registry import register_task


@wp.struct
class GoToState:
    """State of one world's episode."""

    steps: int  # policy steps since the episode began
    goal: wp.vec3  # [m] commanded place, world
    goal_yaw: float  # [rad] commanded yaw, world
    place_error_m: float  # horizontal distance of the base from the goal
    yaw_error_rad: float  # angle from the yaw to the commanded yaw, at most pi


@wp.func
def yaw_left(robot: mdp.RobotView, state: GoToState) -> float:
    """Angle by which to turn left [rad], within -pi..pi."""
    angle = state.goal_yaw - mdp.yaw_of(robot.quat)
    return wp.atan2(wp.sin(angle), wp.cos(angle))


@wp.func
def place_left(robot: mdp.RobotView, state: GoToState) -> wp.vec3:
    """Way to the goal [m], body axes."""
    return wp.quat_rotate_inv(robot.quat, state.goal - robot.pos)


@wp.func
def pose_left(robot: mdp.RobotView, state: GoToState) -> wp.vec4:
    """Way to the goal [m], body axes, and angle by which to turn left [rad]."""
    place = place_left(robot, state)
    return wp.vec4(place[0], place[1], place[2], yaw_left(robot, state))


@wp.func
def advance_go_to(robot: mdp.RobotView, state: GoToState) -> GoToState:
    """Count policy steps, and measure the errors."""
    new = state
    new.steps = state.steps + 1
    new.place_error_m = wp.sqrt((state.goal[0] - robot.pos[0]) ** 2.0 + (state.goal[1] - robot.pos[1]) ** 2.0)
    new.yaw_error_rad = wp.abs(yaw_left(robot, state))
    return new


@wp.func
def set_goal(robot: mdp.RobotView, scene: mdp.Scene, state: GoToState, values: wp.vec4, heading: float) -> GoToState:
    """Command the place (values[0], values[1]) [m] and the yaw values[2] [rad], both relative to robot and heading."""
    new = state
    ahead = wp.quat_rotate(wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), heading), wp.vec3(values[0], values[1], 0.0))
    new.goal = wp.vec3(robot.pos[0] + ahead[0], robot.pos[1] + ahead[1], 0.0)
    new.goal_yaw = heading + values[2]
    return new


@wp.func
def reset_go_to(
    robot: mdp.RobotArrays, scene: mdp.Scene, skill: mdp.SkillSettings, old: GoToState, settings: mdp.NoSettings,
    level: mdp.NoSettings, rng: mdp.RngStream,
) -> GoToState:  # fmt: skip
    """Reset the robot to the default pose, and sample a goal."""
    mdp.write_default_pose(robot, scene, rng.world, 0.0, 0.0)
    new = GoToState()
    new.goal = wp.vec3(mdp.uniform(rng, 0, -0.8, 0.8), mdp.uniform(rng, 1, -0.8, 0.8), 0.0)
    new.goal_yaw = mdp.uniform(rng, 2, -0.5, 0.5)
    return new


@wp.func
def place_error(robot: mdp.RobotView, state: GoToState) -> float:
    """Return the horizontal distance of the base from the goal [m]."""
    return state.place_error_m


@wp.func
def near(robot: mdp.RobotView, state: GoToState, width: float) -> float:
    """Return the closeness to the commanded place, 0 to 1; width [m]: width of the reward kernel."""
    return mdp.rewards.psi(state.place_error_m, width)


def go_to() -> mdp.TaskCfg:
    """Return the task `go-to`."""
    actor = (
        mdp.ObservationTerm(pose_left, mirror=(1, -2, 3, -4)),
        mdp.ObservationTerm(mdp.observations.gravity),
        mdp.ObservationTerm(mdp.observations.ang_vel, history=2),
        mdp.ObservationTerm(mdp.observations.contacts),
        mdp.ObservationTerm(mdp.observations.angle),
        mdp.ObservationTerm(mdp.observations.last_action),
    )
    return mdp.TaskCfg(
        name="go-to",
        state=GoToState,
        advance=mdp.Advance(advance_go_to),
        reset=mdp.Reset(reset_go_to),
        command=mdp.Command(set_goal, labels=("x [m]", "y [m]", "yaw [rad]"), optional=1),
        curriculum=mdp.Curriculum(place_error, tolerance=0.1),
        rewards=(mdp.RewardTerm(near, 2.0, width=0.3), mdp.RewardTerm(mdp.rewards.action_rate, -0.02)),
        terminations=(
            mdp.TerminationTerm(mdp.terminations.diverged),
            mdp.TerminationTerm(mdp.terminations.tilted, angle=0.8),
            mdp.TerminationTerm(mdp.terminations.too_long, steps=30.0, time_out=True, success=True),
        ),
        observations=mdp.ObservationsCfg(actor=actor, critic=actor),
        motors=mdp.walking_motors(),
        command_filter=mdp.walking_filter(),
        action_scale=(10.0, 40.0),
        evaluation=mdp.EpisodeEvaluation(
            metrics=(
                mdp.EpisodeMetric("place_error_mean_m", "place_error_m"),
                mdp.EpisodeMetric("yaw_error_max_rad", "yaw_error_rad", "max"),
            ),
            goal_marker="goal",
        ),
    )


register_task("go-to", go_to)
