"""Robots under a policy, with gradients: what a policy sees is computed from the simulated state, in PyTorch.

An environment gives robots, commands, noise and all values; a `Rollout` of the same robots beside it gives the
derivatives of every policy step by the action and by the state before.
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
from jumper_warp.utils.errors import InputError

DOWN = (0.0, 0.0, -1.0)


class LoopState(NamedTuple):
    """What the next policy step depends on, worlds last, in the layout of `jumper_warp.diff.rollout.Trajectory`."""

    q: torch.Tensor
    """(19, num_worlds) [m], xyzw, [rad]"""
    qd: torch.Tensor
    """(18, num_worlds) [m/s], [rad/s]"""
    before: torch.Tensor
    """(12, num_worlds) [rad] Filtered targets of the step before."""
    impulse: torch.Tensor
    """(4, num_worlds, 3) [N s] On the paws in the last physics step; carries no gradient."""
    action: torch.Tensor
    """(12, num_worlds) Of the step before, within ±1."""
    torque: torch.Tensor
    """(12, num_worlds) [N m] Of the last physics step."""
    past: torch.Tensor
    """(earlier columns, num_worlds) What the policy saw in the steps before, of terms with a history, oldest first."""

    def detach(self) -> LoopState:
        """Return the same without gradients."""
        return LoopState(*(tensor.detach() for tensor in self))


class Motion(NamedTuple):
    """The base and the motors in the terms of observations and rewards, worlds first."""

    pos: torch.Tensor
    """(num_worlds, 3) [m] Base origin, world axes."""
    quat: torch.Tensor
    """(num_worlds, 4) xyzw, body to world."""
    lin_vel: torch.Tensor
    """(num_worlds, 3) [m/s] Base origin, world axes."""
    ang_vel: torch.Tensor
    """(num_worlds, 3) [rad/s] Body axes."""
    gravity: torch.Tensor
    """(num_worlds, 3) Direction of gravity, body axes."""
    angle: torch.Tensor
    """(num_worlds, 12) [rad]"""
    rate: torch.Tensor
    """(num_worlds, 12) [rad/s]"""


def rotated_back(quat: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Return vectors (n, 3) in the body axes of orientations (n, 4), xyzw."""
    u, w = -quat[:, :3], quat[:, 3:]
    twice = 2.0 * torch.linalg.cross(u, v)
    return v + w * twice + torch.linalg.cross(u, twice)


