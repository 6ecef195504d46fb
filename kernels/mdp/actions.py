"""From the policy's action to motor targets, and the push that acts during a policy step."""

import warp as wp

from ..actuation.command_filter import filter_leg
from ..layout import BODIES, COORDS, DOFS
from .env import RING, Delays, EnvArrays, SkillSettings
from .view import RobotArrays, base_quat, base_velocity

wp.set_module_options({"enable_backward": False})


@wp.func
def remember(robot: RobotArrays, push: wp.array(dtype=wp.spatial_vector), push_in_flight: int, world: int):
    """Begin a world's policy step: keep the base's velocity, apply its push."""
    robot.old_lin_vel[world] = base_velocity(robot, world, base_quat(robot, world))
    pushed = push_in_flight
    for k in range(4):
        if robot.contact_time[k, world] > 0.0:
            pushed = int(1)
    wrench = wp.spatial_vector()
    if pushed != 0:
        wrench = push[world]
    robot.body_f[world * BODIES] = wrench


@wp.func
def delayed(delays: Delays, clock: int, world: int, m: int):
    """Choose what a motor follows: the target of as many physics steps ago as the latency asks for."""
    whole = delays.steps[world] // delays.substeps
    delays.late_target[m, world] = delays.past_target[(clock - whole) % RING, m, world]
    delays.earlier_target[m, world] = delays.past_target[(clock - whole - 1) % RING, m, world]
    if m == 0:
        delays.late_steps[world] = delays.steps[world] - whole * delays.substeps


@wp.kernel
def action_kernel(
    # in
    policy_action: wp.array3d(dtype=float),
    skills: wp.array(dtype=SkillSettings),
    push: wp.array(dtype=wp.spatial_vector),
    # in, out
    robot: RobotArrays,
    env: EnvArrays,
    delays: Delays,
):
    """Clamp, scale and filter the action (skills, num_worlds, 12) of each world's skill; one thread per (leg, world).

    An action that is not finite counts as 0, and its world as broken.
    """
    leg, world = wp.tid()
    world += env.first
    skill = skills[env.skill[world]]
    q = world * COORDS + 7 + 5 * leg
    d = world * DOFS + 6 + 5 * leg
    angles = wp.vec3(robot.joint_q[q], robot.joint_q[q + 1], robot.joint_q[q + 3])
    rates = wp.vec3(robot.joint_qd[d], robot.joint_qd[d + 1], robot.joint_qd[d + 3])
    target = wp.vec3(0.0)
    for j in range(3):
        m = 3 * leg + j
        asked = policy_action[env.skill[world], world, m]
        if not wp.isfinite(asked):
            asked = 0.0
            env.bad_action[world] = 1
        action = wp.clamp(asked, -1.0, 1.0)
        robot.older_action[m, world] = robot.old_action[m, world]
        robot.old_action[m, world] = robot.action[m, world]
        robot.action[m, world] = action
        robot.old_rate[m, world] = rates[j]
        robot.old_torque[m, world] = robot.torque[m, world]
        angles[j] = angles[j] + robot.joint_offset[m, world]
        target[j] = action * skill.action_scale[m] + robot.default_angle[m]
    safe = filter_leg(target, angles, rates, skill.command_filter)
    clock = env.clock[world]
    for j in range(3):
        m = 3 * leg + j
        robot.target[m, world] = target[j]
        robot.safe_target[m, world] = safe[j]
        delays.past_target[clock % RING, m, world] = safe[j]
        delayed(delays, clock, world, m)
    if leg == 0:
        remember(robot, push, skill.push_in_flight, world)
