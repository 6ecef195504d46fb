"""Plans of the rest of a jump: actions in every policy step, improved by gradients of the whole motion with contact.

A plan is simulated from the present state until after the landing, with the dynamics, motors and command filter of an
assumed robot. Its cost is a sum of terms over the policy steps, see `jumper_warp.kernels.jump.plan_cost`. Their weights
depend on takeoff and touchdown of the simulated motion, which have no gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from jumper_warp.diff.fixed_rollout import FixedRollout
from jumper_warp.diff.snapshot import Snapshot
from jumper_warp.kernels.jump.state import LANDED, STANCE
from jumper_warp.utils.threads import WARP_LOCK

LONGEST = 150  # Policy steps of a plan for which arrays are allocated at first
SUBSTEPS = 4  # Physics steps in a policy step of a plan, half of the simulation's
TAKEOFF_SPEED = 0.25  # [m/s] Upward speed of a takeoff, as in the jump tasks
END = 5  # Last policy steps of a plan, in which the robot should rest at the goal
MEAN, SQUARE = 0.9, 0.95  # Decay rates of the means of gradients and of squared gradients
LARGEST_GRADIENT = 30.0  # [1] Norm to which a robot's gradient is clipped
EPSILON = 0.01  # [1] Added to the root of the mean squared gradient
FIRST_STEP, STEPS = 0.03, (2.0e-3, 0.1)  # [1] First step of an action, and range of later ones
DECAY = 0.98  # Factor on the step in each iteration before the jump
GROWTH, SHRINKAGE = 1.3, 0.4  # Factors on the step after an iteration that lowers the cost, or does not
DIVERGED = 1.0e12  # [1] Cost of a motion that is not finite


class Start(NamedTuple):
    """State of the robots from which a plan begins."""

    q: np.ndarray  # (19, num_worlds) as in `Trajectory`: base origin [m], xyzw, motor angles [rad]
    qd: np.ndarray  # (18, num_worlds) velocity of the base's COM [m/s], angular velocity, motor rates [rad/s]
    initial_target: np.ndarray  # (steps, 12, num_worlds) [rad] filtered targets of the last policy steps
    phase: np.ndarray  # (num_worlds,) STANCE, FLIGHT or LANDED
    apex: np.ndarray  # (num_worlds,) [m] largest height of the base in flight so far; 0 before


@dataclass(frozen=True)
class Tolerances:
    """Deviations that cost 1 each in the cost of a plan, which is a weighted sum of squares."""

    height: float = 0.02  # [m] Error of the apex
    place: float = 0.03  # [m] Distance from the goal at the end
    drift: float = 0.2  # [m] The same in a jump to a height
    rest: float = 0.15  # [m/s] Speed of the base after the landing
    settling: int = 8  # Policy steps from touchdown until the speed counts
    tilt: tuple[float, float] = (1.0, 0.2)  # [1] Sine of the tilt before and after touchdown
    pose: float = 3.0  # [rad] Deviation of the motor angles from the pose of rest after the landing
    gap: float = 0.01  # [m] Distance that links and shell lack to the ground, to the shell or to other legs


class Outlook(NamedTuple):
    """Simulated motion of a plan."""

    cost: np.ndarray  # (num_worlds,) [1]
    q: np.ndarray  # (policy steps + 1, 19, num_worlds) as in `Trajectory`
    touchdown: np.ndarray  # (num_worlds,) row of the touchdown in q; the last row if there is none


class PlanModel:
    """Differentiable simulation of the robots that a plan assumes, and the cost of their jumps.

    goal: (3, num_worlds) [m] place of the landing x, y, world, and height of the apex, 0: any.
    pose: (12, num_worlds) [rad] motor angles of rest, by default the default pose.
    """

    def __init__(
        self, robots: Snapshot, goal: np.ndarray, *,
        substeps: int = SUBSTEPS, double: bool = False, threads: int | None = None,
    ) -> None:  # fmt: skip
        """Copy the parameters of the robots of an environment of one task on level ground.

        substeps: physics steps in a policy step. double, threads: as in `Rollout`.
        """
        task = robots.tasks[0]
        self.rollout = FixedRollout(
            robots.model, task.motors, task.command_filter, double=double, threads=threads,
            dt=robots.dt * robots.substeps / substeps, substeps=substeps,
        )  # fmt: skip
        for name, tensor in robots.parameters.items():
            wp.to_torch(self.rollout.parameters[name]).copy_(tensor)
        lateral, transversal = np.radians(task.action_scale)
        self.scale = np.tile([lateral, transversal, transversal], 4)[:, None]
        self.default = robots.default_angle.cpu().numpy().astype(float)[:, None]
        self.pose = np.repeat(self.default, self.rollout.num_worlds, axis=1)
        self.goal = goal
        self.tolerances = Tolerances()
        self.terms = self.rollout.dynamics.modules.plan_cost
        self._rows = 0  # of the arrays
        self._allocate(LONGEST)

    def _allocate(self, horizon: int) -> None:
        """Allocate the arrays of plans of at most `horizon` policy steps, and record the launches of the cost."""
        rollout = self.rollout
        rollout.allocate(horizon)
        self._rows = horizon + 1
        n, device = rollout.num_worlds, rollout.device
        shapes = ((12, n), (3, n), (self._rows, int(self.terms.TERMS), n), (n,))
        pose, goal, weight, cost = (wp.zeros(shape, dtype=rollout.real, device=device) for shape in shapes)
        self._constants, self._cost = [wp.to_torch(array) for array in (pose, goal, weight)], wp.to_torch(cost)
        q, qd, by_q, by_qd = (wp.from_torch(row) for row in (rollout.q, rollout.qd, rollout.by_q, rollout.by_qd))
        launch = {
            "kernel": self.terms.plan_cost_kernel, "dim": (1, n, 4), "device": device, "record_cmd": True,
                  "inputs": [rollout.dynamics.robot.geometry, pose, goal, weight, q, qd], "outputs": [cost],
        }  # fmt: skip
        self._add_cost = wp.launch(**launch)
        ones = wp.ones(n, dtype=rollout.real, device=device)
        self._reverse_cost = wp.launch(
            **launch, adjoint=True, adj_inputs=[None, None, None, None, by_q, by_qd], adj_outputs=[ones]
        )

    def simulate(self, actions: np.ndarray, start: Start) -> Outlook:
        """Simulate actions (policy steps, 12, num_worlds) within ±1 from a start, and return motion and cost."""
        if len(actions) >= self._rows:
            self._allocate(len(actions))
        rollout = self.rollout
        rows = rollout.forward(self.default + self.scale * actions, start.q, start.qd, start.initial_target)
        last = slice(rollout.substeps - 1, (rows - 1) * rollout.substeps, rollout.substeps)
        q, qd, impulse = (array.cpu().numpy() for array in (rollout.q[:rows], rollout.qd[:rows], rollout.impulse[last]))
        takeoff, touchdown = self._events(qd, impulse, start)
        weights = self._weights(q, start, takeoff, touchdown)
        for into, values in zip(self._constants, (self.pose, self.goal, weights), strict=True):
            into[: len(values)].copy_(torch.from_numpy(values))
        self._cost.zero_()
        self._launch(self._add_cost, rows)
        cost = np.nan_to_num(self._cost.cpu().numpy(), nan=DIVERGED, posinf=DIVERGED)
        return Outlook(cost, q.copy(), touchdown)

    def gradient(self, outlook: Outlook) -> np.ndarray:
        """Return the gradient of the worlds' costs w.r.t. the actions, (policy steps, 12, num_worlds); 0 for NaN.

        outlook: the last result of `simulate`.
        """
        rows = len(outlook.q)
        self.rollout.by_q[:rows] = self.rollout.by_qd[:rows] = 0.0
        self._launch(self._reverse_cost, rows)
        return np.nan_to_num(self.rollout.reverse() * self.scale, nan=0.0, posinf=0.0, neginf=0.0)

    def _launch(self, launch: Any, rows: int) -> None:
        """Launch a recorded kernel of the cost, a `wp.Launch`, over some rows."""
        launch.set_dim((rows, self.rollout.num_worlds, 4))
        with WARP_LOCK:
            launch.launch()

    def _events(self, qd: np.ndarray, impulse: np.ndarray, start: Start) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of takeoff and touchdown, (num_worlds,), as the jump tasks define them; 0: before.

        qd: as in `Trajectory`; impulse: likewise, of the last physics step of each policy step.
        """
        down = np.abs(impulse).max((1, 3)) > 1.0e-6
        rises = qd[1:, 2] > TAKEOFF_SPEED
        takeoff = np.where(start.phase == int(STANCE), first_row(~down & rises), 0)
        after = np.arange(1, len(down) + 1)[:, None] > takeoff
        return takeoff, np.where(start.phase == int(LANDED), 0, first_row(down & ~rises & after))

    def _weights(self, q: np.ndarray, start: Start, takeoff: np.ndarray, touchdown: np.ndarray) -> np.ndarray:
        """Return the weights of the cost's terms, (rows, terms, num_worlds); row 0 is the start and has none."""
        tolerances = self.tolerances
        terms = self.terms
        rows, _, n = q.shape
        row = np.arange(rows)[:, None]
        weight = np.zeros((rows, int(terms.TERMS), n))
        to_height = self.goal[2] > 0.0
        height = np.where((row >= takeoff) & (row <= touchdown), q[:, 2], 0.0)
        counts = to_height & (start.phase != int(LANDED)) & (height.max(0) > start.apex)
        weight[height.argmax(0), int(terms.HEIGHT), np.arange(n)] = counts / tolerances.height**2
        end = row >= rows - END
        weight[:, int(terms.PLACE)] = end / END / np.where(to_height, tolerances.drift, tolerances.place) ** 2
        rests = (row >= touchdown + tolerances.settling) | end
        share = rests / rests.sum(0)
        weight[:, int(terms.REST)] = share / tolerances.rest**2
        weight[:, int(terms.POSE)] = share / tolerances.pose**2
        before, after = tolerances.tilt
        weight[:, int(terms.TILT)] = 1.0 / np.where(row < touchdown, before, after) ** 2 / rows
        weight[:, int(terms.GAP)] = 1.0 / tolerances.gap**2
        weight[0] = 0.0
        return weight


