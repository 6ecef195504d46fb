"""What domain randomisation may change of every robot, and the events that change it (paper, Table V).

An event is a pure function of (parameters, draw, named numbers) that writes one world's parameters, always from the
nominal values. Ranges are uniform; lower and upper are its numbers. Those with a loop over motors or links share it
among `draw.lanes` threads.
"""

import warp as wp

from ..actuation.motors import MotorArrays
from ..layout import BODIES, DOFS, motor_slot
from .random import RngStream, uniform

wp.set_module_options({"enable_backward": False, "max_unroll": 1})  # long loops in short code


@wp.struct
class RobotParameters:
    """Parameters of all worlds, and what they are without randomisation."""

    body_mass: wp.array(dtype=float)  # [kg] Newton's, like the next ones
    body_inv_mass: wp.array(dtype=float)
    body_com: wp.array(dtype=wp.vec3)  # [m]
    body_inertia: wp.array(dtype=wp.mat33)  # [kg m^2]
    body_inv_inertia: wp.array(dtype=wp.mat33)
    joint_armature: wp.array(dtype=float)  # [kg m^2]
    joint_friction: wp.array(dtype=float)  # [N m]
    shape_mu: wp.array(dtype=float)  # [1]
    paw_shapes: wp.array(dtype=int)  # (4 num_worlds,) indices of the paws in shape_mu
    static_ratio: wp.array(dtype=float)  # [1] (num_worlds,) static over dynamic friction
    motors: MotorArrays
    latency: wp.array(dtype=int)  # [physics steps] (num_worlds,) from action to motor
    observation_latency: wp.array(dtype=int)  # [physics steps] (num_worlds,) from sensor to policy
    push: wp.array(dtype=wp.spatial_vector)  # [N], [N m] (num_worlds,) on the base at its com, world axes
    gain_ratio: wp.array2d(dtype=wp.vec2)  # [1] (12, num_worlds) of kp and kd to those of the active skill
    speed_ratio: wp.array2d(dtype=wp.vec2)  # [1] (12, num_worlds) of no-load and cutoff speed likewise
    torque_ratio: wp.array2d(dtype=float)  # [1] (12, num_worlds) of the torque limit likewise
    physics_dt: float  # [s]
    nominal_mass: wp.array(dtype=float)  # (21,) of one world, like all below
    nominal_com: wp.array(dtype=wp.vec3)
    nominal_inertia: wp.array(dtype=wp.mat33)
    nominal_inv_inertia: wp.array(dtype=wp.mat33)
    nominal_armature: wp.array(dtype=float)  # (38,)
    nominal_kp: wp.array2d(dtype=float)  # (skills, 12), like all below
    nominal_kd: wp.array2d(dtype=float)
    nominal_no_load: wp.array2d(dtype=float)  # [rad/s]
    nominal_cutoff: wp.array2d(dtype=float)  # [rad/s]
    nominal_saturation: wp.array2d(dtype=float)  # [N m]
    nominal_offset: wp.array(dtype=float)  # [rad] (12,) of the position sensors
    skill: wp.array(dtype=int)  # (num_worlds,) the active one


@wp.func
def write_mass(robot: RobotParameters, world: int, body: int, scale: float):
    """Scale mass and inertia of a link."""
    i = world * BODIES + body
    mass = scale * robot.nominal_mass[body]
    inertia = scale * robot.nominal_inertia[body]
    robot.body_mass[i] = mass
    robot.body_inv_mass[i] = 1.0 / mass
    robot.body_inertia[i] = inertia
    robot.body_inv_inertia[i] = robot.nominal_inv_inertia[body] / scale


