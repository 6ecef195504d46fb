"""Start states of velocity tracking: base pose and velocity, and foot positions, sampled on any ground.

If no attempt is valid, the episode begins in the default pose. Starts in motion and with lifted paws show the policy
states that it meets while walking. World z is up, quaternions are xyzw (body to world), a heading is a yaw [rad].
Motors of a leg are lateral (positive outward), outer and inner (positive away from the leg's other thigh).
"""

import warp as wp

from ..kinematics.geometry import LegGeometry
from ..kinematics.inverse import LegLimits
from ..layout import BODIES, COORDS
from ..mdp.attempts import sample_valid_state
from ..mdp.env import Scene, SkillSettings
from ..mdp.random import RngStream, uniform, uniform_range
from ..mdp.reset import leg_limits, write_default_pose
from ..mdp.starts import LegSample, leg_ik, quat_from_ypr, sample_foot_offset, with_foot_velocity
from ..mdp.view import RobotArrays, rotate_yaw
from ..terrain.ground import Ground, surface, world_ground
from . import streams

wp.set_module_options({"enable_backward": False})


@wp.struct
class TileMap:
    """Size of a terrain map of square tiles: difficulty grows with the row, the column is the kind of terrain."""

    rows: int  # number of tiles along x (terrain levels), 0: no map
    cols: int  # number of tiles along y
    tile: float  # [m] edge of a tile


@wp.struct
class VelocitySettings:
    """Ranges from which start states of velocity tracking are sampled; pairs are (lower, upper).

    A half width w means the range from -w to w.
    """

    map: TileMap
    episode_steps: int  # policy steps that an episode lasts
    pace: float  # gait cycles per policy step, 0: no gait clock
    default_pose_probability: float  # of a start in the default pose at rest
    base_xy: float  # [m] half width of the base's offset along x and y
    height: wp.vec2  # [m] of the base above the ground
    tilt: float  # [rad] half width of roll and pitch
    heading: float  # [rad] half width of the yaw
    front_x: wp.vec2  # [m] front paws ahead of the base
    front_y: wp.vec2  # [m] front paws to the side of the base, absolute
    back_x: wp.vec2  # [m] back paws behind the base, absolute
    back_y: wp.vec2  # [m] back paws to the side of the base, absolute
    max_swing_height: float  # [m] largest height of a paw in the air above the ground
    swing_probability: float  # of a paw being in the air
    lin_vel: float  # [m/s] half width of the base's velocity along each axis
    ang_vel: float  # [rad/s] half width of its angular velocity about each axis
    tolerance: float  # [m/s] mean error up to which an episode is a success


@wp.struct
class VelocityStart:
    """Inputs shared by all attempts to sample one start state of velocity tracking: place, ranges and ground."""

    spot: wp.vec2  # [m] x, y around which the base is placed
    heading: float  # [rad] yaw
    settings: VelocitySettings
    limits: LegLimits
    ground: Ground


@wp.struct
class VelocityBase:
    """Sampled pose and velocity of the base in one attempt at a start state."""

    pos: wp.vec3  # [m] base origin, world
    quat: wp.quat  # xyzw, body to world
    com_vel: wp.vec3  # [m/s] centre of mass, world axes
    ang_vel: wp.vec3  # [rad/s] world axes
    lin_vel: wp.vec3  # [m/s] of the base origin, world axes
    body_rate: wp.vec3  # [rad/s] angular velocity, body axes


@wp.func
def sample_tile(rng: RngStream, map: TileMap, level: int) -> wp.vec2:
    """Return the centre (x, y) [m] of a sampled terrain tile in row `level` of the map, or 0 without a map.

    The row is sampled too if `level` is past the last.
    """
    if map.rows == 0:
        return wp.vec2(0.0)
    row = level
    if row >= map.rows:
        row = wp.min(int(uniform(rng, streams.ROW, 0.0, float(map.rows))), map.rows - 1)
    col = wp.min(int(uniform(rng, streams.COL, 0.0, float(map.cols))), map.cols - 1)
    return wp.vec2(
        map.tile * (float(row) + 0.5 - 0.5 * float(map.rows)), map.tile * (float(col) + 0.5 - 0.5 * float(map.cols))
    )


