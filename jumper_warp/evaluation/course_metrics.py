"""What to report of courses: who falls, how closely velocities and goals are met, how soon and how smoothly."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from jumper_warp.evaluation.courses import STUCK, Course
from jumper_warp.evaluation.log import Metrics, failures, finite, largest, mean
from jumper_warp.evaluation.velocities import rms
from jumper_warp.policies.skills import JUMP_TO, JUMP_UP, WALK

QUIET = 0.2
"""[s] Before a jump takes over, in which paw forces are looked at."""
COLOURS = {WALK: "white", JUMP_UP: "tab:orange", JUMP_TO: "tab:purple"}
NAMES = {WALK: "walk", JUMP_UP: "jump up", JUMP_TO: "jump to"}


def course_metrics(course: Course) -> Metrics:
    """Return the metrics of all robots together.

    `success_rate` is the share of robots that made every command without a fall, whatever their errors;
    `on_goal_rate` of those whose jumps came within 0.1 m of their goals besides. Errors are means over the jumps that
    were made. Tracking errors leave out the first second after each command.
    """
    robots, up, to = len(course.end), course.target == JUMP_UP, course.target == JUMP_TO
    jumps = up | to
    made = jumps & (course.takeoff >= 0)
    apex, landing = np.abs(course.apex_error), course.landing_error
    waited = (course.takeoff - course.began)[made] * course.step_dt
    stopped = (course.switched - course.began)[jumps & (course.switched >= 0)] * course.step_dt
    done = course.outcomes == "done"
    tracking = dict(zip(("rmse_vx_m_s", "rmse_vy_m_s", "rmse_yaw_rate_rad_s"), finite(tracking_error(course)),
                        strict=True))  # fmt: skip
    ripple, step = handover_forces(course)
    return {
        "robots": robots,
        "success_rate": float(done.mean()),
        "on_goal_rate": float((done & course.on_goal.all(axis=1)).mean()),
        "fall_rate": float(course.fallen.mean()),
        "stuck_rate": float((course.end == STUCK).mean()),
        **tracking,
        "apex_error_m": mean(apex),
        "max_apex_error_m": largest(apex),
        "mean_signed_apex_error_m": mean(course.apex_error),
        "landing_error_m": mean(landing),
        "max_landing_error_m": largest(landing),
        "jumps_asked": int((jumps & (course.began >= 0)).sum()),
        "jumps_made": int(made.sum()),
        "command_to_takeoff_s": mean(waited),
        "max_command_to_takeoff_s": largest(waited),
        "command_to_jump_skill_s": mean(stopped),
        "max_command_to_jump_skill_s": largest(stopped),
        "handover_force_ripple_n": mean(ripple),
        "max_handover_force_ripple_n": largest(ripple),
        "handover_force_step_n": mean(step),
        "max_handover_force_step_n": largest(step),
    } | failures(course.outcomes[~done])  # fmt: skip


def tracking_error(course: Course) -> np.ndarray:
    """Return the root mean square of velocity less command over all steps that count, (3,)."""
    error = np.array(course.velocity, dtype=float) - np.array(course.wanted, dtype=float)
    error[~np.array(course.counts)] = np.nan
    return rms(error, axis=(0, 1))


def handover_forces(course: Course) -> tuple[np.ndarray, np.ndarray]:
    """Return how the force on a paw varies before each handover to a jump [N], and by how much it steps there.

    Of the paw where it does so most: peak to peak over the last QUIET seconds of the stand before it; and from the last
    policy step before it to the first after it.
    """
    force, ripples, steps = np.array(course.force, dtype=float), [], []
    window = round(QUIET / course.step_dt)
    for world, command in zip(*np.nonzero(course.switched >= 0), strict=True):
        last = course.switched[world, command]  # the last policy step of walking, counted from 1
        part = force[max(last - window, 0) : last, world]
        ripples.append(np.ptp(part, axis=0).max())
        if last < len(force):
            steps.append(np.abs(force[last, world] - force[last - 1, world]).max())
    return np.array(ripples), np.array(steps)


def active_spans(course: Course, world: int) -> list[tuple[int, float, float]]:
    """Return the skills of a robot one after the other: index, beginning and end [s]."""
    skills = np.array(course.skills)[:, world]
    edges = [0, *(np.flatnonzero(np.diff(skills)) + 1).tolist(), len(skills)]
    return [(int(skills[a]), a * course.step_dt, b * course.step_dt) for a, b in pairwise(edges)]


def draw_course(axes: np.ndarray, course: Course, world: int) -> None:
    """Draw velocities and commands, height and active skill of a robot over time, on five axes."""
    time = course.step_dt * np.arange(1, len(course.skills) + 1)
    velocity, wanted = (np.array(values)[:, world] for values in (course.velocity, course.wanted))
    labels = ("vx [m/s]", "vy [m/s]", "yaw rate [rad/s]")
    for i, label in enumerate(labels):
        axes[i].plot(time, velocity[:, i], color="tab:blue", linewidth=0.9, label="actual")
        axes[i].plot(time, wanted[:, i], color="tab:red", linewidth=1.2, label="commanded")
        axes[i].set(ylabel=label, ylim=(-1.6, 1.6))
    axes[0].legend(loc="upper right", ncols=2)
    axes[3].plot(time, np.array(course.height)[:, world], color="tab:blue", linewidth=0.9)
    axes[3].set(ylabel="height [m]")
    axes[4].step(time, np.array(course.skills)[:, world], where="pre", color="black", linewidth=1.0)
    axes[4].set(xlabel="time [s]", ylabel="skill", yticks=list(NAMES), yticklabels=list(NAMES.values()))
    for skill, begin, end in active_spans(course, world):
        for axis in axes:
            axis.axvspan(begin, end, color=COLOURS[skill], alpha=0.15, linewidth=0.0)
