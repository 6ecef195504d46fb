"""Reference state initialisation: episodes begin at the stages of a jump (paper, Section V-D).

Standing or squatting on given paw positions, the default pose, pushing off, in flight on a projectile to the goal, just
before touchdown, and just landed. Joint angles come from the closed-form inverse kinematics and joint rates from the
leg's Jacobian, so every state satisfies the loops. A draw whose paws cannot be reached within limits, whose links
touch, or whose paws are below the ground is drawn again; the default pose stands in after the last attempt.
"""

import warp as wp

from ..kinematics.geometry import LegGeometry
from ..kinematics.inverse import LegLimits
from ..kinematics.leg import leg_forward_kinematics
from ..layout import BODIES, COORDS, DOFS
from ..mdp.attempts import ATTEMPTS, attempt_step, first_attempt, first_leg, leg_step
from ..mdp.env import Scene, SkillSettings
from ..mdp.random import Draw, between, branch, within
from ..mdp.reset import leg_limits, store_pose
from ..mdp.starts import LegDraw, keep_first, leg_over_ground, leg_to, legs_fit, store_base, store_leg
from ..mdp.view import RobotArrays, RobotView, base_pos, turned, yaw_of
from ..terrain.ground import Block, Ground, rest_block, surface, world_ground
from .ground_draws import GroundRanges, draw_ground, footprint
from .reset_draws import (
    AFTER_LANDING,
    DEFAULT,
    IN_FLIGHT,
    PUSHING,
    STANDING,
    TOUCHDOWN,
    BaseDraw,
    ResetRanges,
    draw_base,
    draw_box,
    draw_paw,
    draw_scheme,
    rounded,
    time_spent,
)
from .state import FLIGHT, LANDED, STANCE, JumpState

wp.set_module_options({"enable_backward": False})


@wp.struct
class JumpSettings:
    """How jumps begin."""

    states: ResetRanges
    grounds: GroundRanges


@wp.struct
class JumpLevel:
    """One level of the curriculum."""

    goal_lower: wp.vec3  # [m] relative to start and heading: landing x, y, and base height at the apex (0: any)
    goal_upper: wp.vec3
    base_height: wp.vec2  # [m] of standing starts
    jump_again: float  # share of landed robots that get another goal
    round: int  # 1: goals are drawn from the ellipse inside the box


@wp.func
def draw_leg_in_flight(draw: Draw, ranges: ResetRanges, leg: int, lateral: float) -> wp.vec3:
    """Return motor angles [rad] of a leg in flight: both thighs about alike, all legs about alike."""
    lower = ranges.flight_transversal[0]
    upper = ranges.flight_transversal[1]
    middle = within(draw, 7, ranges.flight_transversal)
    outer = wp.clamp(middle + between(draw, 30 + leg, -0.1, 0.1), lower, upper)
    inner = wp.clamp(middle + between(draw, 34 + leg, -0.1, 0.1), lower, upper)
    return wp.vec3(lateral + between(draw, 38 + leg, -0.03, 0.03), outer, inner)


@wp.func
def draw_leg(
    geo: LegGeometry, ground: Ground, limits: LegLimits, ranges: ResetRanges, draw: Draw, leg: int, scheme: int,
    d: BaseDraw, heading: float, lift: float,
) -> LegDraw:  # fmt: skip
    """Return a leg of a drawn state: on its paw's place, or in flight. lift [m]: ground height under the base."""
    found = LegDraw()
    if d.use_paws != 0:
        spot = d.spot + draw_paw(draw, ranges, leg, heading)
        paw = spot - d.pos
        if scheme == TOUCHDOWN:
            # paws hang below the base, a little above the ground at least
            paw[2] = -wp.min(within(draw, 8, ranges.paw_depth), d.pos[2] - geo.paw_radius - 0.025)
        else:
            here = surface(ground, spot[0], spot[1])
            paw[2] = here[0] + geo.paw_radius - d.pos[2] - lift
        found = leg_to(geo, limits, wp.quat_rotate_inv(d.quat, paw))
        if scheme == AFTER_LANDING or scheme == PUSHING:
            # the paw rests on the ground while the base moves, so the joints move too
            moving = d.lin_vel + wp.cross(d.ang_vel, paw)
            found = leg_over_ground(geo, found, -wp.quat_rotate_inv(d.quat, moving))
    else:
        angles = draw_leg_in_flight(draw, ranges, leg, d.lateral)
        found.angles = angles
        ankle = leg_forward_kinematics(geo, angles[0], angles[1], angles[2])
        found.possible = d.pos[2] + wp.quat_rotate(d.quat, ankle)[2] >= geo.paw_radius + 0.01
    return found