@wp.func
def sample_base(start: VelocityStart, arrays: RobotArrays, rng: RngStream, attempt: int) -> VelocityBase:
    """Return a sampled pose and velocity of the base, with a position around `start.spot`.

    The range of the vertical velocity is 0.3 times the range of the horizontal velocities.
    `mdp.attempts.sample_valid_state` calls this function as its `sample_base`.
    """
    settings = start.settings
    v = settings.lin_vel
    w = settings.ang_vel
    roll = uniform(rng, streams.ROLL, -settings.tilt, settings.tilt)
    pitch = uniform(rng, streams.PITCH, -settings.tilt, settings.tilt)
    x = start.spot[0] + uniform(rng, streams.OFFSET_X, -settings.base_xy, settings.base_xy)
    y = start.spot[1] + uniform(rng, streams.OFFSET_Y, -settings.base_xy, settings.base_xy)
    base = VelocityBase()
    base.quat = quat_from_ypr(start.heading, pitch, roll)
    base.pos = wp.vec3(x, y, surface(start.ground, x, y)[0] + uniform_range(rng, streams.HEIGHT, settings.height))
    base.lin_vel = wp.vec3(
        uniform(rng, streams.LIN_VEL, -v, v),
        uniform(rng, streams.LIN_VEL + 1, -v, v),
        0.3 * uniform(rng, streams.LIN_VEL + 2, -v, v),
    )
    base.body_rate = wp.vec3(
        uniform(rng, streams.ANG_VEL, -w, w),
        uniform(rng, streams.ANG_VEL + 1, -w, w),
        uniform(rng, streams.ANG_VEL + 2, -w, w),
    )
    base.ang_vel = wp.quat_rotate(base.quat, base.body_rate)
    base.com_vel = base.lin_vel + wp.cross(base.ang_vel, wp.quat_rotate(base.quat, arrays.body_com[rng.world * BODIES]))
    return base


@wp.func
def sample_leg(start: VelocityStart, base: VelocityBase, geo: LegGeometry, rng: RngStream, leg: int) -> LegSample:
    """Return sampled motor angles and rates of leg `leg`: paw at rest on the ground, or lifted with rates 0.

    The paw is lifted with `swing_probability`. A paw at rest on the ground under a moving base needs motor rates:
    relative to the base, it moves with minus the velocity of the base at the paw.
    """
    settings = start.settings
    offset = sample_foot_offset(rng, leg, settings.front_x, settings.front_y, settings.back_x, settings.back_y)
    paw = base.pos + rotate_yaw(offset, start.heading)
    lifted = uniform(rng, streams.LIFTED + leg, 0.0, 1.0) < settings.swing_probability
    up = float(0.0)
    if lifted:
        up = uniform(rng, streams.LIFT + leg, 0.01, settings.max_swing_height)
    paw[2] = surface(start.ground, paw[0], paw[1])[0] + geo.paw_radius + up
    ankle = wp.quat_rotate_inv(base.quat, paw - base.pos)
    sample = leg_ik(geo, start.limits, ankle)
    if lifted:
        return sample
    return with_foot_velocity(
        geo, sample, -wp.quat_rotate_inv(base.quat, base.lin_vel) - wp.cross(base.body_rate, ankle)
    )


@wp.func
def write_start(
    arrays: RobotArrays, scene: Scene, skill: SkillSettings, settings: VelocitySettings, terrain_level: int,
    rng: RngStream,
):  # fmt: skip
    """Write a start state of velocity tracking to world `rng.world`.

    The state is sampled, or the default pose with `default_pose_probability`.
    """
    world = rng.world
    start = VelocityStart()
    start.spot = sample_tile(rng, settings.map, terrain_level)
    start.heading = uniform(rng, streams.HEADING, -settings.heading, settings.heading)
    start.settings = settings
    start.limits = leg_limits(skill.command_filter)
    start.ground = world_ground(scene.ground, world)
    if uniform(rng, streams.DEFAULT_POSE, 0.0, 1.0) >= settings.default_pose_probability:
        if sample_valid_state(sample_base, sample_leg, start, arrays, scene, rng):
            return
    write_default_pose(arrays, scene, world, start.heading, surface(start.ground, start.spot[0], start.spot[1])[0])
    arrays.joint_q[world * COORDS] = start.spot[0]
    arrays.joint_q[world * COORDS + 1] = start.spot[1]
