"""Equal starts for measuring a policy."""

import warp as wp

from .parameters import COORDS, DOFS
from .task import JumpTask

wp.set_module_options({"enable_backward": False})


@wp.kernel
def begin_evaluation_kernel(
    # in
    goals: wp.array(dtype=wp.vec3),
    command_step: int,
    reference_q: wp.array(dtype=float),
    # out
    tasks: wp.array(dtype=JumpTask),
    joint_q: wp.array(dtype=float),
    joint_qd: wp.array(dtype=float),
):
    """Stand every world in the model's reference pose with its goal; one thread per world."""
    world = wp.tid()
    for j in range(int(COORDS)):
        joint_q[world * COORDS + j] = reference_q[world * COORDS + j]
    for j in range(int(DOFS)):
        joint_qd[world * DOFS + j] = 0.0
    i = world * COORDS
    task = JumpTask()
    task.level = tasks[world].level
    task.goal = goals[world]
    task.start = wp.vec3(joint_q[i], joint_q[i + 1], joint_q[i + 2])
    task.max_height = joint_q[i + 2]
    task.command_step = command_step
    tasks[world] = task
