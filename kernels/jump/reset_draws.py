"""Draws of the base for reference state initialisation: standing, pushing off, on a jump's projectile, just landed.

A jump goes from above the origin to `goal`: x, y [m] of the landing and, for a vertical jump, the base height [m]
wanted at the apex; where none is wanted, the takeoff angle is drawn.
"""

import warp as wp

from ..mdp.random import Draw, between, within
from ..mdp.starts import place_beside, turn_of
from ..mdp.view import turned
from .phase import time_to_height
from .state import SCHEMES, JumpState, vec_schemes

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

    shares: vec_schemes  # of standing, default, in flight, touchdown, just landed, pushing off
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
class BaseDraw:
    """A drawn state of the base; paws are placed around `spot`."""

    pos: wp.vec3
    quat: wp.quat
    lin_vel: wp.vec3
    ang_vel: wp.vec3  # [rad/s]
    spot: wp.vec3  # [m] on the ground, or below the projectile before touchdown
    lateral: float  # [rad], in flight only
    use_paws: int  # 1: joint angles from the paw positions; 0: from `lateral` and the flight range


@wp.func
def draw_box(draw: Draw, column: int, lower: wp.vec3, upper: wp.vec3) -> wp.vec3:
    """Return a uniform draw from a box."""
    return wp.vec3(
        between(draw, column, lower[0], upper[0]),
        between(draw, column + 1, lower[1], upper[1]),
        between(draw, column + 2, lower[2], upper[2]),
    )


@wp.func
def rounded(goal: wp.vec3, lower: wp.vec3, upper: wp.vec3) -> wp.vec3:
    """Return a goal of a box around the start moved into the ellipse that touches the box's sides, its height kept.

    Each quarter has its own half axes, so that reaches ahead, back and to either side can differ.
    """
    x = goal[0] / wp.max(wp.where(goal[0] < 0.0, -lower[0], upper[0]), 1.0e-6)
    y = goal[1] / wp.max(wp.where(goal[1] < 0.0, -lower[1], upper[1]), 1.0e-6)
    shrink = wp.max(wp.abs(x), wp.abs(y)) / wp.max(wp.length(wp.vec2(x, y)), 1.0e-6)
    return wp.vec3(shrink * goal[0], shrink * goal[1], goal[2])


@wp.func
def draw_quat(draw: Draw, ranges: ResetRanges, heading: float, pitch: float) -> wp.quat:
    """Return an orientation (xyzw) around a heading and a pitch [rad]."""
    yaw = heading + between(draw, 10, -ranges.tilt, ranges.tilt)
    tip = pitch + between(draw, 11, -ranges.tilt, ranges.tilt)
    roll = between(draw, 12, -ranges.tilt, ranges.tilt)
    return turn_of(yaw, tip, roll)


@wp.func
def scheme_of_shares(shares: vec_schemes, u: float) -> int:
    """Return the scheme at u in [0, 1) of the shares one after the other."""
    scheme = int(0)
    rest = u
    for i in range(SCHEMES):
        if rest >= 0.0 and shares[i] > 0.0:
            scheme = i
        rest -= shares[i]
    return scheme


@wp.func
def most_lacking(shares: vec_schemes, spent: vec_schemes) -> int:
    """Return the scheme that is farthest behind its share of what was spent, in policy steps."""
    total = float(0.0)
    for i in range(SCHEMES):
        total += spent[i]
    scheme = int(0)
    most = float(-3.0e38)
    for i in range(SCHEMES):
        lack = shares[i] * total - spent[i]
        if shares[i] > 0.0 and lack > most:
            scheme = i
            most = lack
    return scheme


@wp.func
def time_spent(old: JumpState) -> vec_schemes:
    """Return how many policy steps [1] a world has spent in episodes of each scheme, an ended one included."""
    spent = old.spent
    for i in range(SCHEMES):
        if i == old.scheme:
            spent[i] += float(old.steps)
    return spent


@wp.func
def draw_scheme(draw: Draw, ranges: ResetRanges, spent: vec_schemes) -> int:
    """Return the scheme of a new episode; shares of time are drawn once, and then what lacks most comes next."""
    if ranges.of_time != 0 and wp.length_sq(spent) > 0.0:
        return most_lacking(ranges.shares, spent)
    return scheme_of_shares(ranges.shares, between(draw, 1, 0.0, 1.0))


@wp.func
def draw_paw(draw: Draw, ranges: ResetRanges, leg: int, heading: float) -> wp.vec3:
    """Return a paw's place [m] relative to the spot that they surround, world axes, z = 0."""
    place = place_beside(draw, leg, ranges.front_x, ranges.front_y, ranges.back_x, ranges.back_y)
    return turned(place, heading)


