"""Differentiable closed loop of a policy and the simulation, with observations computed in PyTorch.

An environment provides robots, commands, noise and all values; a `Rollout` of the same robots provides the derivatives
of every policy step w.r.t. the action and the previous state. Values are therefore those of an evaluation, bit for bit,
and PyTorch's functions here need only have the right derivatives. Quaternions are xyzw, body to world; world z is up;
`observed` is an observation as the environment computed it; a term with a history also observes earlier frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import warp as wp

from jumper_warp.diff.rollout import Rollout
from jumper_warp.diff.snapshot import Snapshot
from jumper_warp.diff.torch_rollout import simulate
from jumper_warp.utils.checks import check_flags
from jumper_warp.utils.errors import InputError

DOWN = (0.0, 0.0, -1.0)  # direction of gravity, world axes


class LoopState(NamedTuple):
    """State of robots and policy at the beginning of a policy step, in parallel worlds.

    In the layout of `jumper_warp.diff.rollout.Trajectory`.
    """

    q: torch.Tensor  # (19, num_worlds) base origin [m], orientation xyzw, motor angles [rad]
    qd: torch.Tensor  # (18, num_worlds) velocity of the base's COM [m/s], angular velocity, motor rates [rad/s]
    initial_target: torch.Tensor  # (12, num_worlds) [rad] filtered targets of the last policy step
    impulse: torch.Tensor  # (4, num_worlds, 3) [N s] contact impulses in the last physics step; has no gradient
    action: torch.Tensor  # (12, num_worlds) actions of the last policy step, within ±1
    torque: torch.Tensor  # (12, num_worlds) [N m] motor torques in the last physics step
    history: torch.Tensor  # (columns, num_worlds) earlier frames of the policy's terms with a history, oldest first


class RobotState(NamedTuple):
    """State of base and motors from which observations and rewards are computed; the first axis is the world."""

    pos: torch.Tensor  # (num_worlds, 3) [m] base origin, world axes
    quat: torch.Tensor  # (num_worlds, 4) xyzw, body to world
    lin_vel: torch.Tensor  # (num_worlds, 3) [m/s] base origin, world axes
    ang_vel: torch.Tensor  # (num_worlds, 3) [rad/s] body axes
    gravity: torch.Tensor  # (num_worlds, 3) [1] unit vector along gravity, body axes
    angle: torch.Tensor  # (num_worlds, 12) [rad] true motor angles; legs FL, FR, BL, BR, each lateral, outer, inner
    rate: torch.Tensor  # (num_worlds, 12) [rad/s] motor rates


def rotate_inverse(quat: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Rotate vectors from the world frame into the body frame of given orientations.

    v: (n, 3); quat: (n, 4), xyzw, body to world.
    """
    u, w = -quat[:, :3], quat[:, 3:]
    twice = 2.0 * torch.linalg.cross(u, v)
    return v + w * twice + torch.linalg.cross(u, twice)


