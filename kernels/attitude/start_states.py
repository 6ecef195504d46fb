"""Start states of the attitude task: weightless, with a sampled spin, legs sampled or in the default pose.

World z is up; quaternions are xyzw, body to world. Motors of a leg are lateral (positive outward), outer and inner
(positive away from the leg's other thigh). Joint rates at the start are 0.
"""

import warp as wp

from ..kinematics.geometry import LegGeometry
from ..kinematics.inverse import LegLimits
from ..layout import BODIES
from ..mdp.attempts import ATTEMPTS, sample_valid_state
from ..mdp.env import Scene, SkillSettings
from ..mdp.random import RngStream, uniform, uniform_range
from ..mdp.reset import leg_limits
from ..mdp.starts import LegSample
from ..mdp.view import RobotArrays
from ..terrain.ground import Ground, surface, world_ground
from . import streams

wp.set_module_options({"enable_backward": False})


@wp.struct
class AttitudeSettings:
    """Ranges from which start states of the attitude task are sampled; pairs are (lower, upper)."""

    episode_steps: wp.vec2  # policy steps that an episode lasts
    height: float  # [m] of the base above the ground
    default_pose_probability: float  # of a start in the default pose
    lateral: wp.vec2  # [rad] angle of lateral motors, unless in the default pose
    transversal: wp.vec2  # [rad] angle of outer and inner motors, likewise
    spin: float  # [rad/s] angular velocity about each world axis is sampled from -spin to spin


@wp.struct
class AttitudeStart:
    """Inputs shared by all attempts to sample one start state: base pose and velocity, limits and ground."""

    pos: wp.vec3  # [m] of the base
    quat: wp.quat  # xyzw, body to world
    com_vel: wp.vec3  # [m/s] world axes
    ang_vel: wp.vec3  # [rad/s] world axes
    default_legs: bool  # whether the legs are in the default pose
    default_angle: wp.array(dtype=float)  # [rad] (12,) motor angles of the default pose
    settings: AttitudeSettings
    limits: LegLimits
    ground: Ground


@wp.func
def sample_base(start: AttitudeStart, arrays: RobotArrays, rng: RngStream, attempt: int) -> AttitudeStart:
    """Return a copy of `start` for one sampling attempt; in the last attempt its legs are in the default pose.

    The default pose is free of collisions, so that some attempt is valid. `mdp.attempts.sample_valid_state` calls this
    function as its `sample_base`; arrays and rng are unused.
    """
    base = start
    base.default_legs = start.default_legs or attempt == ATTEMPTS - 1
    return base


@wp.func
def sample_leg(start: AttitudeStart, base: AttitudeStart, geo: LegGeometry, rng: RngStream, leg: int) -> LegSample:
    """Return motor angles of leg `leg`, default or sampled, with rates 0.

    Sampled angles are marked as reachable if the sum of outer and inner angle is within its limits.
    """
    sample = LegSample()
    if base.default_legs:
        for j in range(3):
            sample.angles[j] = start.default_angle[3 * leg + j]
        sample.reachable = True
        return sample
    sample.angles = wp.vec3(
        uniform_range(rng, streams.LATERAL + leg, start.settings.lateral),
        uniform_range(rng, streams.OUTER + leg, start.settings.transversal),
        uniform_range(rng, streams.INNER + leg, start.settings.transversal),
    )
    total = sample.angles[1] + sample.angles[2]
    sample.reachable = total > start.limits.sum_lower and total < start.limits.sum_upper
    return sample


@wp.func
def write_start(
    arrays: RobotArrays, scene: Scene, skill: SkillSettings, settings: AttitudeSettings, quat: wp.quat, rng: RngStream
):
    """Write a weightless start state with orientation `quat` (xyzw, body to world) to world `rng.world`.

    The base origin is at rest above the origin of the world while the body rotates. The centre of mass, whose velocity
    Newton stores, moves around the base origin. `skill` holds the motors' limits.
    """
    w = settings.spin
    start = AttitudeStart()
    start.ground = world_ground(scene.ground, rng.world)
    start.pos = wp.vec3(0.0, 0.0, surface(start.ground, 0.0, 0.0)[0] + settings.height)
    start.quat = quat
    start.ang_vel = wp.vec3(
        uniform(rng, streams.SPIN, -w, w), uniform(rng, streams.SPIN + 1, -w, w), uniform(rng, streams.SPIN + 2, -w, w)
    )
    start.com_vel = wp.cross(start.ang_vel, wp.quat_rotate(quat, arrays.body_com[rng.world * BODIES]))
    start.default_legs = uniform(rng, streams.DEFAULT_LEGS, 0.0, 1.0) < settings.default_pose_probability
    start.default_angle = arrays.default_angle
    start.settings = settings
    start.limits = leg_limits(skill.command_filter)
    sample_valid_state(sample_base, sample_leg, start, arrays, scene, rng)
