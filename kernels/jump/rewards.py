"""Reward terms (paper, Tables I to III). Each is a pure function of the robot, the episode and its parameters p.

phi_s(x) = exp(-x^2 / s^2), psi_s(x) = exp(-|x| / s). Times are counted in policy steps of 1/60 s.
"""

import warp as wp

from .phase import estimated_apex, landing_error_estimate
from .task import (
    FLIGHT,
    LANDED,
    STANCE,
    JumpTask,
    RobotView,
    commanded,
    goal_offset,
    rotation_from,
    vec12,
    waiting,
)

SOON = wp.constant(18)  # policy steps: the first 0.3 s after touchdown
RECOVERED = wp.constant(30)  # policy steps: 0.5 s after touchdown


@wp.func
def phi(x: float, s: float) -> float:
    """Return the exponential kernel phi_s(x)."""
    return wp.exp(-x * x / (s * s))


@wp.func
def psi(x: float, s: float) -> float:
    """Return the Laplacian kernel psi_s(x)."""
    return wp.exp(-wp.abs(x) / s)


@wp.func
def square_sum(v: vec12) -> float:
    """Return the sum of squares."""
    return wp.dot(v, v)


@wp.func
def transversal_offset(view: RobotView, shift: float) -> float:
    """Return the rms offset [rad] of all motors from the default pose, the transversal ones shifted by `shift`."""
    total = float(0.0)
    for m in range(12):
        off = view.angle[m] - view.default_angle[m]
        if m % 3 != 0:
            off = off - shift
        total += off * off
    return wp.sqrt(total / 12.0)


@wp.func
def patience(task: JumpTask, share: float) -> float:
    """Return the weight of what pays without jumping: `share` while a commanded jump has not begun, else 1."""
    return wp.where(waiting(task), share, 1.0)


@wp.func
def just_landed(task: JumpTask) -> bool:
    """Return whether the touchdown was within the last 0.3 s."""
    return task.phase == LANDED and task.phase_steps < SOON


@wp.func
def should_rest(task: JumpTask) -> bool:
    """Return whether the robot should stand still: before the command, and from 0.5 s after touchdown."""
    if task.phase == LANDED:
        return task.phase_steps >= RECOVERED
    return task.phase == STANCE and not commanded(task)


# ---------------------------------------------------------------- vertical jump


@wp.func
def height_kernel(error: float, p: wp.vec4) -> float:
    """Return phi_p0 + 3 psi_p1 + phi_p2 of a height error [m]; the last, wide one gives a slope to low jumps."""
    return phi(error, p[0]) + 3.0 * psi(error, p[1]) + phi(error, p[2])


