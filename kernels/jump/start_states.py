"""Start states of a jump (paper, Section V-D: reference state initialisation), one function a start mode.

Standing or squatting on given paw positions, the default pose, pushing off, in flight on a projectile to the goal, just
before touchdown, and just landed. If no attempt is valid, the episode begins in the default pose.

A jump goes from above the origin to `goal`: x, y [m] of the landing and, for a vertical jump, the base height [m]
wanted at the apex; where none is wanted, the takeoff angle is drawn.
"""

import warp as wp

from ..kinematics.geometry import LegGeometry
from ..kinematics.inverse import LegLimits
from ..kinematics.leg import leg_forward_kinematics
from ..layout import BODIES
from ..mdp.attempts import sample_valid_state
from ..mdp.env import Scene
from ..mdp.random import RngStream, uniform, uniform_range
from ..mdp.reset import write_default_pose
from ..mdp.starts import LegSample, leg_ik, quat_from_ypr, sample_foot_offset, with_foot_velocity
from ..mdp.view import RobotArrays, rotate_yaw
from ..terrain.ground import Ground, surface
from . import streams
from .phase import time_to_height
from .state import NUM_START_MODES, vec_start_modes

wp.set_module_options({"enable_backward": False})

STANDING = wp.constant(0)
DEFAULT = wp.constant(1)
IN_FLIGHT = wp.constant(2)
TOUCHDOWN = wp.constant(3)
AFTER_LANDING = wp.constant(4)
PUSHING = wp.constant(5)


@wp.struct
class ResetRanges:
    """Ranges of the drawn states; pairs are (lower, upper), angles [rad], lengths [m]."""

    shares: vec_start_modes  # of standing, default, in flight, touchdown, just landed, pushing off
    of_time: int  # 1: shares are of the time that a world spends in episodes, 0: of its resets
    base_xy: float  # half width
    tilt: float  # half width of roll, pitch; of yaw too around the heading
    forward_pitch: float  # largest mean pitch of standing states
    lean: float  # base of the deepest squats behind the middle of the paws, at most; straight above it at the highest
    heading: float  # half width of the heading
    front_x: wp.vec2  # paw ahead of the base
    front_y: wp.vec2  # paw beside the base, absolute
    back_x: wp.vec2  # paw behind the base, absolute
    back_y: wp.vec2
    takeoff_height: wp.vec2
    takeoff_ahead: wp.vec2  # base ahead of its start, towards the goal
    takeoff_pitch: wp.vec2  # nose down, of states in flight and pushing off
    push_length: wp.vec2  # of the way to the takeoff, straight along its velocity
    push_acceleration: wp.vec2  # [m/s^2] along it
    takeoff_angle: wp.vec2  # above the horizon, where no apex is wanted
    highest_apex: float  # of jumps with a drawn angle
    landing_height: float  # of the base, where the projectile ends
    flight_time: wp.vec2  # share of the time in the air
    flight_lateral: float  # half width
    flight_transversal: wp.vec2
    touchdown_time: wp.vec2  # [s] before landing
    touchdown_behind: wp.vec2  # base behind the projectile, so that the paws are ahead of it
    paw_depth: wp.vec2  # paws below the base before touchdown
    landed_height: wp.vec2
    landed_ahead: wp.vec2  # base ahead of the goal
    landed_speed: wp.vec2  # [m/s] downward
    command_delay: int  # most policy steps until the jump is commanded
    long_wait_share: float  # of the draws in which it may be `long_wait`
    long_wait: int
    again_delay: wp.vec2  # policy steps after touchdown


@wp.struct
class JumpStart:
    """What all attempts at a start state share."""

    start_mode: int
    heading: float  # [rad] yaw
    goal: wp.vec3  # [m] from the origin, world axes
    base_height: wp.vec2  # [m] range of standing starts
    ranges: ResetRanges
    limits: LegLimits
    ground: Ground


@wp.struct
class JumpBase:
    """The base in an attempt, see `sample_valid_state`; paws are placed around `spot`."""

    pos: wp.vec3
    quat: wp.quat
    com_vel: wp.vec3
    ang_vel: wp.vec3
    lin_vel: wp.vec3  # [m/s] of the origin, world axes
    ground_height: float  # [m] at the origin
    height: float  # [m] above it
    spot: wp.vec3  # [m] on the ground, or below the projectile before touchdown


