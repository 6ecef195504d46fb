"""Reference state initialisation: episodes begin at the stages of a jump (paper, Section V-D).

Standing or squatting on given paw positions, the default pose, in flight on a projectile to the goal, just before
touchdown, and just landed. Joint angles come from the closed-form inverse kinematics and joint rates from the leg's
Jacobian, so every state satisfies the loops. A draw whose paws cannot be reached within limits, whose links touch, or
whose paws are below the ground is drawn again; the default pose stands in after the last attempt.
"""

import warp as wp

from .collision import world_collisions
from .geometry import LegGeometry
from .ground import Ground, surface
from .inverse_kinematics import LegLimits, clamped_closed_form
from .jump_phase import GRAVITY
from .leg_kinematics import leg_forward_kinematics, leg_inverse_velocity
from .parameters import COORDS, DOFS
from .scalar import real
from .state import leg_coord, leg_dof, store_motors
from .task import FLIGHT, LANDED, JumpTask

wp.set_module_options({"enable_backward": False})

STANDING = wp.constant(0)
DEFAULT = wp.constant(1)
IN_FLIGHT = wp.constant(2)
TOUCHDOWN = wp.constant(3)
AFTER_LANDING = wp.constant(4)

ATTEMPTS = wp.constant(8)


@wp.struct
class ResetRanges:
    """Ranges of the drawn states; pairs are (lower, upper), angles [rad], lengths [m]."""

    shares: wp.vec4  # cumulative shares of standing, default, in flight, touchdown; the rest has landed
    base_xy: float  # half width
    tilt: float  # half width of roll, pitch; of yaw too around the heading
    forward_pitch: float  # added to the pitch of standing states
    heading: float  # half width of the heading
    front_x: wp.vec2  # paw ahead of the base
    front_y: wp.vec2  # paw beside the base, absolute
    back_x: wp.vec2  # paw behind the base, absolute
    back_y: wp.vec2
    takeoff_height: wp.vec2
    flight_time: wp.vec2  # share of the time in the air
    flight_lateral: float  # half width
    flight_transversal: wp.vec2
    touchdown_time: wp.vec2  # [s] before landing
    paw_depth: wp.vec2  # paws below the base before touchdown
    landed_height: wp.vec2
    landed_speed: wp.vec2  # [m/s] downward
    command_delay: int  # most policy steps until the jump is commanded


@wp.struct
class Draw:
    """A drawn state; paws relative to the base origin, world axes."""

    pos: wp.vec3
    quat: wp.quat
    lin_vel: wp.vec3
    lateral: float  # [rad], in flight only
    use_paws: int  # 1: joint angles from the paw positions; 0: from `lateral` and the flight range


@wp.func
def between(state: wp.uint32, column: int, lower: float, upper: float) -> float:
    """Return a uniform draw, independent for every column."""
    draw = wp.rand_init(int(state), column)
    return lower + (upper - lower) * wp.randf(draw)


@wp.func
def draw_quat(state: wp.uint32, ranges: ResetRanges, heading: float, pitch: float) -> wp.quat:
    """Return an orientation (xyzw) around a heading and a pitch [rad]."""
    yaw = heading + between(state, 10, -ranges.tilt, ranges.tilt)
    tip = pitch + between(state, 11, -ranges.tilt, ranges.tilt)
    roll = between(state, 12, -ranges.tilt, ranges.tilt)
    return (
        wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)
        * wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), tip)
        * wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), roll)
    )


@wp.func
def draw_scheme(state: wp.uint32, ranges: ResetRanges) -> int:
    """Return a reset scheme by the shares."""
    u = between(state, 1, 0.0, 1.0)
    scheme = int(AFTER_LANDING)
    for i in range(4):
        if u < ranges.shares[3 - i]:
            scheme = 3 - i
    return scheme