@wp.func
def store_draw(
    geometry: wp.array(dtype=LegGeometry), ground: Ground, limits: LegLimits, ranges: ResetRanges, draw: Draw,
    scheme: int, d: BaseDraw, heading: float, lift: float, com: wp.vec3,
    joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
) -> bool:  # fmt: skip
    """Write a drawn state of one world, and return whether it can be taken.

    lift [m]: ground height under the base; com [m]: its centre of mass, body axes.
    """
    com_vel = d.lin_vel + wp.cross(d.ang_vel, wp.quat_rotate(d.quat, com))
    store_base(d.pos + wp.vec3(0.0, 0.0, lift), d.quat, com_vel, d.ang_vel, joint_q, joint_qd)
    possible = bool(True)
    own = LegDraw()
    for leg in range(first_leg(draw), geometry.shape[0], leg_step(draw)):
        own = draw_leg(geometry[leg], ground, limits, ranges, draw, leg, scheme, d, heading, lift)
        possible = possible and own.possible
        store_leg(leg, own, joint_q, joint_qd)
    return legs_fit(geometry, ground, draw, own, possible, joint_q, joint_qd)


@wp.func
def draw_until_taken(
    geometry: wp.array(dtype=LegGeometry), ground: Ground, limits: LegLimits, ranges: ResetRanges, draw: Draw,
    scheme: int, heading: float, height: wp.vec2, goal: wp.vec3, g: float, com: wp.vec3,
    joint_q: wp.array(dtype=float), joint_qd: wp.array(dtype=float),
) -> bool:  # fmt: skip
    """Draw states of a scheme until one can be taken, and write it; returns whether one of the attempts could."""
    if scheme == DEFAULT:
        return False
    here = surface(ground, 0.0, 0.0)
    own_q = wp.zeros(shape=(COORDS,), dtype=float)
    own_qd = wp.zeros(shape=(DOFS,), dtype=float)
    taken = int(ATTEMPTS)
    for attempt in range(first_attempt(draw), ATTEMPTS, attempt_step(draw)):
        if taken == ATTEMPTS:
            fresh = branch(draw, attempt)
            d = draw_base(fresh, ranges, scheme, heading, height, goal, g)
            if store_draw(geometry, ground, limits, ranges, fresh, scheme, d, heading, here[0], com, own_q, own_qd):
                taken = attempt
    return keep_first(geometry, draw, taken, own_q, own_qd, joint_q, joint_qd)


@wp.func
def draw_goal(draw: Draw, level: JumpLevel) -> wp.vec3:
    """Return a goal of a level relative to start and heading."""
    goal = draw_box(draw, 50, level.goal_lower, level.goal_upper)
    if level.round != 0:
        goal = rounded(goal, level.goal_lower, level.goal_upper)
    return goal


@wp.func
def draw_again(draw: Draw, delay: wp.vec2, share: float) -> int:
    """Return how many policy steps after touchdown another goal comes; 0: none, in all but a share of draws.

    delay: range in policy steps.
    """
    steps = int(within(draw, 19, delay))
    return wp.where(between(draw, 18, 0.0, 1.0) < share, wp.max(steps, 1), 0)


@wp.func
def draw_command(draw: Draw, ranges: ResetRanges) -> int:
    """Return at which policy step the jump is commanded: uniform, a share of the draws in the longer of two ranges."""
    u = between(draw, 9, 0.0, 1.0)
    share = ranges.long_wait_share
    soon = (u - share) / wp.max(1.0 - share, 1.0e-6) * (float(ranges.command_delay) + 0.999)
    later = u / wp.max(share, 1.0e-6) * (float(ranges.long_wait) + 0.999)
    return int(wp.where(u < share, later, soon))


@wp.func
def begin_task(
    draw: Draw, ranges: ResetRanges, scheme: int, goal: wp.vec3, pos: wp.vec3, vz: float, jump_again: float
) -> JumpState:
    """Return the state of a new episode that begins with a scheme at a base position [m] and upward speed [m/s]."""
    task = JumpState()
    task.scheme = scheme
    task.goal = goal
    task.start = pos
    task.max_height = pos[2]
    task.command_step = draw_command(draw, ranges)
    task.again_delay = ranges.again_delay
    task.again_step = draw_again(draw, ranges.again_delay, jump_again)
    if scheme == PUSHING or (scheme == STANDING and ranges.lean > 0.0):
        task.start = wp.vec3(0.0, 0.0, pos[2])
    if scheme == PUSHING:
        task.command_step = 0
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
        task.phase_steps = int(between(draw, 9, 0.0, 17.999))
    return task


