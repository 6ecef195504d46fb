"""Optimisation problems of motor targets over time, with gradients that are computed through the simulation.

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

CONTACT_FORCE = 0.1  # [N] force above which a paw is in contact


@dataclass(frozen=True)
class Knots:
    """Parametrisation of motor targets over time: actions within ±1 at knots, interpolated linearly between them."""

    at: tuple[float, ...]  # Policy steps of the knots, rising from 0
    steps: int  # Policy steps of the motion
    scale: tuple[float, float] = (15.0, 90.0)
    """[deg] Change of the target by an action of 1: lateral motors, transversal motors."""
    middle: tuple[float, float] = (0.0, 45.0)  # [deg] Target at an action of 0: lateral motors, transversal motors
    symmetric: bool = True
    """True: left and right legs are equal and lateral motors at 0; False: all twelve motors are free."""

    def __post_init__(self) -> None:
        """Raise InputError unless the times of the knots rise from 0 and end within the motion."""
        rise = len(self.at) > 1 and self.at[0] == 0.0 and bool(np.all(np.diff(self.at) > 0.0))
        if not rise or not max(self.at) < self.steps:
            raise InputError(f"knots must rise from 0 and end before step {self.steps}, got {self.at}")

    @property
    def motors(self) -> int:
        """Number of actions at a knot: 4 (front outer, front inner, hind outer, hind inner) if symmetric, else 12."""
        return 4 if self.symmetric else 12

    def __len__(self) -> int:
        """Return the number of variables of a candidate: knots times `motors`."""
        return len(self.at) * self.motors

    @cached_property
    def weights(self) -> np.ndarray:
        """Interpolation weights of the knots at each policy step, (steps, knots)."""
        return np.stack([np.interp(np.arange(self.steps), self.at, unit) for unit in np.eye(len(self.at))], axis=1)

    def targets(self, x: torch.Tensor) -> torch.Tensor:
        """Return motor targets [rad] (steps, 12, n) of candidates x (n, len(self)), actions within ±1.

        x: the `motors` actions of the first knot, then those of the second, and so forth.
        """
        weights = torch.as_tensor(self.weights, dtype=x.dtype, device=x.device)
        actions = torch.einsum("tk,nkm->tmn", weights, x.unflatten(1, (len(self.at), self.motors)))
        if self.symmetric:
            front = actions[:, :2]
            hind = actions[:, 2:]
            lateral = torch.zeros_like(front[:, :1])
            actions = torch.cat([lateral, front, lateral, front, lateral, hind, lateral, hind], dim=1)
        scale, middle = (
            x.new_tensor(np.tile(np.radians([pair[0], pair[1], pair[1]]), 4))[:, None]
            for pair in (self.scale, self.middle)
        )
        return middle + scale * actions


class SimulatedMotion:
    """Simulated motion of `num` worlds, and quantities derived from it, each computed once.

    Row 0 is the start, row i the end of policy step i; coordinates are last. Positions and velocities: world frame.
    """

    def __init__(self, trajectory: TorchTrajectory, body: WholeBody, rollout: Rollout, gravity: float, start: Momentum):
        """Wrap a trajectory; body: kinematics of the robot of `rollout`.

        Quantities are computed at first use and kept, since objective and constraints share them.
        """
        self.trajectory = trajectory
        self.body = body
        self.gravity = gravity
        self.start = start
        """gravity [m/s^2]: downward, positive; start: momentum in row 0, without gradients."""
        self._cache: dict[Any, Any] = {}
        self.dt, self.substeps = rollout.dt, rollout.substeps
        self.q = trajectory.q.movedim(1, -1)
        self.qd = trajectory.qd.movedim(1, -1)
        """(steps + 1, num, 19) and (steps + 1, num, 18), coordinates and rates as in `Trajectory`."""
        self.num = self.q.shape[1]

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return the result of `make` for a key, computed at the key's first call and then cached."""
        if key not in self._cache:
            self._cache[key] = make()
        return self._cache[key]

    @cached_property
    def points(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions of the links' origins and of the paws' centres [m] during the motion, see `WholeBody.points`."""
        return self.body.points(self.q)

    @property
    def ankles(self) -> torch.Tensor:
        """Centres of the paws FL, FR, BL, BR [m], (steps + 1, num, 4, 3)."""
        return self.points[1]

    @cached_property
    def clearance(self) -> torch.Tensor:
        """Heights of links above the ground [m], (steps + 1, num, 4 legs, 4), see `WholeBody.clearance`."""
        return self.body.clearance_of(self.q, *self.points)

    @cached_property
    def down(self) -> torch.Tensor:
        """Whether each paw is in contact at the end of each policy step, bool (steps, 4, num)."""
        impulse = self.trajectory.impulse.detach()[self.substeps - 1 :: self.substeps]
        return torch.linalg.vector_norm(impulse, dim=-1) > CONTACT_FORCE * self.dt

    @cached_property
    def positive_work(self) -> torch.Tensor:
        """Positive work of all motors [J] until the end of each policy step, (steps, num).

        Torques are those of each physics step; rates are interpolated linearly within the policy step.
        """
        torque = self.trajectory.torque.unflatten(0, (-1, self.substeps))
        ends = self.qd[..., 6:].movedim(-1, 1)
        fraction = (torch.arange(self.substeps, device=torque.device) + 0.5) / self.substeps
        rate = ends[:-1, None] + fraction.to(torque.dtype)[:, None, None] * (ends[1:] - ends[:-1])[:, None]
        return (self.dt * (torque * rate).clamp_min(0.0)).sum((1, 2)).cumsum(0)

    def takeoff(self, speed: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the policy step at which each world's robot takes off, and whether it does.

        Row of takeoff (num,), without takeoff the last one, and bool (num,). Takeoff as in the jump tasks: the first
        row with no paw in contact and the base rising faster than speed [m/s].
        """
        return self.once(("takeoff", speed), lambda: self._takeoff(speed))

    def _takeoff(self, speed: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute `takeoff`, without its cache; `down` row i is that of row i + 1 of the state."""
        airborne = ~self.down.any(dim=1) & (self.base_velocity[1:, :, 2].detach() > speed)
        return torch.where(airborne.any(0), airborne.int().argmax(0) + 1, len(airborne)), airborne.any(0)

    @cached_property
    def base_velocity(self) -> torch.Tensor:
        """Velocity of the base's origin [m/s], (steps + 1, num, 3)."""
        return self.body.base_velocity(self.q, self.qd)

    def momentum_at(self, row: torch.Tensor) -> Momentum:
        """Return centre of mass and momentum of each world's robot at the policy step `row` (num,) of that world."""
        worlds = torch.arange(self.num, device=row.device)
        return self.body.momentum(self.q[row, worlds], self.qd[row, worlds])

    def momentum_at_takeoff(self, speed: float) -> Momentum:
        """Return centre of mass and momentum of each world's robot at `takeoff`; speed [m/s]."""
        return self.once(("momentum", speed), lambda: self.momentum_at(self.takeoff(speed)[0]))


Term = Callable[[SimulatedMotion], torch.Tensor]
"""Returns an objective (num,), or constraints (..., num) that must be <= 0, scaled to about 1."""


class Values(NamedTuple):
    """Objective and constraints of n candidate solutions of a trajectory optimisation problem."""

    objective: torch.Tensor  # (n,) to minimise
    constraints: torch.Tensor  # (n, m) satisfied where <= 0


class _Worlds(NamedTuple):
    """Differentiable simulation of n candidate motions, and their initial state, standing in the default pose."""

    rollout: Rollout
    body: WholeBody
    q: torch.Tensor  # (19, n) initial coordinates, as in `Trajectory.q`
    qd: torch.Tensor  # (18, n) initial rates, zero
    start: Momentum  # in the initial state


@dataclass
class Problem:
    """Optimisation problem of motor targets, for a motion that starts from standing in the default pose."""

    knots: Knots
    objective: Term
    constraints: Sequence[Term] = ()
    motors: MotorCfg = field(default_factory=jumping_motors)
    command_filter: FilterCfg | None = None
    friction: float = 0.85  # [1] Friction coefficient of the paws
    gravity: float = EARTH  # [m/s^2] Downward, positive
    substeps: int = SUBSTEPS  # Physics steps in a policy step of 1/60 s; fewer are faster and coarser
    double: bool = True  # Whether to compute in double precision
    tolerance: float | None = 1.0e-9  # [m/s] Tolerance of the contact iteration
    device: Any = None
    threads: int | None = None
    world_steps: int = field(default=0, init=False)  # Number of simulated policy steps so far, worlds times steps
    reverse_steps: int = field(default=0, init=False)
    """Number of policy steps of reverse passes so far, worlds times steps."""

    def __post_init__(self) -> None:
        """Create an empty cache of simulations, by number of candidates."""
        self._worlds: dict[int, _Worlds] = {}

    def rollout(self, num_worlds: int) -> Rollout:
        """Return the differentiable simulation of `num_worlds` candidates, built at first use and cached."""
        return self._worlds_of(num_worlds).rollout

    def _worlds_of(self, num_worlds: int) -> _Worlds:
        """Return simulation and initial state of `num_worlds` candidates, built at first use and cached."""
        if num_worlds not in self._worlds:
            model = build_model(
                num_worlds, visuals=False, friction=self.friction, gravity=self.gravity, device=self.device
            )
            rollout = Rollout(
                model, self.motors, self.command_filter, double=self.double, tolerance=self.tolerance,
                dt=PHYSICS_DT * SUBSTEPS / self.substeps, substeps=self.substeps, threads=self.threads,
            )  # fmt: skip
            body = WholeBody(rollout)
            real = torch.float64 if self.double else torch.float32
            q, qd = (torch.as_tensor(array, dtype=real, device=str(rollout.device)) for array in rollout.standing())
            self._worlds[num_worlds] = _Worlds(rollout, body, q, qd, body.momentum(q.T, qd.T))
        return self._worlds[num_worlds]

    def motion(self, x: torch.Tensor) -> SimulatedMotion:
        """Return the simulated motion of candidates x (n, len(knots)), one world each, differentiable w.r.t. x."""
        rollout, body, q, qd, start = self._worlds_of(len(x))
        targets = self.knots.targets(x)
        self.world_steps += targets.shape[0] * len(x)
        return SimulatedMotion(simulate(rollout, targets, q, qd, trusted=True), body, rollout, self.gravity, start)

    def motion_of(self, trajectory: TorchTrajectory) -> SimulatedMotion:
        """Wrap a one-world trajectory from another simulation of the same robot as a motion, for `values`."""
        rollout, body, _, _, start = self._worlds_of(1)
        return SimulatedMotion(trajectory, body, rollout, self.gravity, start)

    def evaluate(self, x: torch.Tensor) -> Values:
        """Return objective and constraints of candidates x (n, len(knots)), see `values`."""
        return self.values(self.motion(x))

    def values(self, motion: SimulatedMotion) -> Values:
        """Return objective and constraints of a motion; a diverged world has an infinite objective, constraints 0."""
        objective = self.objective(motion)
        rows = [term(motion).reshape(-1, motion.num) for term in self.constraints]
        constraints = torch.cat(rows).T if rows else objective.new_zeros(motion.num, 0)
        diverged = ~(objective.isfinite() & constraints.isfinite().all(1))
        return Values(torch.where(diverged, torch.inf, objective), torch.where(diverged[:, None], 0.0, constraints))

    def gradient(self, x: torch.Tensor, merit: Callable[[Values], torch.Tensor]) -> tuple[Values, torch.Tensor]:
        """Return the values of candidates x (n, len(knots)) and the gradient of their merit w.r.t. x.

        merit: returns (n,) to minimise, given `Values`. The gradient is zero for candidates that diverge.
        """
        x = x.detach().requires_grad_()
        values = self.evaluate(x)
        merits = merit(values)
        gradient = torch.autograd.grad(merits[merits.isfinite()].sum(), x)[0]
        self.reverse_steps += self.knots.steps * len(x)
        return Values(*(value.detach() for value in values)), torch.nan_to_num(gradient, 0.0, 0.0, 0.0)