class Plan:
    """Actions of a jump and the state of their optimisation, by normalised steps along a running mean of gradients.

    A step is kept only if it lowers the cost in the simulation. Each robot has its own length of steps.

    Attributes:
        actions: (policy steps, 12, num_worlds) within ±1.
    """

    def __init__(self, actions: np.ndarray) -> None:
        """Begin with actions (policy steps, 12, num_worlds) within ±1."""
        self.actions = actions
        self._explored = actions.copy()
        self._best = np.full(actions.shape[2], np.inf)
        self._mean = np.zeros_like(actions)
        self._square = np.zeros_like(actions)
        self._count = np.zeros(actions.shape[2])
        self._step = np.full(actions.shape[2], FIRST_STEP)

    def explore(self, model: PlanModel, start: Start, horizon: int, iterations: int) -> np.ndarray:
        """Search from the first policy step on by steps that may raise the cost; keep the best actions, return costs.

        Steps across kinks of contacts find lower minima than steps that always descend. They need a fixed start.
        """
        for _ in range(iterations):
            outlook = model.simulate(self._explored[:horizon], start)
            better = outlook.cost < self._best
            self._best = np.where(better, outlook.cost, self._best)
            self.actions[:horizon] = np.where(better, self._explored[:horizon], self.actions[:horizon])
            gradient = clipped(model.gradient(outlook))
            self._count += 1
            mean, square = self._mean[:horizon], self._square[:horizon]
            mean += (1.0 - MEAN) * (gradient - mean)
            square += (1.0 - SQUARE) * (gradient**2 - square)
            step = FIRST_STEP * DECAY**self._count * self._direction(mean, square)
            self._explored[:horizon] = np.clip(self._explored[:horizon] - step, -1.0, 1.0)
        return self._best

    def improve(self, model: PlanModel, start: Start, at: np.ndarray, horizon: int, iterations: int) -> np.ndarray:
        """Improve the actions by some iterations, and return the costs (num_worlds,).

        start: of the robots in their policy steps `at` (num_worlds,) of the plan; horizon: policy steps to simulate.
        """
        rows = (at + np.arange(horizon)[:, None])[:, None]
        x, mean, square = (np.take_along_axis(array, rows, 0) for array in (self.actions, self._mean, self._square))
        outlook = model.simulate(x, start)
        cost = outlook.cost
        better = np.ones(len(at), dtype=bool)
        for _ in range(iterations):
            if better.any():
                gradient = clipped(model.gradient(outlook))
                mean = np.where(better, MEAN * mean + (1.0 - MEAN) * gradient, mean)
                square = np.where(better, SQUARE * square + (1.0 - SQUARE) * gradient**2, square)
                self._count += better
            tried = np.clip(x - self._step * self._direction(mean, square), -1.0, 1.0)
            outlook = model.simulate(tried, start)
            better = outlook.cost < cost
            cost = np.where(better, outlook.cost, cost)
            x = np.where(better, tried, x)
            self._step = np.clip(self._step * np.where(better, GROWTH, SHRINKAGE), *STEPS)
        for array, values in ((self.actions, x), (self._mean, mean), (self._square, square)):
            np.put_along_axis(array, rows, values, 0)
        return cost

    def _direction(self, mean: np.ndarray, square: np.ndarray) -> np.ndarray:
        """Return the direction of a step, whose entries are about 1 where the gradient does not scatter."""
        rms = np.sqrt(square / (1.0 - SQUARE**self._count))
        return mean / (1.0 - MEAN**self._count) / (rms + EPSILON)


def clipped(gradient: np.ndarray) -> np.ndarray:
    """Return a gradient (policy steps, 12, num_worlds), each world's scaled down to `LARGEST_GRADIENT`."""
    norm = np.sqrt((gradient**2).sum((0, 1)))
    return gradient * (LARGEST_GRADIENT / np.maximum(norm, LARGEST_GRADIENT))


def first_row(true: np.ndarray) -> np.ndarray:
    """Return the number of the first true row, counted from 1, (n,); the number of rows if none is true."""
    return np.where(true.any(0), true.argmax(0) + 1, len(true))
