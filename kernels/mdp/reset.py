"""Resets: new episodes, commands within an episode (sampled or from the host), and the default pose.

A launch covers all worlds; `mask` selects those to reset, so that no host decision interrupts a policy step. World z is
up, a heading is a yaw [rad], quaternions are xyzw (body to world). Motors are 3 * leg + j: lateral, outer, inner.
"""

from typing import Any

import warp as wp

from ..actuation.command_filter import FilterParams
from ..kinematics.geometry import LegGeometry, leg_of
from ..kinematics.inverse import LegLimits
from ..layout import BODIES, COORDS, DOFS, motor_slot
from ..terrain.ground import rest_block, surface, world_ground
from .attempts import sync_attempts
from .env import BEGUN, COMMANDED, RING, Delays, EpisodeArrays, Scene, SkillSettings, launched_world
from .factory import FAST, kernel_name
from .random import ANY_LEVEL, COMMAND, RESET, make_stream, uniform
from .track import update_paw_kinematics
from .view import RobotArrays, base_quat, base_velocity, load_view, yaw_of

wp.set_module_options({"enable_backward": False})


@wp.func
def previous_state(old: Any, done: float):
    """Return the previous episode's task state, with `steps` 0 if `Env.reset` interrupted the episode.

    Resets of tasks count an episode with steps in their statistics and levels; an interrupted one is no success or
    failure. old: its state; done: 0 if it was interrupted.
    """
    state = old
    if done == 0.0:
        state.steps = 0
    return state


def make_reset_kernel(task: Any) -> wp.Kernel:
    """Return the kernel that begins episodes by `task.reset.func` and samples a task's commands within episodes.

    task: see `jumper_warp.tasks.cfg.TaskCfg`.
    """
    reset, due, command = task.reset.func, task.command.resample_due, task.command.resample
    settings_type, level_type = task.settings_type, task.level_type

    name = kernel_name("reset_kernel", task.state, settings_type, level_type)

    @wp.kernel(name=name, module="unique", module_options=FAST)
    def reset_kernel(
        # in
        skill: int,
        lanes: int,
        mask: wp.array(dtype=float),
        scene: Scene,
        skills: wp.array(dtype=SkillSettings),
        settings: wp.array(dtype=settings_type),
        levels: wp.array(dtype=level_type),
        # in, out
        episode: EpisodeArrays,
        states: wp.array(dtype=task.state),
        arrays: RobotArrays,
    ):
        """Begin a new episode where mask != 0, else sample a command where one is due; launch over (worlds, lanes).

        Worlds of `skill` only; mask: (num_worlds,). All lanes of a world (one warp) run the task's reset, which splits
        its work by `rng.lane`; lane 0 writes the state. A world that passed the last level uses a sampled one.
        """
        index, lane = wp.tid()
        world = launched_world(episode, index)
        if world < 0 or episode.skill[world] != skill:
            return
        begins = mask[world] != 0.0
        commanded = bool(False)
        if wp.static(due is not None):
            commanded = wp.static(due)(states[world])
        if not (begins or commanded):
            return
        rng = make_stream(episode.seed, episode.purpose, world, episode.step_count[world], RESET)
        rng.lane = lane
        rng.lanes = lanes
        level = episode.level[world]
        if level >= levels.shape[0]:
            level = wp.min(int(uniform(rng, ANY_LEVEL, 0.0, float(levels.shape[0]))), levels.shape[0] - 1)
        if begins:
            old = previous_state(states[world], episode.done[world])
            state = wp.static(reset)(arrays, scene, skills[skill], old, settings[0], levels[level], rng)
            sync_attempts(rng)
            if lane == 0:
                states[world] = state
                episode.history_reset[world] = BEGUN
                episode.diverged[world] = 0
                episode.bad_action[world] = 0
        elif wp.static(command is not None):
            if lane == 0:
                robot = load_view(arrays, scene.ground, world)
                fresh = make_stream(episode.seed, episode.purpose, world, episode.step_count[world], COMMAND)
                states[world] = wp.static(command)(robot, scene, states[world], levels[level], fresh)
                episode.history_reset[world] = COMMANDED

    return reset_kernel


def make_set_command_kernel(task: Any) -> wp.Kernel:
    """Return the kernel that sets a task's commands from the host; task: see `jumper_warp.tasks.cfg.TaskCfg`."""
    set_command = task.command.set

    @wp.kernel(name=kernel_name("set_command_kernel", task.state), module="unique", enable_backward=False)
    def set_command_kernel(
        # in
        skill: int,
        mask: wp.array(dtype=float),
        begins: int,
        values: wp.array(dtype=wp.vec4),
        headings: wp.array(dtype=float),
        scene: Scene,
        arrays: RobotArrays,
        # in, out
        episode: EpisodeArrays,
        states: wp.array(dtype=task.state),
    ):
        """Set the command `values` where mask != 0, in worlds of `skill`; one thread per world.

        begins 1: first command of a new episode, relative to `headings` [rad]; 0: relative to the robot's present yaw.
        """
        world = wp.tid()
        if episode.skill[world] != skill or mask[world] == 0.0:
            return
        robot = load_view(arrays, scene.ground, world)
        if begins != 0:
            fresh = task.state()
            states[world] = wp.static(set_command)(robot, scene, fresh, values[world], headings[world])
            episode.history_reset[world] = BEGUN
            episode.diverged[world] = 0
        else:
            states[world] = wp.static(set_command)(robot, scene, states[world], values[world], yaw_of(robot.quat))
            if episode.history_reset[world] != BEGUN:
                episode.history_reset[world] = COMMANDED

    return set_command_kernel


