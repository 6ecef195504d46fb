"""Rewards of the vertical jump as smooth functions of the robot's state, for their derivatives.

Values always come from the environment. What has no derivative here counts steps or events (lifted paws), or is of
forces and decelerations at impacts. Phases (stance, flight, landed) switch terms and are no function of the state here:
nothing says how to take off sooner. The floor under the total passes derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from jumper_warp.diff.closed_loop import ClosedLoop, LoopState, Motion

STANCE, FLIGHT, LANDED = 0, 1, 2
SOON, RECOVERED = 18, 30
"""Policy steps after touchdown."""


class Moment(NamedTuple):
    """A policy step of all worlds."""

    motion: Motion
    before: Motion
    """At its beginning."""
    state: LoopState
    old: LoopState
    phase: torch.Tensor
    """(n,) The jump's, at the end of the step."""
    due: torch.Tensor
    """(n,) bool, whether a jump is commanded that has not begun."""
    soon: torch.Tensor
    """(n,) bool, whether the touchdown was within the last 0.3 s."""
    resting: torch.Tensor
    """(n,) bool, whether the robot should stand still."""
    rising: torch.Tensor
    """(n,) bool, in flight before the apex."""
    at_apex: torch.Tensor
    """(n,) bool"""
    goal: torch.Tensor
    """(n,) [m] Commanded height."""
    default: torch.Tensor
    """(12,) [rad]"""
    gravity: float
    step_dt: float


def make_moment(loop: ClosedLoop, state: LoopState, old: LoopState, arrays: Mapping[str, np.ndarray]) -> Moment:
    """Return a step; arrays: `Env.task_arrays` at its end, of the episode that it belongs to."""

    def at(values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), device=state.q.device)

    phase, after, steps = arrays["phase"], arrays["phase_steps"], arrays["steps"]
    asked = steps >= arrays["command_step"]
    resting = ((phase == LANDED) & (after >= RECOVERED)) | ((phase == STANCE) & ~asked)
    rising = (phase == FLIGHT) & (arrays["apex_passed"] == 0)
    return Moment(
        loop.motion(state), loop.motion(old), state, old, at(phase), at((phase == STANCE) & asked),
        at((phase == LANDED) & (after < SOON)), at(resting), at(rising), at(arrays["at_apex"] == 1),
        at(arrays["goal"][:, 2]), loop.default, loop.task.gravity, loop.env.step_dt,
    )  # fmt: skip


def phi(squared: torch.Tensor, std: float) -> torch.Tensor:
    """Return exp(-x^2 / std^2) for x^2."""
    return torch.exp(-squared / std**2)


def norm(x: torch.Tensor) -> torch.Tensor:
    """Return the norms of the rows of x, with a finite derivative at 0."""
    return (x.square().sum(1) + 1.0e-12).sqrt()


def apex(m: Moment) -> torch.Tensor:
    """Return the height [m] of the apex of the base's projectile, to come or just past, (n,)."""
    return m.motion.pos[:, 2] + m.motion.lin_vel[:, 2].square() / (2.0 * m.gravity)


def height_kernel(m: Moment, p: Mapping[str, float]) -> torch.Tensor:
    """Return how close the apex is to the goal."""
    miss = apex(m) - m.goal
    return (
        phi(miss.square(), p["std_fine"])
        + 3.0 * torch.exp(-miss.abs() / p["scale_sharp"])
        + phi(miss.square(), p["std_wide"])
    )


def patience(m: Moment, p: Mapping[str, float]) -> torch.Tensor:
    """Return 1, or `waiting_scale` while a commanded jump has not begun."""
    return torch.where(m.due, p["waiting_scale"], 1.0)


def posture(m: Moment, p: Mapping[str, float], shift: float) -> torch.Tensor:
    """Return phi of the rms offset from the default pose, transversal motors moved by a shift [rad]."""
    shifts = m.default.new_tensor(4 * [0.0, shift, shift])
    return phi((m.motion.angle - m.default - shifts).square().mean(1), p["std"])


def symmetry(m: Moment, p: Mapping[str, float]) -> torch.Tensor:
    """Return the closeness of the transversal angles to each other and of the lateral ones to 0."""
    legs = m.motion.angle.view(-1, 4, 3)
    spread = legs[:, :, 1:].flatten(1).var(1, correction=0)
    return (
        phi(spread.square(), p["std_variance"]) * phi(legs[:, :, 0].square().sum(1), p["std_lateral"]) * patience(m, p)
    )


def level(m: Moment) -> torch.Tensor:
    """Return the squared sine of the tilt, (n,)."""
    return m.motion.gravity[:, :2].square().sum(1)


Smooth = Callable[[Moment, Mapping[str, float]], torch.Tensor]
SMOOTH: dict[str, Smooth] = {
    "jump_height": lambda m, p: m.at_apex * height_kernel(m, p),
    "estimated_jump_height": lambda m, p: m.rising * height_kernel(m, p),
    "horizontal_velocity": lambda m, p: (
        torch.exp(-norm(m.motion.lin_vel[:, :2]) / p["speed_scale"]) * torch.where(m.phase == STANCE, 1.0, 2.0)
    ) * patience(m, p),
    "orientation": lambda m, p: phi(level(m), p["std"]) * patience(m, p),
    "angular_velocity": lambda m, p: phi(m.motion.ang_vel.square().sum(1), p["std"]) * patience(m, p),
    "joint_symmetry": symmetry,
    "ground_posture": lambda m, p: (m.phase != FLIGHT) * posture(m, p, p["shift"]) * patience(m, p),
    "air_posture": lambda m, p: (m.phase == FLIGHT) * posture(m, p, 0.0),
    "post_landing_posture": lambda m, p: m.soon * posture(m, p, p["shift"]),
    "base_at_rest": lambda m, p: m.resting * phi(m.motion.lin_vel.square().sum(1), p["std_lin_vel"])
    * phi(m.motion.ang_vel.square().sum(1), p["std_ang_vel"]),
    "landing_tilt": lambda m, p: (m.phase == LANDED) * level(m) / np.sin(p["angle"]) ** 2,
    "catch_landing": lambda m, p: m.soon * (-m.motion.lin_vel[:, 2]).clamp(0.0, 1.0),
    "damp_landing": lambda m, p: m.soon * m.motion.rate.view(-1, 4, 3)[:, :, 1:].flatten(1).clamp(0.0, 1.0).mean(1),
    "motor_torque_sq": lambda m, p: m.state.torque.square().sum(0),
    "joint_acceleration": lambda m, p: ((m.motion.rate - m.before.rate) / m.step_dt).square().sum(1),
    "action_rate": lambda m, p: (m.state.action - m.old.action).square().sum(0),
    "resting_action_rate": lambda m, p: m.resting * (m.state.action - m.old.action).square().sum(0),
    "torque_ripple": lambda m, p: m.resting * (m.state.torque - m.old.torque).square().sum(0),
}  # fmt: skip
"""By the name of the term's function."""


def smooth_reward(task: Any, moment: Moment) -> torch.Tensor:
    """Return the sum of the rewards that are in `SMOOTH`, weights and policy step applied, (n,)."""
    total = torch.zeros_like(moment.goal)
    for term in task.rewards:
        if term.func.key in SMOOTH:
            time = moment.step_dt if term.options["scale_by_dt"] else 1.0
            total = total + term.numbers["weight"] * time * SMOOTH[term.func.key](moment, term.numbers)
    return total
