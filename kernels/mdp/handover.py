"""Handover of a world from one skill (task) to another, as from walking to jumping; the robot's state does not change.

Each skill has its own policy, motor gains, observations and task state, of which only one is active in a world.
"""

from typing import Any

import warp as wp

from .env import BEGUN, EpisodeArrays, Scene, SkillSettings
from .factory import kernel_name
from .parameters import RobotParameters, set_motor
from .view import RobotArrays, load_view, yaw_of

wp.set_module_options({"enable_backward": False})

NONE = wp.constant(-1)  # `requested_task` without a request, `skill` of a world that no task steps


@wp.func
def hand_over(
    arrays: RobotArrays, parameters: RobotParameters, episode: EpisodeArrays, skills: wp.array(dtype=SkillSettings),
    world: int, target: int,
):  # fmt: skip
    """Make skill `target` active in a world: set its motor constants, and clear the observation history.

    The request of a task (`Env.request`) is cleared too. The policy of `target` observes previous actions. They become
    the action of `target` that yields the present filtered motor targets, as if this skill had been active before.
    """
    episode.skill[world] = target
    episode.requested_task[world] = NONE
    episode.has_command[world] = 0
    episode.history_reset[world] = BEGUN
    for m in range(12):
        offset = arrays.filtered_target[m, world] - arrays.default_angle[m]
        action = wp.clamp(offset / skills[target].action_scale[m], -1.0, 1.0)
        arrays.action[m, world] = action
        arrays.prev_action[m, world] = action
        arrays.prev_prev_action[m, world] = action
        set_motor(parameters, world, m)


@wp.kernel
def set_skill_kernel(
    # in
    mask: wp.array(dtype=float),
    skill: int,
    # in, out
    episode: EpisodeArrays,
):
    """Set the active skill of worlds with mask != 0, NONE to leave them out of all tasks; one thread per world."""
    world = episode.first + wp.tid()
    if mask[world] != 0.0:
        episode.skill[world] = skill


@wp.kernel
def restore_task_kernel(
    # in
    mask: wp.array(dtype=float),
    home: wp.array(dtype=int),
    # in, out
    parameters: RobotParameters,
    episode: EpisodeArrays,
):
    """Make the skill `home` of each world with mask != 0 active, and set its motor constants; one thread per world.

    The request of a task (`Env.request`) is cleared. home: (num_worlds,) skill with which a world's episodes begin.
    """
    world = episode.first + wp.tid()
    if mask[world] == 0.0:
        return
    episode.skill[world] = home[world]
    episode.requested_task[world] = NONE
    episode.has_command[world] = 0
    for m in range(12):
        set_motor(parameters, world, m)


def make_handover_kernel(handover: Any) -> wp.Kernel:
    """Return the kernel that performs a `jumper_warp.tasks.cfg.Handover` in the worlds in which its condition holds.

    The handover's functions are `@wp.func` of one world, with robot a `RobotView`:

    - when(robot, state of the source, requested) -> bool: whether to hand over in this step. requested: whether
      `Env.request` has requested the target task in this world.
    - begin(robot, state of the source) -> state of the target: initial state, without the requested command.
    - target.command.set(robot, scene, state of the target, values, heading) -> state of the target: state with the
      requested command, called after `begin` if the request has one. values: wp.vec4, in the units of the task.
      heading: yaw of the robot [rad], world.
    """
    when, begin, set_command = handover.when, handover.begin, handover.target.command.set

    name = kernel_name("handover_kernel", handover.source.state, handover.target.state)

    @wp.kernel(name=name, module="unique", enable_backward=False)
    def handover_kernel(
        # in
        source: int,
        target: int,
        scene: Scene,
        skills: wp.array(dtype=SkillSettings),
        moved: wp.array(dtype=int),
        # in, out
        arrays: RobotArrays,
        parameters: RobotParameters,
        episode: EpisodeArrays,
        sources: wp.array(dtype=handover.source.state),
        targets: wp.array(dtype=handover.target.state),
    ):
        """Hand over worlds from skill `source` to `target` where `handover.when` holds; one thread per world.

        A pending command of the target is set. moved: (num_worlds,) 1 where a world was handed over in this step; these
        worlds and ended ones keep their skill. sources, targets: (num_worlds,) task states of both skills.
        """
        world = episode.first + wp.tid()
        if episode.skill[world] != source or episode.done[world] != 0.0 or moved[world] != 0:
            return
        robot = load_view(arrays, scene.ground, world)
        if wp.static(when)(robot, sources[world], episode.requested_task[world] == target):
            begun = wp.static(begin)(robot, sources[world])
            if episode.requested_task[world] == target and episode.has_command[world] != 0:
                targets[world] = wp.static(set_command)(
                    robot, scene, begun, episode.pending_command[world], yaw_of(robot.quat)
                )
            else:
                targets[world] = begun
            hand_over(arrays, parameters, episode, skills, world, target)
            moved[world] = 1

    return handover_kernel
