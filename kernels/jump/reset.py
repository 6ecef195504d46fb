"""Reference state initialisation: episodes begin at the stages of a jump (paper, Section V-D).

Standing or squatting on given paw positions, the default pose, in flight on a projectile to the goal, just before
touchdown, and just landed. Joint angles come from the closed-form inverse kinematics and joint rates from the leg's
Jacobian, so every state satisfies the loops. A draw whose paws cannot be reached within limits, whose links touch, or
whose paws are below the ground is drawn again; the default pose stands in after the last attempt.
"""

import warp as wp

from ..collision.robot import world_collisions
from ..kinematics.geometry import LegGeometry
from ..kinematics.inverse import LegLimits, clamped_closed_form
from ..kinematics.leg import leg_forward_kinematics, leg_inverse_velocity
from ..layout import COORDS, DOFS, motor_slot
from ..scalar import real
from ..state import leg_coord, leg_dof, store_motors
from ..terrain.ground import Block, Ground, rest_block, surface, world_ground
from .ground_draws import GroundRanges, draw_ground, footprint
from .reset_draws import (
    AFTER_LANDING,
    DEFAULT,
    IN_FLIGHT,
    STANDING,
    TOUCHDOWN,
    Draw,
    ResetRanges,
    between,
    draw_base,
    draw_box,
    draw_paw,
    draw_scheme,
    turned,
    within,
)
from .task import FLIGHT, LANDED, STANCE, JumpTask, yaw_of

wp.set_module_options({"enable_backward": False})

ATTEMPTS = wp.constant(6)


@wp.func
def draw_leg_in_flight(state: wp.uint32, ranges: ResetRanges, leg: int, lateral: float) -> wp.vec3:
    """Return motor angles [rad] of a leg in flight: both thighs about alike, all legs about alike."""
    lower = ranges.flight_transversal[0]
    upper = ranges.flight_transversal[1]
    middle = within(state, 7, ranges.flight_transversal)
    outer = wp.clamp(middle + between(state, 30 + leg, -0.1, 0.1), lower, upper)
    inner = wp.clamp(middle + between(state, 34 + leg, -0.1, 0.1), lower, upper)
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
    depth = within(state, 8, ranges.paw_depth)
    for leg in range(geometry.shape[0]):
        geo = geometry[leg]
        spot = d.spot + draw_paw(state, ranges, leg, heading)
        paw = spot - d.pos
        if scheme == TOUCHDOWN:
            # paws hang below the base, a little above the ground at least
            paw[2] = -wp.min(depth, d.pos[2] - geo.paw_radius - 0.025)
        else:
            here = surface(ground, spot[0], spot[1])
            paw[2] = here[0] + geo.paw_radius - d.pos[2] - lift
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
def draw_again(state: wp.uint32, ranges: ResetRanges) -> int:
    """Return how many policy steps after touchdown another goal comes; 0: none."""
    steps = int(within(state, 19, ranges.again_delay))
    return wp.where(between(state, 18, 0.0, 1.0) < ranges.jump_again, wp.max(steps, 1), 0)


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
    if old.level > 0:
        task.again_step = draw_again(state, ranges)
    if scheme == IN_FLIGHT or scheme == TOUCHDOWN:
        task.phase = FLIGHT
        task.command_step = 0
        if vz <= 0.0:
            task.apex_passed = 1
            task.max_height = wp.max(goal[2], pos[2])
    if scheme == AFTER_LANDING:
        task.phase = LANDED
        task.command_step = 0
        task.apex_passed = 1
        task.max_height = wp.max(goal[2], pos[2])
        task.phase_steps = int(between(state, 9, 0.0, 17.999))
    return task


