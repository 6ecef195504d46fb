"""Inputs and recorded trajectories of rollouts, and functions for their latency, motors and command filter.

A rollout has T policy steps of S physics steps. Motors are 3 * leg + j: legs FL, FR, BL, BR; j lateral, outer, inner.
Unlike in environments, the latency is a real number, so that the motion has a derivative with respect to it. Rows hold
Newton's velocities of the base (centre of mass, world axes). `BaseState` has the velocity of the origin, and the
angular velocity in body axes. Quaternions are xyzw, body to world.
"""

import warp as wp

from ..actuation.command_filter import FilterParams, Limits, filter_leg
from ..actuation.motors import MotorArrays, MotorParams, load_motor, motor_torque
from ..scalar import quat, real, vec3
from ..state import BaseState

wp.set_module_options({"enable_backward": False})

CPU_FLAGS = "-march=native -mllvm=-inline-threshold=200000 -mllvm=-inline-cold-callsite-threshold=3000"
"""Compiler flags of the kernels that plans wait for: all functions in one, without what only unused results need."""

ROW_COORDS = wp.constant(19)  # entries of a row of q: base position (3) and orientation (4, xyzw), motor angles (12)
ROW_RATES = wp.constant(18)  # of qd: velocity of the base's com (3), angular velocity (3), world; motor rates (12)

# rows of the filter's constants: 0 to 11 are lower, upper, lower_zone, upper_zone of lateral, transversal, sum
FILTER_HORIZON = wp.constant(12)  # [s]
FILTER_SPEED = wp.constant(13)  # speed floor [rad/s]
FILTER_ROWS = wp.constant(14)


EARLIEST = wp.constant(1000000)  # policy steps before the first, beyond any latency


@wp.struct
class Timing:
    """Numbers of policy and physics steps of a rollout, and of physics steps between recorded rows."""

    steps: int  # T, policy steps
    substeps: int  # S, physics steps in a policy step
    every: int  # physics steps from row to row, a divisor of S


@wp.struct
class Actuation:
    """Constants of motors, latency and command filter of every world, with which targets become torques."""

    motors: MotorArrays  # without its fades, see `fade`
    fade: wp.array2d(dtype=real)  # [rad/s], (2, num_worlds): start and end of the over-speed protection
    latency: wp.array(dtype=real)  # [s], (num_worlds,)
    filtered: int  # 0: targets are not filtered
    limits: wp.array2d(dtype=real)  # constants of the filter, (FILTER_ROWS, num_worlds)


@wp.struct
class Commands:
    """Inputs of a rollout of T policy steps: motor targets, wrenches on the base and the paws' initial impulses."""

    target: wp.array3d(dtype=real)  # [rad], (T, 12, num_worlds)
    initial_target: wp.array3d(dtype=real)  # [rad], (earlier policy steps, 12, num_worlds), the latest one last
    wrench: wp.array3d(dtype=real)  # [N], [N m] at the base's com, world axes, (T, 6, num_worlds)
    impulse: wp.array2d(dtype=vec3)  # [N s] of each paw in the step before the first, world axes, (4, num_worlds)


@wp.struct
class TrajectoryArrays:
    """Recorded states, torques, paw impulses and pressed stops of a rollout, or the gradient w.r.t. these.

    Empty gradients mean zeros; K = T S / every, see `Timing`.
    """

    q: wp.array3d(dtype=real)  # [m], [rad], (K + 1, ROW_COORDS, num_worlds)
    qd: wp.array3d(dtype=real)  # [m/s], [rad/s], (K + 1, ROW_RATES, num_worlds)
    torque: wp.array3d(dtype=real)  # [N m], (T S, 12, num_worlds)
    impulse: wp.array3d(dtype=vec3)  # [N s] on each paw, world axes, (T S, 4, num_worlds)
    pressed: wp.array3d(dtype=wp.uint8)  # sets of pressed stops, see `stops`, (T S, 4, num_worlds)


