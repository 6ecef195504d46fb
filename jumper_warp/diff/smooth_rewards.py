"""Rewards of the vertical jump as smooth functions of the robot's state, for their derivatives.

Reward values always come from the environment. Terms that count steps or events (lifted paws) or depend on forces and
decelerations at impacts have no derivative. Phases (stance, flight, landed) switch terms without depending on the
state, so that no derivative rewards an earlier takeoff. The floor under the total passes derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

from jumper_warp.diff.closed_loop import ClosedLoop, LoopState, RobotState

STANCE, FLIGHT, LANDED = 0, 1, 2
LANDING, RECOVERED = 18, 30
"""Policy steps after touchdown that count as landing, and after which the robot should rest."""


class RewardContext(NamedTuple):
    """Inputs of the rewards of a policy step, n worlds."""

    motion: RobotState
    """At the end of the step."""
    prev_motion: RobotState
    """At its beginning."""
    state: LoopState
    """At the end of the step."""
    prev_state: LoopState
    """At its beginning."""
    phase: torch.Tensor
    """(n,) `STANCE`, `FLIGHT` or `LANDED`, at the end of the step."""
    jump_due: torch.Tensor
    """(n,) bool, a commanded jump has not begun."""
    landing: torch.Tensor
    """(n,) bool, touchdown was within the last 0.3 s."""
    resting: torch.Tensor
    """(n,) bool, the robot should stand still."""
    rising: torch.Tensor
    """(n,) bool, in flight before the apex."""
    at_apex: torch.Tensor
    """(n,) bool, the apex was passed in this step."""
    goal: torch.Tensor
    """(n,) [m] Commanded height."""
    default: torch.Tensor
    """(12,) [rad] Motor angles of the default pose."""
    gravity: float
    """[m/s^2] Downward."""
    step_dt: float
    """[s] Policy step."""


def make_context(
    loop: ClosedLoop, state: LoopState, prev_state: LoopState, arrays: Mapping[str, np.ndarray]
) -> RewardContext:
    """Return the rewards' inputs of a policy step; arrays: `Env.task_arrays` at its end, before any reset."""

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), device=state.q.device)

    phase, after, steps = arrays["phase"], arrays["phase_steps"], arrays["steps"]
    commanded = steps >= arrays["command_step"]
    resting = ((phase == LANDED) & (after >= RECOVERED)) | ((phase == STANCE) & ~commanded)
    rising = (phase == FLIGHT) & (arrays["apex_passed"] == 0)
    return RewardContext(
        loop.motion(state), loop.motion(prev_state), state, prev_state, tensor(phase),
        tensor((phase == STANCE) & commanded), tensor((phase == LANDED) & (after < LANDING)),
        tensor(resting), tensor(rising), tensor(arrays["at_apex"] == 1), tensor(arrays["goal"][:, 2]), loop.default,
        loop.task.gravity, loop.env.step_dt,
    )  # fmt: skip


def gaussian(squared: torch.Tensor, std: float) -> torch.Tensor:
    """Return exp(-x^2 / std^2), given x^2."""
    return torch.exp(-squared / std**2)


def row_norm(x: torch.Tensor) -> torch.Tensor:
    """Return the norms of the rows of x (n, k), (n,), with a finite derivative at 0."""
    return (x.square().sum(1) + 1.0e-12).sqrt()


def ballistic_apex(m: RewardContext) -> torch.Tensor:
    """Return the apex height [m] of the base's ballistic path through the present state, (n,)."""
    return m.motion.pos[:, 2] + m.motion.lin_vel[:, 2].square() / (2.0 * m.gravity)


def height_kernel(m: RewardContext, p: Mapping[str, float]) -> torch.Tensor:
    """Return the closeness of the ballistic apex to the goal, (n,), at most 5."""
    error = ballistic_apex(m) - m.goal
    return (
        gaussian(error.square(), p["std_fine"])
        + 3.0 * torch.exp(-error.abs() / p["scale_sharp"])
        + gaussian(error.square(), p["std_wide"])
    )


def waiting_scale(m: RewardContext, p: Mapping[str, float]) -> torch.Tensor:
    """Return the scale of a reward, (n,): below 1 while a commanded jump has not begun."""
    return torch.where(m.jump_due, p["waiting_scale"], 1.0)


