"""Paw kinematics, contact timers and collisions at the end of a policy step.

Rewards and observations read the results once per policy step; physics steps need none of them.
"""

import warp as wp

from ..collision.robot import leg_collisions
from ..dynamics.leg_dynamics import leg_pose, paw_kinematics
from ..kinematics.geometry import LegGeometry, leg_of
from ..layout import COORDS
from ..state import leg_coord, leg_dof, load_motors
from ..terrain.ground import Ground, grown_block, surface, world_ground
from .env import EpisodeArrays, SkillSettings
from .view import RobotArrays, base_pos, base_quat, base_velocity

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class PawMotion:
    """Motion of a paw's centre, world axes."""

    pos: wp.vec3  # [m]
    vel: wp.vec3  # [m/s]


@wp.func
def paw_motion(arrays: RobotArrays, geo: LegGeometry, world: int, leg: int) -> PawMotion:
    """Return the motion of a leg's paw from the coordinates and rates of base and joints."""
    quat = base_quat(arrays, world)
    angles = load_motors(arrays.joint_q, leg_coord(world, leg))
    rates = load_motors(arrays.joint_qd, leg_dof(world, leg))
    paw = paw_kinematics(geo, leg_pose(geo, angles))
    arm = wp.quat_rotate(quat, paw.position)
    i = leg_dof(world, 0) - 3
    ang = wp.vec3(arrays.joint_qd[i], arrays.joint_qd[i + 1], arrays.joint_qd[i + 2])
    along = wp.quat_rotate(quat, paw.jacobian * rates)
    motion = PawMotion()
    motion.pos = base_pos(arrays, world) + arm
    motion.vel = base_velocity(arrays, world, quat) + wp.cross(ang, arm) + along
    return motion


@wp.func
def update_paw_kinematics(arrays: RobotArrays, geo: LegGeometry, world: int, leg: int):
    """Write position [m] and velocity [m/s] of a leg's paw centre (`paw_pos`, `paw_vel`), world axes."""
    paw = paw_motion(arrays, geo, world, leg)
    arrays.paw_pos[leg, world] = paw.pos
    arrays.paw_vel[leg, world] = paw.vel


@wp.func
def paw_clearance(geo: LegGeometry, ground: Ground, world: int, pos: wp.vec3) -> float:
    """Return the height of a paw's lowest point above the ground below its centre `pos` [m], negative inside it."""
    return pos[2] - surface(world_ground(ground, world), pos[0], pos[1])[0] - geo.paw_radius


@wp.func
def update_contact_timers(arrays: RobotArrays, world: int, leg: int, down: bool):
    """Update contact time, air time [s] and touchdown speed [m/s] of a paw; down: whether it is in contact.

    At the first contact, `air_time` is still the duration of the swing, for rewards of long swings. It is 0 from the
    next step on. `paw_vel` is the velocity before the contact, which stops the paw.
    """
    was_down = arrays.contact_time[leg, world] > 0.0
    if down:
        if was_down:
            arrays.air_time[leg, world] = 0.0
        elif arrays.air_time[leg, world] > 0.0:
            arrays.touchdown_speed[leg, world] = wp.max(-arrays.paw_vel[leg, world][2], 0.0)
        arrays.contact_time[leg, world] = arrays.contact_time[leg, world] + arrays.step_dt
    else:
        if was_down:
            arrays.air_time[leg, world] = 0.0
        arrays.air_time[leg, world] = arrays.air_time[leg, world] + arrays.step_dt
        arrays.contact_time[leg, world] = 0.0


@wp.kernel
def track_kernel(
    # in
    geometry: wp.array(dtype=LegGeometry),
    ground: Ground,
    skills: wp.array(dtype=SkillSettings),
    episode: EpisodeArrays,
    # in, out
    arrays: RobotArrays,
):
    """Update every paw's kinematics and contact, and each leg's collision flags; one thread per (leg, world)."""
    leg, world = wp.tid()
    world += episode.first
    skill = skills[episode.skill[world]]
    down = wp.length(arrays.paw_force[leg, world]) > skill.contact_force
    update_contact_timers(arrays, world, leg, down)  # reads paw_vel of the previous policy step: call it first
    update_paw_kinematics(arrays, leg_of(geometry, world, leg), world, leg)
    arrays.paw_height[leg, world] = paw_clearance(
        leg_of(geometry, world, leg), ground, world, arrays.paw_pos[leg, world]
    )
    grown_ground = grown_block(world_ground(ground, world), skill.obstacle_margin)
    arrays.collisions[leg, world] = leg_collisions(
        geometry, grown_ground, arrays.joint_q, world, world * COORDS, leg, skill.self_collision_margin
    )
