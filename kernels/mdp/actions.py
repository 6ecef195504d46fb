"""Motor targets from the policy's action, and the external push of a policy step.

Motors m are 3 * leg + j: legs FL, FR, BL, BR; j lateral, outer, inner. A policy step (1/60 s) has several physics
steps. The target of an action arrives at the motors after the world's latency, often within a later physics step.
"""

import warp as wp

from ..actuation.command_filter import filter_leg
from ..layout import BODIES
from ..state import leg_coord, leg_dof, load_motors
from .env import RING, Delays, EpisodeArrays, SkillSettings
from .view import RobotArrays, base_quat, base_velocity

wp.set_module_options({"enable_backward": False})


@wp.func
def of_leg(values: wp.array2d(dtype=float), leg: int, world: int) -> wp.vec3:
    """Return a world's values of a leg's three motors, from an array (12, num_worlds)."""
    return wp.vec3(values[3 * leg, world], values[3 * leg + 1, world], values[3 * leg + 2, world])


@wp.func
def begin_policy_step(arrays: RobotArrays, push: wp.array(dtype=wp.spatial_vector), push_in_flight: int, world: int):
    """Begin a policy step of a world: store the base's velocity as `prev_lin_vel`, apply an external push to the base.

    push [N], [N m]: (num_worlds,), world axes; without a paw in contact it acts only if push_in_flight is 1.
    """
    arrays.prev_lin_vel[world] = base_velocity(arrays, world, base_quat(arrays, world))
    pushed = push_in_flight
    for k in range(4):
        if arrays.contact_time[k, world] > 0.0:
            pushed = int(1)
    wrench = wp.spatial_vector()
    if pushed != 0:
        wrench = push[world]
    arrays.body_f[world * BODIES] = wrench


@wp.func
def select_delayed_targets(delays: Delays, step_count: int, world: int, leg: int):
    """Write the two targets [rad] that a leg's motors follow in this policy step, and the physics step of the switch.

    step_count: policy steps of the world so far. The latency is `delays.steps` physics steps: `whole` policy steps and
    a remainder. During the remainder, the motors still follow the older target.
    """
    whole = delays.steps[world] // delays.substeps
    current = of_leg(delays.target_history[(step_count - whole) % RING], leg, world)
    previous = of_leg(delays.target_history[(step_count - whole - 1) % RING], leg, world)
    for j in range(3):
        delays.current_target[3 * leg + j, world] = current[j]
        delays.prev_target[3 * leg + j, world] = previous[j]
    if leg == 0:
        delays.switch_step[world] = delays.steps[world] - whole * delays.substeps


@wp.kernel
def action_kernel(
    # in
    policy_action: wp.array3d(dtype=float),
    skills: wp.array(dtype=SkillSettings),
    push: wp.array(dtype=wp.spatial_vector),
    # in, out
    arrays: RobotArrays,
    episode: EpisodeArrays,
    delays: Delays,
):
    """Turn the policy's action into motor targets (clamp, scale, filter, delay); one thread per (leg, world).

    A fifth thread of each world begins the policy step: see `begin_policy_step`. Launch over (5, num_worlds).
    policy_action: (skills, num_worlds, 12); each world uses the action for its skill. A non-finite action counts as 0
    and sets `bad_action` of its world.
    """
    leg, world = wp.tid()
    world += episode.first
    skill = skills[episode.skill[world]]
    if leg == 4:
        if world == episode.first:
            episode.num_listed[episode.slice] = 0
        begin_policy_step(arrays, push, skill.push_in_flight, world)
        return
    angles = load_motors(arrays.joint_q, leg_coord(world, leg))
    rates = load_motors(arrays.joint_qd, leg_dof(world, leg))
    target = wp.vec3(0.0)
    policy = policy_action[episode.skill[world], world]
    raw_actions = wp.vec3(policy[3 * leg], policy[3 * leg + 1], policy[3 * leg + 2])
    prev_actions = of_leg(arrays.action, leg, world)  # all loads come first: a GPU waits for them once
    prev_prev_actions = of_leg(arrays.prev_action, leg, world)
    prev_torques = of_leg(arrays.torque, leg, world)
    offsets = of_leg(arrays.joint_offset, leg, world)
    for j in range(3):
        m = 3 * leg + j
        raw_action = raw_actions[j]
        if not wp.isfinite(raw_action):
            raw_action = 0.0
            episode.bad_action[world] = 1
        action = wp.clamp(raw_action, -1.0, 1.0)
        arrays.prev_prev_action[m, world] = prev_prev_actions[j]
        arrays.prev_action[m, world] = prev_actions[j]
        arrays.action[m, world] = action
        arrays.prev_rate[m, world] = rates[j]
        arrays.prev_torque[m, world] = prev_torques[j]
        angles[j] = angles[j] + offsets[j]
        target[j] = action * skill.action_scale[m] + arrays.default_angle[m]
    safe = filter_leg(target, angles, rates, skill.command_filter)
    step_count = episode.step_count[world]
    for j in range(3):
        m = 3 * leg + j
        arrays.target[m, world] = target[j]
        arrays.filtered_target[m, world] = safe[j]
        delays.target_history[step_count % RING, m, world] = safe[j]
    select_delayed_targets(delays, step_count, world, leg)