@wp.func
def start_mode_at(shares: vec_start_modes, u: float) -> int:
    """Return the start mode in whose share u in [0, 1) falls, shares laid end to end."""
    start_mode = int(0)
    rest = u
    for i in range(NUM_START_MODES):
        if rest >= 0.0 and shares[i] > 0.0:
            start_mode = i
        rest -= shares[i]
    return start_mode


@wp.func
def least_sampled_mode(shares: vec_start_modes, steps_per_mode: vec_start_modes) -> int:
    """Return the start mode whose policy steps so far are farthest below its share of all."""
    total = float(0.0)
    for i in range(NUM_START_MODES):
        total += steps_per_mode[i]
    start_mode = int(0)
    most = float(-3.0e38)
    for i in range(NUM_START_MODES):
        lack = shares[i] * total - steps_per_mode[i]
        if shares[i] > 0.0 and lack > most:
            start_mode = i
            most = lack
    return start_mode


@wp.func
def sample_start_mode(rng: RngStream, ranges: ResetRanges, steps_per_mode: vec_start_modes) -> int:
    """Return the start mode of a new episode: sampled, or with shares of steps the one that lacks most."""
    if ranges.of_time != 0 and wp.length_sq(steps_per_mode) > 0.0:
        return least_sampled_mode(ranges.shares, steps_per_mode)
    return start_mode_at(ranges.shares, uniform(rng, streams.START_MODE, 0.0, 1.0))


@wp.func
def sample_quat(rng: RngStream, ranges: ResetRanges, heading: float, pitch: float) -> wp.quat:
    """Return a sampled orientation (xyzw): heading and pitch [rad] plus uniform noise, and a sampled roll."""
    yaw = heading + uniform(rng, streams.YAW, -ranges.tilt, ranges.tilt)
    tip = pitch + uniform(rng, streams.PITCH, -ranges.tilt, ranges.tilt)
    roll = uniform(rng, streams.ROLL, -ranges.tilt, ranges.tilt)
    return quat_from_ypr(yaw, tip, roll)


@wp.func
def sample_offset(rng: RngStream, ranges: ResetRanges) -> wp.vec3:
    """Return a sampled horizontal offset [m] of the base."""
    x = uniform(rng, streams.OFFSET_X, -ranges.base_xy, ranges.base_xy)
    return wp.vec3(x, uniform(rng, streams.OFFSET_Y, -ranges.base_xy, ranges.base_xy), 0.0)


@wp.func
def direction(start: JumpStart) -> wp.vec3:
    """Return the horizontal unit vector towards the goal, along the heading for a jump on the spot."""
    to_goal = wp.vec3(start.goal[0], start.goal[1], 0.0)
    if wp.length(to_goal) > 1.0e-3:
        return wp.normalize(to_goal)
    return rotate_yaw(wp.vec3(1.0, 0.0, 0.0), start.heading)


@wp.func
def standing(start: JumpStart, rng: RngStream) -> JumpBase:
    """Return a base at rest over paws around the origin; in a deeper squat it may be farther behind their middle."""
    ranges = start.ranges
    lower = start.base_height[0]
    upper = start.base_height[1]
    height = uniform_range(rng, streams.HEIGHT, start.base_height)
    tip = uniform(rng, streams.FORWARD_PITCH, 0.0, ranges.forward_pitch)
    lean = (upper - height) / wp.max(upper - lower, 1.0e-6) * uniform(rng, streams.LEAN, 0.0, ranges.lean)
    base = JumpBase()
    base.quat = sample_quat(rng, ranges, start.heading, tip)
    base.pos = sample_offset(rng, ranges) + wp.vec3(0.0, 0.0, height) - lean * direction(start)
    return base