@wp.func
def base_mass(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Add a mass [kg] to the base, its inertia in proportion."""
    write_mass(robot, rng.world, 0, 1.0 + uniform(rng, 0, lower, upper) / robot.nominal_mass[0])


@wp.func
def link_mass(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Scale mass and inertia of each link of the legs."""
    for body in range(1 + rng.lane, BODIES, rng.lanes):
        write_mass(robot, rng.world, body, uniform(rng, body, lower, upper))


@wp.func
def com_shift(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Shift the base's centre of mass [m] along each axis."""
    shift = wp.vec3(uniform(rng, 0, lower, upper), uniform(rng, 1, lower, upper), uniform(rng, 2, lower, upper))
    robot.body_com[rng.world * BODIES] = robot.nominal_com[0] + shift


@wp.func
def armature(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Scale each motor's armature."""
    for m in range(rng.lane, 12, rng.lanes):
        dof = 6 + motor_slot(m)
        robot.joint_armature[rng.world * DOFS + dof] = robot.nominal_armature[dof] * uniform(rng, m, lower, upper)


@wp.func
def motor_friction(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Give each motor a Coulomb friction [N m]."""
    for m in range(rng.lane, 12, rng.lanes):
        robot.joint_friction[rng.world * DOFS + 6 + motor_slot(m)] = uniform(rng, m, lower, upper)


@wp.func
def set_gains(robot: RobotParameters, world: int, m: int, ratio: wp.vec2):
    """Write gains of a motor: those of the active skill, by the drawn ratios of kp and kd."""
    skill = robot.skill[world]
    robot.motors.kp[m, world] = robot.nominal_kp[skill, m] * ratio[0]
    robot.motors.kd[m, world] = robot.nominal_kd[skill, m] * ratio[1]


@wp.func
def set_speed_limits(robot: RobotParameters, world: int, m: int, ratio: wp.vec2):
    """Write no-load and cutoff speed of a motor likewise; a drawn cutoff stays below the no-load speed."""
    skill = robot.skill[world]
    no_load = robot.nominal_no_load[skill, m] * ratio[0]
    cutoff = robot.nominal_cutoff[skill, m] * ratio[1]
    if ratio[0] != 1.0 or ratio[1] != 1.0:
        cutoff = wp.min(cutoff, 0.95 * no_load)
    robot.motors.no_load_speed[m, world] = no_load
    robot.motors.cutoff_speed[m, world] = cutoff


@wp.func
def set_torque_limit(robot: RobotParameters, world: int, m: int):
    """Write the torque limit of a motor likewise."""
    robot.motors.saturation[m, world] = robot.nominal_saturation[robot.skill[world], m] * robot.torque_ratio[m, world]


@wp.func
def set_motor(robot: RobotParameters, world: int, m: int):
    """Write all constants of a motor that depend on the active skill."""
    set_gains(robot, world, m, robot.gain_ratio[m, world])
    set_speed_limits(robot, world, m, robot.speed_ratio[m, world])
    set_torque_limit(robot, world, m)


@wp.kernel
def motors_kernel(
    # in, out
    robot: RobotParameters,
):
    """Give every world the motors of its skill; one thread per (motor, world)."""
    m, world = wp.tid()
    set_motor(robot, world, m)


@wp.func
def gains(
    robot: RobotParameters, rng: RngStream, kp_lower: float, kp_upper: float, kd_lower: float, kd_upper: float
):  # fmt: skip
    """Scale kp and kd of each motor."""
    for m in range(rng.lane, 12, rng.lanes):
        ratio = wp.vec2(uniform(rng, m, kp_lower, kp_upper), uniform(rng, 12 + m, kd_lower, kd_upper))
        robot.gain_ratio[m, rng.world] = ratio
        set_gains(robot, rng.world, m, ratio)


@wp.func
def speed_limits(
    robot: RobotParameters, rng: RngStream, no_load_lower: float, no_load_upper: float, cutoff_lower: float,
    cutoff_upper: float,
):  # fmt: skip
    """Scale no-load and cutoff speed of each motor; the cutoff stays below the no-load speed."""
    for m in range(rng.lane, 12, rng.lanes):
        ratio = wp.vec2(uniform(rng, m, no_load_lower, no_load_upper), uniform(rng, 12 + m, cutoff_lower, cutoff_upper))
        robot.speed_ratio[m, rng.world] = ratio
        set_speed_limits(robot, rng.world, m, ratio)


@wp.func
def joint_offset(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Give each motor's position sensor a constant error [rad] besides its nominal one."""
    for m in range(rng.lane, 12, rng.lanes):
        robot.motors.offset[m, rng.world] = robot.nominal_offset[m] + uniform(rng, m, lower, upper)


@wp.func
def friction(
    robot: RobotParameters, rng: RngStream, dynamic_lower: float, dynamic_upper: float, static_lower: float,
    static_upper: float,
):  # fmt: skip
    """Draw the paws' dynamic coefficient, and a static one that is not below it."""
    dynamic = uniform(rng, 0, dynamic_lower, dynamic_upper)
    static = wp.max(uniform(rng, 1, static_lower, static_upper), dynamic)
    for k in range(4):
        robot.shape_mu[robot.paw_shapes[4 * rng.world + k]] = dynamic
    # without dynamic friction there is no static one either
    robot.static_ratio[rng.world] = wp.where(dynamic > 0.0, static / wp.max(dynamic, 1.0e-9), 1.0)


@wp.func
def physics_steps(robot: RobotParameters, seconds: float) -> int:
    """Return the number of physics steps that is nearest to a time; latencies are whole steps."""
    return int(wp.round(seconds / robot.physics_dt))


@wp.func
def drawn_delay(robot: RobotParameters, rng: RngStream, lower: float, upper: float, none: float) -> int:
    """Return a drawn delay [physics steps], none in a share of draws."""
    if uniform(rng, 1, 0.0, 1.0) < none:
        return 0
    return physics_steps(robot, uniform(rng, 0, lower, upper))


@wp.func
def action_latency(robot: RobotParameters, rng: RngStream, lower: float, upper: float, none: float = 0.0):
    """Delay actions [s], but not in a share of worlds."""
    robot.latency[rng.world] = drawn_delay(robot, rng, lower, upper, none)


@wp.func
def observation_latency(robot: RobotParameters, rng: RngStream, lower: float, upper: float, none: float = 0.0):
    """Delay what the policy reads of its sensors [s], but not in a share of worlds."""
    robot.observation_latency[rng.world] = drawn_delay(robot, rng, lower, upper, none)


@wp.func
def push(
    robot: RobotParameters, rng: RngStream, share: float, force_lower: float, force_upper: float, torque_lower: float,
    torque_upper: float,
):  # fmt: skip
    """Push the base with a force [N] along and a torque [N m] about each world axis in a share of draws, else not."""
    wrench = wp.spatial_vector()
    if uniform(rng, 6, 0.0, 1.0) < share:
        for i in range(3):
            wrench[i] = uniform(rng, i, force_lower, force_upper)
            wrench[3 + i] = uniform(rng, 3 + i, torque_lower, torque_upper)
    robot.push[rng.world] = wrench
