"""Motor model: position control, torque-speed envelope and over-speed protection.

Motors are numbered 3 * leg + j: legs FL, FR, BL, BR; j lateral, outer, inner. A positive torque raises the motor's
angle: it swings the paw outward (lateral), or the thigh away from the leg's other thigh (outer, inner).
"""

import warp as wp

from ..layout import COORDS, DOFS, motor_slot
from ..scalar import real


@wp.struct
class MotorParams:
    """Gains, torque limits, speeds where torque drops, and sensor offset of a motor, at the joint (behind the gear)."""

    kp: real  # [N m/rad]
    kd: real  # [N m s/rad]
    saturation: real  # [N m] largest torque that the controller commands, either way
    peak: real  # [N m] largest torque that the motor delivers, up to the cutoff speed
    cutoff_speed: real  # [rad/s] full driving torque up to here
    no_load_speed: real  # [rad/s] no driving torque from here, > cutoff_speed
    offset: real  # [rad] added by the position sensor to the true angle
    fade_start: real  # [rad/s] over-speed protection reduces the torque from here
    fade_end: real  # [rad/s] no torque from here, > fade_start


@wp.struct
class MotorArrays:
    """Gains, limits and sensor offsets of the motors of all worlds; motors by leg FL, FR, BL, BR."""

    kp: wp.array2d(dtype=real)  # [N m/rad] (12, num_worlds)
    kd: wp.array2d(dtype=real)  # [N m s/rad] (12, num_worlds)
    saturation: wp.array2d(dtype=real)  # [N m] (12, num_worlds) largest torque that the controller commands
    peak: wp.array2d(dtype=real)  # [N m] (12, num_worlds) largest torque that the motor delivers
    cutoff_speed: wp.array2d(dtype=real)  # [rad/s] (12, num_worlds) full driving torque up to here
    no_load_speed: wp.array2d(dtype=real)  # [rad/s] (12, num_worlds) no driving torque from here
    offset: wp.array2d(dtype=real)  # [rad] (12, num_worlds) added by the position sensor to the true angle
    fade_start: real  # [rad/s] over-speed protection reduces the torque of every motor from here
    fade_end: real  # [rad/s] no torque from here


@wp.func
def load_motor(motors: MotorArrays, motor: int, world: int) -> MotorParams:
    """Return gains, limits and sensor offset of motor 0 to 11 of a world."""
    params = MotorParams()
    params.kp = motors.kp[motor, world]
    params.kd = motors.kd[motor, world]
    params.saturation = motors.saturation[motor, world]
    params.peak = motors.peak[motor, world]
    params.cutoff_speed = motors.cutoff_speed[motor, world]
    params.no_load_speed = motors.no_load_speed[motor, world]
    params.offset = motors.offset[motor, world]
    params.fade_start = motors.fade_start
    params.fade_end = motors.fade_end
    return params


@wp.func
def envelope(direction: real, vel: real, motor: MotorParams) -> real:
    """Return a motor's largest torque [N m], >= 0, along `direction` (+1 or -1) at joint speed `vel` [rad/s].

    The motor brakes with its peak torque. Its driving torque is at most the peak up to the cutoff speed, and falls
    linearly to 0 at the no-load speed. The controller commands at most the saturation torque.
    """
    headroom = (motor.no_load_speed - direction * vel) / (motor.no_load_speed - motor.cutoff_speed)
    return wp.min(motor.saturation, motor.peak * wp.clamp(headroom, real(0.0), real(1.0)))


@wp.func
def motor_torque(target: real, pos: real, vel: real, motor: MotorParams) -> real:
    """Return a motor's torque [N m] at the joint for a target [rad], the true position [rad] and speed [rad/s].

    The torque of the position control is bounded by the torque-speed envelope. Over-speed protection then reduces it,
    in driving and in braking. The controller reads the true position plus `offset`, the error of the sensor.
    """
    command = motor.kp * (target - (pos + motor.offset)) - motor.kd * vel
    bounded = wp.clamp(command, -envelope(real(-1.0), vel, motor), envelope(real(1.0), vel, motor))
    fade = (motor.fade_end - wp.abs(vel)) / (motor.fade_end - motor.fade_start)
    return bounded * wp.clamp(fade, real(0.0), real(1.0))


@wp.kernel
def motor_torque_kernel(
    # in
    target: wp.array2d(dtype=real),
    joint_q: wp.array(dtype=real),
    joint_qd: wp.array(dtype=real),
    motors: MotorArrays,
    # out
    joint_f: wp.array(dtype=real),
):
    """Write the motor torques [N m] to their entries of Newton's joint_f; launch over (12, num_worlds).

    target [rad]: (12, num_worlds). joint_q, joint_qd, joint_f: flat over worlds; other entries of joint_f stay.
    `motor_slot` skips the passive knees.
    """
    motor, world = wp.tid()
    coord = COORDS * world + 7 + motor_slot(motor)
    dof = DOFS * world + 6 + motor_slot(motor)
    params = load_motor(motors, motor, world)
    joint_f[dof] = motor_torque(target[motor, world], joint_q[coord], joint_qd[dof], params)