@wp.func
def just_landed(start: JumpStart, rng: RngStream) -> JumpBase:
    """Return a base just after landing: over paws around the goal, moving down."""
    ranges = start.ranges
    base = JumpBase()
    base.quat = sample_quat(rng, ranges, start.heading, 0.0)
    base.spot = wp.vec3(start.goal[0], start.goal[1], 0.0)
    ahead = uniform_range(rng, streams.LANDED_AHEAD, ranges.landed_ahead)
    base.pos = sample_offset(rng, ranges) + base.spot + ahead * direction(start)
    base.pos[2] = uniform_range(rng, streams.LANDED_HEIGHT, ranges.landed_height)
    base.lin_vel = wp.vec3(0.0, 0.0, -uniform_range(rng, streams.LANDED_SPEED, ranges.landed_speed))
    return base


@wp.func
def takeoff_speed(rng: RngStream, ranges: ResetRanges, height: float, distance: float, apex: float, g: float) -> float:
    """Return the vertical takeoff speed [m/s] at `height` [m] of a jump over `distance` [m]; apex [m], 0: any."""
    if apex > 0.0:
        return wp.sqrt(wp.max(2.0 * g * (apex - height), 0.0))
    # height + v_z t - g t^2 / 2 = landing_height, where v_z t = distance tan(angle)
    climb = distance * wp.tan(uniform_range(rng, streams.TAKEOFF_ANGLE, ranges.takeoff_angle))
    t = wp.sqrt(wp.max(2.0 * (height - ranges.landing_height + climb) / g, 1.0e-6))
    limit = wp.sqrt(wp.max(2.0 * g * (ranges.highest_apex - height), 0.0))
    return wp.min(climb / t, limit)


@wp.func
def in_flight(start: JumpStart, rng: RngStream, g: float) -> JumpBase:
    """Return a base on the ballistic flight to the goal: anywhere on it, before touchdown, or at takeoff (PUSHING)."""
    ranges = start.ranges
    along = direction(start)
    height = uniform_range(rng, streams.TAKEOFF_HEIGHT, ranges.takeoff_height)
    way = wp.length(wp.vec3(start.goal[0], start.goal[1], 0.0))
    ahead = wp.min(uniform_range(rng, streams.TAKEOFF_AHEAD, ranges.takeoff_ahead), way)
    distance = way - ahead
    up = takeoff_speed(rng, ranges, height, distance, start.goal[2], g)
    duration = wp.max(time_to_height(height, up, ranges.landing_height, g), 1.0e-3)
    forward = distance / duration
    t = duration * uniform_range(rng, streams.FLIGHT_TIME, ranges.flight_time)
    if start.start_mode == TOUCHDOWN:
        t = wp.max(duration - uniform_range(rng, streams.TOUCHDOWN_TIME, ranges.touchdown_time), 0.0)
    if start.start_mode == PUSHING:
        t = float(0.0)
    rise = wp.vec3(0.0, 0.0, height + up * t - 0.5 * g * t * t)
    base = JumpBase()
    base.quat = sample_quat(rng, ranges, start.heading, uniform_range(rng, streams.TAKEOFF_PITCH, ranges.takeoff_pitch))
    base.pos = sample_offset(rng, ranges) + (ahead + forward * t) * along + rise
    base.lin_vel = forward * along + wp.vec3(0.0, 0.0, up - g * t)
    return base


@wp.func
def before_touchdown(start: JumpStart, flight: JumpBase, rng: RngStream) -> JumpBase:
    """Return a base in flight, moved back [m] relative to its paws, which stay below the projectile."""
    base = flight
    base.spot = wp.vec3(flight.pos[0], flight.pos[1], 0.0)
    base.pos = flight.pos - uniform_range(rng, streams.TOUCHDOWN_BEHIND, start.ranges.touchdown_behind) * direction(
        start
    )
    return base


@wp.func
def pushing_off(start: JumpStart, takeoff: JumpBase, rng: RngStream) -> JumpBase:
    """Return a base on a straight line to its takeoff state, with constant acceleration, over paws around the start."""
    base = takeoff
    back = uniform_range(rng, streams.PUSH_LENGTH, start.ranges.push_length)
    speed = wp.length(takeoff.lin_vel)
    before = speed * speed - 2.0 * back * uniform_range(rng, streams.PUSH_ACCELERATION, start.ranges.push_acceleration)
    way = wp.normalize(takeoff.lin_vel)
    base.pos = takeoff.pos - back * way
    base.lin_vel = wp.sqrt(wp.max(before, 0.0)) * way
    return base