@wp.func
def row_base(pos: vec3, orientation: quat, com_lin: vec3, ang: vec3, com: vec3) -> BaseState:
    """Convert the base's entries of a trajectory row to a base state: pos [m], orientation, com_lin [m/s], ang [rad/s].

    com_lin: velocity of the com; com [m]: centre of mass in the base's frame; all others in world axes.
    """
    base = BaseState()
    base.pos = pos
    base.quat = wp.normalize(orientation)
    base.lin = com_lin - wp.cross(ang, wp.quat_rotate(base.quat, com))
    base.ang = wp.quat_rotate_inv(base.quat, ang)
    return base


@wp.func
def row_vec3(values: wp.array3d(dtype=real), row: int, first: int, world: int) -> vec3:
    """Return three consecutive entries of a trajectory row, from index `first`; values: (rows, entries, num_worlds)."""
    return vec3(values[row, first, world], values[row, first + 1, world], values[row, first + 2, world])


@wp.func
def row_quat(values: wp.array3d(dtype=real), row: int, first: int, world: int) -> quat:
    """Return a quaternion (xyzw) from a trajectory row, from index `first` on; values: (rows, entries, num_worlds)."""
    return quat(
        values[row, first, world], values[row, first + 1, world], values[row, first + 2, world],
        values[row, first + 3, world],
    )  # fmt: skip


@wp.func
def store_row_vec3(values: wp.array3d(dtype=real), row: int, first: int, world: int, v: vec3):
    """Write v to three entries of a trajectory row, from index `first`; values: (rows, entries, num_worlds)."""
    for i in range(3):
        values[row, first + i, world] = v[i]


@wp.func
def load_row_base(trajectory: TrajectoryArrays, row: int, world: int, com: vec3) -> BaseState:
    """Return the base's state stored in a trajectory row; com [m]: the base's centre of mass in its frame."""
    return row_base(
        row_vec3(trajectory.q, row, 0, world), row_quat(trajectory.q, row, 3, world),
        row_vec3(trajectory.qd, row, 0, world), row_vec3(trajectory.qd, row, 3, world), com,
    )  # fmt: skip


@wp.func
def store_row_base(trajectory: TrajectoryArrays, row: int, world: int, com: vec3, base: BaseState):
    """Write the base's state to a trajectory row; com [m]: the base's centre of mass in its frame."""
    ang = wp.quat_rotate(base.quat, base.ang)
    store_row_vec3(trajectory.q, row, 0, world, base.pos)
    for i in range(4):
        trajectory.q[row, 3 + i, world] = base.quat[i]
    store_row_vec3(trajectory.qd, row, 0, world, base.lin + wp.cross(ang, wp.quat_rotate(base.quat, com)))
    store_row_vec3(trajectory.qd, row, 3, world, ang)


@wp.func
def load_limits(table: wp.array2d(dtype=real), row: int, world: int) -> Limits:
    """Return the command filter's limits [rad] of one angle or sum of angles from the table of filter constants.

    Rows `row` to `row` + 3 of table (FILTER_ROWS, num_worlds).
    """
    limits = Limits()
    limits.lower = table[row, world]
    limits.upper = table[row + 1, world]
    limits.lower_zone = table[row + 2, world]
    limits.upper_zone = table[row + 3, world]
    return limits


@wp.func
def load_filter(table: wp.array2d(dtype=real), world: int) -> FilterParams:
    """Return the command filter's constants of a world; table: (FILTER_ROWS, num_worlds)."""
    params = FilterParams()
    params.lateral = load_limits(table, 0, world)
    params.transversal = load_limits(table, 4, world)
    params.sum = load_limits(table, 8, world)
    params.horizon = table[FILTER_HORIZON, world]
    params.speed_floor = table[FILTER_SPEED, world]
    return params


@wp.func
def load_world_motor(actuation: Actuation, motor: int, world: int) -> MotorParams:
    """Return all constants of motor 0 to 11 of a world, including the speeds of its over-speed protection."""
    params = load_motor(actuation.motors, motor, world)
    params.fade_start = actuation.fade[0, world]
    params.fade_end = actuation.fade[1, world]
    return params


