"""Start of the first jump at a reset (`reset_jump`), and of further jumps within an episode.

All jump tasks use these functions. They sample start mode, goal, ground and time of the command; `start_states` samples
the state of the robot. An episode begins above the origin, in any part of a jump (the start mode), so that late parts
are learnt before early ones succeed. World z is up; a heading is a yaw [rad]. Random numbers are identified by their
index in a stream (`streams`); policy steps last 1/60 s.
"""

import warp as wp

from ..layout import DOFS
from ..mdp.durations import whole_steps
from ..mdp.env import Scene, SkillSettings
from ..mdp.random import RngStream, uniform, uniform_range
from ..mdp.reset import leg_limits
from ..mdp.view import RobotArrays, RobotView, base_pos, rotate_yaw, yaw_of
from ..terrain.ground import Block, Ground, rest_block, surface, world_ground
from . import start_states, streams
from .ground_draws import GroundRanges, footprint, sample_ground
from .state import FLIGHT, LANDED, STANCE, JumpState

wp.set_module_options({"enable_backward": False})


@wp.struct
class JumpSettings:
    """Ranges from which the reset of a jump episode samples start state and ground."""

    states: start_states.ResetRanges
    grounds: GroundRanges


@wp.struct
class JumpLevel:
    """One level of the jump curriculum; goals are sampled from a box."""

    goal_lower: wp.vec3  # [m] relative to start and heading: landing x, y, and base height at the apex (0: any)
    goal_upper: wp.vec3  # [m] opposite corner of the box
    base_height: wp.vec2  # [m] (lower, upper) of standing starts
    next_jump_probability: float  # of another goal for a landed robot
    elliptical: int  # 1: goals are sampled from the ellipse inscribed in the box, seen from above


@wp.func
def project_to_ellipse(goal: wp.vec3, lower: wp.vec3, upper: wp.vec3) -> wp.vec3:
    """Return a goal [m] that is moved horizontally toward the start, so that the box of goals becomes an ellipse.

    The ellipse is inscribed in the box (lower, upper). Each quadrant has its own half axes, since the box need not be
    centred on the start.
    """
    x = goal[0] / wp.max(wp.where(goal[0] < 0.0, -lower[0], upper[0]), 1.0e-6)
    y = goal[1] / wp.max(wp.where(goal[1] < 0.0, -lower[1], upper[1]), 1.0e-6)
    shrink = wp.max(wp.abs(x), wp.abs(y)) / wp.max(wp.length(wp.vec2(x, y)), 1.0e-6)
    return wp.vec3(shrink * goal[0], shrink * goal[1], goal[2])


@wp.func
def sample_goal(rng: RngStream, level: JumpLevel) -> wp.vec3:
    """Return a sampled goal [m] of a level, relative to start and heading: x, y and apex height."""
    lower = level.goal_lower
    upper = level.goal_upper
    goal = wp.vec3(
        uniform(rng, streams.GOAL, lower[0], upper[0]),
        uniform(rng, streams.GOAL + 1, lower[1], upper[1]),
        uniform(rng, streams.GOAL + 2, lower[2], upper[2]),
    )
    if level.elliptical != 0:
        goal = project_to_ellipse(goal, lower, upper)
    return goal


@wp.func
def sample_next_jump_step(rng: RngStream, delay: wp.vec2, probability: float) -> int:
    """Return the sampled number of policy steps from touchdown to the next goal; 0: there is no further jump.

    delay: range of the number; probability of a further jump.
    """
    steps = whole_steps(uniform_range(rng, streams.AGAIN_STEP, delay))
    return wp.where(uniform(rng, streams.AGAIN, 0.0, 1.0) < probability, wp.max(steps, 1), 0)