def posture(m: RewardContext, p: Mapping[str, float], shift: float) -> torch.Tensor:
    """Return the closeness of the angles to the default pose, (n,), transversal motors shifted by `shift` [rad]."""
    shifts = m.default.new_tensor(4 * [0.0, shift, shift])
    return gaussian((m.motion.angle - m.default - shifts).square().mean(1), p["std"])


def symmetry(m: RewardContext, p: Mapping[str, float]) -> torch.Tensor:
    """Return the closeness of the transversal angles to each other and of the lateral ones to 0, (n,)."""
    legs = m.motion.angle.view(-1, 4, 3)
    spread = legs[:, :, 1:].flatten(1).var(1, correction=0)
    return (
        gaussian(spread.square(), p["std_variance"])
        * gaussian(legs[:, :, 0].square().sum(1), p["std_lateral"])
        * waiting_scale(m, p)
    )


def squared_tilt(m: RewardContext) -> torch.Tensor:
    """Return the squared sine of the tilt, (n,)."""
    return m.motion.gravity[:, :2].square().sum(1)


Smooth = Callable[[RewardContext, Mapping[str, float]], torch.Tensor]
SMOOTH: dict[str, Smooth] = {
    "jump_height": lambda m, p: m.at_apex * height_kernel(m, p),
    "estimated_jump_height": lambda m, p: m.rising * height_kernel(m, p),
    "horizontal_velocity": lambda m, p: (
        torch.exp(-row_norm(m.motion.lin_vel[:, :2]) / p["speed_scale"]) * torch.where(m.phase == STANCE, 1.0, 2.0)
    ) * waiting_scale(m, p),
    "orientation": lambda m, p: gaussian(squared_tilt(m), p["std"]) * waiting_scale(m, p),
    "angular_velocity": lambda m, p: gaussian(m.motion.ang_vel.square().sum(1), p["std"]) * waiting_scale(m, p),
    "joint_symmetry": symmetry,
    "ground_posture": lambda m, p: (m.phase != FLIGHT) * posture(m, p, p["shift"]) * waiting_scale(m, p),
    "air_posture": lambda m, p: (m.phase == FLIGHT) * posture(m, p, 0.0),
    "post_landing_posture": lambda m, p: m.landing * posture(m, p, p["shift"]),
    "base_at_rest": lambda m, p: m.resting * gaussian(m.motion.lin_vel.square().sum(1), p["std_lin_vel"])
    * gaussian(m.motion.ang_vel.square().sum(1), p["std_ang_vel"]),
    "landing_tilt": lambda m, p: (m.phase == LANDED) * squared_tilt(m) / np.sin(p["angle"]) ** 2,
    "catch_landing": lambda m, p: m.landing * (-m.motion.lin_vel[:, 2]).clamp(0.0, 1.0),
    "damp_landing": lambda m, p: m.landing * m.motion.rate.view(-1, 4, 3)[:, :, 1:].flatten(1).clamp(0.0, 1.0).mean(1),
    "motor_torque_sq": lambda m, p: m.state.torque.square().sum(0),
    "joint_acceleration": lambda m, p: ((m.motion.rate - m.prev_motion.rate) / m.step_dt).square().sum(1),
    "action_rate": lambda m, p: (m.state.action - m.prev_state.action).square().sum(0),
    "resting_action_rate": lambda m, p: m.resting * (m.state.action - m.prev_state.action).square().sum(0),
    "torque_ripple": lambda m, p: m.resting * (m.state.torque - m.prev_state.torque).square().sum(0),
}  # fmt: skip
"""Smooth reward terms by name of the term's function, each (n,)."""


def smooth_reward(task: Any, context: RewardContext) -> torch.Tensor:
    """Return the weighted sum of the rewards that are in `SMOOTH`, (n,), scaled by the policy step."""
    total = torch.zeros_like(context.goal)
    for term in task.rewards:
        if term.func.key in SMOOTH:
            time = context.step_dt if term.options["scale_by_dt"] else 1.0
            total = total + term.numbers["weight"] * time * SMOOTH[term.func.key](context, term.numbers)
    return total