@wp.func
def leg_limits(params: FilterParams) -> LegLimits:
    """Return the angle limits [rad] of a command filter as `LegLimits` of the inverse kinematics.

    Start states thus lie within the limits that the filter enforces, unless a task's reset has a wider limit.
    """
    limits = LegLimits()
    limits.lateral_lower = params.lateral.lower
    limits.lateral_upper = params.lateral.upper
    limits.transversal_lower = params.transversal.lower
    limits.transversal_upper = params.transversal.upper
    limits.sum_lower = params.sum.lower
    limits.sum_upper = params.sum.upper
    return limits


@wp.func
def write_default_pose(arrays: RobotArrays, scene: Scene, world: int, heading: float, ground_height: float):
    """Write the default pose at rest to a world, at x = y = 0; heading: yaw [rad]; ground_height [m]."""
    q = world * COORDS
    for j in range(int(COORDS)):
        arrays.joint_q[q + j] = scene.reference_q[q + j]
    for j in range(int(DOFS)):
        arrays.joint_qd[world * DOFS + j] = 0.0
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), heading)
    for j in range(4):
        arrays.joint_q[q + 3 + j] = turn[j]
    arrays.joint_q[q + 2] = scene.reference_q[q + 2] + ground_height


@wp.kernel
def default_pose_kernel(
    # in
    mask: wp.array(dtype=float),
    headings: wp.array(dtype=float),
    scene: Scene,
    skills: wp.array(dtype=SkillSettings),
    skill: wp.array(dtype=int),
    # in, out
    arrays: RobotArrays,
):
    """Write the default pose with yaw `headings` [rad], and the block's start position, in worlds with mask != 0.

    The robot is above the ground by the `eval_height_offset` of the world's skill; one thread per world.
    """
    world = wp.tid()
    if mask[world] != 0.0:
        rest_block(scene.ground, world)
        height = surface(world_ground(scene.ground, world), 0.0, 0.0)[0] + skills[skill[world]].eval_height_offset
        write_default_pose(arrays, scene, world, headings[world], height)


@wp.kernel
def advance_rng_kernel(
    # in
    mask: wp.array(dtype=float),
    # in, out
    episode: EpisodeArrays,
):
    """Increment the step count of worlds with mask != 0, which renews their random streams; one thread per world.

    Without a policy step in between, two resets would otherwise sample the same start.
    """
    world = episode.first + wp.tid()
    if mask[world] != 0.0:
        episode.step_count[world] = episode.step_count[world] + 1


@wp.kernel
def clear_history_kernel(
    # in
    first: int,
    mask: wp.array(dtype=float),
    geometry: wp.array(dtype=LegGeometry),
    # in, out
    arrays: RobotArrays,
    delays: Delays,
):
    """Clear the stored actions, torques, contacts and wrenches of worlds with mask != 0; a thread per (motor, world).

    Present and past motor targets become the present angles as the position sensors read them, so that motors at rest
    have no torque; paw and base kinematics are updated. first: world of the first thread.
    """
    m, world = wp.tid()
    world += first
    if mask[world] == 0.0:
        return
    slot = motor_slot(m)
    angle = arrays.joint_q[world * COORDS + 7 + slot] + arrays.joint_offset[m, world]
    arrays.torque[m, world] = 0.0
    arrays.prev_torque[m, world] = 0.0
    arrays.action[m, world] = 0.0
    arrays.prev_action[m, world] = 0.0
    arrays.prev_prev_action[m, world] = 0.0
    arrays.target[m, world] = angle
    arrays.filtered_target[m, world] = angle
    arrays.prev_rate[m, world] = arrays.joint_qd[world * DOFS + 6 + slot]
    for i in range(RING):
        delays.target_history[i, m, world] = angle
    delays.current_target[m, world] = angle
    delays.prev_target[m, world] = angle
    if m < 4:
        arrays.impulse[m, world] = wp.vec3(0.0)
        arrays.paw_force[m, world] = wp.vec3(0.0)
        arrays.peak_force[m, world] = 0.0
        arrays.contact_time[m, world] = 0.0
        arrays.air_time[m, world] = 0.0
        arrays.touchdown_speed[m, world] = 0.0
        arrays.paw_height[m, world] = 0.0
        arrays.collisions[m, world] = 0
        update_paw_kinematics(arrays, leg_of(geometry, world, m), world, m)
    if m == 0:
        arrays.diverged[world] = 0
        arrays.body_f[world * BODIES] = wp.spatial_vector()
        delays.switch_step[world] = 0
        arrays.prev_lin_vel[world] = base_velocity(arrays, world, base_quat(arrays, world))
