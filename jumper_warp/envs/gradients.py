"""Differentiable policy steps of an environment: rewards and observations with gradients w.r.t. actions and states.

The environment provides all values, bit for bit as without gradients. A `Rollout` of the same robots provides the
derivatives of the motion, and one kernel those of the task's rewards and observation terms, a user's included. Phase
machine, events, contacts that begin or end, and resets are constants of a step.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
import warp as wp

from jumper_warp.diff.rollout import Rollout
from jumper_warp.diff.snapshot import Snapshot, compact_columns
from jumper_warp.diff.torch_rollout import TorchTrajectory, simulate
from jumper_warp.kernels.mdp.env import BEGUN, RING
from jumper_warp.kernels.mdp.gradients import make_gradient_kernel, paw_gradient_kernel
from jumper_warp.kernels.mdp.view import RobotArrays
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Kernel, KernelStruct, load_kernels
from jumper_warp.utils.threads import WARP_LOCK

SHARED = ("diverged", "impulse", "gravity", "default_angle", "step_dt")  # What no reset changes, or no term reads
BLOCK = 32  # Threads of a block
PAWS = ("paw_pos", "paw_vel", "paw_height")  # Functions of the joint coordinates and rates


class LoopState(NamedTuple):
    """State of the robots at the beginning of a policy step, in the layout of `jumper_warp.diff.rollout.Trajectory`."""

    q: torch.Tensor  # (19, num_worlds) base origin [m], orientation xyzw, motor angles [rad]
    qd: torch.Tensor  # (18, num_worlds) velocity of the base's COM [m/s], angular velocity, motor rates [rad/s]
    initial_target: torch.Tensor  # (steps, 12, num_worlds) [rad] filtered targets of the last policy steps
    impulse: torch.Tensor  # (4, num_worlds, 3) [N s] contact impulses in the last physics step; has no gradient
    action: torch.Tensor  # (12, num_worlds) actions of the last policy step, within ±1
    prev_action: torch.Tensor  # (12, num_worlds) actions of the policy step before
    torque: torch.Tensor  # (12, num_worlds) [N m] motor torques in the last physics step


class StepInputs(NamedTuple):
    """Quantities at the end of a policy step that rewards and observations depend on, as `RobotArrays`."""

    joint_q: torch.Tensor  # (19, num_worlds) as `LoopState.q`
    joint_qd: torch.Tensor  # (18, num_worlds) as `LoopState.qd`
    torque: torch.Tensor  # (12, num_worlds) [N m]
    paw_force: torch.Tensor  # (4, num_worlds, 3) [N] last physics step, world axes
    peak_force: torch.Tensor  # (4, num_worlds) [N]
    action: torch.Tensor  # (12, num_worlds), as the two below
    prev_action: torch.Tensor
    prev_prev_action: torch.Tensor
    target: torch.Tensor  # (12, num_worlds) [rad] before the command filter
    filtered_target: torch.Tensor  # (12, num_worlds) [rad]
    prev_rate: torch.Tensor  # (12, num_worlds) [rad/s]
    prev_lin_vel: torch.Tensor  # (3, num_worlds) [m/s]
    prev_torque: torch.Tensor  # (12, num_worlds) [N m]


def origin_velocity(q: torch.Tensor, qd: torch.Tensor, com: torch.Tensor) -> torch.Tensor:
    """Return the velocity of base origins [m/s], (3, num_worlds), world axes.

    q, qd: as in `LoopState`; com: (num_worlds, 3) [m] centre of mass of the base, in its frame.
    """
    quat = q[3:7].T
    axis, w = quat[:, :3], quat[:, 3:]
    twice = 2.0 * torch.linalg.cross(axis, com)
    arm = com + w * twice + torch.linalg.cross(axis, twice)  # in world axes
    return qd[:3] - torch.linalg.cross(qd[3:6].T, arm).T


class EnvGradients:
    """Context in which an environment's `step` returns rewards and observations with gradients, see `Env.gradients`.

    Attributes:
        state: `LoopState` after the last step. A world that was reset has no gradient.
        simulated: `LoopState` of the rollout before resets; it differs from `state` by rounding.
        reward_terms: Reward terms of the last step, weights applied, (rewards, num_worlds).
        arrays: Arrays of `RobotArrays` by name between physics and resets of the last step, and `states` of the task
            before it.
        shape: Numbers of rewards and of components of the policy's observation.
    """

    def __init__(self, env: Any) -> None:
        """Prepare the derivatives of the steps of an `Env`; compiles kernels that nothing else needs.

        Raises InputError: the environment has several tasks, another solver or moving blocks.
        """
        robots: Snapshot = env.snapshot()
        self.task = task = robots.tasks[0]
        if len(robots.tasks) > 1 or robots.solver != "SolverJumper":
            raise InputError("gradients need an environment of one task on SolverJumper")
        if robots.blocks:
            raise InputError("gradients need a ground without moving blocks: train with level ground")
        self.env = env
        self.num_worlds = env.num_envs
        self.rollout = Rollout(robots.model, task.motors, task.command_filter, dt=robots.dt, substeps=robots.substeps)
        self.kernel: Kernel = make_gradient_kernel(task)
        load_kernels([(self.kernel, BLOCK), (paw_gradient_kernel, BLOCK)], env.wp_device)
        self._skill = env.skills[0]
        self._randomizes = bool(task.params.slots["events"])  # Whether resets randomise the robots
        lateral, transversal = (math.radians(scale) for scale in task.action_scale)
        self._scale = torch.tensor(4 * [lateral, transversal, transversal], device=env.device)[:, None]
        self._columns = self._column_indices()
        self.shape = len(task.rewards), len(self._columns["newest"])
        self._is_delayed = bool(self._columns["delayed"].any())
        self.read_parameters()

    def _column_indices(self) -> dict[str, torch.Tensor]:
        """Return columns and settings of the policy's observation, by component and by earlier value, as int64.

        A term has adjacent columns: all components of its oldest frame, and so on to its newest. Entries by component,
        (components,), in the order of the terms:

        newest: column of the component's newest frame.
        scale, clip: index of the scale [1 / unit of the term], and of the limit [unit of the term], in `params.values`.
        delayed: 1 where the sensor's latency applies, else 0.

        Entries by value of an earlier frame, (columns - components,):

        older: column of the value.
        source: column of the same component one frame later, from which the value moves to `older` in a step.
        """
        layout = self.task.layout("actor")
        columns: dict[str, list[int]] = {name: [] for name in ("newest", "scale", "clip", "delayed", "older", "source")}
        for slot in self.task.params.slots["observations.actor"]:
            first, end = layout[slot.term.name]
            width = slot.term.width
            columns["newest"] += range(end - width, end)
            columns["older"] += range(first, end - width)
            columns["source"] += range(first + width, end)
            for name in ("scale", "clip", "delayed"):
                columns[name] += width * [int(getattr(slot, name))]
        return {name: torch.tensor(values, device=self.env.device).long() for name, values in columns.items()}

    def __enter__(self) -> EnvGradients:
        """Begin: the next step's gradients end at the environment's current state."""
        if self.env.gradients_of_step is not None:
            raise InputError("gradients of this environment are in use already")
        self.env.gradients_of_step = self
        self.restart()
        return self

    def __exit__(self, *error: object) -> None:
        """Let `step` return values without gradients again."""
        self.env.gradients_of_step = None

    def restart(self) -> None:
        """Begin at the environment's current state, without gradients; its resets call this."""
        self.read_parameters()
        self.state = self._state_of_env()
        self.simulated = self.state
        zero = torch.zeros_like(self.env.obs)
        self._obs = zero  # Derivatives of the last observation, of value 0
        self._raw = RING * [zero[:, : self.shape[1]]]  # of the last values of terms, newest first

    def read_parameters(self) -> dict[str, torch.Tensor]:
        """Copy the environment's robot parameters, such as masses, into the differentiable rollout, and return copies.

        By name, shapes as in `Rollout.parameters`.
        """
        robots: Snapshot = self.env.snapshot()
        parameters = {name: tensor.clone() for name, tensor in robots.parameters.items()}
        for name, tensor in parameters.items():
            wp.to_torch(self.rollout.parameters[name]).copy_(tensor)
        self.com = robots.com.clone()
        return parameters

    def _state_of_env(self) -> LoopState:
        """Return a copy of the environment's current state, without gradients."""
        env: Snapshot = self.env.snapshot()
        previous = wp.to_torch(self.env.robot.prev_action)
        parts = (env.q, env.qd, env.initial_target, env.impulse, env.action, previous, env.torque)
        return LoopState(*(part.clone() for part in parts))

    # ------------------------------------------------------------------ a step

    def _record(self) -> None:
        """Copy the arrays of the robots, and the state of the task, between physics and rewards of a step."""
        self.arrays = {name: wp.clone(getattr(self.env.robot, name)) for name in RobotArrays.vars if name not in SHARED}
        self.arrays["states"] = wp.clone(self._skill.states)

    def step(self, action: torch.Tensor) -> Any:
        """Step the environment, and return its `Step` with gradients; see `Env.gradients`."""
        env = self.env
        before = self.state
        parameters = self.read_parameters() if self._randomizes else {}
        com = self.com
        values = env.step_values(action, self._record)
        wrench = wp.to_torch(self.arrays.pop("body_f")).view(self.num_worlds, -1, 6)[:, 0].T
        clamped = action.clamp(-1.0, 1.0).T
        default = wp.to_torch(env.robot.default_angle)[:, None]
        targets = clamped * self._scale + default
        trajectory = simulate(
            self.rollout, targets[None], before.q, before.qd, initial_target=before.initial_target,
            impulse=before.impulse.detach(), wrench=wrench[None], trusted=True, **parameters,
        )  # fmt: skip
        end = LoopState(**trajectory.end(), action=clamped, prev_action=before.action, torque=trajectory.torque[-1])
        begun = wp.to_torch(env.episodes.history_reset) == BEGUN
        inputs = self._inputs(before, end, trajectory, targets, com)
        kept = wp.to_torch(env.episodes.diverged) == 0
        terms, raw = _Terms.apply(self, self.arrays, kept, *inputs)
        self.simulated = end
        self.state = self._next_state(end, begun)
        obs = {**values.obs, "actor": values.obs["actor"] + self._observation(raw, begun)}
        return values._replace(obs=obs, reward=values.reward + self._reward(terms))

    def evaluate(self, arrays: dict[str, wp.array]) -> tuple[wp.array, wp.array]:
        """Return rewards (rewards, num_worlds) and observation terms (components, num_worlds) of recorded arrays.

        arrays: see `arrays`; those of the paws are computed from the joint coordinates and rates.
        """
        robot = self._struct(arrays)
        rewards, components = (wp.zeros((rows, self.num_worlds), dtype=float, device=robot.torque.device)
                               for rows in self.shape)  # fmt: skip
        for kernel, dim, inputs, outputs in (
            (paw_gradient_kernel, (4, self.num_worlds), self._paw_inputs(robot), [arrays[name] for name in PAWS]),
            (self.kernel, self.num_worlds, self._inputs_of_terms(robot, arrays), [rewards, components]),
        ):
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=rewards.device, block_dim=BLOCK)
        return rewards, components

    def reverse(
        self, arrays: dict[str, wp.array], by_terms: torch.Tensor, by_components: torch.Tensor,
        numbers: torch.Tensor | None = None,
    ) -> dict[str, wp.array]:  # fmt: skip
        """Return gradients w.r.t. the arrays of `StepInputs` by name, from those w.r.t. the results of `evaluate`.

        numbers: of the task's terms, by default the environment's; a reward of weight 0 is skipped.
        """
        grads: dict[str, Any] = {}
        for name in (*StepInputs._fields, *PAWS):
            arrays[name].requires_grad = True
            grads[name] = arrays[name].grad
            grads[name].zero_()
        robot = self._struct(arrays)
        outputs = [wp.from_torch(grad.contiguous()) for grad in (by_terms, by_components)]
        for kernel, dim, inputs, by_outputs in (
            (self.kernel, self.num_worlds, self._inputs_of_terms(robot, arrays, numbers), outputs),
            (paw_gradient_kernel, (4, self.num_worlds), self._paw_inputs(robot), [grads[name] for name in PAWS]),
        ):
            wp.launch(
                kernel, dim=dim, inputs=inputs, outputs=[wp.empty_like(grad) for grad in by_outputs], adjoint=True,
                adj_inputs=[None if isinstance(each, wp.array) else each for each in inputs], adj_outputs=by_outputs,
                device=robot.torque.device, block_dim=BLOCK,
            )  # fmt: skip
        return grads

    def _struct(self, arrays: dict[str, wp.array]) -> KernelStruct:
        """Return recorded arrays, and the environment's others, as the kernels' `RobotArrays`."""
        robot: KernelStruct = RobotArrays()
        for name in RobotArrays.vars:
            setattr(robot, name, arrays.get(name, getattr(self.env.robot, name)))
        return robot

    def _inputs_of_terms(
        self, robot: KernelStruct, arrays: dict[str, wp.array], numbers: torch.Tensor | None = None
    ) -> list:
        """Return the inputs of the kernel of the task's terms."""
        values = self._skill.params.values if numbers is None else wp.from_torch(numbers)
        return [robot, self.env._scene.ground, arrays["states"], values]

    def _paw_inputs(self, robot: KernelStruct) -> list:
        """Return the inputs of the kernel of the paws' motion."""
        return [self.env._scene.geometry, self.env._scene.ground, robot]

    def _inputs(
        self, before: LoopState, end: LoopState, trajectory: TorchTrajectory, targets: torch.Tensor, com: torch.Tensor
    ) -> StepInputs:
        """Return what rewards and observations of a step depend on; com: as in `origin_velocity`."""
        force = trajectory.impulse / self.rollout.dt
        return StepInputs(
            end.q, end.qd, end.torque, force[-1], force.norm(dim=-1).amax(0), end.action, before.action,
            before.prev_action, targets, end.initial_target[-1], before.qd[6:],
            origin_velocity(before.q, before.qd, com), before.torque,
        )  # fmt: skip

    def _next_state(self, end: LoopState, begun: torch.Tensor) -> LoopState:
        """Return the environment's state with the derivatives of the rollout's; none where an episode began."""
        parts = []
        for name, value, computed in zip(LoopState._fields, self._state_of_env(), end, strict=True):
            mask = begun[None, :, None] if name == "impulse" else begun[None]
            parts.append(torch.where(mask, value, value + (computed - computed.detach())))
        return LoopState(*parts)

    def _reward(self, terms: torch.Tensor) -> torch.Tensor:
        """Return the derivatives of the reward, of value 0; terms: those of its terms."""
        values = wp.to_torch(self._skill.term_value)[: len(terms)]
        self.reward_terms = values + terms
        counted = torch.where(values.isfinite(), terms, 0.0).sum(0)
        floor = self.task.reward_floor
        return counted if floor is None else torch.where(values.nansum(0) > floor, counted, 0.0)

    def _observation(self, raw: torch.Tensor, begun: torch.Tensor) -> torch.Tensor:
        """Return the derivatives of the policy's observation, of value 0, from those of its terms.

        A clipped component has none, and none is left where an episode has begun.
        """
        columns = self._columns
        numbers = wp.to_torch(self._skill.params.values)
        self._raw = [torch.where(begun[:, None], 0.0, past) for past in (raw.T, *self._raw[: RING - 1])]
        value = self._raw[0]
        if self._is_delayed:
            value = torch.where(columns["delayed"] > 0, self._delayed(), value)
        scale = numbers[columns["scale"]]
        limit = scale.abs() * numbers[columns["clip"]]
        unclipped = self.env.obs[:, columns["newest"]].abs() < limit
        obs = torch.zeros_like(self.env.obs)
        obs = obs.index_copy(1, columns["newest"], torch.where(unclipped, scale * value, 0.0))
        obs = obs.index_copy(1, columns["older"], self._obs[:, columns["source"]])
        self._obs = torch.where(begun[:, None], 0.0, obs)
        return self._obs

    def _delayed(self) -> torch.Tensor:
        """Return the last values of terms, (num_worlds, components), delayed by each world's latency."""
        arrays = self._skill.observations
        latency = wp.to_torch(arrays.latency).long()
        steps = latency // arrays.substeps
        fraction = ((latency - steps * arrays.substeps).float() / arrays.substeps)[:, None]
        past = torch.stack(self._raw)
        worlds = torch.arange(self.num_worlds, device=latency.device)
        return torch.lerp(past[steps, worlds], past[steps + 1, worlds], fraction)


