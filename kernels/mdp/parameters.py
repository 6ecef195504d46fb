"""Robot parameters that domain randomisation changes, and the events that change them (paper, Table V).

An event is a function of (parameters, rng, named numbers) that samples parameters of world `rng.world`, relative to the
nominal values. Its numbers lower and upper bound a uniform distribution. Ranges of friction and latency are absolute
and hold for the described robot; `*_move`, another robot's value minus the described one, moves them. `rng.lanes`
threads share loops over motors or links. Motors m are 0 to 11: legs FL, FR, BL, BR; each lateral, outer, inner. Sampled
ratios are stored as well, since nominal gains and limits change with the active skill, and the ratio must remain.
"""

import warp as wp

from ..actuation.motors import MotorArrays
from ..layout import BODIES, DOFS, motor_slot
from .random import RngStream, uniform

wp.set_module_options({"enable_backward": False, "max_unroll": 1})  # long loops in short code


@wp.struct
class RobotParameters:
    """Robot parameters of all worlds that randomisation changes, and their nominal values (`nominal_*`)."""

    body_mass: wp.array(dtype=float)  # [kg] (21 num_worlds,) of Newton's model
    body_inv_mass: wp.array(dtype=float)  # [1/kg] (21 num_worlds,)
    body_com: wp.array(dtype=wp.vec3)  # [m] (21 num_worlds,) body axes
    body_inertia: wp.array(dtype=wp.mat33)  # [kg m^2] (21 num_worlds,) body axes
    body_inv_inertia: wp.array(dtype=wp.mat33)  # [1/(kg m^2)] (21 num_worlds,) body axes
    joint_armature: wp.array(dtype=float)  # [kg m^2] (38 num_worlds,) 6 dofs of the base first
    joint_friction: wp.array(dtype=float)  # [N m] (38 num_worlds,) 6 dofs of the base first
    shape_mu: wp.array(dtype=float)  # [1] (shapes,) dynamic friction coefficient of each shape
    paw_shapes: wp.array(dtype=int)  # (4 num_worlds,) indices of the paws in shape_mu
    static_ratio: wp.array(dtype=float)  # [1] (num_worlds,) static over dynamic friction
    motors: MotorArrays  # constants of all motors
    latency: wp.array(dtype=int)  # [physics steps] (num_worlds,) from action to motor
    observation_latency: wp.array(dtype=int)  # [physics steps] (num_worlds,) from sensor to policy
    push: wp.array(dtype=wp.spatial_vector)  # [N], [N m] (num_worlds,) on the base at its com, world axes
    gain_ratio: wp.array2d(dtype=wp.vec2)  # [1] (12, num_worlds) kp, kd over the active skill's nominal values
    speed_ratio: wp.array2d(dtype=wp.vec2)  # [1] (12, num_worlds) no-load, cutoff speed over nominal values
    torque_ratio: wp.array2d(dtype=float)  # [1] (12, num_worlds) torque limit over nominal value
    physics_dt: float  # [s] physics step
    nominal_mass: wp.array(dtype=float)  # [kg] (21 robots,), which worlds take in turn
    nominal_com: wp.array(dtype=wp.vec3)  # [m] (21 robots,) body axes
    nominal_inertia: wp.array(dtype=wp.mat33)  # [kg m^2] (21 robots,) body axes
    nominal_inv_inertia: wp.array(dtype=wp.mat33)  # [1/(kg m^2)] (21 robots,) body axes
    nominal_armature: wp.array(dtype=float)  # [kg m^2] (38 robots,)
    nominal_kp: wp.array2d(dtype=float)  # [N m/rad] (skills, 12 robots)
    nominal_kd: wp.array2d(dtype=float)  # [N m s/rad] (skills, 12 robots)
    nominal_no_load: wp.array2d(dtype=float)  # [rad/s] (skills, 12 robots) no-load speed
    nominal_cutoff: wp.array2d(dtype=float)  # [rad/s] (skills, 12 robots) cutoff speed
    nominal_saturation: wp.array2d(dtype=float)  # [N m] (skills, 12 robots) torque limit
    nominal_offset: wp.array(dtype=float)  # [rad] (12 robots,) of the position sensors
    zero_latency: float  # [s] latency from action to motor that is sampled with `zero_probability`
    motor_friction_move: wp.array(dtype=float)  # [N m] (12,) added to ranges of motor friction
    friction_move: wp.vec2  # [1] added to ranges of the paws' (dynamic, static) friction
    latency_move: float  # [s] added to ranges of the latency from action to motor
    skill: wp.array(dtype=int)  # (num_worlds,) index of the active skill


@wp.func
def nominal_column(robot: RobotParameters, world: int, m: int) -> int:
    """Return the column of `nominal_kp` and of other nominal motor constants for motor m of a world's robot."""
    return (12 * world + m) % robot.nominal_kp.shape[1]


