"""The policy's observations, with sensor noise, and the critic's, which hold what only a simulation knows."""

import warp as wp

from ..terrain.ground import Ground
from .phase import estimated_apex, estimated_landing
from .task import JumpTask, RobotView, ViewArrays, commanded, goal_offset, load_view, yaw_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class SensorNoise:
    """Standard deviations of the observation noise; draws are Gaussian, cut at one standard deviation."""

    lin_vel: float  # [m/s]
    ang_vel: float  # [rad/s]
    gravity: float  # [1]
    angle: float  # [rad]
    rate: float  # [rad/s]
    position: float  # [m]


@wp.struct
class Observations:
    """Of all worlds: (num_worlds, columns)."""

    actor: wp.array2d(dtype=float)
    critic: wp.array2d(dtype=float)


NUM_ROBOT_COLUMNS = wp.constant(45)
NUM_EPISODE_COLUMNS = wp.constant(15)


@wp.func
def is_finite(view: RobotView) -> bool:
    """Return whether everything is finite that an observation is made of."""
    total = wp.length_sq(view.pos) + wp.length_sq(view.lin_vel) + wp.length_sq(view.ang_vel)
    total += wp.dot(view.angle, view.angle) + wp.dot(view.rate, view.rate) + wp.dot(view.action, view.action)
    return wp.isfinite(total + wp.length_sq(view.gravity) + wp.dot(view.paw_force, view.paw_force))


@wp.func
def clear_row(values: wp.array2d(dtype=float), row: int, count: int):
    """Set the first `count` values of a row to 0."""
    for j in range(count):
        values[row, j] = 0.0


@wp.func
def noisy(value: float, scale: float, state: wp.uint32, column: int) -> float:
    """Return a value with cut Gaussian noise, an independent draw for every column."""
    draw = wp.rand_init(int(state), column)
    return value + scale * wp.clamp(wp.randn(draw), -1.0, 1.0)


@wp.func
def observe_robot(
    out: wp.array2d(dtype=float), world: int, first: int, view: RobotView, offset: wp.array2d(dtype=float),
    noise: SensorNoise, state: wp.uint32,
):  # fmt: skip
    """Write velocity, angular velocity, gravity (body axes), angles, rates and last action from column `first`.

    offset [rad], (12, num_worlds): constant error of each motor's position sensor.
    """
    lin = wp.quat_rotate_inv(view.quat, view.lin_vel)
    for j in range(3):
        out[world, first + j] = noisy(lin[j], noise.lin_vel, state, first + j)
        out[world, first + 3 + j] = noisy(view.ang_vel[j], noise.ang_vel, state, first + 3 + j)
        out[world, first + 6 + j] = noisy(view.gravity[j], noise.gravity, state, first + 6 + j)
    for m in range(12):
        angle = view.angle[m] + offset[m, world] - view.default_angle[m]
        out[world, first + 9 + m] = noisy(angle, noise.angle, state, first + 9 + m)
        out[world, first + 21 + m] = noisy(view.rate[m], noise.rate, state, first + 21 + m)
        out[world, first + 33 + m] = view.action[m]


@wp.func
def observe_vertical(
    out: wp.array2d(dtype=float), world: int, view: RobotView, task: JumpTask, noise: SensorNoise, state: wp.uint32
) -> int:
    """Write wanted height, jump command and base height; returns the number of columns."""
    command = float(0.0)
    if commanded(task):
        command = 1.0
    out[world, 0] = task.goal[2]
    out[world, 1] = command
    out[world, 2] = noisy(view.height, noise.position, state, 2)
    return 3


@wp.func
def in_heading(v: wp.vec3, heading: float) -> wp.vec3:
    """Return a horizontal world vector in axes turned by a heading [rad] about z."""
    return wp.quat_rotate(wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), -heading), v)


@wp.func
def observe_horizontal(
    out: wp.array2d(dtype=float), world: int, view: RobotView, task: JumpTask, noise: SensorNoise, state: wp.uint32
) -> int:
    """Write the way to the goal in the yaw-aligned frame, 0 before the command, and base height; returns 3."""
    way = wp.vec3(0.0)
    if task.steps >= task.command_step:
        way = in_heading(goal_offset(view, task), yaw_of(view.quat))
    out[world, 0] = noisy(way[0], noise.position, state, 0)
    out[world, 1] = noisy(way[1], noise.position, state, 1)
    out[world, 2] = noisy(view.height, noise.position, state, 2)
    return 3


@wp.func
def observe_episode(out: wp.array2d(dtype=float), world: int, first: int, view: RobotView, task: JumpTask):
    """Write phase, times [s], estimates [m] and paw forces for the critic, from column `first`."""
    yaw = yaw_of(view.quat)
    landing = estimated_landing(view.pos, view.lin_vel, 0.3 + task.goal_ground)
    miss = in_heading(wp.vec3(task.goal[0] - landing[0], task.goal[1] - landing[1], 0.0), yaw)
    way = in_heading(goal_offset(view, task), yaw)
    for j in range(3):
        out[world, first + j] = wp.where(task.phase == j, 1.0, 0.0)
    out[world, first + 3] = wp.min(float(task.phase_steps), 120.0) / 60.0
    out[world, first + 4] = wp.clamp(float(task.steps - task.command_step), -60.0, 180.0) / 60.0
    out[world, first + 5] = task.max_height - task.goal[2]
    out[world, first + 6] = estimated_apex(view.pos, view.lin_vel) - task.goal[2]
    out[world, first + 7] = miss[0]
    out[world, first + 8] = miss[1]
    out[world, first + 9] = way[0]
    out[world, first + 10] = way[1]
    for k in range(4):
        out[world, first + 11 + k] = wp.min(view.paw_force[k] / 140.0, 5.0)


def make_observe_kernel(observe_task: wp.Function) -> wp.Kernel:
    """Return the observation kernel of a task; observe_task writes the task's own columns, which come first."""

    @wp.kernel(module="unique", enable_backward=False)
    def observe_kernel(
        # in
        arrays: ViewArrays,
        ground: Ground,
        tasks: wp.array(dtype=JumpTask),
        offset: wp.array2d(dtype=float),
        noise: SensorNoise,
        only: wp.array(dtype=float),
        everywhere: int,
        # in, out
        random: wp.array(dtype=wp.uint32),
        # out
        out: Observations,
    ):
        """Write the observations of worlds where `only` is not 0, of all if everywhere = 1; zeros where not finite.

        The critic's columns after those of the episode are left as they are.
        """
        world = wp.tid()
        if everywhere == 0 and only[world] == 0.0:
            return
        state = random[world]
        random[world] = wp.rand_init(int(state), world)
        task = tasks[world]
        view = load_view(arrays, ground, world, 0.1)
        if not is_finite(view):
            clear_row(out.actor, world, out.actor.shape[1])
            clear_row(out.critic, world, out.actor.shape[1] + NUM_EPISODE_COLUMNS)
            return
        first = observe_task(out.actor, world, view, task, noise, state)
        observe_robot(out.actor, world, first, view, offset, noise, state)
        exact = SensorNoise()
        first = observe_task(out.critic, world, view, task, exact, state)
        observe_robot(out.critic, world, first, view, offset, exact, state)
        observe_episode(out.critic, world, first + NUM_ROBOT_COLUMNS, view, task)

    return observe_kernel
