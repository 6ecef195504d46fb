"""Rewards of the vertical jump as differentiable functions of the robot's state.

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
LANDING, RECOVERED = 18, 30  # policy steps after touchdown that count as landing, and after which robots should rest


class RewardContext(NamedTuple):
    """States of robot and jump from which the rewards of a policy step are computed, for n worlds.

    The phase and conditions such as `landing` are those at the end of the step.
    """

    motion: RobotState  # at the end of the step
    prev_motion: RobotState  # at the beginning of the step
    state: LoopState  # at the end of the step
    prev_state: LoopState  # at the beginning of the step
    phase: torch.Tensor  # (n,) `STANCE`, `FLIGHT` or `LANDED`
    jump_due: torch.Tensor  # (n,) bool, a jump is commanded and has not begun
    landing: torch.Tensor  # (n,) bool, touchdown was within the last `LANDING` steps (0.3 s)
    resting: torch.Tensor  # (n,) bool, the robot should stand still: no command yet, or `RECOVERED` after touchdown
    rising: torch.Tensor  # (n,) bool, in flight before the apex
    at_apex: torch.Tensor  # (n,) bool, the apex was passed in this step
    goal: torch.Tensor  # (n,) [m] commanded apex height of the base
    default: torch.Tensor  # (12,) [rad] motor angles of the default pose
    gravity: float  # [m/s^2] downward, positive
    step_dt: float  # [s] policy step


def make_context(
    loop: ClosedLoop, state: LoopState, prev_state: LoopState, arrays: Mapping[str, np.ndarray]
) -> RewardContext:
    """Collect the states of robot and jump from which the rewards of a policy step are computed.

    The step leads from prev_state to state; arrays: `Env.task_arrays` before resets.
    """

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
    """Return the Gaussian kernel of an error, 1 at zero error: exp(-squared / std^2).

    Shape of `squared`, the squared error; std: width in the unit of the error.
    """
    return torch.exp(-squared / std**2)


def row_norm(x: torch.Tensor) -> torch.Tensor:
    """Return the norm (n,) of each row of x (n, k), with a finite derivative at 0."""
    return (x.square().sum(1) + 1.0e-12).sqrt()


def ballistic_apex(ctx: RewardContext) -> torch.Tensor:
    """Return the apex height [m] of the base's ballistic path through the state at the end of the step, (n,)."""
    return ctx.motion.pos[:, 2] + ctx.motion.lin_vel[:, 2].square() / (2.0 * ctx.gravity)


def height_closeness(ctx: RewardContext, const: Mapping[str, float]) -> torch.Tensor:
    """Return a measure [1], at most 5, of how close the ballistic apex is to the commanded height, (n,).

    Constants: std_fine, scale_sharp, std_wide [m].
    """
    error = ballistic_apex(ctx) - ctx.goal
    return (
        gaussian(error.square(), const["std_fine"])
        + 3.0 * torch.exp(-error.abs() / const["scale_sharp"])
        + gaussian(error.square(), const["std_wide"])
    )


def waiting_scale(ctx: RewardContext, const: Mapping[str, float]) -> torch.Tensor:
    """Return the factor (n,) of a reward: the constant `waiting_scale` from a jump's command to its start, else 1."""
    return torch.where(ctx.jump_due, const["waiting_scale"], 1.0)


def posture(ctx: RewardContext, const: Mapping[str, float], shift: float) -> torch.Tensor:
    """Return a measure (n,), at most 1, of how close the motor angles are to the default pose plus `shift`.

    shift [rad]: added to the pose's transversal angles. Constants: std [rad].
    """
    shifts = ctx.default.new_tensor(4 * [0.0, shift, shift])
    return gaussian((ctx.motion.angle - ctx.default - shifts).square().mean(1), const["std"])


