"""Motor targets on a schedule, and the record of a motion: what a rollout needs that replays recorded targets."""

import warp as wp

from ..layout import COORDS, DOFS, motor_slot
from ..scalar import real
from .motors import MotorArrays, load_motor, motor_torque

wp.set_module_options({"enable_backward": False})

RECORD_ANGLE = wp.constant(0)  # rows of a record: 12 motor angles [rad], true ones
RECORD_RATE = wp.constant(12)  # 12 motor rates [rad/s]
RECORD_TORQUE = wp.constant(24)  # 12 motor torques [N m]
RECORD_BASE = wp.constant(36)  # position of the base [m] (3), its quaternion xyzw (4)
RECORD_ROWS = wp.constant(43)


@wp.kernel
def scheduled_target_kernel(
    # in
    first: int,
    schedule: wp.array2d(dtype=real),
    latency: wp.array(dtype=real),
    clock: wp.array(dtype=int),
    slot: int,
    # out
    target: wp.array2d(dtype=real),
):
    """Write the motor targets [rad] of the step that `clock[slot]` counts; launch over (12, worlds from `first` on).

    schedule [rad], (12, steps): held from step to step. latency [steps], (num_worlds,), any fraction: the target is the
    mean of the delayed schedule over the step, so that it is continuous in the latency.
    """
    motor, world = wp.tid()
    world += first
    step = clock[slot]
    whole = wp.floor(latency[world])
    part = latency[world] - whole
    last = schedule.shape[1] - 1
    newer = wp.clamp(step - int(whole), 0, last)
    older = wp.clamp(step - int(whole) - 1, 0, last)
    target[motor, world] = (real(1.0) - part) * schedule[motor, newer] + part * schedule[motor, older]


@wp.kernel
def record_motion_kernel(
    # in
    first: int,
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    target: wp.array2d(dtype=real),
    motors: MotorArrays,
    clock: wp.array(dtype=int),
    slot: int,
    stride: int,
    lead: int,
    # out
    record: wp.array3d(dtype=real),
):
    """Write row `(clock[slot] - lead) / stride` of the record, (rows, RECORD_ROWS, num_worlds); launch over worlds.

    The torques are those that the motors give at this state towards `target`.
    """
    world = first + wp.tid()
    row = (clock[slot] - lead) / stride
    q = COORDS * world + 7
    d = DOFS * world + 6
    for motor in range(12):
        angle = joint_q[q + motor_slot(motor)]
        rate = joint_qd[d + motor_slot(motor)]
        params = load_motor(motors, motor, world)
        record[row, RECORD_ANGLE + motor, world] = angle
        record[row, RECORD_RATE + motor, world] = rate
        record[row, RECORD_TORQUE + motor, world] = motor_torque(target[motor, world], angle, rate, params)
    for i in range(7):
        record[row, RECORD_BASE + i, world] = joint_q[COORDS * world + i]


@wp.kernel
def tick_kernel(
    # in
    slot: int,
    # in, out
    clock: wp.array(dtype=int),
):
    """Count a step."""
    clock[slot] = clock[slot] + 1