@wp.func
def sample_command_step(rng: RngStream, ranges: start_states.ResetRanges) -> int:
    """Return the sampled policy step at which the jump is commanded.

    The step is at most `long_wait` with `long_wait_probability`, else at most `command_delay`. With a random delay, the
    robot learns to wait for the command. One random number u selects the case and, rescaled to [0, 1), the step within
    it.
    """
    u = uniform(rng, streams.COMMAND_STEP, 0.0, 1.0)
    probability = ranges.long_wait_probability
    soon = (u - probability) / wp.max(1.0 - probability, 1.0e-6) * (float(ranges.command_delay) + 0.999)
    later = u / wp.max(probability, 1.0e-6) * (float(ranges.long_wait) + 0.999)
    return whole_steps(wp.where(u < probability, later, soon))


@wp.func
def begin_jump(
    rng: RngStream, ranges: start_states.ResetRanges, start_mode: int, goal: wp.vec3, pos: wp.vec3, vz: float,
    next_jump_probability: float,
) -> JumpState:  # fmt: skip
    """Return the task state of a new episode: phase of the jump and time of its command, according to the start mode.

    goal [m]: world axes; pos [m], vz [m/s]: position and vertical velocity of the base. If an episode begins after the
    apex, its apex is not known: the commanded height replaces it.
    """
    state = JumpState()
    state.start_mode = start_mode
    state.goal = goal
    state.start = pos
    state.max_height = pos[2]
    state.squat = pos[2]
    state.command_step = sample_command_step(rng, ranges)
    state.next_jump_delay = ranges.next_jump_delay
    state.next_jump_step = sample_next_jump_step(rng, ranges.next_jump_delay, next_jump_probability)
    if start_mode == start_states.PUSHING or (start_mode == start_states.STANDING and ranges.lean > 0.0):
        state.start = wp.vec3(0.0, 0.0, pos[2])
    if start_mode == start_states.PUSHING:
        state.command_step = 0
        state.squat = 0.0  # before the start, as deep as any
    if start_mode == start_states.IN_FLIGHT or start_mode == start_states.TOUCHDOWN:
        state.phase = FLIGHT
        state.command_step = 0
        if vz <= 0.0:
            state.apex_passed = 1
            state.max_height = wp.max(goal[2], pos[2])
    if start_mode == start_states.AFTER_LANDING:
        state.phase = LANDED
        state.command_step = 0
        state.apex_passed = 1
        state.max_height = wp.max(goal[2], pos[2])
        state.phase_steps = int(uniform(rng, streams.LANDED_STEPS, 0.0, 17.999))
    return state


@wp.func
def begin_next_jump(robot: RobotView, old: JumpState, ground: Ground, goal: wp.vec3, heading: float) -> JumpState:
    """Return the task state in which the next jump of an episode begins, commanded at once.

    goal [m]: x, y relative to base position and `heading` [rad], and base height at the apex, world z.
    """
    state = old
    state.heading = heading
    state.goal = rotate_yaw(goal, heading) + wp.vec3(robot.pos[0], robot.pos[1], 0.0)
    state.goal_ground = surface(ground, state.goal[0], state.goal[1])[0]
    state.start = robot.pos
    state.phase = STANCE
    state.phase_steps = 0
    state.command_step = old.steps
    state.apex_passed = 0
    state.idle_steps = 0
    state.max_height = robot.pos[2]
    state.squat = robot.height
    state.peak_tilt = 0.0
    state.paws_landed = 0
    state.next_jump_step = 0
    state.jumps = old.jumps + 1
    return state


@wp.func
def place_ground(ground: Ground, start: start_states.JumpStart, grounds: GroundRanges, rng: RngStream) -> Ground:
    """Sample a new block for a world, or put the present one back to its start position; return the world's ground.

    The block is sampled if a probability of `grounds` is positive. Only standing starts (STANDING, DEFAULT) get a
    block.
    """
    if grounds.platform + grounds.block > 0.0:
        block = Block()
        if start.start_mode == start_states.STANDING or start.start_mode == start_states.DEFAULT:
            block = sample_ground(rng, grounds, footprint(start.ranges, start.heading), start.goal)
        ground.blocks[rng.world] = block
    else:
        rest_block(ground, rng.world)
    return world_ground(ground, rng.world)