@wp.func
def jump_height(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Jump height: closeness of the highest base height to the goal, once, at the apex."""
    if task.at_apex == 0:
        return 0.0
    return height_kernel(task.max_height - task.goal[2], p)


@wp.func
def estimated_jump_height(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Est jump height: the same of the ballistic estimate, in flight until the apex."""
    if task.phase != FLIGHT or task.apex_passed != 0:
        return 0.0
    return height_kernel(estimated_apex(view.pos, view.lin_vel) - task.goal[2], p)


@wp.func
def horizontal_velocity(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Staying over the spot: exp(-|v_xy| / p0), doubled off stance; share p1 while a jump is due."""
    speed = wp.length(wp.vec2(view.lin_vel[0], view.lin_vel[1]))
    return wp.exp(-speed / p[0]) * wp.where(task.phase == STANCE, 1.0, 2.0) * patience(task, p[1])


@wp.func
def orientation(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Orientation error: phi_p0 of the horizontal part of projected gravity; share p1 while a jump is due."""
    return phi(wp.length(wp.vec2(view.gravity[0], view.gravity[1])), p[0]) * patience(task, p[1])


@wp.func
def angular_velocity(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Angular velocity: phi_p0(|w|); share p1 while a jump is due."""
    return phi(wp.length(view.ang_vel), p[0]) * patience(task, p[1])


@wp.func
def joint_symmetry(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Joint symmetry: phi_p0(variance of the transversal angles) phi_p1(|lateral angles|); share p2 while due."""
    total = float(0.0)
    total_sq = float(0.0)
    lateral = float(0.0)
    for m in range(12):
        a = view.angle[m]
        if m % 3 == 0:
            lateral += a * a
        else:
            total += a
            total_sq += a * a
    variance = total_sq / 8.0 - total * total / 64.0
    return phi(variance, p[0]) * phi(wp.sqrt(lateral), p[1]) * patience(task, p[2])


@wp.func
def ground_posture(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Desired joint position on the ground: phi_p0 of the offset from default, transversal + p1; share p2 while due."""
    if task.phase == FLIGHT:
        return 0.0
    return phi(transversal_offset(view, p[1]), p[0]) * patience(task, p[2])


@wp.func
def air_posture(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Desired joint position in the air: phi_p0 of the offset from default."""
    if task.phase != FLIGHT:
        return 0.0
    return phi(transversal_offset(view, 0.0), p[0])


@wp.func
def retract(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Retracting after landing: phi_p0 of the offset from default, transversal motors + p1, first 0.3 s."""
    if not just_landed(task):
        return 0.0
    return phi(transversal_offset(view, p[1]), p[0])


# ---------------------------------------------------------------- horizontal jump


@wp.func
def tracking(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Tracking: phi_p0 + p2 phi_p1 of the distance from the goal [m], after takeoff."""
    if task.phase == STANCE:
        return 0.0
    error = wp.length(goal_offset(view, task))
    return phi(error, p[0]) + p[2] * phi(error, p[1])


@wp.func
def estimated_tracking(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Est tracking: phi_p0 + 0.1 phi_p1 + 0.3 phi_p2 of the ballistic landing's distance from the goal, in flight.

    The landing is where the base falls through p3 [m].
    """
    if task.phase != FLIGHT:
        return 0.0
    error = landing_error_estimate(view, task, p[3])
    return phi(error, p[0]) + 0.1 * phi(error, p[1]) + 0.3 * phi(error, p[2])


@wp.func
def flight_orientation(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Orientation error: phi_p0 of the rotation from level and heading, in flight while moving toward the goal."""
    if task.phase != FLIGHT or wp.dot(view.lin_vel, goal_offset(view, task)) <= 0.0:
        return 0.0
    return phi(rotation_from(view.quat, task.heading), p[0])


@wp.func
def flight_angular_velocity(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Angular velocity: phi_p0(|w|), in flight."""
    if task.phase != FLIGHT:
        return 0.0
    return phi(wp.length(view.ang_vel), p[0])


@wp.func
def left_right_symmetry(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Joint symmetry: phi_p0 of the rms difference of left and right transversal angles; share p1 while due."""
    total = float(0.0)
    for m in range(12):
        if m % 3 != 0 and (m / 3) % 2 == 0:
            off = view.angle[m] - view.angle[m + 3]
            total += off * off
    return phi(wp.sqrt(total / 4.0), p[0]) * patience(task, p[1])


@wp.func
def standing_posture(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Stance: phi_p0 of the offset from default, transversal motors + p1, while the robot should rest."""
    if not should_rest(task):
        return 0.0
    return phi(transversal_offset(view, p[1]), p[0])


# ---------------------------------------------------------------- impacts and landing


@wp.func
def braking(view: RobotView) -> float:
    """Return the base's acceleration along its motion where it slows down [m/s^2], <= 0."""
    speed = wp.length(view.lin_vel)
    if speed < 1.0e-6:
        return 0.0
    return wp.min(wp.dot(view.lin_acc, view.lin_vel) / speed, 0.0)


@wp.func
def soft_impact(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Soft impact: max(0, 1 - deceleration / p0), first 0.3 s after touchdown."""
    if not just_landed(task):
        return 0.0
    return wp.max(0.0, 1.0 + braking(view) / p[0])


@wp.func
def stance_impact(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Stance impact: deceleration / p0 in stance, in -1..0."""
    if task.phase != STANCE:
        return 0.0
    return wp.clamp(braking(view) / p[0], -1.0, 0.0)


@wp.func
def catch_landing(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Catch landing: let the base fall on, clamp(-v_z, 0, 1), first 0.3 s."""
    if not just_landed(task):
        return 0.0
    return wp.clamp(-view.lin_vel[2], 0.0, 1.0)


@wp.func
def damp_landing(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Damp landing: fold the legs, mean clamp(transversal rates, 0, 1), first 0.3 s."""
    if not just_landed(task):
        return 0.0
    total = float(0.0)
    for m in range(12):
        if m % 3 != 0:
            total += wp.clamp(view.rate[m], 0.0, 1.0)
    return total / 8.0


@wp.func
def rest(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Rest: phi_p0(|v|) phi_p1(|w|), while the robot should rest."""
    if not should_rest(task):
        return 0.0
    return phi(wp.length(view.lin_vel), p[0]) * phi(wp.length(view.ang_vel), p[1])


@wp.func
def landing_tilt(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Tilt after touchdown: squared sine of the angle between body z and world z over that of p0 [rad]."""
    if task.phase != LANDED:
        return 0.0
    sine = wp.length(wp.vec2(view.gravity[0], view.gravity[1])) / wp.sin(p[0])
    return sine * sine


@wp.func
def lifted_paws(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Steps after landing: paws off the ground later than p0 policy steps after touchdown, 0 to 4."""
    if task.phase != LANDED or task.phase_steps <= int(p[0]):
        return 0.0
    return float(4 - view.contacts)


# ---------------------------------------------------------------- regularization


@wp.func
def ground_force(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Ground force L2: sum of squared paw forces over squared weight p0 [N]."""
    return wp.dot(view.paw_force, view.paw_force) / (p[0] * p[0])


@wp.func
def action_clip(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Action clip: squared distance that the command filter moved the targets [rad^2]."""
    return view.clipped


@wp.func
def motor_torque_sq(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Motor torque: sum of squares [N^2 m^2]."""
    return square_sum(view.torque)


@wp.func
def joint_acceleration(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Joint acceleration: sum of squares [rad^2/s^4]."""
    return square_sum(view.rate_change)


@wp.func
def action_rate(view: RobotView, task: JumpTask, p: wp.vec4) -> float:
    """Action rate: sum of squared changes of the action."""
    return square_sum(view.action - view.old_action)
