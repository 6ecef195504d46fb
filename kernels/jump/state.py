"""State of one jump (`JumpState`), and quantities derived from it; policy steps last 1/60 s, world z is up."""

import warp as wp

from ..mdp.view import RobotView

STANCE = wp.constant(0)  # phases: before takeoff
FLIGHT = wp.constant(1)  # from takeoff to touchdown, see `phase.next_phase`
LANDED = wp.constant(2)  # from touchdown on
NUM_START_MODES = wp.constant(6)  # see `start_states`
vec_start_modes = wp.types.vector(length=6, dtype=wp.float32)


@wp.struct
class JumpState:
    """State of the jump task in one world: goal, start, phase of the jump, and counters of policy steps."""

    goal: wp.vec3  # [m] world: base x, y at landing, and commanded base height at the apex (0: any)
    start: wp.vec3  # [m] world, base origin where the jump began
    goal_ground: float  # [m] height of the ground at the goal
    heading: float  # [rad] yaw of the jump
    phase: int  # STANCE, FLIGHT, LANDED
    steps: int  # policy steps since the episode began
    phase_steps: int  # policy steps in this phase
    command_step: int  # policy step from which the jump is commanded
    idle_steps: int  # policy steps without motion while a jump was commanded
    took_off: int  # 1 in the step of the takeoff, and in each step to which later contact moves it
    touched_down: int  # 1 in the step of the touchdown
    at_apex: int  # 1 in the step in which the base begins to fall
    apex_passed: int  # 1 from that step on
    max_height: float  # [m] highest base origin since takeoff, world z
    squat: float  # [m] lowest base origin above the ground from the command to takeoff; before the command the present
    touchdown_vel: wp.vec3  # [m/s] world, velocity of the base in the step before touchdown
    peak_tilt: float  # [rad] largest angle between body and world z since touchdown
    start_mode: int  # start mode of the episode (`start_states`)
    next_jump_step: int  # policy steps after touchdown at which the next goal is commanded, 0: never
    next_jump_delay: wp.vec2  # [policy steps] range from which the `next_jump_step` of the next jump is sampled
    jumps: int  # jumps of this episode that were followed by another
    paws_landed: int  # bit k: paw k has been in contact since touchdown
    steps_per_mode: vec_start_modes  # policy steps of the world's earlier episodes by start mode


@wp.func
def goal_offset(robot: RobotView, state: JumpState) -> wp.vec3:
    """Return the horizontal vector (z = 0) from the base origin to the goal [m], world axes."""
    return wp.vec3(state.goal[0] - robot.pos[0], state.goal[1] - robot.pos[1], 0.0)


@wp.func
def commanded(state: JumpState) -> bool:
    """Return whether a jump is commanded and the robot has not landed yet (the paper's c, which policies observe)."""
    return state.steps >= state.command_step and state.phase != LANDED


@wp.func
def waiting(state: JumpState) -> bool:
    """Return whether the robot is still in stance although a jump is commanded: it prepares the jump, or is idle."""
    return state.phase == STANCE and state.steps >= state.command_step


@wp.func
def wanted_squat(robot: RobotView, state: JumpState, takeoff_height: float, acceleration: float, floor: float) -> float:
    """Return the base height [m] from which a constant acceleration gives the speed for the commanded apex.

    Above the height z, `takeoff_height` [m], the base no longer accelerates. With gravity g, its speed there is v =
    sqrt(2 g (apex - z)), and it accelerates over v^2 / 2a with `acceleration` a [m/s^2]. The result is at least `floor`
    [m].
    """
    rise = wp.max(state.goal[2] - takeoff_height, 0.0)
    return wp.max(takeoff_height - rise * robot.gravity_magnitude / acceleration, floor)