def rotate(quat: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Rotate vectors from the body frame of given orientations into the world frame.

    v: (n, 3); quat: (n, 4), xyzw, body to world.
    """
    return rotate_inverse(quat * quat.new_tensor([-1.0, -1.0, -1.0, 1.0]), v)


def heading_of(quat: torch.Tensor) -> torch.Tensor:
    """Return the yaw [rad] (n,) of orientations (n, 4), xyzw: the direction of body x in the world's xy plane."""
    ahead = rotate(quat, quat.new_tensor([1.0, 0.0, 0.0]).expand(len(quat), 3))
    return torch.atan2(ahead[:, 1], ahead[:, 0])


def with_gradient_of(value: torch.Tensor, computed: torch.Tensor) -> torch.Tensor:
    """Return a tensor whose values are those of `value` and whose derivatives are those of `computed`.

    The difference computed - computed.detach() is 0 in value only.
    """
    return value + (computed - computed.detach())


class ClosedLoop:
    """Differentiable closed loop of an environment's robots and a policy: policy steps and observations.

    `advance` and `observe` are functions of tensors, in single or double precision; `step` also steps the
    environment and returns its values with derivatives.
    """

    def __init__(self, env: Any, *, double: bool = False) -> None:
        """Prepare a differentiable simulation of the robots of a `jumper_warp.envs.env.Env`. See `read_parameters`.

        Raises InputError: several tasks, another solver, moving blocks, sensor latency, or a history of a term that is
        not a function of the robot's state alone.
        """
        if not hasattr(env, "snapshot"):
            raise InputError(f"env must be an Env, got {env!r:.60}")
        check_flags(double=double)
        robots: Snapshot = env.snapshot()
        self.task = task = robots.tasks[0]
        if len(robots.tasks) > 1 or robots.solver != "SolverJumper":
            raise InputError("gradients need an environment of one task on SolverJumper")
        if robots.blocks:
            raise InputError("gradients need a ground without moving blocks: train with level ground")
        if task.randomization.observation_latency:
            raise InputError(f"{task.name}: gradients need observations without latency")
        for term in task.observations.actor:
            if term.options["history"] > 1 and term.func.key not in STATE_TERMS:
                raise InputError(f"{task.name}: gradients need histories of the robot's state, not of {term.name}")
        self.env = env
        self.num_worlds = env.num_envs
        self.rollout = Rollout(
            robots.model, task.motors, task.command_filter, double=double, dt=robots.dt, substeps=robots.substeps
        )
        self.dtype = torch.float64 if double else torch.float32
        self.randomizes = bool(task.params.slots["events"])  # Whether resets randomise the robots
        self.layout = task.layout("actor")
        self._columns = [(term, *self.layout[term.name]) for term in task.observations.actor]
        self._history_terms = [entry for entry in self._columns if entry[0].options["history"] > 1]
        lateral, transversal = (math.radians(scale) for scale in task.action_scale)
        like = {"dtype": self.dtype, "device": env.device}
        self.scale = torch.tensor(4 * [lateral, transversal, transversal], **like)
        """(12,) [rad] Change of the motor targets by an action of 1."""
        self.default = robots.default_angle.to(**like)  # (12,) [rad] Motor targets at a zero action
        self.read_parameters()

    def read_parameters(self) -> dict[str, torch.Tensor]:
        """Copy the environment's robot parameters, such as masses, into the differentiable rollout, and return copies.

        By name, shapes as in `Rollout.parameters`.
        """
        robots: Snapshot = self.env.snapshot()
        parameters = {name: tensor.to(self.dtype, copy=True) for name, tensor in robots.parameters.items()}
        for name, tensor in parameters.items():
            wp.to_torch(self.rollout.parameters[name]).copy_(tensor)
        self.com = robots.com.to(self.dtype, copy=True)
        self.offset = parameters["offset"].T
        return parameters

    def state(self) -> LoopState:
        """Return a copy of the environment's current state, without gradients."""
        env: Snapshot = self.env.snapshot()
        history = self._history_of(self.env.obs)
        parts = (env.q, env.qd, env.initial_target, env.impulse, env.action, env.torque, history)
        return LoopState(*(part.to(self.dtype, copy=True).contiguous() for part in parts))

    def _history_of(self, obs: torch.Tensor) -> torch.Tensor:
        """Select from the policy's observation the earlier values of all terms that have a history.

        As in `LoopState.history`. obs: (num_worlds, columns of the actor).
        """
        ends = [(first, end - term.width) for term, first, end in self._history_terms]
        return torch.cat([obs[:, first:last] for first, last in ends] or [obs[:, :0]], 1).T

    def _histories(self, state: LoopState) -> list[torch.Tensor]:
        """Return earlier values of each observation term that has a history, (num_worlds, frames * width) each."""
        counts = [end - first - term.width for term, first, end in self._history_terms]
        return list(state.history.T.split(counts, 1)) if counts else []

    def _next_history(self, state: LoopState) -> torch.Tensor:
        """Return the observation history for the next policy step.

        Each term drops its oldest frame and appends its frame at `state`, as in `LoopState.history`.
        """
        motion = self.motion(state)
        frames = []
        for (term, _, _), past in zip(self._history_terms, self._histories(state), strict=True):
            frames += [past[:, term.width :], self._frame(term, motion, state, past[:, : term.width])]
        return torch.cat(frames, 1).T if frames else state.history

    def _frame(self, term: Any, motion: RobotState, state: LoopState, observed: torch.Tensor) -> torch.Tensor:
        """Return an observation term's current values from the robot's state, scaled, clipped, (num_worlds, width).

        motion: of the state. observed: the environment's observation of the term, (num_worlds, width).
        """
        scale, clip = term.numbers["scale"], term.numbers["clip"]
        return scale * SMOOTH_TERMS[term.func.key](self, motion, state, observed / scale).clamp(-clip, clip)

    def advance(
        self,
        state: LoopState,
        action: torch.Tensor,
        wrench: torch.Tensor | None = None,
        parameters: dict[str, torch.Tensor] | None = None,
    ) -> LoopState:
        """Return the state of robots and policy after one differentiable policy step.

        Latencies must be at most a policy step. action: (num_worlds, 12), clamped to ±1. wrench: force [N] and moment
        [N m] on the base, (6, num_worlds). parameters: from `read_parameters`, restored for the reverse pass; by
        default the rollout's current parameters.
        """
        clamped = action.clamp(-1.0, 1.0).T
        targets = clamped * self.scale[:, None] + self.default[:, None]
        trajectory = simulate(
            self.rollout, targets[None], state.q, state.qd, initial_target=state.initial_target,
            impulse=state.impulse, wrench=None if wrench is None else wrench[None], trusted=True, **(parameters or {}),
        )  # fmt: skip
        end = trajectory.end()
        history = self._next_history(state)
        return LoopState(**end, action=clamped, torque=trajectory.torque[-1], history=history)

    def motion(self, state: LoopState) -> RobotState:
        """Convert the state of the closed loop to the robots' pose, velocity and motor angles, (num_worlds, ...)."""
        q, qd = state.q.T, state.qd.T
        quat = q[:, 3:7] / q[:, 3:7].norm(dim=1, keepdim=True)
        ang = qd[:, 3:6]
        lin_vel = qd[:, :3] - torch.linalg.cross(ang, rotate(quat, self.com))
        gravity = rotate_inverse(quat, q.new_tensor(DOWN).expand(len(q), 3))
        return RobotState(q[:, :3], quat, lin_vel, rotate_inverse(quat, ang), gravity, q[:, 7:], qd[:, 6:])

    def observe(self, state: LoopState, observed: torch.Tensor) -> torch.Tensor:
        """Return the policy's observation (num_worlds, columns) as a differentiable function of the state; no noise.

        observed: the environment's observation, from which columns without derivatives, such as commands, are copied.
        """
        motion = self.motion(state)
        columns = []
        histories = iter(self._histories(state))
        for term, first, end in self._columns:
            value = observed[:, first:end].to(self.dtype)
            if term.options["history"] > 1:
                columns.append(next(histories))
                value = value[:, -term.width :]
            columns.append(self._frame(term, motion, state, value) if term.func.key in SMOOTH_TERMS else value)
        return torch.cat(columns, 1)

    def step(self, state: LoopState, action: torch.Tensor) -> tuple[LoopState, LoopState]:
        """Step the environment and the differentiable rollout, and return their states after the step.

        Returned: (next state after resets, state of the rollout before resets). The next state has the environment's
        values with derivatives; a world that was reset has no gradient. action: (num_worlds, 12). state: the
        environment's current state, from the method `state` or the last `step`.
        """
        env = self.env
        parameters = self.read_parameters() if self.randomizes else None
        env.step(action.detach())
        wrench = env.snapshot().wrench.to(self.dtype).contiguous() if self.randomizes else None
        simulated = self.advance(state, action, wrench, parameters)
        after = self.state()
        reset = env.done > 0.0 if env.auto_reset else torch.zeros_like(env.done, dtype=torch.bool)
        parts = []
        for name, value, computed in zip(LoopState._fields, after, simulated, strict=True):
            mask = reset[None, :, None] if name == "impulse" else reset[None]
            parts.append(torch.where(mask, value, with_gradient_of(value, computed)))
        if self.randomizes:
            self.read_parameters()
        return LoopState(*parts), simulated

    def observation(self, state: LoopState) -> torch.Tensor:
        """Return the environment's noisy observation, with derivatives with respect to `state`.

        Shape (num_worlds, columns).
        """
        return with_gradient_of(self.env.obs.to(self.dtype), self.observe(state, self.env.obs))


def _goal_offset(loop: ClosedLoop, motion: RobotState, state: LoopState, observed: torch.Tensor) -> torch.Tensor:
    """Return the observed offset from base to goal [m], with derivatives w.r.t. the base's pose.

    Shape (n, 2), body yaw frame. A goal observed at (0, 0) has no derivative.
    """
    heading = heading_of(motion.quat)
    cos, sin = torch.cos(heading), torch.sin(heading)
    axes = torch.stack([torch.stack([cos, sin], 1), torch.stack([-sin, cos], 1)], 1)
    goal = motion.pos[:, :2].detach() + torch.einsum("nij,ni->nj", axes.detach(), observed)
    offset = torch.einsum("nij,nj->ni", axes, goal - motion.pos[:, :2])
    return torch.where((observed == 0.0).all(1, keepdim=True), observed, offset)


def _height_errors(loop: ClosedLoop, motion: RobotState, state: LoopState, observed: torch.Tensor) -> torch.Tensor:
    """Return the observed height errors of a jump [m], of which that of the ballistic apex has derivatives.

    Shape (n, 2); the apex is the second one.
    """
    apex = motion.pos[:, 2] + motion.lin_vel[:, 2].clamp(min=0.0).square() / (2.0 * loop.task.gravity)
    return torch.stack([observed[:, 0], with_gradient_of(observed[:, 1], apex)], 1)


SMOOTH_TERMS: dict[str, Callable[..., torch.Tensor]] = {
    "goal": _goal_offset,
    "height_errors": _height_errors,
    "height": lambda loop, motion, state, observed: motion.pos[:, 2:],
    "lin_vel": lambda loop, motion, state, observed: rotate_inverse(motion.quat, motion.lin_vel),
    "ang_vel": lambda loop, motion, state, observed: motion.ang_vel,
    "gravity": lambda loop, motion, state, observed: motion.gravity,
    "angle": lambda loop, motion, state, observed: motion.angle + loop.offset - loop.default,
    "rate": lambda loop, motion, state, observed: motion.rate,
    "last_action": lambda loop, motion, state, observed: state.action.T,
}
"""Differentiable observation terms by name of the term's function, unscaled, (num_worlds, width) each.

Arguments: loop, `RobotState`, `LoopState` and the environment's unscaled observation. Height: above level ground."""
STATE_TERMS = frozenset(SMOOTH_TERMS) - {"goal", "height_errors"}  # terms that depend on the robot's state alone