def rotated(quat: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Return body vectors (n, 3) in world axes, for orientations (n, 4), xyzw."""
    return rotated_back(quat * quat.new_tensor([-1.0, -1.0, -1.0, 1.0]), v)


def heading_of(quat: torch.Tensor) -> torch.Tensor:
    """Return the yaw [rad] (n,) of orientations (n, 4), xyzw: the heading of body x in the world plane."""
    ahead = rotated(quat, quat.new_tensor([1.0, 0.0, 0.0]).expand(len(quat), 3))
    return torch.atan2(ahead[:, 1], ahead[:, 0])


def anchored(value: torch.Tensor, computed: torch.Tensor) -> torch.Tensor:
    """Return the value with the derivatives of what was computed."""
    return value + (computed - computed.detach())


class ClosedLoop:
    """The robots of an environment with gradients.

    `advance` and `observe` are functions of tensors, in single or double precision; `step` moves the environment too,
    and gives its values with their derivatives.
    """

    def __init__(self, env: Any, *, double: bool = False) -> None:
        """Take the robots of a `jumper_warp.envs.env.Env` as they are; see `read_parameters`.

        Raises InputError: several tasks, another solver, drawn blocks, late sensors, or a history of what is not the
        robot's state alone.
        """
        robots: Snapshot = env.snapshot()
        self.task = task = robots.tasks[0]
        if len(robots.tasks) > 1 or robots.solver != "SolverJumper":
            raise InputError("gradients need an environment of one task on SolverJumper")
        if robots.blocks:
            raise InputError("gradients need a ground without moving blocks: train with level ground")
        if task.randomization.observation_latency:
            raise InputError(f"{task.name}: gradients need observations without latency")
        for term in (*task.observations.actor, *task.observations.critic):
            if term.options["history"] > 1 and (term.func.key not in OWN or term not in task.observations.actor):
                raise InputError(f"{task.name}: gradients of a history need one of the robot's state, not {term.name}")
        self.env, self.num_worlds = env, env.num_envs
        self.rollout = Rollout(
            robots.model, task.motors, task.command_filter, double=double, dt=robots.dt, substeps=robots.substeps
        )
        self.dtype = torch.float64 if double else torch.float32
        self.draws = bool(task.params.slots["events"])
        """Whether resets draw other robots."""
        self.layout = task.layout("actor")
        self._columns = {
            group: [(term, *task.layout(group)[term.name]) for term in getattr(task.observations, group)]
            for group in task.groups
        }
        self._remembered = [entry for entry in self._columns["actor"] if entry[0].options["history"] > 1]
        lateral, transversal = (math.radians(scale) for scale in task.action_scale)
        like = {"dtype": self.dtype, "device": env.device}
        self.scale = torch.tensor(4 * [lateral, transversal, transversal], **like)
        """(12,) [rad]"""
        self.default = robots.default_angle.to(**like)
        """(12,) [rad]"""
        self.read_parameters()

    def read_parameters(self) -> dict[str, torch.Tensor]:
        """Take over masses, motors, friction and latency of the environment's robots; return them by name."""
        robots: Snapshot = self.env.snapshot()
        found = {name: tensor.to(self.dtype, copy=True) for name, tensor in robots.parameters.items()}
        for name, tensor in found.items():
            wp.to_torch(self.rollout.parameters[name]).copy_(tensor)
        self.com = robots.com.to(self.dtype, copy=True)
        self.offset = found["offset"].T
        return found

    def state(self) -> LoopState:
        """Return the environment's state, without gradients."""
        now: Snapshot = self.env.snapshot()
        parts = (now.q, now.qd, now.before, now.impulse, now.action, now.torque, self._earlier(self.env.obs))
        return LoopState(*(part.to(self.dtype, copy=True).contiguous() for part in parts))

    def _earlier(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the frames before the last of all terms that have some, as `LoopState.past`."""
        ends = [(first, end - term.width) for term, first, end in self._remembered]
        return torch.cat([obs[:, first:last] for first, last in ends] or [obs[:, :0]], 1).T

    def _pasts(self, state: LoopState) -> list[torch.Tensor]:
        """Return the earlier frames of each term that has some, (num_worlds, columns)."""
        counts = [end - first - term.width for term, first, end in self._remembered]
        return list(state.past.T.split(counts, 1)) if counts else []

    def _aged(self, state: LoopState) -> torch.Tensor:
        """Return the earlier frames of the state that follows: those of this state without the oldest, and its own."""
        motion, found = self.motion(state), []
        for (term, _, _), past in zip(self._remembered, self._pasts(state), strict=True):
            found += [past[:, term.width :], self._frame(term, motion, state, past[:, : term.width])]
        return torch.cat(found, 1).T if found else state.past

    def _frame(self, term: Any, motion: Motion, state: LoopState, told: torch.Tensor) -> torch.Tensor:
        """Return what a term shows of a state; told: as the environment shows it."""
        scale, clip = term.numbers["scale"], term.numbers["clip"]
        return scale * SEEN[term.func.key](self, motion, state, told / scale).clamp(-clip, clip)

    def advance(
        self,
        state: LoopState,
        action: torch.Tensor,
        wrench: torch.Tensor | None = None,
        parameters: dict[str, torch.Tensor] | None = None,
    ) -> LoopState:
        """Return the state a policy step later.

        action: (num_worlds, 12), clamped to ±1; latencies are at most a policy step. wrench: (6, num_worlds) [N],
        [N m] on the base. parameters: as `read_parameters` returned them, kept for the reverse pass; by default those
        that the rollout has now.
        """
        clamped = action.clamp(-1.0, 1.0).T
        targets = clamped * self.scale[:, None] + self.default[:, None]
        made = simulate(
            self.rollout, targets[None], state.q, state.qd, before=state.before, impulse=state.impulse,
            wrench=None if wrench is None else wrench[None], trusted=True, **(parameters or {}),
        )  # fmt: skip
        impulse = made.impulse[-1].detach()
        return LoopState(made.q[-1], made.qd[-1], made.safe[-1], impulse, clamped, made.torque[-1], self._aged(state))

    def motion(self, state: LoopState) -> Motion:
        """Return base and motors of a state."""
        q, qd = state.q.T, state.qd.T
        quat = q[:, 3:7] / q[:, 3:7].norm(dim=1, keepdim=True)
        ang = qd[:, 3:6]
        lin_vel = qd[:, :3] - torch.linalg.cross(ang, rotated(quat, self.com))
        gravity = rotated_back(quat, q.new_tensor(DOWN).expand(len(q), 3))
        return Motion(q[:, :3], quat, lin_vel, rotated_back(quat, ang), gravity, q[:, 7:], qd[:, 6:])

    def observe(self, state: LoopState, told: torch.Tensor, group: str = "actor") -> torch.Tensor:
        """Return what the policy, or the critic, sees of a state, (num_worlds, columns), without noise.

        told: (num_worlds, columns), of which those that are not of the robot's state, such as commands, are taken.
        """
        motion, columns, pasts = self.motion(state), [], iter(self._pasts(state))
        for term, first, end in self._columns[group]:
            value = told[:, first:end].to(self.dtype)
            if term.options["history"] > 1:
                columns.append(next(pasts))
                value = value[:, -term.width :]
            columns.append(self._frame(term, motion, state, value) if term.func.key in SEEN else value)
        return torch.cat(columns, 1)

    def step(self, state: LoopState, action: torch.Tensor) -> tuple[LoopState, LoopState]:
        """Let the environment make a policy step from the state that it has; return the next state twice.

        The first is of worlds as they go on, with the environment's values; a world that has begun a new episode has
        no gradient. The second is that of the rollout, where no episode has ended.
        action: (num_worlds, 12); state: of the environment, as `state` or the step before returned it.
        """
        env = self.env
        parameters = self.read_parameters() if self.draws else None
        env.step(action.detach())
        wrench = None
        if self.draws:
            wrench = env.snapshot().wrench.to(self.dtype).contiguous()
        made, now = self.advance(state, action, wrench, parameters), self.state()
        begun = env.done > 0.0 if env.auto_reset else torch.zeros_like(env.done, dtype=torch.bool)
        parts = []
        for name, value, computed in zip(LoopState._fields, now, made, strict=True):
            mask = begun[None, :, None] if name == "impulse" else begun[None]
            parts.append(torch.where(mask, value, anchored(value, computed)))
        if self.draws:
            self.read_parameters()
        return LoopState(*parts), made

    def seen(self, state: LoopState) -> torch.Tensor:
        """Return the environment's observation, noise included, with its derivatives by the state."""
        return anchored(self.env.obs.to(self.dtype), self.observe(state, self.env.obs))


def _way(loop: ClosedLoop, motion: Motion, state: LoopState, told: torch.Tensor) -> torch.Tensor:
    """Return the way to the goal that the environment tells, as a function of where the base is."""
    heading = heading_of(motion.quat)
    cos, sin = torch.cos(heading), torch.sin(heading)
    axes = torch.stack([torch.stack([cos, sin], 1), torch.stack([-sin, cos], 1)], 1)
    goal = motion.pos[:, :2].detach() + torch.einsum("nij,ni->nj", axes.detach(), told)
    way = torch.einsum("nij,nj->ni", axes, goal - motion.pos[:, :2])
    return torch.where((told == 0.0).all(1, keepdim=True), told, way)


def _height_errors(loop: ClosedLoop, motion: Motion, state: LoopState, told: torch.Tensor) -> torch.Tensor:
    """Return the misses of height as told, the ballistic one with its derivatives."""
    apex = motion.pos[:, 2] + motion.lin_vel[:, 2].clamp(min=0.0).square() / (2.0 * loop.task.gravity)
    return torch.stack([told[:, 0], anchored(told[:, 1], apex)], 1)


SEEN: dict[str, Callable[..., torch.Tensor]] = {
    "goal": _way,
    "height_errors": _height_errors,
    "height": lambda loop, motion, state, told: motion.pos[:, 2:],
    "lin_vel": lambda loop, motion, state, told: rotated_back(motion.quat, motion.lin_vel),
    "ang_vel": lambda loop, motion, state, told: motion.ang_vel,
    "gravity": lambda loop, motion, state, told: motion.gravity,
    "angle": lambda loop, motion, state, told: motion.angle + loop.offset - loop.default,
    "rate": lambda loop, motion, state, told: motion.rate,
    "last_action": lambda loop, motion, state, told: state.action.T,
}
"""Observation terms of the robot's state, by name; the height is that above level ground."""
OWN = frozenset(SEEN) - {"goal", "height_errors"}
"""Those of the robot's state alone."""
