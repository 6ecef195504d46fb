"""How episodes of velocity tracking begin: any pose of the base, any places of the paws, in motion, on any ground.

Joint angles come from the closed-form inverse kinematics and joint rates from the leg's Jacobian, so that every state
satisfies the loops. A draw whose paws cannot be reached within limits, or whose links touch what they must not, is
drawn again; the default pose stands in after the last attempt.
"""

import warp as wp

from ..kinematics.geometry import LegGeometry
from ..kinematics.inverse import LegLimits
from ..layout import BODIES, COORDS, DOFS
from ..mdp.attempts import ATTEMPTS, attempt_step, first_attempt, first_leg, leg_step, meet_attempts
from ..mdp.env import Scene, SkillSettings
from ..mdp.random import Draw, between, branch, within
from ..mdp.reset import leg_limits, store_pose
from ..mdp.starts import (
    LegDraw,
    keep_first,
    leg_over_ground,
    leg_to,
    legs_fit,
    place_beside,
    store_base,
    store_leg,
    turn_of,
)
from ..mdp.view import RobotArrays, base_pos, turned
from ..terrain.ground import Ground, rest_block, surface, world_ground
from .commands import CommandRanges, draw_velocity, with_command
from .state import VelocityState, mean_error
from .terminations import off_map

wp.set_module_options({"enable_backward": False})

FALL = wp.constant(60.0)  # [m/s] what a fall takes from the score, as much as a second at 1 m/s gives


@wp.struct
class Map:
    """A map of square tiles around the origin: harder ones with growing x, of another kind with growing y."""

    rows: int  # along x, 0: no map
    cols: int  # along y
    tile: float  # [m] edge of a tile


@wp.struct
class VelocitySettings:
    """How episodes begin; pairs are (lower, upper)."""

    map: Map
    episode_steps: int  # policy steps that an episode lasts
    pace: float  # cycles of the gait in a policy step, 0: no clock
    default_share: float  # share of episodes that begin in the default pose at rest
    base_xy: float  # [m] half width
    height: wp.vec2  # [m] of the base above the ground
    tilt: float  # [rad] half width of roll and pitch
    heading: float  # [rad] half width
    front_x: wp.vec2  # [m] paws relative to the base
    front_y: wp.vec2
    back_x: wp.vec2
    back_y: wp.vec2
    lift: float  # [m] most of the paws in the air
    lifted_share: float  # share of paws in the air
    lin_vel: float  # [m/s] half width of the base's velocity along each axis
    ang_vel: float  # [rad/s] half width of its angular velocity about each axis
    tolerance: float  # [m/s] mean error up to which an episode is a success


@wp.struct
class BaseDraw:
    """A drawn state of the base."""

    pos: wp.vec3  # [m] world
    quat: wp.quat  # xyzw
    lin_vel: wp.vec3  # [m/s] of the origin, world
    ang_vel: wp.vec3  # [rad/s] body axes
    heading: float  # [rad]


@wp.func
def draw_base(draw: Draw, settings: VelocitySettings, ground: Ground, spot: wp.vec2, heading: float) -> BaseDraw:
    """Return a state of the base around a spot [m] of the ground."""
    d = BaseDraw()
    d.heading = heading
    roll = between(draw, 10, -settings.tilt, settings.tilt)
    pitch = between(draw, 11, -settings.tilt, settings.tilt)
    d.quat = turn_of(heading, pitch, roll)
    x = spot[0] + between(draw, 2, -settings.base_xy, settings.base_xy)
    y = spot[1] + between(draw, 3, -settings.base_xy, settings.base_xy)
    d.pos = wp.vec3(x, y, surface(ground, x, y)[0] + within(draw, 4, settings.height))
    v = settings.lin_vel
    w = settings.ang_vel
    d.lin_vel = wp.vec3(between(draw, 5, -v, v), between(draw, 6, -v, v), 0.3 * between(draw, 7, -v, v))
    d.ang_vel = wp.vec3(between(draw, 13, -w, w), between(draw, 14, -w, w), between(draw, 15, -w, w))
    return d


@wp.func
def draw_paw(draw: Draw, settings: VelocitySettings, ground: Ground, d: BaseDraw, leg: int, radius: float) -> wp.vec4:
    """Return the place of a paw's centre [m], world, and 1 if it is in the air."""
    beside = place_beside(draw, leg, settings.front_x, settings.front_y, settings.back_x, settings.back_y)
    paw = d.pos + turned(beside, d.heading)
    up = float(0.0)
    lifted = float(0.0)
    if between(draw, 28 + leg, 0.0, 1.0) < settings.lifted_share:
        up = between(draw, 32 + leg, 0.01, settings.lift)
        lifted = 1.0
    return wp.vec4(paw[0], paw[1], surface(ground, paw[0], paw[1])[0] + radius + up, lifted)


@wp.func
def draw_leg(
    geo: LegGeometry, ground: Ground, limits: LegLimits, settings: VelocitySettings, draw: Draw, leg: int, d: BaseDraw
) -> LegDraw:  # fmt: skip
    """Return a leg of a drawn state; a paw on the ground rests there."""
    paw = draw_paw(draw, settings, ground, d, leg, geo.paw_radius)
    ankle = wp.quat_rotate_inv(d.quat, wp.vec3(paw[0], paw[1], paw[2]) - d.pos)
    found = leg_to(geo, limits, ankle)
    if paw[3] == 0.0:
        return leg_over_ground(geo, found, -wp.quat_rotate_inv(d.quat, d.lin_vel) - wp.cross(d.ang_vel, ankle))
    return found


