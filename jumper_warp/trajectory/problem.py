"""Trajectory optimisation problems: motor targets, an objective and constraints, with gradients of the simulation.

Targets are knots over time, interpolated to policy steps. Every candidate is a world of one rollout. A problem is

    minimise f(x)  subject to  c(x) <= 0,  lower <= x <= upper,

with f and c functions of the simulated motion (see `jumper_warp.trajectory.jumps`).
`jumper_warp.trajectory.augmented_lagrangian.minimise` solves it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch

from jumper_warp.diff.rollout import Rollout
from jumper_warp.diff.torch_rollout import TorchTrajectory, simulate
from jumper_warp.robot.gravity import EARTH
from jumper_warp.robot.model import PHYSICS_DT, build_model
from jumper_warp.robot.motors import FilterCfg, MotorCfg, jumping_motors
from jumper_warp.sim.simulation import SUBSTEPS
from jumper_warp.trajectory.whole_body import Momentum, WholeBody
from jumper_warp.utils.errors import InputError

CONTACT_FORCE = 0.1
"""[N] Force above which a paw is in contact."""


@dataclass(frozen=True)
class Knots:
    """Parametrisation of motor targets: actions within ±1 at knots, linear in between, the last held to the end."""

    at: tuple[float, ...]
    """Policy steps of the knots, rising from 0."""
    steps: int
    """Policy steps of the motion."""
    scale: tuple[float, float] = (15.0, 90.0)
    """[deg] Of an action of 1, lateral and transversal motors."""
    middle: tuple[float, float] = (0.0, 45.0)
    """[deg] Of an action of 0."""
    symmetric: bool = True
    """True: left and right are equal and lateral motors at 0; False: all twelve motors are free."""

    def __post_init__(self) -> None:
        """Raises InputError: knots that do not rise from 0, or beyond the motion."""
        rise = len(self.at) > 1 and self.at[0] == 0.0 and bool(np.all(np.diff(self.at) > 0.0))
        if not rise or not max(self.at) < self.steps:
            raise InputError(f"knots must rise from 0 and end before step {self.steps}, got {self.at}")

    @property
    def motors(self) -> int:
        """Number of actions of a knot: front outer, front inner, hind outer, hind inner; or all motors."""
        return 4 if self.symmetric else 12

    def __len__(self) -> int:
        """Return the number of variables of a candidate."""
        return len(self.at) * self.motors

    @cached_property
    def weights(self) -> np.ndarray:
        """Interpolation weights of the knots at each policy step, (steps, knots)."""
        return np.stack([np.interp(np.arange(self.steps), self.at, unit) for unit in np.eye(len(self.at))], axis=1)

    def targets(self, x: torch.Tensor) -> torch.Tensor:
        """Return targets [rad] (steps, 12, n) of candidates (n, len(self))."""
        weights = torch.as_tensor(self.weights, dtype=x.dtype, device=x.device)
        actions = torch.einsum("tk,nkm->tmn", weights, x.unflatten(1, (len(self.at), self.motors)))
        if self.symmetric:
            front, hind = actions[:, :2], actions[:, 2:]
            lateral = torch.zeros_like(front[:, :1])
            actions = torch.cat([lateral, front, lateral, front, lateral, hind, lateral, hind], dim=1)
        scale, middle = (
            x.new_tensor(np.tile(np.radians([pair[0], pair[1], pair[1]]), 4))[:, None]
            for pair in (self.scale, self.middle)
        )
        return middle + scale * actions


class SimulatedMotion:
    """Motion of `num` worlds with derived quantities, which are computed once; row 0 is the start.

    Rows are policy steps, coordinates last.
    """

    def __init__(self, trajectory: TorchTrajectory, body: WholeBody, rollout: Rollout, gravity: float, start: Momentum):
        self.trajectory, self.body, self.gravity, self.start = trajectory, body, gravity, start
        """gravity [m/s^2]: downward; start: momentum at the start, without gradients."""
        self._cache: dict[Any, Any] = {}
        self.dt, self.substeps = rollout.dt, rollout.substeps
        self.q, self.qd = trajectory.q.movedim(1, -1), trajectory.qd.movedim(1, -1)
        """(steps + 1, num, 19) and (steps + 1, num, 18), see `Trajectory`."""
        self.num = self.q.shape[1]

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return `make()`, computed once per key and shared by terms."""
        if key not in self._cache:
            self._cache[key] = make()
        return self._cache[key]

    @cached_property
    def points(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions of the legs' joints and ankles [m], (steps + 1, num, ...), see `WholeBody.points`."""
        return self.body.points(self.q)

    @property
    def ankles(self) -> torch.Tensor:
        """Centres of the paws [m], (steps + 1, num, 4, 3)."""
        return self.points[1]

    @cached_property
    def clearance(self) -> torch.Tensor:
        """Distances of links from the ground [m], (steps + 1, num, 4, 4), see `WholeBody.clearance`."""
        return self.body.clearance_of(self.q, *self.points)

    @cached_property
    def down(self) -> torch.Tensor:
        """Whether each paw is in contact at the end of each policy step, bool (steps, 4, num)."""
        impulse = self.trajectory.impulse.detach()[self.substeps - 1 :: self.substeps]
        return torch.linalg.vector_norm(impulse, dim=-1) > CONTACT_FORCE * self.dt

    @cached_property
    def positive_work(self) -> torch.Tensor:
        """Positive work of the motors [J] until each policy step, (steps, num).

        Torques are those of every physics step, rates interpolated within the policy step.
        """
        torque = self.trajectory.torque.unflatten(0, (-1, self.substeps))
        ends = self.qd[..., 6:].movedim(-1, 1)
        share = (torch.arange(self.substeps, device=torque.device) + 0.5) / self.substeps
        share = share.to(torque.dtype)[:, None, None]
        rate = ends[:-1, None] + share * (ends[1:] - ends[:-1])[:, None]
        return (self.dt * (torque * rate).clamp_min(0.0)).sum((1, 2)).cumsum(0)

    def takeoff(self, speed: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the row of takeoff (num,), the last row where there is none, and whether there is one, bool (num,).

        Takeoff as in the jumps' tasks: no paw in contact and the base rising faster than `speed` [m/s].
        """
        return self.once(("takeoff", speed), lambda: self._takeoff(speed))

    def _takeoff(self, speed: float) -> tuple[torch.Tensor, torch.Tensor]:
        free = ~self.down.any(dim=1) & (self.base_velocity[1:, :, 2].detach() > speed)
        steps = free.shape[0]
        row = torch.where(free.any(0), free.int().argmax(0) + 1, steps)
        return row, free.any(0)

    @cached_property
    def base_velocity(self) -> torch.Tensor:
        """Velocity of the base's origin [m/s], (steps + 1, num, 3)."""
        return self.body.base_velocity(self.q, self.qd)

    def momentum_at(self, row: torch.Tensor) -> Momentum:
        """Return the momentum at a row of each world, (num,)."""
        worlds = torch.arange(self.num, device=row.device)
        return self.body.momentum(self.q[row, worlds], self.qd[row, worlds])

    def momentum_at_takeoff(self, speed: float) -> Momentum:
        """Return the momentum at takeoff, see `takeoff`."""
        return self.once(("momentum", speed), lambda: self.momentum_at(self.takeoff(speed)[0]))


Term = Callable[[SimulatedMotion], torch.Tensor]
"""Returns an objective (num,), or constraints (..., num) that must be <= 0, scaled to about 1."""


class Values(NamedTuple):
    """Objective and constraints of n candidates."""

    objective: torch.Tensor
    """(n,)"""
    constraints: torch.Tensor
    """(n, m) Satisfied where <= 0."""


class _Worlds(NamedTuple):
    """Rollout and start of n candidates, standing in the default pose."""

    rollout: Rollout
    body: WholeBody
    q: torch.Tensor
    """(19, n)"""
    qd: torch.Tensor
    """(18, n)"""
    start: Momentum
    """At the start."""


@dataclass
class Problem:
    """Optimisation problem of a motion that starts from standing in the default pose."""

    knots: Knots
    objective: Term
    constraints: Sequence[Term] = ()
    motors: MotorCfg = field(default_factory=jumping_motors)
    command_filter: FilterCfg | None = None
    friction: float = 0.85
    """[1] Of the paws."""
    gravity: float = EARTH
    """[m/s^2] Downward."""
    substeps: int = SUBSTEPS
    """Physics steps in a policy step; fewer are faster and coarser."""
    double: bool = True
    """Whether to compute in double precision."""
    tolerance: float | None = 1.0e-9
    """[m/s] Of the contact iteration."""
    device: Any = None
    threads: int | None = None
    world_steps: int = field(default=0, init=False)
    """Simulated policy steps so far, worlds times steps."""
    reverse_steps: int = field(default=0, init=False)
    """Policy steps of reverse passes so far, worlds times steps."""

    def __post_init__(self) -> None:
        """Start without worlds."""
        self._worlds: dict[int, _Worlds] = {}

    def rollout(self, num_worlds: int) -> Rollout:
        """Return the rollout of a number of worlds, made at first use."""
        return self._worlds_of(num_worlds).rollout

    def _worlds_of(self, num_worlds: int) -> _Worlds:
        """Return rollout and start of a number of worlds, made at first use."""
        if num_worlds not in self._worlds:
            model = build_model(
                num_worlds, visuals=False, friction=self.friction, gravity=self.gravity, device=self.device
            )
            rollout = Rollout(
                model, self.motors, self.command_filter, double=self.double, tolerance=self.tolerance,
                dt=PHYSICS_DT * SUBSTEPS / self.substeps, substeps=self.substeps, threads=self.threads,
            )  # fmt: skip
            body, real = WholeBody(rollout), torch.float64 if self.double else torch.float32
            q, qd = (torch.as_tensor(array, dtype=real, device=str(rollout.device)) for array in rollout.standing())
            self._worlds[num_worlds] = _Worlds(rollout, body, q, qd, body.momentum(q.T, qd.T))
        return self._worlds[num_worlds]

    def motion(self, x: torch.Tensor) -> SimulatedMotion:
        """Return the simulated motion of candidates (n, len(knots)), differentiable by x."""
        rollout, body, q, qd, start = self._worlds_of(len(x))
        targets = self.knots.targets(x)
        self.world_steps += targets.shape[0] * len(x)
        return SimulatedMotion(simulate(rollout, targets, q, qd, trusted=True), body, rollout, self.gravity, start)

    def motion_of(self, trajectory: TorchTrajectory) -> SimulatedMotion:
        """Return the motion of a trajectory of one world from another simulation of the same robot."""
        rollout, body, _, _, start = self._worlds_of(1)
        return SimulatedMotion(trajectory, body, rollout, self.gravity, start)

    def evaluate(self, x: torch.Tensor) -> Values:
        """Return objective and constraints of candidates (n, len(knots)), see `values`."""
        return self.values(self.motion(x))

    def values(self, motion: SimulatedMotion) -> Values:
        """Return objective and constraints of a motion; a diverged world has an infinite objective."""
        objective = self.objective(motion)
        rows = [term(motion).reshape(-1, motion.num) for term in self.constraints]
        constraints = torch.cat(rows).T if rows else objective.new_zeros(motion.num, 0)
        diverged = ~(objective.isfinite() & constraints.isfinite().all(1))
        return Values(torch.where(diverged, torch.inf, objective), torch.where(diverged[:, None], 0.0, constraints))

    def gradient(self, x: torch.Tensor, merit: Callable[[Values], torch.Tensor]) -> tuple[Values, torch.Tensor]:
        """Return the values of candidates and the gradient of their merit, (n, len(knots)), zero where they diverge.

        merit: function of `Values` to minimise, returns (n,).
        """
        x = x.detach().requires_grad_()
        values = self.evaluate(x)
        merits = merit(values)
        gradient = torch.autograd.grad(merits[merits.isfinite()].sum(), x)[0]
        self.reverse_steps += self.knots.steps * len(x)
        return Values(*(value.detach() for value in values)), torch.nan_to_num(gradient, 0.0, 0.0, 0.0)