@wp.func
def reset_jump(
    arrays: RobotArrays, scene: Scene, skill: SkillSettings, old: JumpState, settings: JumpSettings, level: JumpLevel,
    rng: RngStream,
) -> JumpState:  # fmt: skip
    """Write a start state of a jump to world `rng.world` (`write_start`), and return the state of its new episode.

    old: state of the previous episode. Its policy steps count toward its start mode: modes can be balanced by steps
    (`ResetRanges.by_steps`), since episodes that begin late are short. skill: has the motors' limits.
    """
    world = rng.world
    ranges = settings.states
    steps_per_mode = old.steps_per_mode
    steps_per_mode[old.start_mode] += float(old.steps)
    start = start_states.JumpStart()
    start.start_mode = start_states.sample_start_mode(rng, ranges, steps_per_mode)
    start.heading = uniform(rng, streams.HEADING, -ranges.heading, ranges.heading)
    start.goal = rotate_yaw(sample_goal(rng, level), start.heading)
    start.base_height = level.base_height
    start.ranges = ranges
    start.limits = leg_limits(skill.command_filter)
    start.limits.transversal_upper = wp.max(start.limits.transversal_upper, ranges.transversal_limit)
    start.ground = place_ground(scene.ground, start, settings.grounds, rng)
    start_mode = start_states.write_start(arrays, scene, start, rng)
    vz = arrays.joint_qd[world * DOFS + 2]
    state = begin_jump(rng, ranges, start_mode, start.goal, base_pos(arrays, world), vz, level.next_jump_probability)
    state.heading = start.heading
    state.steps_per_mode = steps_per_mode
    state.goal_ground = surface(start.ground, start.goal[0], start.goal[1])[0]
    return state


@wp.func
def next_jump_due(state: JumpState) -> bool:
    """Return whether a robot that has landed receives its next goal in this policy step."""
    return state.phase == LANDED and state.next_jump_step > 0 and state.phase_steps >= state.next_jump_step


@wp.func
def resample_jump(robot: RobotView, scene: Scene, state: JumpState, level: JumpLevel, rng: RngStream) -> JumpState:
    """Return the state of an episode's next jump, whose goal is sampled from `level`."""
    goal = sample_goal(rng, level)
    new = begin_next_jump(robot, state, world_ground(scene.ground, robot.world), goal, yaw_of(robot.quat))
    new.next_jump_step = sample_next_jump_step(rng, state.next_jump_delay, level.next_jump_probability)
    return new


@wp.func
def set_jump(robot: RobotView, scene: Scene, state: JumpState, values: wp.vec4, heading: float) -> JumpState:
    """Return the state with a jump commanded by the host if the robot is at the start or has landed; else `state`.

    A command at any other time, as in flight, is ignored. values: goal x, y [m] relative to base and heading [rad],
    base height at the apex [m], and, at the start only, the policy step of the command.
    """
    here = world_ground(scene.ground, robot.world)
    goal = wp.vec3(values[0], values[1], values[2])
    if state.phase == LANDED:
        return begin_next_jump(robot, state, here, goal, heading)
    if state.phase != STANCE or state.steps > 0:
        return state
    new = JumpState()
    new.heading = heading
    new.start = robot.pos
    new.goal = rotate_yaw(goal, heading) + wp.vec3(robot.pos[0], robot.pos[1], 0.0)
    new.goal_ground = surface(here, new.goal[0], new.goal[1])[0]
    new.max_height = robot.pos[2]
    new.squat = robot.height
    new.command_step = whole_steps(values[3])
    return new


@wp.func
def from_standing(state: JumpState) -> bool:
    """Return whether the episode began standing or in the default pose, and so counts for the curriculum.

    Other episodes begin in the middle of a jump, so their success proves less.
    """
    return state.start_mode <= start_states.DEFAULT