@wp.func
def moved_uniform(rng: RngStream, i: int, lower: float, upper: float, move: float) -> float:
    """Return random number i of a stream, uniform from lower + move to upper + move, both limits at least 0."""
    return uniform(rng, i, wp.max(lower + move, 0.0), wp.max(upper + move, 0.0))


@wp.func
def write_mass(robot: RobotParameters, world: int, body: int, scale: float):
    """Write mass and inertia of body `body` (0: base) of a world: nominal values times `scale`."""
    i = world * BODIES + body
    nominal = i % robot.nominal_mass.shape[0]
    mass = scale * robot.nominal_mass[nominal]
    inertia = scale * robot.nominal_inertia[nominal]
    robot.body_mass[i] = mass
    robot.body_inv_mass[i] = 1.0 / mass
    robot.body_inertia[i] = inertia
    robot.body_inv_inertia[i] = robot.nominal_inv_inertia[nominal] / scale


@wp.func
def base_mass(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Add a random mass from lower to upper [kg] to the base, and scale its inertia in proportion."""
    nominal = rng.world * BODIES % robot.nominal_mass.shape[0]
    write_mass(robot, rng.world, 0, 1.0 + uniform(rng, 0, lower, upper) / robot.nominal_mass[nominal])


@wp.func
def link_mass(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Scale mass and inertia of each leg link by a random factor from lower to upper [1]."""
    for body in range(1 + rng.lane, BODIES, rng.lanes):
        write_mass(robot, rng.world, body, uniform(rng, body, lower, upper))


@wp.func
def com_shift(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Shift the base's centre of mass along each body axis by a random distance from lower to upper [m]."""
    shift = wp.vec3(uniform(rng, 0, lower, upper), uniform(rng, 1, lower, upper), uniform(rng, 2, lower, upper))
    i = rng.world * BODIES
    robot.body_com[i] = robot.nominal_com[i % robot.nominal_com.shape[0]] + shift


@wp.func
def armature(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Scale each motor's armature by a random factor from lower to upper [1]."""
    for m in range(rng.lane, 12, rng.lanes):
        i = rng.world * DOFS + 6 + motor_slot(m)
        nominal = robot.nominal_armature[i % robot.nominal_armature.shape[0]]
        robot.joint_armature[i] = nominal * uniform(rng, m, lower, upper)


@wp.func
def motor_friction(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Sample the Coulomb friction of each motor uniformly from a range (lower, upper) [N m], shifted for each motor.

    shift: `motor_friction_move`; limits below 0 become 0.
    """
    for m in range(rng.lane, 12, rng.lanes):
        value = moved_uniform(rng, m, lower, upper, robot.motor_friction_move[m])
        robot.joint_friction[rng.world * DOFS + 6 + motor_slot(m)] = value


@wp.func
def set_gains(robot: RobotParameters, world: int, m: int, ratio: wp.vec2):
    """Write gains of motor m in a world: the active skill's nominal (kp, kd) times `ratio`."""
    skill = robot.skill[world]
    column = nominal_column(robot, world, m)
    robot.motors.kp[m, world] = robot.nominal_kp[skill, column] * ratio[0]
    robot.motors.kd[m, world] = robot.nominal_kd[skill, column] * ratio[1]


@wp.func
def set_speed_limits(robot: RobotParameters, world: int, m: int, ratio: wp.vec2):
    """Write no-load and cutoff speed of motor m in a world: the nominal speeds of the active skill times `ratio`.

    Unless both ratios are 1, the cutoff speed is at most 0.95 of the no-load speed: the torque falls from its peak to 0
    between them.
    """
    skill = robot.skill[world]
    column = nominal_column(robot, world, m)
    no_load = robot.nominal_no_load[skill, column] * ratio[0]
    cutoff = robot.nominal_cutoff[skill, column] * ratio[1]
    if ratio[0] != 1.0 or ratio[1] != 1.0:
        cutoff = wp.min(cutoff, 0.95 * no_load)
    robot.motors.no_load_speed[m, world] = no_load
    robot.motors.cutoff_speed[m, world] = cutoff


@wp.func
def set_torque_limit(robot: RobotParameters, world: int, m: int):
    """Write the torque limit of motor m in a world: the active skill's nominal limit times `torque_ratio`."""
    nominal = robot.nominal_saturation[robot.skill[world], nominal_column(robot, world, m)]
    robot.motors.saturation[m, world] = nominal * robot.torque_ratio[m, world]


@wp.func
def set_motor(robot: RobotParameters, world: int, m: int):
    """Write gains, speeds and torque limit of a world's motor m, for its active skill and stored random ratios."""
    set_gains(robot, world, m, robot.gain_ratio[m, world])
    set_speed_limits(robot, world, m, robot.speed_ratio[m, world])
    set_torque_limit(robot, world, m)


@wp.kernel
def motors_kernel(
    # in, out
    robot: RobotParameters,
):
    """Write all motor constants for the active skills (`set_motor`); one thread per (motor, world)."""
    m, world = wp.tid()
    set_motor(robot, world, m)


@wp.func
def gains(robot: RobotParameters, rng: RngStream, kp_lower: float, kp_upper: float, kd_lower: float, kd_upper: float):
    """Scale kp and kd of each motor by random factors [1] from the two ranges."""
    for m in range(rng.lane, 12, rng.lanes):
        ratio = wp.vec2(uniform(rng, m, kp_lower, kp_upper), uniform(rng, 12 + m, kd_lower, kd_upper))
        robot.gain_ratio[m, rng.world] = ratio
        set_gains(robot, rng.world, m, ratio)


@wp.func
def speed_limits(
    robot: RobotParameters, rng: RngStream, no_load_lower: float, no_load_upper: float, cutoff_lower: float,
    cutoff_upper: float,
):  # fmt: skip
    """Scale no-load and cutoff speed of each motor by random factors [1]; the cutoff stays below the no-load speed."""
    for m in range(rng.lane, 12, rng.lanes):
        ratio = wp.vec2(uniform(rng, m, no_load_lower, no_load_upper), uniform(rng, 12 + m, cutoff_lower, cutoff_upper))
        robot.speed_ratio[m, rng.world] = ratio
        set_speed_limits(robot, rng.world, m, ratio)


@wp.func
def joint_offset(robot: RobotParameters, rng: RngStream, lower: float, upper: float):
    """Set each motor's position sensor error to its nominal value plus a random error from lower to upper [rad]."""
    for m in range(rng.lane, 12, rng.lanes):
        nominal = robot.nominal_offset[nominal_column(robot, rng.world, m)]
        robot.motors.offset[m, rng.world] = nominal + uniform(rng, m, lower, upper)


@wp.func
def friction(
    robot: RobotParameters, rng: RngStream, dynamic_lower: float, dynamic_upper: float, static_lower: float,
    static_upper: float,
):  # fmt: skip
    """Sample dynamic and static friction coefficients [1] of a robot's paws from their ranges, each one shifted.

    shift: `friction_move`; limits below 0 become 0. The static coefficient is at least the dynamic coefficient.
    """
    dynamic = moved_uniform(rng, 0, dynamic_lower, dynamic_upper, robot.friction_move[0])
    static = wp.max(moved_uniform(rng, 1, static_lower, static_upper, robot.friction_move[1]), dynamic)
    for k in range(4):
        robot.shape_mu[robot.paw_shapes[4 * rng.world + k]] = dynamic
    # without dynamic friction there is no static one either
    robot.static_ratio[rng.world] = wp.where(dynamic > 0.0, static / wp.max(dynamic, 1.0e-9), 1.0)


@wp.func
def physics_steps(robot: RobotParameters, seconds: float) -> int:
    """Return a time [s] in physics steps, rounded to the nearest whole number."""
    return int(wp.round(seconds / robot.physics_dt))


@wp.func
def is_nominal(rng: RngStream, lower: float, upper: float, nominal_probability: float) -> bool:
    """Return True with `nominal_probability`: a delay gets its nominal value. Always False if lower is upper.

    A range of one value fixes the delay, as in an evaluation.
    """
    return lower < upper and uniform(rng, 1, 0.0, 1.0) < nominal_probability


@wp.func
def action_latency(robot: RobotParameters, rng: RngStream, lower: float, upper: float, zero_probability: float = 0.0):
    """Sample the latency of actions uniformly from a range (lower, upper) [s], shifted by `latency_move`.

    Limits below 0 become 0. With `zero_probability`, the latency is nominal (0 for the described robot), unless lower
    is upper.
    """
    seconds = moved_uniform(rng, 0, lower, upper, robot.latency_move)
    if is_nominal(rng, lower, upper, zero_probability):
        seconds = robot.zero_latency
    robot.latency[rng.world] = physics_steps(robot, seconds)


@wp.func
def observation_latency(
    robot: RobotParameters, rng: RngStream, lower: float, upper: float, zero_probability: float = 0.0
):
    """Sample the latency of delayed observation terms from lower to upper [s]; with `zero_probability` it is 0."""
    seconds = uniform(rng, 0, lower, upper)
    if is_nominal(rng, lower, upper, zero_probability):
        seconds = 0.0
    robot.observation_latency[rng.world] = physics_steps(robot, seconds)


@wp.func
def push(
    robot: RobotParameters, rng: RngStream, probability: float, force_lower: float, force_upper: float,
    torque_lower: float, torque_upper: float,
):  # fmt: skip
    """Set the push on the base: with `probability` a sampled force [N] and torque [N m] per world axis, else 0."""
    wrench = wp.spatial_vector()
    if uniform(rng, 6, 0.0, 1.0) < probability:
        for i in range(3):
            wrench[i] = uniform(rng, i, force_lower, force_upper)
            wrench[3 + i] = uniform(rng, 3 + i, torque_lower, torque_upper)
    robot.push[rng.world] = wrench