class _Terms(torch.autograd.Function):
    """Rewards and observation terms of a step, of value 0, whose reverse pass is the kernels'."""

    @staticmethod
    def forward(
        ctx: Any, gradients: EnvGradients, arrays: dict[str, wp.array], kept: torch.Tensor, *inputs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Keep the recorded values for the reverse pass; kept: (num_worlds,) worlds that did not diverge.

        arrays: see `EnvGradients.arrays`.
        """
        ctx.gradients = gradients
        ctx.arrays = arrays
        ctx.kept = kept
        ctx.numbers = wp.to_torch(gradients._skill.params.values).clone()  # `Env.set` may change them
        rewards, components = gradients.shape
        return inputs[0].new_zeros(rewards, len(kept)), inputs[0].new_zeros(components, len(kept))

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple:
        """Return the gradients w.r.t. `StepInputs`; grads: w.r.t. rewards and observation terms."""
        if torch.is_grad_enabled():  # as `create_graph` sets it
            raise InputError("an environment's steps have no second derivatives: create_graph must be False")
        n = len(ctx.kept)
        with WARP_LOCK:
            kept = (torch.where(ctx.kept, grad, 0.0) for grad in grads)
            by_arrays = ctx.gradients.reverse(ctx.arrays, *kept, numbers=ctx.numbers)
        by_inputs = []
        for name in StepInputs._fields:
            grad = wp.to_torch(by_arrays[name])
            if name in ("joint_q", "joint_qd"):
                grad = compact_columns(grad.view(n, -1), 7 if name == "joint_q" else 6)
            grad = grad.T if name == "prev_lin_vel" else grad
            by_inputs.append(torch.where(ctx.kept[:, None] if grad.ndim == 3 else ctx.kept, grad, 0.0))
        return (None, None, None, *by_inputs)
