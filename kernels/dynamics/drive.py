"""Inputs of the physics kernels (motor targets, forces), and arrays of their results in every world.

Motors are 3 * leg + j: legs FL, FR, BL, BR; j lateral, outer, inner. One launch makes several physics steps of a policy
step: the motors' feedback acts in each, and `delay` steps pass before a new target arrives (latency).
"""

import warp as wp

from ..actuation.motors import MotorArrays, MotorParams, load_motor, motor_torque
from ..layout import BODIES, COORDS, DOFS
from ..scalar import real, vec3, vec6
from ..state import leg_dof, load_motors
from ..terrain.ground import rest_block
from .parameters import load_vec3
from .step import RobotModel

wp.set_module_options({"enable_backward": False})


@wp.struct
class Drive:
    """Inputs that drive the robots, constant in a kernel launch: motor targets, joint forces, wrench on the base.

    `joint_f` and `body_f` have the layout of Newton's arrays, flat over worlds. Entries 0 to 5 of a world's `joint_f`
    are a wrench on the base at its com, world axes: force x, y, z [N], moment x, y, z [N m]. It is added to the wrench
    in `body_f`, see `base_wrench`. The entries of the motors are torques [N m], see `applied_torque`: they are added to
    the feedback torques if `closed_loop` is 1. The entries of knees and loop joints are not read.
    """

    closed_loop: int  # 1: the motors follow `target`; 0: motor torques are those in `joint_f`
    motors: MotorArrays
    target: wp.array2d(dtype=real)  # [rad], (12, num_worlds)
    previous: wp.array2d(dtype=real)  # [rad], (12, num_worlds), followed during the first `delay` steps
    delay: wp.array(dtype=int)  # physics steps until `target` is followed, (num_worlds,); empty: 0
    joint_f: wp.array(dtype=real)  # (DOFS num_worlds,), base wrench [N], [N m] and motor torques [N m]
    body_f: wp.array(dtype=wp.spatial_vector)  # (BODIES num_worlds,), force [N], moment [N m]; only the base's is read


@wp.struct
class LegDrive:
    """Inputs that drive one leg in a kernel launch: targets, motor constants, added torques (lateral, outer, inner)."""

    closed_loop: int  # as in `Drive`
    lateral: MotorParams
    outer: MotorParams
    inner: MotorParams
    target: vec3  # [rad]
    previous: vec3  # [rad]
    delay: int  # steps that `previous` is followed
    extra: vec3  # [N m] added to the motors' torque


@wp.struct
class Workspace:
    """Results and working arrays of the solver, which persist between launches; per-world arrays are (num_worlds,)."""

    impulse: wp.array2d(dtype=vec3)  # [N s] of each paw in the last step, world frame, (4, num_worlds)
    contact_force: wp.array2d(dtype=vec3)  # [N] on each paw in the last step, world frame, (4, num_worlds)
    peak_force: wp.array(dtype=real)  # [N] largest total paw force of the launch
    peak_paw_force: wp.array2d(dtype=real)  # [N] largest on each paw in the launch, (4, num_worlds)
    torque: wp.array2d(dtype=real)  # [N m] of each motor in the last step, (12, num_worlds)
    residual: wp.array(dtype=real)  # [m/s] of the contact iteration, largest of the launch
    sweeps: wp.array(dtype=int)  # of the contact iteration, largest number of the launch
    diverged: wp.array(dtype=int)  # 1: the state became non-finite; the world is frozen until a reset
    reference_q: wp.array(dtype=real)  # joint_q of diverged worlds, (43 num_worlds,)


@wp.func
def freeze_diverged_world(
    model: RobotModel, work: Workspace, world: int, joint_q: wp.array(dtype=real), joint_qd: wp.array(dtype=real)
):
    """Put a diverged world at rest in its reference pose, without contact forces, and reset its block.

    Newton's arrays thus contain no NaN. The world stays in that pose until it is reset (`Workspace.diverged`).
    """
    rest_block(model.ground, world)
    for i in range(int(COORDS)):
        joint_q[world * COORDS + i] = work.reference_q[world * COORDS + i]
    for i in range(int(DOFS)):
        joint_qd[world * DOFS + i] = real(0.0)
    for k in range(4):
        work.impulse[k, world] = vec3(real(0.0))
        work.contact_force[k, world] = vec3(real(0.0))


@wp.func
def load_leg_drive(drive: Drive, world: int, k: int) -> LegDrive:
    """Return the motor targets, motor constants and added torques of leg k (0 to 3) of a world."""
    leg = LegDrive()
    leg.extra = load_motors(drive.joint_f, leg_dof(world, k))
    leg.closed_loop = drive.closed_loop
    if drive.closed_loop != 0:
        leg.lateral = load_motor(drive.motors, 3 * k, world)
        leg.outer = load_motor(drive.motors, 3 * k + 1, world)
        leg.inner = load_motor(drive.motors, 3 * k + 2, world)
        leg.target = load_vec3(drive.target, 3 * k, world)
        if drive.delay.shape[0] > 0:
            leg.delay = drive.delay[world]
            leg.previous = load_vec3(drive.previous, 3 * k, world)
    return leg


@wp.func
def applied_torque(leg: LegDrive, step: int, angles: vec3, rates: vec3) -> vec3:
    """Return a leg's motor torques [N m] in step `step` of the launch (from 0), at angles [rad] and rates [rad/s]."""
    if leg.closed_loop == 0:
        return leg.extra
    target = leg.target
    if step < leg.delay:
        target = leg.previous
    motor = vec3(
        motor_torque(target[0], angles[0], rates[0], leg.lateral),
        motor_torque(target[1], angles[1], rates[1], leg.outer),
        motor_torque(target[2], angles[2], rates[2], leg.inner),
    )
    return motor + leg.extra


@wp.func
def base_wrench(joint_f: wp.array(dtype=real), body_f: wp.array(dtype=wp.spatial_vector), world: int) -> vec6:
    """Return the external wrench on the base at its com, world axes: force x, y, z [N], moment x, y, z [N m]."""
    w = body_f[world * BODIES]
    i = world * DOFS
    return vec6(
        real(w[0]) + joint_f[i], real(w[1]) + joint_f[i + 1], real(w[2]) + joint_f[i + 2],
        real(w[3]) + joint_f[i + 3], real(w[4]) + joint_f[i + 4], real(w[5]) + joint_f[i + 5],
    )  # fmt: skip