@wp.func
def draw_paw(state: wp.uint32, ranges: ResetRanges, leg: int, heading: float) -> wp.vec3:
    """Return a paw's place on the ground [m] relative to the spot under the base, world axes, z = 0."""
    x = between(state, 20 + leg, ranges.front_x[0], ranges.front_x[1])
    y = between(state, 24 + leg, ranges.front_y[0], ranges.front_y[1])
    if leg >= 2:
        x = -between(state, 20 + leg, ranges.back_x[0], ranges.back_x[1])
        y = between(state, 24 + leg, ranges.back_y[0], ranges.back_y[1])
    if leg % 2 == 1:
        y = -y
    return wp.quat_rotate(wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), heading), wp.vec3(x, y, 0.0))


@wp.func
def draw_base(
    state: wp.uint32, ranges: ResetRanges, scheme: int, heading: float, height: wp.vec2, goal: wp.vec3
) -> Draw:
    """Return pose and velocity of the base for a scheme of the vertical jump; goal as in `JumpTask`."""
    d = Draw()
    x = between(state, 2, -ranges.base_xy, ranges.base_xy)
    y = between(state, 3, -ranges.base_xy, ranges.base_xy)
    d.quat = draw_quat(state, ranges, heading, 0.0)
    d.use_paws = 1
    if scheme == STANDING:
        d.pos = wp.vec3(x, y, between(state, 4, height[0], height[1]))
        d.quat = draw_quat(state, ranges, heading, ranges.forward_pitch)
    elif scheme == AFTER_LANDING:
        d.pos = wp.vec3(x, y, between(state, 4, ranges.landed_height[0], ranges.landed_height[1]))
        d.lin_vel = wp.vec3(0.0, 0.0, -between(state, 5, ranges.landed_speed[0], ranges.landed_speed[1]))
    else:
        takeoff = between(state, 4, ranges.takeoff_height[0], ranges.takeoff_height[1])
        speed = wp.sqrt(wp.max(2.0 * GRAVITY * (goal[2] - takeoff), 0.0))
        whole = 2.0 * speed / GRAVITY
        t = whole * between(state, 5, ranges.flight_time[0], ranges.flight_time[1])
        if scheme == TOUCHDOWN:
            t = wp.max(whole - between(state, 5, ranges.touchdown_time[0], ranges.touchdown_time[1]), 0.0)
        else:
            d.use_paws = 0
            d.lateral = between(state, 6, -ranges.flight_lateral, ranges.flight_lateral)
        d.pos = wp.vec3(x, y, takeoff + speed * t - 0.5 * GRAVITY * t * t)
        d.lin_vel = wp.vec3(0.0, 0.0, speed - GRAVITY * t)
    return d


@wp.func
def draw_leg_in_flight(state: wp.uint32, ranges: ResetRanges, leg: int, lateral: float) -> wp.vec3:
    """Return motor angles [rad] of a leg in flight: both thighs about alike, all legs about alike."""
    middle = between(state, 7, ranges.flight_transversal[0], ranges.flight_transversal[1])
    outer = wp.clamp(
        middle + between(state, 30 + leg, -0.1, 0.1), ranges.flight_transversal[0], ranges.flight_transversal[1]
    )
    inner = wp.clamp(
        middle + between(state, 34 + leg, -0.1, 0.1), ranges.flight_transversal[0], ranges.flight_transversal[1]
    )
    return wp.vec3(lateral + between(state, 38 + leg, -0.03, 0.03), outer, inner)


@wp.func
def store_leg(
    geo: LegGeometry, limits: LegLimits, world: int, leg: int, d: Draw, paw: wp.vec3, angles_in_flight: wp.vec3,
    moving: int, joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
) -> int:  # fmt: skip
    """Write a leg's motor angles and rates; returns 0 if its paw position [m], relative to the base, is out of reach.

    moving = 1: the paw rests on the ground while the base moves, so the joints move too.
    """
    angles = angles_in_flight
    if d.use_paws != 0:
        ankle = wp.quat_rotate_inv(d.quat, paw)
        angles = clamped_closed_form(geo, limits, ankle - geo.hip)
        if wp.length(leg_forward_kinematics(geo, angles[0], angles[1], angles[2]) - ankle) > 1.0e-4:
            return 0
    rates = wp.vec3(0.0)
    if moving != 0:
        rates = leg_inverse_velocity(geo, angles, -wp.quat_rotate_inv(d.quat, d.lin_vel))
        if wp.length(rates) > 30.0:
            return 0
    store_motors(joint_q, leg_coord(world, leg), angles)
    store_motors(joint_qd, leg_dof(world, leg), rates)
    return 1