@wp.func
def takeoff_speed(draw: Draw, ranges: ResetRanges, height: float, distance: float, apex: float, g: float) -> float:
    """Return the upward speed [m/s] with which a jump over a distance [m] leaves a height [m]."""
    if apex > 0.0:
        return wp.sqrt(wp.max(2.0 * g * (apex - height), 0.0))
    # height + v_z t - g t^2 / 2 = landing_height, where v_z t = distance tan(angle)
    climb = distance * wp.tan(within(draw, 16, ranges.takeoff_angle))
    t = wp.sqrt(wp.max(2.0 * (height - ranges.landing_height + climb) / g, 1.0e-6))
    limit = wp.sqrt(wp.max(2.0 * g * (ranges.highest_apex - height), 0.0))
    return wp.min(climb / t, limit)


@wp.func
def push_off(draw: Draw, ranges: ResetRanges, takeoff: BaseDraw) -> BaseDraw:
    """Return a state before a takeoff, its paws still around the start: on a straight line, evenly accelerated."""
    d = takeoff
    back = within(draw, 54, ranges.push_length)
    speed = wp.length(takeoff.lin_vel)
    before = speed * speed - 2.0 * back * within(draw, 55, ranges.push_acceleration)
    way = wp.normalize(takeoff.lin_vel)
    d.pos = takeoff.pos - back * way
    d.lin_vel = wp.sqrt(wp.max(before, 0.0)) * way
    d.spot = wp.vec3(0.0)
    d.use_paws = 1
    return d


@wp.func
def draw_airborne(
    draw: Draw,
    ranges: ResetRanges,
    scheme: int,
    heading: float,
    goal: wp.vec3,
    along: wp.vec3,
    g: float,
) -> BaseDraw:
    """Return a state on the projectile to the goal, or on the way to its takeoff; along: unit vector towards it."""
    d = BaseDraw()
    d.quat = draw_quat(draw, ranges, heading, within(draw, 56, ranges.takeoff_pitch))
    height = within(draw, 4, ranges.takeoff_height)
    way = wp.length(wp.vec3(goal[0], goal[1], 0.0))
    ahead = wp.min(within(draw, 14, ranges.takeoff_ahead), way)
    distance = way - ahead
    up = takeoff_speed(draw, ranges, height, distance, goal[2], g)
    whole = wp.max(time_to_height(height, up, ranges.landing_height, g), 1.0e-3)
    t = whole * within(draw, 5, ranges.flight_time)
    if scheme == TOUCHDOWN:
        t = wp.max(whole - within(draw, 5, ranges.touchdown_time), 0.0)
    if scheme == PUSHING:
        t = float(0.0)
    forward = distance / whole
    off = wp.vec3(
        between(draw, 2, -ranges.base_xy, ranges.base_xy), between(draw, 3, -ranges.base_xy, ranges.base_xy), 0.0
    )
    d.pos = off + (ahead + forward * t) * along + wp.vec3(0.0, 0.0, height + up * t - 0.5 * g * t * t)
    d.lin_vel = forward * along + wp.vec3(0.0, 0.0, up - g * t)
    if scheme == PUSHING:
        return push_off(draw, ranges, d)
    d.spot = wp.vec3(d.pos[0], d.pos[1], 0.0)
    if scheme == TOUCHDOWN:
        d.use_paws = 1
        d.pos = d.pos - within(draw, 15, ranges.touchdown_behind) * along
    else:
        d.lateral = between(draw, 6, -ranges.flight_lateral, ranges.flight_lateral)
    return d


@wp.func
def draw_base(
    draw: Draw,
    ranges: ResetRanges,
    scheme: int,
    heading: float,
    height: wp.vec2,
    goal: wp.vec3,
    g: float,
) -> BaseDraw:
    """Return pose and velocity of the base for a scheme; height [m]: range of standing starts."""
    to_goal = wp.vec3(goal[0], goal[1], 0.0)
    along = turned(wp.vec3(1.0, 0.0, 0.0), heading)
    if wp.length(to_goal) > 1.0e-3:
        along = wp.normalize(to_goal)
    if scheme == IN_FLIGHT or scheme == TOUCHDOWN or scheme == PUSHING:
        return draw_airborne(draw, ranges, scheme, heading, goal, along, g)
    d = BaseDraw()
    d.use_paws = 1
    off = wp.vec3(
        between(draw, 2, -ranges.base_xy, ranges.base_xy), between(draw, 3, -ranges.base_xy, ranges.base_xy), 0.0
    )
    d.quat = draw_quat(draw, ranges, heading, between(draw, 17, 0.0, ranges.forward_pitch))
    low = (height[1] - within(draw, 4, height)) / wp.max(height[1] - height[0], 1.0e-6)
    lean = low * between(draw, 53, 0.0, ranges.lean)
    d.pos = off + wp.vec3(0.0, 0.0, within(draw, 4, height)) - lean * along
    if scheme == AFTER_LANDING:
        d.quat = draw_quat(draw, ranges, heading, 0.0)
        d.spot = to_goal
        d.pos = off + to_goal + within(draw, 14, ranges.landed_ahead) * along
        d.pos[2] = within(draw, 4, ranges.landed_height)
        d.lin_vel = wp.vec3(0.0, 0.0, -within(draw, 5, ranges.landed_speed))
    return d