@wp.func
def begin_next_jump(old: JumpTask, ground: Ground, goal: wp.vec3, pos: wp.vec3, heading: float) -> JumpTask:
    """Return the state of an episode that goes on with another jump at once; goal relative to base and heading."""
    task = old
    task.heading = heading
    task.goal = turned(goal, heading) + wp.vec3(pos[0], pos[1], 0.0)
    task.goal_ground = surface(ground, task.goal[0], task.goal[1])[0]
    task.start = pos
    task.phase = STANCE
    task.phase_steps = 0
    task.command_step = old.steps
    task.apex_passed = 0
    task.idle_steps = 0
    task.max_height = pos[2]
    task.peak_tilt = 0.0
    task.again_step = 0
    task.jumps = old.jumps + 1
    return task


@wp.func
def place_ground(
    ground: Ground, world: int, state: wp.uint32, ranges: ResetRanges, grounds: GroundRanges, scheme: int,
    heading: float, goal: wp.vec3,
) -> Ground:  # fmt: skip
    """Put the block of a world to its start, or draw another if blocks are drawn; returns the ground as it is there."""
    if grounds.platform + grounds.block > 0.0:
        block = Block()
        if scheme == STANDING or scheme == DEFAULT:
            block = draw_ground(state, grounds, footprint(ranges, heading), goal)
        ground.blocks[world] = block
    else:
        rest_block(ground, world)
    return world_ground(ground, world)


@wp.kernel
def reset_kernel(
    # in
    done: wp.array(dtype=float),
    geometry: wp.array(dtype=LegGeometry),
    ground: Ground,
    limits: LegLimits,
    ranges: ResetRanges,
    grounds: GroundRanges,
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
    """Begin a new episode where one is done, or the next jump where it is due; one thread per world.

    Goals, relative to the start, and base heights: one entry per level.
    """
    world = wp.tid()
    task = tasks[world]
    again = task.phase == LANDED and task.again_step > 0 and task.phase_steps >= task.again_step
    if done[world] == 0.0 and not again:
        return
    state = wp.rand_init(int(random[world]), world + 1)
    random[world] = wp.rand_init(int(state), 99)
    levels = goal_lower.shape[0]
    level = task.level
    if level >= levels:
        level = wp.min(int(between(state, 0, 0.0, float(levels))), levels - 1)
    goal = draw_box(state, 50, goal_lower[level], goal_upper[level])
    q = world * COORDS
    if done[world] == 0.0:
        pos = wp.vec3(joint_q[q], joint_q[q + 1], joint_q[q + 2])
        quat = wp.quat(joint_q[q + 3], joint_q[q + 4], joint_q[q + 5], joint_q[q + 6])
        task = begin_next_jump(task, world_ground(ground, world), goal, pos, yaw_of(quat))
        task.again_step = draw_again(state, ranges)
        tasks[world] = task
        return
    scheme = draw_scheme(state, ranges)
    heading = between(state, 13, -ranges.heading, ranges.heading)
    goal = turned(goal, heading)
    here = place_ground(ground, world, state, ranges, grounds, scheme, heading, goal)
    taken = draw_until_taken(
        geometry, here, limits, ranges, state, world, scheme, heading, base_height[level], goal, joint_q, joint_qd
    )
    if taken == 0:
        scheme = int(DEFAULT)
        store_default(reference_q, world, heading, surface(here, 0.0, 0.0)[0], joint_q, joint_qd)
    pos = wp.vec3(joint_q[q], joint_q[q + 1], joint_q[q + 2])
    task = begin_task(task, state, ranges, scheme, goal, pos, joint_qd[world * DOFS + 2])
    task.heading = heading
    task.goal_ground = surface(here, goal[0], goal[1])[0]
    tasks[world] = task


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
        slot = motor_slot(m)
        torque[m, world] = 0.0
        action[m, world] = 0.0
        old_action[m, world] = 0.0
        safe_target[m, world] = joint_q[world * COORDS + 7 + slot]
        old_rate[m, world] = joint_qd[world * DOFS + 6 + slot]
    i = world * DOFS
    old_lin_vel[world] = wp.vec3(joint_qd[i], joint_qd[i + 1], joint_qd[i + 2])