@wp.func
def sample_base(start: JumpStart, arrays: RobotArrays, rng: RngStream, attempt: int) -> JumpBase:
    """Return the base's sampled state of an attempt, for the start's mode."""
    base = JumpBase()
    if start.start_mode == STANDING:
        base = standing(start, rng)
    elif start.start_mode == AFTER_LANDING:
        base = just_landed(start, rng)
    else:
        base = in_flight(start, rng, -arrays.gravity[rng.world][2])
        if start.start_mode == TOUCHDOWN:
            base = before_touchdown(start, base, rng)
        if start.start_mode == PUSHING:
            base = pushing_off(start, base, rng)
    base.com_vel = base.lin_vel + wp.cross(base.ang_vel, wp.quat_rotate(base.quat, arrays.body_com[rng.world * BODIES]))
    base.height = base.pos[2]
    base.ground_height = surface(start.ground, 0.0, 0.0)[0]
    base.pos = base.pos + wp.vec3(0.0, 0.0, base.ground_height)
    return base


@wp.func
def leg_in_flight(ranges: ResetRanges, base: JumpBase, geo: LegGeometry, rng: RngStream, leg: int) -> LegSample:
    """Return a leg in flight: angles near one sampled value for all legs; reachable if its paw is above the ground."""
    lower = ranges.flight_transversal[0]
    upper = ranges.flight_transversal[1]
    middle = uniform_range(rng, streams.FLIGHT_TRANSVERSAL, ranges.flight_transversal)
    lateral = uniform(rng, streams.FLIGHT_LATERAL, -ranges.flight_lateral, ranges.flight_lateral)
    angles = wp.vec3(
        lateral + uniform(rng, streams.LEG_LATERAL + leg, -0.03, 0.03),
        wp.clamp(middle + uniform(rng, streams.LEG_OUTER + leg, -0.1, 0.1), lower, upper),
        wp.clamp(middle + uniform(rng, streams.LEG_INNER + leg, -0.1, 0.1), lower, upper),
    )
    found = LegSample()
    found.angles = angles
    ankle = leg_forward_kinematics(geo, angles[0], angles[1], angles[2])
    found.reachable = base.height + wp.quat_rotate(base.quat, ankle)[2] >= geo.paw_radius + 0.01
    return found


@wp.func
def sample_leg(start: JumpStart, base: JumpBase, geo: LegGeometry, rng: RngStream, leg: int) -> LegSample:
    """Return a leg of an attempt: in flight, or from its paw's position on the ground (TOUCHDOWN: above it)."""
    ranges = start.ranges
    if start.start_mode == IN_FLIGHT:
        return leg_in_flight(ranges, base, geo, rng, leg)
    beside = sample_foot_offset(rng, leg, ranges.front_x, ranges.front_y, ranges.back_x, ranges.back_y)
    spot = base.spot + rotate_yaw(beside, start.heading)
    paw = spot - base.pos
    if start.start_mode == TOUCHDOWN:
        # paws hang below the base, a little above the ground at least
        depth = uniform_range(rng, streams.PAW_DEPTH, ranges.paw_depth)
        paw[2] = -wp.min(depth, base.height - geo.paw_radius - 0.025)
    else:
        below = surface(start.ground, spot[0], spot[1])[0]
        paw[2] = below + geo.paw_radius - base.height - base.ground_height
    found = leg_ik(geo, start.limits, wp.quat_rotate_inv(base.quat, paw))
    if start.start_mode == AFTER_LANDING or start.start_mode == PUSHING:
        # the paw rests on the ground while the base moves, so the joints move too
        moving = base.lin_vel + wp.cross(base.ang_vel, paw)
        found = with_foot_velocity(geo, found, -wp.quat_rotate_inv(base.quat, moving))
    return found


@wp.func
def write_start(arrays: RobotArrays, scene: Scene, start: JumpStart, rng: RngStream) -> int:
    """Write a start state to a world, and return its mode; `DEFAULT` also where no attempt was valid."""
    if start.start_mode != DEFAULT:
        if sample_valid_state(sample_base, sample_leg, start, arrays, scene, rng):
            return start.start_mode
    write_default_pose(arrays, scene, rng.world, start.heading, surface(start.ground, 0.0, 0.0)[0])
    return DEFAULT
