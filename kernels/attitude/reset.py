"""How episodes of turning begin: afloat in any attitude, legs anywhere, with a turn to make.

A draw whose links touch what they must not is drawn again; the default pose stands in after the last attempt.
"""

import warp as wp

from ..layout import BODIES, COORDS, DOFS
from ..mdp.attempts import ATTEMPTS, attempt_step, first_attempt, first_leg, leg_step, meet_attempts
from ..mdp.env import Scene, SkillSettings
from ..mdp.random import Draw, between, branch, within
from ..mdp.starts import LegDraw, keep_first, legs_fit, store_base, store_leg
from ..mdp.view import RobotArrays
from ..terrain.ground import Ground, rest_block, surface, world_ground
from .commands import TurnRanges, draw_turn, draw_unit_quat
from .state import AttitudeState, carried_over, with_goal

wp.set_module_options({"enable_backward": False})


@wp.struct
class AttitudeSettings:
    """How episodes begin; pairs are (lower, upper)."""

    episode_steps: wp.vec2  # policy steps that an episode lasts
    height: float  # [m] of the base above the ground
    default_share: float  # share of episodes that begin in the default pose
    lateral: wp.vec2  # [rad] of drawn legs
    transversal: wp.vec2  # [rad]
    spin: float  # [rad/s] half width of the angular velocity about each axis


@wp.func
def draw_leg(draw: Draw, settings: AttitudeSettings, limits_sum: wp.vec2, leg: int) -> LegDraw:
    """Return a leg at rest; possible if the sum of its transversal angles keeps its limits [rad]."""
    found = LegDraw()
    found.angles = wp.vec3(
        within(draw, 20 + leg, settings.lateral),
        within(draw, 24 + leg, settings.transversal),
        within(draw, 28 + leg, settings.transversal),
    )
    total = found.angles[1] + found.angles[2]
    found.possible = total > limits_sum[0] and total < limits_sum[1]
    return found


@wp.func
def draw_until_taken(
    robot: RobotArrays, scene: Scene, ground: Ground, limits_sum: wp.vec2, settings: AttitudeSettings, draw: Draw,
    pos: wp.vec3, quat: wp.quat, spin: wp.vec3, default: bool,
) -> bool:  # fmt: skip
    """Draw legs until none touches another, and write the state; returns whether one of the attempts could.

    spin [rad/s]: world axes, about the base's origin. default: the legs are in the default pose.
    """
    com = wp.quat_rotate(quat, robot.body_com[draw.world * BODIES])
    own_q = wp.zeros(shape=(COORDS,), dtype=float)
    own_qd = wp.zeros(shape=(DOFS,), dtype=float)
    taken = int(ATTEMPTS)
    for attempt in range(first_attempt(draw), ATTEMPTS, attempt_step(draw)):
        if taken == ATTEMPTS:
            fresh = branch(draw, attempt)
            store_base(pos, quat, wp.cross(spin, com), spin, own_q, own_qd)
            possible = bool(True)
            own = LegDraw()
            for leg in range(first_leg(draw), scene.geometry.shape[0], leg_step(draw)):
                own = draw_leg(fresh, settings, limits_sum, leg)
                if default or attempt == ATTEMPTS - 1:
                    for j in range(3):
                        own.angles[j] = robot.default_angle[3 * leg + j]
                    own.possible = True
                possible = possible and own.possible
                store_leg(leg, own, own_q, own_qd)
            if legs_fit(scene.geometry, ground, draw, own, possible, own_q, own_qd):
                taken = attempt
    return keep_first(scene.geometry, draw, taken, own_q, own_qd, robot.joint_q, robot.joint_qd)


@wp.func
def draw_spin(draw: Draw, settings: AttitudeSettings) -> wp.vec3:
    """Return an angular velocity [rad/s]."""
    w = settings.spin
    return wp.vec3(between(draw, 13, -w, w), between(draw, 14, -w, w), between(draw, 15, -w, w))


@wp.func
def reset_attitude(
    robot: RobotArrays, scene: Scene, skill: SkillSettings, old: AttitudeState, settings: AttitudeSettings,
    level: TurnRanges, draw: Draw,
) -> AttitudeState:  # fmt: skip
    """Begin an episode with a drawn turn, and return its state."""
    new = carried_over(old)
    rest_block(scene.ground, draw.world)
    ground = world_ground(scene.ground, draw.world)
    pos = wp.vec3(0.0, 0.0, surface(ground, 0.0, 0.0)[0] + settings.height)
    quat = draw_unit_quat(branch(draw, 200))
    meet_attempts(draw)
    limits = wp.vec2(skill.command_filter.sum.lower, skill.command_filter.sum.upper)
    default = between(draw, 1, 0.0, 1.0) < settings.default_share
    draw_until_taken(robot, scene, ground, limits, settings, draw, pos, quat, draw_spin(draw, settings), default)
    new.episode_steps = wp.max(int(within(draw, 16, settings.episode_steps) + 0.5), 1)
    return with_goal(new, quat, quat * draw_turn(branch(draw, 300), level))