@wp.func
def store_draw(
    geometry: wp.array(dtype=LegGeometry), ground: Ground, limits: LegLimits, ranges: ResetRanges, state: wp.uint32,
    world: int, scheme: int, d: Draw, heading: float, lift: float,
    joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
) -> int:  # fmt: skip
    """Write a drawn state; returns 0 if it cannot be taken. lift [m]: ground height under the base."""
    q = world * COORDS
    for j in range(3):
        joint_q[q + j] = d.pos[j]
        joint_qd[world * DOFS + j] = d.lin_vel[j]
        joint_qd[world * DOFS + 3 + j] = 0.0
    joint_q[q + 2] = d.pos[2] + lift
    for j in range(4):
        joint_q[q + 3 + j] = d.quat[j]
    depth = between(state, 8, ranges.paw_depth[0], ranges.paw_depth[1])
    for leg in range(geometry.shape[0]):
        geo = geometry[leg]
        spot = draw_paw(state, ranges, leg, heading)
        paw = wp.vec3(0.0)
        if scheme == TOUCHDOWN:
            # paws hang below the base, a little above the ground at least
            drop = wp.min(depth, d.pos[2] - geo.paw_radius - 0.025)
            paw = wp.vec3(spot[0], spot[1], -drop)
        else:
            # on the ground, around the spot that the episode began on
            here = surface(ground, spot[0], spot[1])
            paw = wp.vec3(spot[0] - d.pos[0], spot[1] - d.pos[1], here[0] + geo.paw_radius - d.pos[2] - lift)
        air = draw_leg_in_flight(state, ranges, leg, d.lateral)
        moving = wp.where(scheme == AFTER_LANDING, 1, 0)
        if store_leg(geo, limits, world, leg, d, paw, air, moving, joint_q, joint_qd) == 0:
            return 0
        if scheme == IN_FLIGHT:
            ankle = leg_forward_kinematics(geo, air[0], air[1], air[2])
            if d.pos[2] + wp.quat_rotate(d.quat, ankle)[2] < geo.paw_radius + 0.01:
                return 0
    if world_collisions(geometry, ground, joint_q, q, real(0.0)).flags != 0:
        return 0
    return 1


@wp.func
def draw_until_taken(
    geometry: wp.array(dtype=LegGeometry), ground: Ground, limits: LegLimits, ranges: ResetRanges, state: wp.uint32,
    world: int, scheme: int, heading: float, height: wp.vec2, goal: wp.vec3,
    joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
) -> int:  # fmt: skip
    """Draw states of a scheme until one can be taken; returns 0 if none of the attempts could."""
    if scheme == DEFAULT:
        return 0
    here = surface(ground, 0.0, 0.0)
    for attempt in range(int(ATTEMPTS)):
        fresh = wp.rand_init(int(state), attempt)
        d = draw_base(fresh, ranges, scheme, heading, height, goal)
        if (
            store_draw(geometry, ground, limits, ranges, fresh, world, scheme, d, heading, here[0], joint_q, joint_qd)
            != 0
        ):
            return 1
    return 0


@wp.func
def store_default(
    reference_q: wp.array(dtype=float), world: int, heading: float, lift: float,
    joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
):  # fmt: skip
    """Write the model's reference pose at rest, turned to a heading [rad]."""
    q = world * COORDS
    for j in range(int(COORDS)):
        joint_q[q + j] = reference_q[q + j]
    for j in range(int(DOFS)):
        joint_qd[world * DOFS + j] = 0.0
    turn = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), heading)
    for j in range(4):
        joint_q[q + 3 + j] = turn[j]
    joint_q[q + 2] = reference_q[q + 2] + lift