def symmetry(ctx: RewardContext, const: Mapping[str, float]) -> torch.Tensor:
    """Return a measure (n,) of how symmetric the legs are: largest for equal transversal angles and lateral angles 0.

    The product of a Gaussian for each of the two and of `waiting_scale`. Constants: std_variance [rad^2], std_lateral
    [rad], waiting_scale [1].
    """
    legs = ctx.motion.angle.view(-1, 4, 3)
    spread = legs[:, :, 1:].flatten(1).var(1, correction=0)
    return (
        gaussian(spread.square(), const["std_variance"])
        * gaussian(legs[:, :, 0].square().sum(1), const["std_lateral"])
        * waiting_scale(ctx, const)
    )


def squared_tilt(ctx: RewardContext) -> torch.Tensor:
    """Return the squared sine of the base's tilt, (n,)."""
    return ctx.motion.gravity[:, :2].square().sum(1)


Smooth = Callable[[RewardContext, Mapping[str, float]], torch.Tensor]  # context and term's constants to (n,)
SMOOTH: dict[str, Smooth] = {
    "jump_height": lambda ctx, const: ctx.at_apex * height_closeness(ctx, const),
    "estimated_jump_height": lambda ctx, const: ctx.rising * height_closeness(ctx, const),
    "horizontal_velocity": lambda ctx, const: (
        torch.exp(-row_norm(ctx.motion.lin_vel[:, :2]) / const["speed_scale"])
        * torch.where(ctx.phase == STANCE, 1.0, 2.0)
    ) * waiting_scale(ctx, const),
    "orientation": lambda ctx, const: gaussian(squared_tilt(ctx), const["std"]) * waiting_scale(ctx, const),
    "angular_velocity": lambda ctx, const: gaussian(ctx.motion.ang_vel.square().sum(1), const["std"])
    * waiting_scale(ctx, const),
    "joint_symmetry": symmetry,
    "ground_posture": lambda ctx, const: (ctx.phase != FLIGHT) * posture(ctx, const, const["shift"])
    * waiting_scale(ctx, const),
    "air_posture": lambda ctx, const: (ctx.phase == FLIGHT) * posture(ctx, const, 0.0),
    "post_landing_posture": lambda ctx, const: ctx.landing * posture(ctx, const, const["shift"]),
    "base_at_rest": lambda ctx, const: ctx.resting * gaussian(ctx.motion.lin_vel.square().sum(1), const["std_lin_vel"])
    * gaussian(ctx.motion.ang_vel.square().sum(1), const["std_ang_vel"]),
    "landing_tilt": lambda ctx, const: (ctx.phase == LANDED) * squared_tilt(ctx) / np.sin(const["angle"]) ** 2,
    "catch_landing": lambda ctx, const: ctx.landing * (-ctx.motion.lin_vel[:, 2]).clamp(0.0, 1.0),
    "damp_landing": lambda ctx, const: ctx.landing
    * ctx.motion.rate.view(-1, 4, 3)[:, :, 1:].flatten(1).clamp(0.0, 1.0).mean(1),
    "motor_torque_sq": lambda ctx, const: ctx.state.torque.square().sum(0),
    "joint_acceleration": lambda ctx, const: ((ctx.motion.rate - ctx.prev_motion.rate) / ctx.step_dt).square().sum(1),
    "action_rate": lambda ctx, const: (ctx.state.action - ctx.prev_state.action).square().sum(0),
    "resting_action_rate": lambda ctx, const: ctx.resting * (ctx.state.action - ctx.prev_state.action).square().sum(0),
    "torque_ripple": lambda ctx, const: ctx.resting * (ctx.state.torque - ctx.prev_state.torque).square().sum(0),
}  # fmt: skip
"""Unweighted smooth reward terms (n,) by name of the environment term's function; const: the term's constants."""


def smooth_reward(task: Any, context: RewardContext) -> torch.Tensor:
    """Return the differentiable part of the reward: the weighted sum (n,) of the terms in `SMOOTH`, but of weight 0.

    Times the policy step where `scale_by_dt` is set.
    """
    total = torch.zeros_like(context.goal)
    for term in task.rewards:
        if term.func.key in SMOOTH and term.numbers["weight"] != 0.0:
            time = context.step_dt if term.options["scale_by_dt"] else 1.0
            total = total + term.numbers["weight"] * time * SMOOTH[term.func.key](context, term.numbers)
    return total
