"""Phase machine of a jump (stance, flight, landed), and ballistic estimates of its apex and landing.

World z is up. The base is taken for a projectile under gravity g, so that a takeoff can be judged before the jump ends.
`state.goal` is (x, y of the landing, base height at the apex), world.
"""

import warp as wp

from ..mdp.view import RobotView, in_flight, tilt
from .state import FLIGHT, LANDED, STANCE, JumpState


@wp.func
def estimated_apex(pos: wp.vec3, lin_vel: wp.vec3, g: float) -> float:
    """Return the apex height [m] of a projectile, z + v_z^2 / 2g, or z if it falls; units m, m/s, m/s^2."""
    up = wp.max(lin_vel[2], 0.0)
    return pos[2] + up * up / (2.0 * g)


@wp.func
def time_to_height(z: float, vz: float, height: float, g: float) -> float:
    """Return the time [s] until a projectile falls through `height` [m], or until its apex if that is lower.

    z [m], vz [m/s], g [m/s^2]: present height, vertical velocity and gravity. The result is >= 0.
    """
    under_root = vz * vz + 2.0 * g * (z - height)
    return wp.max((vz + wp.sqrt(wp.max(under_root, 0.0))) / g, 0.0)


@wp.func
def estimated_landing(pos: wp.vec3, lin_vel: wp.vec3, height: float, g: float) -> wp.vec2:
    """Return the point (x, y) [m] where a projectile falls through `height` [m]; pos [m], lin_vel [m/s], g [m/s^2]."""
    t = time_to_height(pos[2], lin_vel[2], height, g)
    return wp.vec2(pos[0] + t * lin_vel[0], pos[1] + t * lin_vel[1])


@wp.func
def landing_error_estimate(robot: RobotView, state: JumpState, height: float) -> float:
    """Return the horizontal distance [m] between the goal and the ballistic landing of the base.

    The landing is where the base falls through `height` [m] above the goal's ground.
    """
    landing = estimated_landing(robot.pos, robot.lin_vel, height + state.goal_ground, robot.gravity_magnitude)
    return wp.length(wp.vec2(state.goal[0] - landing[0], state.goal[1] - landing[1]))


@wp.func
def next_phase(state: JumpState, robot: RobotView, takeoff_speed: float) -> int:
    """Return the phase of a jump (STANCE, FLIGHT or LANDED) after this policy step; takeoff_speed: see `in_flight`."""
    flies = in_flight(robot, state.phase == FLIGHT, takeoff_speed)
    if state.phase == STANCE and flies:
        return FLIGHT
    if state.phase == FLIGHT and not flies:
        return LANDED
    return state.phase


@wp.func
def advance_jump(robot: RobotView, state: JumpState, takeoff_speed: float) -> JumpState:
    """Return the state of a jump (phase, apex, landing) updated by one policy step.

    takeoff_speed [m/s]: least upward speed of a takeoff. A contact in flight that is no touchdown restarts the flight:
    takeoff and apex then count from this step.
    """
    t = state
    t.steps = state.steps + 1
    phase = next_phase(state, robot, takeoff_speed)
    t.took_off = wp.where(phase == FLIGHT and (state.phase == STANCE or robot.contacts > 0), 1, 0)
    t.touched_down = wp.where(state.phase == FLIGHT and phase == LANDED, 1, 0)
    t.phase_steps = wp.where(phase == state.phase and t.took_off == 0, state.phase_steps + 1, 0)
    t.phase = phase
    if t.took_off == 1:
        t.max_height = robot.pos[2]
        t.apex_passed = 0
    if phase == STANCE:
        t.squat = wp.where(t.steps <= t.command_step, robot.height, wp.min(state.squat, robot.height))
    t.at_apex = 0
    if phase != STANCE and state.apex_passed == 0:
        t.max_height = wp.max(t.max_height, robot.pos[2])
        if robot.lin_vel[2] <= 0.0 or t.touched_down == 1:
            t.apex_passed = 1
            t.at_apex = 1
    if t.touched_down == 1:
        t.touchdown_vel = robot.prev_lin_vel
        t.peak_tilt = 0.0
        t.paws_landed = 0
    if phase == LANDED:
        t.peak_tilt = wp.max(t.peak_tilt, tilt(robot))
        for k in range(4):
            if robot.contact[k] > 0.0:
                t.paws_landed = t.paws_landed | (1 << k)
    t.idle_steps = 0
    if phase == STANCE and t.steps >= t.command_step and wp.length(robot.lin_vel) < 0.1:
        t.idle_steps = state.idle_steps + 1
    return t
