"""Equal starts for measuring a policy."""

import warp as wp

from ..layout import COORDS, DOFS
from ..terrain.ground import Ground, rest_block, surface, world_ground
from .reset import begin_next_jump
from .reset_draws import turned
from .task import LANDED, JumpTask, yaw_of

wp.set_module_options({"enable_backward": False})


@wp.kernel
def begin_evaluation_kernel(
    # in
    goals: wp.array(dtype=wp.vec3),
    headings: wp.array(dtype=float),
    command_step: wp.array(dtype=int),
    ground: Ground,
    reference_q: wp.array(dtype=float),
    # out
    tasks: wp.array(dtype=JumpTask),
    joint_q: wp.array(dtype=float),
    joint_qd: wp.array(dtype=float),
):
    """Stand every world in the model's reference pose with its heading [rad] and goal; one thread per world.

    Goals [m] are relative to the start and heading; the jump is commanded at policy step `command_step`.
    """
    world = wp.tid()
    rest_block(ground, world)
    for j in range(int(COORDS)):
        joint_q[world * COORDS + j] = reference_q[world * COORDS + j]
    for j in range(int(DOFS)):
        joint_qd[world * DOFS + j] = 0.0
    i = world * COORDS
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), headings[world])
    for j in range(4):
        joint_q[i + 3 + j] = turn[j]
    task = JumpTask()
    task.heading = headings[world]
    here = world_ground(ground, world)
    joint_q[i + 2] = joint_q[i + 2] + surface(here, 0.0, 0.0)[0]
    task.level = tasks[world].level
    task.start = wp.vec3(joint_q[i], joint_q[i + 1], joint_q[i + 2])
    task.goal = turned(goals[world], headings[world]) + wp.vec3(task.start[0], task.start[1], 0.0)
    task.goal_ground = surface(here, task.goal[0], task.goal[1])[0]
    task.max_height = joint_q[i + 2]
    task.command_step = command_step[world]
    tasks[world] = task


@wp.kernel
def next_jump_kernel(
    # in
    goals: wp.array(dtype=wp.vec3),
    chosen: wp.array(dtype=int),
    ground: Ground,
    joint_q: wp.array(dtype=float),
    # in, out
    tasks: wp.array(dtype=JumpTask),
):
    """Command another jump in chosen worlds that have landed; goals [m] relative to base and yaw; thread per world."""
    world = wp.tid()
    if chosen[world] == 0 or tasks[world].phase != LANDED:
        return
    i = world * COORDS
    pos = wp.vec3(joint_q[i], joint_q[i + 1], joint_q[i + 2])
    quat = wp.quat(joint_q[i + 3], joint_q[i + 4], joint_q[i + 5], joint_q[i + 6])
    tasks[world] = begin_next_jump(tasks[world], world_ground(ground, world), goals[world], pos, yaw_of(quat))
