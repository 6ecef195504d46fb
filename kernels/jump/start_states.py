"""Start states of a jump (paper, Section V-D: reference state initialisation), one function `*_base` per start mode.

If no attempt is valid, the episode begins in the default pose. A jump goes from above the origin to `goal`: x, y [m] of
the landing and the commanded base height [m] at the apex; if that is 0, the takeoff angle is sampled instead.

Episodes that begin late in a jump let a policy learn the landing before it can take off. World z is up, quaternions
are xyzw (body to world), heading is a yaw [rad], a positive pitch lowers the nose. Legs are FL, FR, BL, BR; motors are
lateral (positive outward), outer and inner (positive away from the leg's other thigh). "Sampled" numbers are uniform in
a range of `ResetRanges` and identified by an index in the random stream (`streams`).
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

STANDING = wp.constant(0)  # at rest at a sampled height over sampled paw positions
DEFAULT = wp.constant(1)  # default pose at rest
IN_FLIGHT = wp.constant(2)  # on the ballistic flight to the goal
TOUCHDOWN = wp.constant(3)  # in flight just before touchdown
AFTER_LANDING = wp.constant(4)  # over paws on the ground at the goal, still moving down
PUSHING = wp.constant(5)  # in stance, accelerating toward takeoff


@wp.struct
class ResetRanges:
    """Ranges from which start states of jumps are sampled; pairs are (lower, upper), angles [rad], lengths [m].

    A half width w means the range from -w to w.
    """

    start_probability: vec_start_modes  # of STANDING, DEFAULT, IN_FLIGHT, TOUCHDOWN, AFTER_LANDING, PUSHING
    by_steps: int  # 1: probabilities are fractions of a world's policy steps, 0: of its resets
    base_xy: float  # half width of the base's horizontal offset along x and y
    tilt: float  # half width of roll, pitch, and yaw around the heading
    forward_pitch: float  # largest mean pitch of standing states
    lean: float  # largest distance of the base behind the paws' middle in the deepest squat; 0 at the highest
    heading: float  # half width of the heading
    front_x: wp.vec2  # front paws ahead of the base
    front_y: wp.vec2  # front paws to the side of the base, absolute
    back_x: wp.vec2  # back paws behind the base, absolute
    back_y: wp.vec2  # back paws to the side of the base, absolute
    takeoff_height: wp.vec2  # base above the ground
    takeoff_ahead: wp.vec2  # base ahead of its start, towards the goal
    takeoff_pitch: wp.vec2  # nose down, of states in flight and pushing off
    push_length: wp.vec2  # distance to the takeoff position, straight along the takeoff velocity
    push_acceleration: wp.vec2  # [m/s^2] along it
    takeoff_angle: wp.vec2  # above the horizon, for goals without an apex
    highest_apex: float  # of jumps with a sampled takeoff angle
    landing_height: float  # base above the ground at the end of the flight
    flight_time: wp.vec2  # [1] fraction of the flight's duration
    flight_lateral: float  # half width of lateral angles in flight
    flight_transversal: wp.vec2  # outer and inner angles in flight
    transversal_limit: float  # largest outer and inner angle, if that of the command filter is smaller
    touchdown_time: wp.vec2  # [s] before landing
    touchdown_behind: wp.vec2  # base behind the projectile, so that the paws are ahead of it
    paw_depth: wp.vec2  # paws below the base before touchdown
    landed_height: wp.vec2  # base above the ground
    landed_ahead: wp.vec2  # base ahead of the goal
    landed_speed: wp.vec2  # [m/s] downward
    command_delay: int  # largest number of policy steps until the jump is commanded
    long_wait_probability: float  # that `long_wait` replaces `command_delay`
    long_wait: int  # policy steps
    next_jump_delay: wp.vec2  # policy steps from touchdown to the next goal


@wp.struct
class JumpStart:
    """Inputs shared by all attempts to sample one start state of a jump: start mode, goal, ranges and ground."""

    start_mode: int  # STANDING to PUSHING
    heading: float  # [rad] yaw
    goal: wp.vec3  # [m] from the origin, world axes
    base_height: wp.vec2  # [m] range of standing starts
    ranges: ResetRanges
    limits: LegLimits
    ground: Ground


@wp.struct
class JumpBase:
    """Pose and velocity of the base, sampled in one attempt at a start state, and the middle of the paws (`spot`)."""

    pos: wp.vec3  # [m] base origin, world
    quat: wp.quat  # xyzw, body to world
    com_vel: wp.vec3  # [m/s] centre of mass, world axes
    ang_vel: wp.vec3  # [rad/s] world axes, 0
    lin_vel: wp.vec3  # [m/s] of the base origin, world axes
    ground_height: float  # [m] at the origin
    height: float  # [m] above it
    spot: wp.vec3  # [m] middle of the paws on the ground; for TOUCHDOWN x, y of the projectile


@wp.func
def start_mode_at(probability: vec_start_modes, u: float) -> int:
    """Return the start mode (STANDING, IN_FLIGHT, ...) that a random number u, uniform in [0, 1), selects.

    Mode i has the probability `probability[i]`.
    """
    start_mode = int(0)
    rest = u
    for i in range(NUM_START_MODES):
        if rest >= 0.0 and probability[i] > 0.0:
            start_mode = i
        rest -= probability[i]
    return start_mode


@wp.func
def least_sampled_mode(probability: vec_start_modes, steps_per_mode: vec_start_modes) -> int:
    """Return the start mode with the largest deficit of policy steps: its wanted number less its number so far.

    The wanted number is the mode's `probability` times all policy steps; the probabilities add up to 1. With a balance
    of episodes instead of steps, modes with short episodes would have too few samples.
    """
    total = float(0.0)
    for i in range(NUM_START_MODES):
        total += steps_per_mode[i]
    start_mode = int(0)
    largest = float(-3.0e38)
    for i in range(NUM_START_MODES):
        lack = probability[i] * total - steps_per_mode[i]
        if probability[i] > 0.0 and lack > largest:
            start_mode = i
            largest = lack
    return start_mode


@wp.func
def sample_start_mode(rng: RngStream, ranges: ResetRanges, steps_per_mode: vec_start_modes) -> int:
    """Return the start mode of a new episode: a random one, or with `ranges.by_steps` the `least_sampled_mode`.

    Before any policy step is counted, the mode is random in both cases.
    """
    if ranges.by_steps != 0 and wp.length_sq(steps_per_mode) > 0.0:
        return least_sampled_mode(ranges.start_probability, steps_per_mode)
    return start_mode_at(ranges.start_probability, uniform(rng, streams.START_MODE, 0.0, 1.0))


@wp.func
def sample_quat(rng: RngStream, ranges: ResetRanges, heading: float, pitch: float) -> wp.quat:
    """Return an orientation (xyzw, body to world) with yaw, pitch and roll sampled around heading, pitch and 0 [rad].

    Each angle is at most `ranges.tilt` off; a positive pitch lowers the nose.
    """
    yaw = heading + uniform(rng, streams.YAW, -ranges.tilt, ranges.tilt)
    sampled_pitch = pitch + uniform(rng, streams.PITCH, -ranges.tilt, ranges.tilt)
    roll = uniform(rng, streams.ROLL, -ranges.tilt, ranges.tilt)
    return quat_from_ypr(yaw, sampled_pitch, roll)


@wp.func
def sample_offset(rng: RngStream, ranges: ResetRanges) -> wp.vec3:
    """Return a sampled horizontal offset [m] of the base from its nominal position, world axes, z = 0."""
    x = uniform(rng, streams.OFFSET_X, -ranges.base_xy, ranges.base_xy)
    return wp.vec3(x, uniform(rng, streams.OFFSET_Y, -ranges.base_xy, ranges.base_xy), 0.0)


@wp.func
def goal_direction(start: JumpStart) -> wp.vec3:
    """Return the horizontal unit vector toward the goal, world axes; along the heading for a jump on the spot."""
    to_goal = wp.vec3(start.goal[0], start.goal[1], 0.0)
    if wp.length(to_goal) > 1.0e-3:
        return wp.normalize(to_goal)
    return rotate_yaw(wp.vec3(1.0, 0.0, 0.0), start.heading)


@wp.func
def standing_base(start: JumpStart, rng: RngStream) -> JumpBase:
    """Return the sampled base state of a standing start: at rest over paws around the origin.

    A deeper squat may lean farther back (`lean`): the farthest jumps start from such squats.
    """
    ranges = start.ranges
    lower = start.base_height[0]
    upper = start.base_height[1]
    height = uniform_range(rng, streams.HEIGHT, start.base_height)
    pitch = uniform(rng, streams.FORWARD_PITCH, 0.0, ranges.forward_pitch)
    lean = (upper - height) / wp.max(upper - lower, 1.0e-6) * uniform(rng, streams.LEAN, 0.0, ranges.lean)
    base = JumpBase()
    base.quat = sample_quat(rng, ranges, start.heading, pitch)
    base.pos = sample_offset(rng, ranges) + wp.vec3(0.0, 0.0, height) - lean * goal_direction(start)
    return base


@wp.func
def landed_base(start: JumpStart, rng: RngStream) -> JumpBase:
    """Return the sampled base state just after landing: over paws around the goal, moving straight down."""
    ranges = start.ranges
    base = JumpBase()
    base.quat = sample_quat(rng, ranges, start.heading, 0.0)
    base.spot = wp.vec3(start.goal[0], start.goal[1], 0.0)
    ahead = uniform_range(rng, streams.LANDED_AHEAD, ranges.landed_ahead)
    base.pos = sample_offset(rng, ranges) + base.spot + ahead * goal_direction(start)
    base.pos[2] = uniform_range(rng, streams.LANDED_HEIGHT, ranges.landed_height)
    base.lin_vel = wp.vec3(0.0, 0.0, -uniform_range(rng, streams.LANDED_SPEED, ranges.landed_speed))
    return base


@wp.func
def takeoff_speed(rng: RngStream, ranges: ResetRanges, height: float, distance: float, apex: float, g: float) -> float:
    """Return the vertical takeoff speed [m/s] with which the base reaches the height `apex` [m] from `height` [m].

    If apex is 0, it follows from `distance` [m], horizontal, and a sampled takeoff angle. g [m/s^2].
    """
    if apex > 0.0:
        return wp.sqrt(wp.max(2.0 * g * (apex - height), 0.0))
    # height + v_z t - g t^2 / 2 = landing_height, where v_z t = distance tan(angle)
    climb = distance * wp.tan(uniform_range(rng, streams.TAKEOFF_ANGLE, ranges.takeoff_angle))
    t = wp.sqrt(wp.max(2.0 * (height - ranges.landing_height + climb) / g, 1.0e-6))
    limit = wp.sqrt(wp.max(2.0 * g * (ranges.highest_apex - height), 0.0))
    return wp.min(climb / t, limit)


@wp.func
def flight_base(start: JumpStart, rng: RngStream, g: float) -> JumpBase:
    """Return the sampled base state on the ballistic flight to the goal.

    It is anywhere on the flight (IN_FLIGHT), near its end (TOUCHDOWN) or at takeoff (PUSHING). g [m/s^2]. Heights are
    above the ground at the origin.
    """
    ranges = start.ranges
    along = goal_direction(start)
    height = uniform_range(rng, streams.TAKEOFF_HEIGHT, ranges.takeoff_height)
    goal_distance = wp.length(wp.vec3(start.goal[0], start.goal[1], 0.0))
    ahead = wp.min(uniform_range(rng, streams.TAKEOFF_AHEAD, ranges.takeoff_ahead), goal_distance)
    distance = goal_distance - ahead
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
def touchdown_base(start: JumpStart, flight: JumpBase, rng: RngStream) -> JumpBase:
    """Return the base state shortly before touchdown: `flight` moved back by a sampled distance, with the paws ahead.

    Paws ahead of the base let the legs brake the horizontal velocity. flight: base state on the ballistic flight; the
    paws (`spot`) stay below its position.
    """
    base = flight
    base.spot = wp.vec3(flight.pos[0], flight.pos[1], 0.0)
    behind = uniform_range(rng, streams.TOUCHDOWN_BEHIND, start.ranges.touchdown_behind)
    base.pos = flight.pos - behind * goal_direction(start)
    return base


@wp.func
def pushing_base(start: JumpStart, takeoff: JumpBase, rng: RngStream) -> JumpBase:
    """Return the base state during push-off, a sampled distance before the base state `takeoff`.

    The base moves on a straight line to `takeoff` with a sampled constant acceleration (`push_length`,
    `push_acceleration`), so its speed there was sqrt(v^2 - 2 s a), or 0. Its paws are around the origin. Such starts
    show the policy that pushing off leads to flight.
    """
    base = takeoff
    back = uniform_range(rng, streams.PUSH_LENGTH, start.ranges.push_length)
    speed = wp.length(takeoff.lin_vel)
    acceleration = uniform_range(rng, streams.PUSH_ACCELERATION, start.ranges.push_acceleration)
    speed_sq = speed * speed - 2.0 * back * acceleration
    along = wp.normalize(takeoff.lin_vel)
    base.pos = takeoff.pos - back * along
    base.lin_vel = wp.sqrt(wp.max(speed_sq, 0.0)) * along
    return base


@wp.func
def sample_base(start: JumpStart, arrays: RobotArrays, rng: RngStream, attempt: int) -> JumpBase:
    """Return the base's sampled pose and velocity for the start mode; `sample_valid_state` calls it.

    The start mode is not DEFAULT: `write_start` writes the default pose without sampling. attempt: unused, as `rng`
    is already the attempt's own stream; it is part of the signature in `sample_valid_state`. Positions are sampled with
    heights above the ground at the origin. The ground's height is added at the end: `pos` is in the world frame.
    """
    base = JumpBase()
    if start.start_mode == STANDING:
        base = standing_base(start, rng)
    elif start.start_mode == AFTER_LANDING:
        base = landed_base(start, rng)
    else:
        base = flight_base(start, rng, -arrays.gravity[rng.world][2])
        if start.start_mode == TOUCHDOWN:
            base = touchdown_base(start, base, rng)
        if start.start_mode == PUSHING:
            base = pushing_base(start, base, rng)
    base.com_vel = base.lin_vel + wp.cross(base.ang_vel, wp.quat_rotate(base.quat, arrays.body_com[rng.world * BODIES]))
    base.height = base.pos[2]
    base.ground_height = surface(start.ground, 0.0, 0.0)[0]
    base.pos = base.pos + wp.vec3(0.0, 0.0, base.ground_height)
    return base


@wp.func
def leg_in_flight(ranges: ResetRanges, base: JumpBase, geo: LegGeometry, rng: RngStream, leg: int) -> LegSample:
    """Return sampled motor angles of leg `leg` in flight, with rates 0.

    The angles are marked as reachable if the paw is at least 0.01 m above the ground. Legs in flight are nearly
    symmetric: the angles are within 0.03 rad (lateral) or 0.1 rad (outer, inner) of a value that is sampled once for
    all legs. Random indices that do not depend on `leg` give all legs the same number.
    """
    lower = ranges.flight_transversal[0]
    upper = ranges.flight_transversal[1]
    middle = uniform_range(rng, streams.FLIGHT_TRANSVERSAL, ranges.flight_transversal)
    lateral = uniform(rng, streams.FLIGHT_LATERAL, -ranges.flight_lateral, ranges.flight_lateral)
    angles = wp.vec3(
        lateral + uniform(rng, streams.LEG_LATERAL + leg, -0.03, 0.03),
        wp.clamp(middle + uniform(rng, streams.LEG_OUTER + leg, -0.1, 0.1), lower, upper),
        wp.clamp(middle + uniform(rng, streams.LEG_INNER + leg, -0.1, 0.1), lower, upper),
    )
    sample = LegSample()
    sample.angles = angles
    ankle = leg_forward_kinematics(geo, angles[0], angles[1], angles[2])
    sample.reachable = base.height + wp.quat_rotate(base.quat, ankle)[2] >= geo.paw_radius + 0.01
    return sample


@wp.func
def sample_leg(start: JumpStart, base: JumpBase, geo: LegGeometry, rng: RngStream, leg: int) -> LegSample:
    """Return sampled motor angles and rates of leg `leg`: in flight, or with its paw on a sampled spot of the ground.

    Before touchdown (TOUCHDOWN) the paw is above the spot.
    """
    ranges = start.ranges
    if start.start_mode == IN_FLIGHT:
        return leg_in_flight(ranges, base, geo, rng, leg)
    offset = sample_foot_offset(rng, leg, ranges.front_x, ranges.front_y, ranges.back_x, ranges.back_y)
    spot = base.spot + rotate_yaw(offset, start.heading)
    paw = spot - base.pos
    if start.start_mode == TOUCHDOWN:
        # paws hang below the base, a little above the ground at least
        depth = uniform_range(rng, streams.PAW_DEPTH, ranges.paw_depth)
        paw[2] = -wp.min(depth, base.height - geo.paw_radius - 0.025)
    else:
        below = surface(start.ground, spot[0], spot[1])[0]
        paw[2] = below + geo.paw_radius - base.height - base.ground_height
    sample = leg_ik(geo, start.limits, wp.quat_rotate_inv(base.quat, paw))
    if start.start_mode == AFTER_LANDING or start.start_mode == PUSHING:
        # the paw rests on the ground while the base moves, so the joints move too
        moving = base.lin_vel + wp.cross(base.ang_vel, paw)
        sample = with_foot_velocity(geo, sample, -wp.quat_rotate_inv(base.quat, moving))
    return sample


@wp.func
def write_start(arrays: RobotArrays, scene: Scene, start: JumpStart, rng: RngStream) -> int:
    """Write a sampled start state of a jump to world `rng.world`, and return its start mode.

    The mode is DEFAULT if no attempt is valid.
    """
    if start.start_mode != DEFAULT:
        if sample_valid_state(sample_base, sample_leg, start, arrays, scene, rng):
            return start.start_mode
    write_default_pose(arrays, scene, rng.world, start.heading, surface(start.ground, 0.0, 0.0)[0])
    return DEFAULT