@wp.func
def begin_next_jump(old: JumpState, ground: Ground, goal: wp.vec3, pos: wp.vec3, heading: float) -> JumpState:
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
    task.paws_landed = 0
    task.again_step = 0
    task.jumps = old.jumps + 1
    return task


@wp.func
def place_ground(
    ground: Ground, world: int, draw: Draw, ranges: ResetRanges, grounds: GroundRanges, scheme: int,
    heading: float, goal: wp.vec3,
) -> Ground:  # fmt: skip
    """Put the block of a world to its start, or draw another if blocks are drawn; returns the ground as it is there."""
    if grounds.platform + grounds.block > 0.0:
        block = Block()
        if scheme == STANDING or scheme == DEFAULT:
            block = draw_ground(draw, grounds, footprint(ranges, heading), goal)
        ground.blocks[world] = block
    else:
        rest_block(ground, world)
    return world_ground(ground, world)


@wp.func
def reset_jump(
    robot: RobotArrays, scene: Scene, skill: SkillSettings, old: JumpState, settings: JumpSettings, level: JumpLevel,
    draw: Draw,
) -> JumpState:  # fmt: skip
    """Begin an episode at a stage of a jump, and return its state."""
    world = draw.world
    ranges = settings.states
    g = -robot.gravity[world][2]
    spent = time_spent(old)
    scheme = draw_scheme(draw, ranges, spent)
    heading = between(draw, 13, -ranges.heading, ranges.heading)
    goal = turned(draw_goal(draw, level), heading)
    here = place_ground(scene.ground, world, draw, ranges, settings.grounds, scheme, heading, goal)
    taken = draw_until_taken(
        scene.geometry, here, leg_limits(skill.command_filter), ranges, draw, scheme, heading, level.base_height,
        goal, g, robot.body_com[world * BODIES], robot.joint_q, robot.joint_qd,
    )  # fmt: skip
    if not taken:
        scheme = int(DEFAULT)
        store_pose(robot, scene, world, heading, surface(here, 0.0, 0.0)[0])
    pos = base_pos(robot, world)
    task = begin_task(draw, ranges, scheme, goal, pos, robot.joint_qd[world * DOFS + 2], level.jump_again)
    task.heading = heading
    task.spent = spent
    task.goal_ground = surface(here, goal[0], goal[1])[0]
    return task


@wp.func
def another_jump_due(task: JumpState) -> bool:
    """Return whether a landed robot gets another goal now."""
    return task.phase == LANDED and task.again_step > 0 and task.phase_steps >= task.again_step


@wp.func
def draw_next_jump(view: RobotView, scene: Scene, task: JumpState, level: JumpLevel, draw: Draw) -> JumpState:
    """Return the state of an episode that goes on with another jump, to a drawn goal."""
    goal = draw_goal(draw, level)
    new = begin_next_jump(task, world_ground(scene.ground, view.world), goal, view.pos, yaw_of(view.quat))
    new.again_step = draw_again(draw, task.again_delay, level.jump_again)
    return new


@wp.func
def give_jump(view: RobotView, scene: Scene, task: JumpState, values: wp.vec4, heading: float) -> JumpState:
    """Ask a robot that stands at its start, or has landed, for a jump.

    values: goal x, y [m] relative to base and heading, base height at the apex [m], and at a start the policy step of
    the command.
    """
    here = world_ground(scene.ground, view.world)
    goal = wp.vec3(values[0], values[1], values[2])
    if task.phase == LANDED:
        return begin_next_jump(task, here, goal, view.pos, heading)
    if task.phase != STANCE or task.steps > 0:
        return task
    new = JumpState()
    new.heading = heading
    new.start = view.pos
    new.goal = turned(goal, heading) + wp.vec3(view.pos[0], view.pos[1], 0.0)
    new.goal_ground = surface(here, new.goal[0], new.goal[1])[0]
    new.max_height = view.pos[2]
    new.command_step = int(values[3])
    return new


@wp.func
def from_standing(task: JumpState) -> bool:
    """Return whether an episode began standing, and so counts for the curriculum."""
    return task.scheme <= DEFAULT
