"""Misses of many jumps at once, and their derivatives by the weights of the policy.

Whole jumps go through physics, motors, latency, command filter and network, simulated as in an evaluation; derivatives
reach from the apex back to the command. The apex is a smooth function of the push; contact after it is left out: that
of a landing place is the derivative of where the projectile comes down, its value where the robot stood in the end.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch

from jumper_warp.diff.closed_loop import ClosedLoop, LoopState
from jumper_warp.envs.env import Env
from jumper_warp.evaluation.jumps import LANDED, REST_TIME
from jumper_warp.trajectory.gauss_newton import Network, Tape, per_world_gradients

LANDING_HEIGHT = 0.30
"""[m] Of the base, where its projectile comes down."""
LATEST = 2.5
"""[s] After the last command, by when all jumps are past their apex."""
HUBER = 0.02
"""[m] Misses beyond count less: of jumps that a weak robot cannot make."""


class Misses(NamedTuple):
    """Of one group of jumps."""

    value: torch.Tensor
    """(n,) [m] Of a jump to a place ahead first, then to the left: (2n,)."""
    rows: torch.Tensor
    """(n, weights) [m] Derivatives; empty if none were asked for."""
    valid: torch.Tensor
    """(n,) Whether the jump took off."""


@dataclass
class Group:
    """Jumps in one environment."""

    name: str
    env: Env
    std: float
    commands: np.ndarray
    to_height: bool
    """Whether the apex is what misses, not the place."""
    loop: ClosedLoop = field(init=False)

    def __post_init__(self) -> None:
        """Keep the environment's state, so that every run draws the same robots."""
        self._fresh = self.env.state_dict()
        self.loop = ClosedLoop(self.env)

    def begin(self) -> None:
        """Stand all robots at their start."""
        self.env.load_state_dict(self._fresh)
        self.env.evaluation_reset(self.commands)
        self.loop.read_parameters()

    def importance(self, misses: Misses) -> torch.Tensor:
        """Return the weights of the misses: Huber's, over the variance that the group may have."""
        huber = (HUBER / misses.value.abs().clamp(min=1.0e-9)).clamp(max=1.0)
        return torch.where(misses.valid, huber, 0.0) / (self.std**2 * len(misses.value))


def apex_of(loop: ClosedLoop, states: list[LoopState], arrays: dict[str, np.ndarray]) -> list[torch.Tensor]:
    """Return the base heights at the apex [m], (n,), as one list entry."""
    heights = torch.stack([state.q[2] for state in states])
    reached = torch.as_tensor(arrays["max_height"], dtype=heights.dtype, device=heights.device)
    row = (heights.detach() - reached).abs().argmin(0, keepdim=True)
    return [heights.gather(0, row)[0]]


def place_of(loop: ClosedLoop, states: list[LoopState], arrays: dict[str, np.ndarray]) -> list[torch.Tensor]:
    """Return where the base's projectile comes down, x and y [m], (n,) each, seen from the apex."""
    reached = torch.as_tensor(arrays["max_height"], device=states[0].q.device)
    row = (torch.stack([state.q[2].detach() for state in states]) - reached).abs().argmin(0)
    motions = [loop.motion(state) for state in states]
    pos, vel = (torch.stack([getattr(motion, name) for motion in motions]) for name in ("pos", "lin_vel"))
    worlds = torch.arange(len(row), device=row.device)
    pos, vel = pos[row, worlds], vel[row, worlds]
    g = loop.task.gravity
    fall = (vel[:, 2] + (vel[:, 2].square() + 2.0 * g * (pos[:, 2] - LANDING_HEIGHT).clamp(min=0.0)).sqrt()) / g
    return [pos[:, i] + fall * vel[:, i] for i in range(2)]


def follow(group: Group, network: Network, *, derivatives: bool) -> Misses:
    """Let all robots of a group jump; return their misses."""
    env, loop, to_height = group.env, group.loop, group.to_height
    group.begin()
    begin, last = int(group.commands[:, 3].min()), int(group.commands[:, 3].max()) + round(LATEST / env.step_dt)
    with torch.no_grad():
        for _ in range(begin):
            env.step(network.act(env.obs))
    state, states, tape = loop.state(), [], Tape()
    arrays: dict[str, np.ndarray] = {}
    for _ in range(begin, last):
        if derivatives:
            state, _ = loop.step(state, network.act(loop.observation(state), tape=tape))
        else:
            env.step(network.act(env.obs))
            state = loop.state()
        states.append(state)
        arrays = env.task_arrays()
        if (arrays["apex_passed"] > 0)[arrays["phase"] > 0].all() and (arrays["phase"] > 0).all():
            break
    valid = torch.as_tensor(arrays["phase"] > 0, device=env.device)
    if to_height:
        found = [arrays["max_height"] - group.commands[:, 2]]
    else:
        found = _final_miss(env, network)
    value = torch.as_tensor(np.concatenate(found), dtype=loop.dtype, device=env.device)
    valid = valid.repeat(len(found)) & value.isfinite()
    rows = value.new_zeros(0)
    if derivatives:
        numbers = (apex_of if to_height else place_of)(loop, states, arrays)
        rows = torch.cat([per_world_gradients(number.sum(), tape) for number in numbers]).nan_to_num(0.0, 0.0, 0.0)
    return Misses(torch.where(valid, value, 0.0), rows, valid)


def _final_miss(env: Env, network: Network) -> list[np.ndarray]:
    """Go on until the robots have had a second to come to rest, which on Mars takes a fall of up to 1.4 s besides.

    Returns how far they are from their goals, x and y.
    """
    rest = round(REST_TIME / env.step_dt)
    with torch.no_grad():
        for _ in range(3 * rest):
            arrays = env.task_arrays()
            if ((arrays["phase"] == LANDED) & (arrays["phase_steps"] >= rest)).all():
                break
            env.step(network.act(env.obs))
    arrays = env.task_arrays()
    return [arrays["base_pos"][:, i] - arrays["goal"][:, i] for i in range(2)]
