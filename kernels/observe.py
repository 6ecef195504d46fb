"""The policy's observations, with sensor noise."""

import warp as wp

from .task import JumpTask, RobotView, ViewArrays, commanded, load_view

wp.set_module_options({"enable_backward": False})


@wp.struct
class SensorNoise:
    """Standard deviations of the observation noise; draws are Gaussian, cut at one standard deviation."""

    lin_vel: float  # [m/s]
    ang_vel: float  # [rad/s]
    gravity: float  # [1]
    angle: float  # [rad]
    rate: float  # [rad/s]
    height: float  # [m]


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
    out[world, 2] = noisy(view.pos[2], noise.height, state, 2)
    return 3


def make_observe_kernel(observe_task: wp.Function) -> wp.Kernel:
    """Return the observation kernel of a task; observe_task writes the task's own columns, which come first."""

    @wp.kernel(module="unique", enable_backward=False)
    def observe_kernel(
        # in
        arrays: ViewArrays,
        tasks: wp.array(dtype=JumpTask),
        offset: wp.array2d(dtype=float),
        noise: SensorNoise,
        only: wp.array(dtype=float),
        everywhere: int,
        before: wp.array2d(dtype=float),
        # in, out
        random: wp.array(dtype=wp.uint32),
        # out
        out: wp.array2d(dtype=float),
    ):
        """Write every world's observation; unless everywhere = 1, copy `before` where `only` is 0."""
        world = wp.tid()
        if everywhere == 0 and only[world] == 0.0:
            for j in range(out.shape[1]):
                out[world, j] = before[world, j]
            return
        state = random[world]
        view = load_view(arrays, world, 0.1)
        first = observe_task(out, world, view, tasks[world], noise, state)
        observe_robot(out, world, first, view, offset, noise, state)
        for j in range(out.shape[1]):
            if not wp.isfinite(out[world, j]):
                out[world, j] = 0.0
        random[world] = wp.rand_init(int(state), world)

    return observe_kernel
