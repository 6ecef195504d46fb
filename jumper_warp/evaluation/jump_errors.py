"""Errors of jumps (apex height or landing position), and their derivatives with respect to the policy's weights.

Whole jumps are simulated with physics, motors, latency, command filter and network, as in an evaluation. Derivatives
reach from the apex back to the command; contact after the apex is omitted. A landing error is evaluated where the robot
comes to rest; its derivative is that of the landing point of the ballistic flight from the apex.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch

from jumper_warp.envs.env import Env
from jumper_warp.envs.gradients import EnvGradients, LoopState, origin_velocity
from jumper_warp.evaluation.jumps import LANDED, REST_TIME, updated_apex
from jumper_warp.trajectory.gauss_newton import Network, Tape, per_world_gradients
from jumper_warp.utils.progress import phase

LANDING_HEIGHT = 0.30  # [m] Base height at which the ballistic flight lands
LATEST = 2.5  # [s] Time after the last command at which all jumps are past their apex
DESCENT = 0.05  # [m] Descent from the largest height in flight after which no base rises above it again
HUBER = 0.02  # [m] Threshold of the Huber weight: larger errors, as of robots too weak for a jump, count less


class JumpErrors(NamedTuple):
    """Errors of n jumps in apex height or landing position, and their derivatives w.r.t. the network's weights.

    m = n for apex heights, m = 2n for landing positions (all x, then all y, world).
    """

    value: torch.Tensor  # (m,) [m] Errors, 0 where not valid
    jacobian: torch.Tensor  # (m, weights) [m] Derivatives with respect to the network's weights; empty if not requested
    valid: torch.Tensor  # (m,) Whether the jump took off and its error is finite


@dataclass
class JumpGroup:
    """Environment of robots that make one jump each, with fixed commands."""

    name: str  # Name of the group in logs and records
    env: Env  # Environment of n worlds, one jump each
    std: float  # [m] Standard deviation that weights the errors
    commands: np.ndarray  # (n, 4) Commands of `jump_commands`
    to_height: bool  # Whether the error is that of the apex height, else of the landing position
    gradients: EnvGradients = field(init=False)  # Of the environment's steps

    def __post_init__(self) -> None:
        """Save the environment's state, from which every run of the jumps begins with the same robots."""
        self._initial_state = self.env.state_dict()
        self.gradients = self.env.gradients()

    def begin(self) -> None:
        """Reset all robots to their state when the group was made, and command their jumps."""
        self.env.load_state_dict(self._initial_state)
        self.env.evaluation_reset(self.commands)

    def importance(self, errors: JumpErrors) -> torch.Tensor:
        """Return the weights (m,) that the errors of the jumps have in the cost that fine-tuning reduces.

        A weight is the Huber weight / (std² · number of errors), 0 for an invalid jump.
        """
        huber = (HUBER / errors.value.abs().clamp(min=1.0e-9)).clamp(max=1.0)
        return torch.where(errors.valid, huber, 0.0) / (self.std**2 * len(errors.value))


def ballistic_landing(gradients: EnvGradients, states: list[LoopState], steps: torch.Tensor) -> list[torch.Tensor]:
    """Return x and y [m] of the landing points of ballistic flights from the jumps' apexes, (n,) each, differentiable.

    World frame; the base lands at LANDING_HEIGHT. states: of every policy step; steps: indices of the apexes in them,
    (n,).
    """
    worlds = torch.arange(len(steps), device=steps.device)
    q, qd = (torch.stack([getattr(state, name) for state in states])[steps, :, worlds].T for name in ("q", "qd"))
    pos, vel = q[:3], origin_velocity(q, qd, gradients.com)
    g = gradients.task.gravity
    drop = (pos[2] - LANDING_HEIGHT).clamp(min=0.0)
    fall_time = (vel[2] + (vel[2].square() + 2.0 * g * drop).sqrt()) / g
    return [pos[i] + fall_time * vel[i] for i in range(2)]


def jump_errors(group: JumpGroup, network: Network, *, derivatives: bool) -> JumpErrors:
    """Simulate the jumps of a group under a network's actions, and return their errors; derivatives: with Jacobian."""
    env = group.env
    gradients = group.gradients
    to_height = group.to_height
    group.begin()
    begin = int(group.commands[:, 3].min())
    last = int(group.commands[:, 3].max()) + round(LATEST / env.step_dt)
    with torch.no_grad():
        for _ in range(begin):
            env.step(network.act(env.obs))
    states = []
    tape = Tape()
    obs = env.obs
    arrays: dict[str, np.ndarray] = {}
    apex = np.full(len(group.commands), np.nan)
    apex_step = np.zeros(len(group.commands), dtype=np.int64)
    name = f"{len(group.commands)} {group.name} jumps"
    with phase(f"simulating {name}", last - begin) as advance, gradients if derivatives else torch.no_grad():
        for step in range(last - begin):
            obs = env.step(network.act(obs, tape=tape if derivatives else None)).obs["actor"]
            if derivatives:
                states.append(gradients.state)
            arrays = env.task_arrays()
            earlier = apex
            apex = updated_apex(earlier, arrays)
            apex_step[apex != earlier] = step
            if ((arrays["phase"] == LANDED) | (apex - arrays["base_pos"][:, 2] > DESCENT)).all():
                break
            advance()
    valid = torch.as_tensor(arrays["phase"] > 0, device=env.device)
    if to_height:
        errors = [apex - group.commands[:, 2]]
    else:
        errors = _landing_errors(env, network)
    value = torch.as_tensor(np.concatenate(errors), dtype=torch.float32, device=env.device)
    valid = valid.repeat(len(errors)) & value.isfinite()
    jacobian = value.new_zeros(0)
    if derivatives:
        steps = torch.as_tensor(apex_step, device=env.device)
        heights = torch.stack([state.q[2] for state in states]).gather(0, steps[None])
        outcomes = [heights[0]] if to_height else ballistic_landing(gradients, states, steps)
        rows = [per_world_gradients(outcome.sum(), tape) for outcome in outcomes]
        jacobian = torch.cat(rows).nan_to_num(0.0, 0.0, 0.0)
    return JumpErrors(torch.where(valid, value, 0.0), jacobian, valid)


def _landing_errors(env: Env, network: Network) -> list[np.ndarray]:
    """Continue the jumps until REST_TIME after touchdown; return the bases' distances from the goals [m].

    The result is [x, y], (n,) each: base minus goal, world axes.
    """
    rest = round(REST_TIME / env.step_dt)
    with torch.no_grad():
        for _ in range(3 * rest):  # on Mars the fall from the apex takes up to 1.4 s
            arrays = env.task_arrays()
            if ((arrays["phase"] == LANDED) & (arrays["phase_steps"] >= rest)).all():
                break
            env.step(network.act(env.obs))
    arrays = env.task_arrays()
    return [arrays["base_pos"][:, i] - arrays["goal"][:, i] for i in range(2)]