@wp.func
def begin_task(
    old: JumpTask, state: wp.uint32, ranges: ResetRanges, scheme: int, goal: wp.vec3, pos: wp.vec3, vz: float
) -> JumpTask:
    """Return the state of a new episode that begins with a scheme at a base position [m] and upward speed [m/s]."""
    task = JumpTask()
    task.level = old.level
    task.streak = old.streak
    task.scheme = scheme
    task.goal = goal
    task.start = pos
    task.max_height = pos[2]
    task.command_step = int(between(state, 9, 0.0, float(ranges.command_delay) + 0.999))
    if scheme == IN_FLIGHT or scheme == TOUCHDOWN:
        task.phase = FLIGHT
        task.command_step = 0
        if vz <= 0.0:
            task.apex_passed = 1
            task.max_height = goal[2]
    if scheme == AFTER_LANDING:
        task.phase = LANDED
        task.command_step = 0
        task.apex_passed = 1
        task.max_height = goal[2]
        task.phase_steps = int(between(state, 9, 0.0, 17.999))
    return task


@wp.kernel
def reset_kernel(
    # in
    done: wp.array(dtype=float),
    geometry: wp.array(dtype=LegGeometry),
    ground: Ground,
    limits: LegLimits,
    ranges: ResetRanges,
    goal_lower: wp.array(dtype=wp.vec3),
    goal_upper: wp.array(dtype=wp.vec3),
    base_height: wp.array(dtype=wp.vec2),
    reference_q: wp.array(dtype=float),
    # in, out
    random: wp.array(dtype=wp.uint32),
    tasks: wp.array(dtype=JumpTask),
    joint_q: wp.array(dtype=float),
    joint_qd: wp.array(dtype=float),
):
    """Begin a new episode where one is done; one thread per world. Goals and base heights: one entry per level."""
    world = wp.tid()
    if done[world] == 0.0:
        return
    state = wp.rand_init(int(random[world]), world + 1)
    levels = goal_lower.shape[0]
    level = tasks[world].level
    if level >= levels:
        level = wp.min(int(between(state, 0, 0.0, float(levels))), levels - 1)
    goal = wp.vec3(0.0)
    for j in range(3):
        goal[j] = between(state, 50 + j, goal_lower[level][j], goal_upper[level][j])
    scheme = draw_scheme(state, ranges)
    heading = between(state, 13, -ranges.heading, ranges.heading)
    here = surface(ground, 0.0, 0.0)
    taken = draw_until_taken(
        geometry, ground, limits, ranges, state, world, scheme, heading, base_height[level], goal, joint_q, joint_qd
    )
    if taken == 0:
        scheme = int(DEFAULT)
        store_default(reference_q, world, heading, here[0], joint_q, joint_qd)
    pos = wp.vec3(joint_q[world * COORDS], joint_q[world * COORDS + 1], joint_q[world * COORDS + 2])
    tasks[world] = begin_task(tasks[world], state, ranges, scheme, goal, pos, joint_qd[world * DOFS + 2])
    random[world] = wp.rand_init(int(state), 99)


@wp.kernel
def clear_world_kernel(
    # in
    done: wp.array(dtype=float),
    joint_q: wp.array(dtype=float),
    # out
    impulse: wp.array2d(dtype=wp.vec3),
    paw_force: wp.array2d(dtype=wp.vec3),
    invalid: wp.array(dtype=int),
    torque: wp.array2d(dtype=float),
    action: wp.array2d(dtype=float),
    old_action: wp.array2d(dtype=float),
    safe_target: wp.array2d(dtype=float),
    old_rate: wp.array2d(dtype=float),
    old_lin_vel: wp.array(dtype=wp.vec3),
    joint_qd: wp.array(dtype=float),
):
    """Forget the past of worlds that began a new episode; one thread per world."""
    world = wp.tid()
    if done[world] == 0.0:
        return
    invalid[world] = 0
    for k in range(4):
        impulse[k, world] = wp.vec3(0.0)
        paw_force[k, world] = wp.vec3(0.0)
    for m in range(12):
        slot = 5 * (m / 3) + m % 3 + (m % 3) / 2
        torque[m, world] = 0.0
        action[m, world] = 0.0
        old_action[m, world] = 0.0
        safe_target[m, world] = joint_q[world * COORDS + 7 + slot]
        old_rate[m, world] = joint_qd[world * DOFS + 6 + slot]
    i = world * DOFS
    old_lin_vel[world] = wp.vec3(joint_qd[i], joint_qd[i + 1], joint_qd[i + 2])