@wp.func
def store_draw(
    geometry: wp.array(dtype=LegGeometry), com: wp.vec3, ground: Ground, limits: LegLimits,
    settings: VelocitySettings, draw: Draw, d: BaseDraw, joint_q: wp.array(dtype=float),
    joint_qd: wp.array(dtype=float),
) -> bool:  # fmt: skip
    """Write a drawn state of one world, and return whether it can be taken; com [m]: of the base, body axes."""
    spin = wp.quat_rotate(d.quat, d.ang_vel)
    store_base(d.pos, d.quat, d.lin_vel + wp.cross(spin, wp.quat_rotate(d.quat, com)), spin, joint_q, joint_qd)
    possible = bool(True)
    own = LegDraw()
    for leg in range(first_leg(draw), geometry.shape[0], leg_step(draw)):
        own = draw_leg(geometry[leg], ground, limits, settings, draw, leg, d)
        possible = possible and own.possible
        store_leg(leg, own, joint_q, joint_qd)
    return legs_fit(geometry, ground, draw, own, possible, joint_q, joint_qd)


@wp.func
def draw_until_taken(
    robot: RobotArrays, scene: Scene, ground: Ground, limits: LegLimits, settings: VelocitySettings, draw: Draw,
    spot: wp.vec2, heading: float,
) -> bool:  # fmt: skip
    """Draw states until one can be taken, and write it; returns whether one of the attempts could."""
    com = robot.body_com[draw.world * BODIES]
    own_q = wp.zeros(shape=(COORDS,), dtype=float)
    own_qd = wp.zeros(shape=(DOFS,), dtype=float)
    taken = int(ATTEMPTS)
    for attempt in range(first_attempt(draw), ATTEMPTS, attempt_step(draw)):
        if taken == ATTEMPTS:
            fresh = branch(draw, attempt)
            d = draw_base(fresh, settings, ground, spot, heading)
            if store_draw(scene.geometry, com, ground, limits, settings, fresh, d, own_q, own_qd):
                taken = attempt
    return keep_first(scene.geometry, draw, taken, own_q, own_qd, robot.joint_q, robot.joint_qd)


@wp.func
def draw_spot(draw: Draw, map: Map, level: int) -> wp.vec2:
    """Return the middle of a tile [m] of a level, of any level past the last; the origin without a map."""
    if map.rows == 0:
        return wp.vec2(0.0)
    row = level
    if row >= map.rows:
        row = wp.min(int(between(draw, 90, 0.0, float(map.rows))), map.rows - 1)
    col = wp.min(int(between(draw, 91, 0.0, float(map.cols))), map.cols - 1)
    return wp.vec2(
        map.tile * (float(row) + 0.5 - 0.5 * float(map.rows)), map.tile * (float(col) + 0.5 - 0.5 * float(map.cols))
    )


@wp.func
def map_limit(map: Map) -> wp.vec2:
    """Return where the base has left the tiles [m] along x and y, 0 without a map."""
    return 0.5 * map.tile * wp.vec2(float(map.rows), float(map.cols))


@wp.func
def carried_over(
    old: VelocityState, pos: wp.vec3, tolerance: float, command_levels: int, terrain_levels: int
) -> VelocityState:  # fmt: skip
    """Return the state of a new episode, with what was counted, and both levels after the old one, ended at `pos` [m].

    An episode to the end with a mean error up to a tolerance [m/s] raises the levels, a fall lowers them.
    """
    new = VelocityState()
    new.sum_xy = old.sum_xy
    new.sum_yaw = old.sum_yaw
    new.sum_settled = old.sum_settled
    new.score = old.score
    new.all_steps = old.all_steps
    new.minutes = old.minutes
    new.seconds_walking = old.seconds_walking
    new.falls = old.falls
    new.touchdowns = old.touchdowns
    new.apexes = old.apexes
    up = int(0)
    if old.steps > 0 and old.episode_steps > 0 and not off_map(pos, old.limit):
        if old.steps < old.episode_steps:
            new.falls = old.falls + 1.0
            new.score = old.score - FALL
            up = int(-1)
        elif old.settled > 0.0 and mean_error(old) <= tolerance:
            up = int(1)
    new.command_level = wp.clamp(old.command_level + up, 0, command_levels)
    new.terrain_level = wp.clamp(old.terrain_level + up, 0, terrain_levels)
    return new


@wp.func
def reset_velocity(
    robot: RobotArrays, scene: Scene, skill: SkillSettings, old: VelocityState, settings: VelocitySettings,
    level: CommandRanges, draw: Draw,
) -> VelocityState:  # fmt: skip
    """Begin an episode with a drawn command, and return its state."""
    world = draw.world
    new = carried_over(old, base_pos(robot, world), settings.tolerance, level.levels, settings.map.rows)
    rest_block(scene.ground, world)
    here = world_ground(scene.ground, world)
    spot = draw_spot(draw, settings.map, new.terrain_level)
    heading = between(draw, 12, -settings.heading, settings.heading)
    taken = bool(False)
    meet_attempts(draw)  # all have read where the base was
    if between(draw, 1, 0.0, 1.0) >= settings.default_share:
        taken = draw_until_taken(
            robot, scene, here, leg_limits(skill.command_filter), settings, draw, spot, heading
        )  # fmt: skip
    if not taken:
        store_pose(robot, scene, world, heading, surface(here, spot[0], spot[1])[0])
        robot.joint_q[world * COORDS] = spot[0]
        robot.joint_q[world * COORDS + 1] = spot[1]
    new.episode_steps = settings.episode_steps
    new.pace = settings.pace
    new.phase = between(draw, 16, 0.0, 1.0)
    new.limit = map_limit(settings.map)
    new = with_command(new, draw_velocity(draw, level, new.command_level))
    new.command_lasts = wp.max(int(within(draw, 85, level.lasts)), 1)
    return new
