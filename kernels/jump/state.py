"""State of one jump (`JumpState`), and quantities derived from it."""

import warp as wp

from ..mdp.view import RobotView

STANCE = wp.constant(0)
FLIGHT = wp.constant(1)
LANDED = wp.constant(2)


NUM_START_MODES = wp.constant(6)  # see `start_states`
vec_start_modes = wp.types.vector(length=6, dtype=wp.float32)


@wp.struct
class JumpState:
    """Task state of one world in a jump episode."""

    goal: wp.vec3  # [m] where to land: base x, y; and its wanted height at the apex, 0 if any will do
    start: wp.vec3  # [m] base origin where the jump began
    goal_ground: float  # [m] height of the ground there
    heading: float  # [rad] yaw of the jump
    phase: int  # STANCE, FLIGHT, LANDED
    steps: int  # policy steps since the episode began
    phase_steps: int  # policy steps in this phase
    command_step: int  # policy step from which the jump is commanded
    idle_steps: int  # policy steps without motion while a jump was commanded
    took_off: int  # 1 in the step of the takeoff
    touched_down: int  # 1 in the step of the touchdown
    at_apex: int  # 1 in the step in which the base begins to fall
    apex_passed: int
    max_height: float  # [m] of the base since takeoff
    touchdown_vel: wp.vec3  # [m/s] of the base, step before touchdown
    peak_tilt: float  # [rad] largest between body and world z since touchdown
    start_mode: int  # reset scheme that began the episode
    next_jump_step: int  # policy steps after touchdown at which another goal comes, 0: never
    again_delay: wp.vec2  # policy steps between which that of yet another goal is drawn
    jumps: int  # jumps that were followed by another in this episode
    paws_landed: int  # bits of the paws that have come down since touchdown
    steps_per_mode: vec_start_modes  # policy steps that the world has spent in episodes of each scheme, before this one


@wp.func
def goal_offset(robot: RobotView, state: JumpState) -> wp.vec3:
    """Return the horizontal vector from the base to the goal [m], world axes."""
    return wp.vec3(state.goal[0] - robot.pos[0], state.goal[1] - robot.pos[1], 0.0)


@wp.func
def commanded(state: JumpState) -> bool:
    """Return whether a jump is commanded and not yet landed (the paper's c)."""
    return state.steps >= state.command_step and state.phase != LANDED


@wp.func
def waiting(state: JumpState) -> bool:
    """Return whether a jump is commanded but the robot is still in stance."""
    return state.phase == STANCE and state.steps >= state.command_step