@wp.struct
class Arrival:
    """Indices and weight of the two delayed policy targets between which a motor's target is interpolated."""

    older: int  # policy step of the target at the start of the physics step; below 0: `Commands.initial_target`
    newer: int  # policy step of the target at the end of the physics step
    weight: real  # of the newer target, in (0, 1]; the older one has 1 - weight


@wp.func
def arrival(step: int, substeps: int, delay: real) -> Arrival:
    """Return the indices and weight of the two delayed policy targets between which physics step `step` interpolates.

    step counts from 0. delay: latency in physics steps, a real >= 0. substeps: physics steps per policy step. A target
    that arrives exactly at the start of the step has weight 1, and the one-sided derivative toward a larger latency. No
    target arrives before it is sent.
    """
    begin = real(step) - delay
    size = real(substeps)
    a = Arrival()
    a.older = wp.clamp(int(wp.ceil(begin / size)) - 1, -EARLIEST, step / substeps)
    a.newer = wp.clamp(int(wp.ceil((begin + real(1.0)) / size)) - 1, -EARLIEST, step / substeps)
    a.weight = real(1.0)
    if a.newer > a.older:
        a.weight = begin + real(1.0) - real(a.newer) * size
    return a


@wp.func
def policy_target(
    filtered_target: wp.array3d(dtype=real), initial_target: wp.array3d(dtype=real), step: int, motor: int, world: int
) -> real:
    """Return the filtered target [rad] of motor 0 to 11 in policy step `step`, or an initial target if step < 0.

    The first initial target stands for all earlier ones.
    """
    if step < 0:
        return initial_target[wp.max(initial_target.shape[0] + step, 0), motor, world]
    return filtered_target[step, motor, world]


@wp.func
def arrived_target(
    commands: Commands, filtered_target: wp.array3d(dtype=real), arrived: Arrival, motor: int, world: int
) -> real:
    """Return the delayed target [rad] that motor 0 to 11 follows in a physics step, interpolated by `arrived`."""
    newer = policy_target(filtered_target, commands.initial_target, arrived.newer, motor, world)
    if arrived.weight == real(1.0):
        return newer
    older = policy_target(filtered_target, commands.initial_target, arrived.older, motor, world)
    return older + arrived.weight * (newer - older)


@wp.func
def leg_torque(
    commands: Commands, actuation: Actuation, filtered_target: wp.array3d(dtype=real), arrived: Arrival, leg: int,
    world: int, angles: vec3, rates: vec3,
) -> vec3:  # fmt: skip
    """Return a leg's motor torques [N m], lateral, outer, inner, in a physics step at angles [rad], rates [rad/s]."""
    torque = vec3(real(0.0))
    for j in range(3):
        motor = 3 * leg + j
        target = arrived_target(commands, filtered_target, arrived, motor, world)
        torque[j] = motor_torque(target, angles[j], rates[j], load_world_motor(actuation, motor, world))
    return torque


@wp.func
def filter_commands(
    commands: Commands, actuation: Actuation, step: int, leg: int, world: int, angles: vec3, rates: vec3,
    filtered_target: wp.array3d(dtype=real),
):  # fmt: skip
    """Apply the command filter to a leg's targets [rad] of policy step `step`, and write the filtered targets.

    angles [rad], rates [rad/s]: true values at the start of the policy step; lateral, outer, inner. The filter reads
    the measured angles: the true angles plus `actuation.motors.offset`, as the motors' controller does.
    filtered_target: (T, 12, num_worlds). Without a filter the targets are copied.
    """
    m = 3 * leg
    target = row_vec3(commands.target, step, m, world)
    if actuation.filtered != 0:
        offset = actuation.motors.offset
        measured = angles + vec3(offset[m, world], offset[m + 1, world], offset[m + 2, world])
        target = filter_leg(target, measured, rates, load_filter(actuation.limits, world))
    store_row_vec3(filtered_target, step, m, world, target)
