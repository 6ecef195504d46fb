"""Differentiable jumps of robots whose legs have lengths and a spring of their own.

A design has three numbers: thigh and shank in nominal lengths, and the stiffness between the knees in `STIFFEST`. Links
keep their mass per length and cross-section; body, motor housings, motors and stops stay the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from jumper_warp.diff.rollout import GEOMETRY_NAMES, Rollout
from jumper_warp.diff.torch_rollout import TorchTrajectory, simulate
from jumper_warp.kernels.layout import LEG_ROWS, OUTER_SHANK, SPRING
from jumper_warp.robot.description import RobotDescription, leg_dimensions, load_description
from jumper_warp.robot.model import PHYSICS_DT, build_model
from jumper_warp.robot.motors import horizontal_jump_filter, jumping_motors
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.robot.values import described

POSE = math.radians(45.0)  # [rad] Transversal angle in standing, and target in flight
PUSH, FLIGHT = 40, 14  # Policy steps of optimised targets, and of the flight
LARGEST_ANGLE = math.radians(132.0)  # [rad] Larger motor angles are faults: the stops are at 140 degrees
REST_LENGTH = 0.17  # [m] Of the springs
STIFFEST = 1500.0  # [N/m] Unit of a design's stiffness
SAMPLES = np.array([0.6, 0.87, 1.13, 1.4])  # Factors on the lengths of robots that define the parameters' polynomials


class Jump(NamedTuple):
    """Jumps of n robots, which are differentiable with respect to designs and targets."""

    distance: torch.Tensor  # (n,) [m]
    energy: torch.Tensor  # (n,) [J]
    faults: torch.Tensor  # (n,) [1] Sum of penalties, 0 for a good jump
    landing: torch.Tensor  # (n,) [m] Height of the base at touchdown
    trajectory: TorchTrajectory


def robot_of(design: Sequence[float] | np.ndarray) -> RobotDescription:
    """Return the robot of a design: thigh and shank in nominal lengths, stiffness in `STIFFEST`."""
    thigh, shank, spring = map(float, design)
    leg = leg_dimensions(load_description(), "FL")
    overlay = RobotOverlay({
        "thigh_length": (thigh * leg.thigh,), "shank_length": (shank * leg.shank,),
        "link_mass": (1.0, thigh, shank, thigh, shank), "spring_stiffness": (STIFFEST * spring,),
        "spring_length": (REST_LENGTH,),
    })  # fmt: skip
    return described(overlay.robots(), overlay.description)


class Jumps:
    """Differentiable jumps of n robots with legs of their own on one planet."""

    def __init__(self, count: int, gravity: float, *, double: bool = False, device: str | None = None,
                 threads: int | None = None):  # fmt: skip
        """Build the simulation, and the kernels' parameters as polynomials of the factors on the lengths."""
        self.gravity = gravity
        self.real = torch.float64 if double else torch.float32
        self.size = leg_dimensions(load_description(), "FL")
        motors = jumping_motors()
        common: Any = {"gravity": gravity, "visuals": False, "device": device, "mujoco": False}
        self.rollout = Rollout(
            build_model(count, **common), motors, horizontal_jump_filter(), double=double, every=1, threads=threads
        )
        robots = [robot_of((factor, factor, 0.0)) for factor in SAMPLES]
        samples = Rollout(build_model(len(SAMPLES), description=robots, **common), description=robots, double=True)
        table = np.asarray(samples.parameters["table"].numpy(), dtype=float)
        self.table = self.tensor(np.linalg.solve(np.vander(SAMPLES), table.T)[..., None])
        starts = LEG_ROWS * np.arange(4)[:, None]
        rows = np.arange(len(table))[:, None]
        self.of_shank = torch.tensor(np.isin(rows % LEG_ROWS // 10, (OUTER_SHANK // 10, 2 + OUTER_SHANK // 10)))
        self.of_spring = torch.tensor(np.isin(rows, starts + SPRING))
        self.lengths = self.tensor(self.rollout.geometry()[..., None])
        kinds = (motors.lateral, motors.transversal, motors.transversal)
        self.loss = self.tensor([[(kind.no_load_speed - kind.cutoff_speed) / kind.peak] for kind in kinds] * 4)

    def tensor(self, values: Any) -> torch.Tensor:
        """Return values as a tensor of the simulation's precision."""
        return torch.tensor(np.asarray(values), dtype=self.real)

    def parameters(self, design: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return `table` and `geometry` of the rollout for designs (3, n)."""
        factor = torch.where(self.of_shank, design[1], design[0])
        table = self.table[0]
        for coefficient in self.table[1:]:
            table = table * factor + coefficient
        factors = torch.ones(4, len(GEOMETRY_NAMES), design.shape[1], dtype=self.real)
        factors[:, GEOMETRY_NAMES.index("thigh")] = design[0]
        factors[:, GEOMETRY_NAMES.index("shank")] = design[1]
        return {"table": torch.where(self.of_spring, STIFFEST * design[2], table), "geometry": factors * self.lengths}

    def depth(self, angles: torch.Tensor, design: torch.Tensor) -> torch.Tensor:
        """Return how far the legs reach below the hips [m], (4, n), for motor angles (12, n) with 0 lateral."""
        outer, inner = angles[1::3], angles[2::3]
        thigh, shank = self.size.thigh * design[0], self.size.shank * design[1]
        x = self.size.outer_x - self.size.inner_x + thigh * (outer.sin() + inner.sin())
        span = x.square() + (thigh * (inner.cos() - outer.cos())).square()  # [m^2] Squared distance of the knees
        below = (shank.square() / span - 0.25).clamp(min=1.0e-4).sqrt()
        return self.size.paw_radius + 0.5 * thigh * (outer.cos() + inner.cos()) + below * x

    def __call__(self, targets: torch.Tensor, design: torch.Tensor) -> Jump:
        """Simulate jumps from standing at rest.

        targets [rad]: (PUSH, 4, n), of outer and inner motors of both front legs, then of both back legs; design:
        (3, n).
        """
        n = targets.shape[-1]
        full = torch.zeros(PUSH + FLIGHT, 2, 2, 3, n, dtype=self.real)  # ends, sides, motors
        full[:PUSH, :, :, 1:] = targets.reshape(PUSH, 2, 1, 2, n)
        full[PUSH:, :, :, 1:] = POSE
        q = torch.zeros(19, n, dtype=self.real)
        q[6] = 1.0
        q[7:] = full[-1].reshape(12, n)
        standing = self.depth(q[7:], design)[0]
        q = torch.cat([q[:2], standing[None], q[3:]])
        qd = torch.zeros(18, n, dtype=self.real)
        motion = simulate(self.rollout, full.reshape(-1, 12, n), q, qd, trusted=True, **self.parameters(design))
        return self.jump(motion, torch.maximum(standing, self.depth(motion.q[-1, 7:], design).mean(0)))

    def jump(self, motion: TorchTrajectory, landing: torch.Tensor) -> Jump:
        """Return distance, energy and faults of a motion that ends in flight; landing [m]: height of touchdown."""
        end, velocity = motion.q[-1], motion.qd[-1]
        above = end[2] - landing
        falling = (velocity[2].square() + 2.0 * self.gravity * above).clamp(min=1.0e-6).sqrt()
        flight = ((velocity[2] + falling) / self.gravity).clamp(min=0.0)
        work = (motion.torque * motion.q[:, 7:].diff(dim=0)).clamp(min=0.0)
        loss = self.loss * motion.torque.square()  # [W]
        energy = (work + PHYSICS_DT * loss).sum((0, 1)) + flight * loss[-1].sum(0)
        pitch = 2.0 * end[4].clamp(-0.9, 0.9).asin() + flight * velocity[4]  # [rad] At touchdown
        faults = (
            (pitch / 0.1).square()
            + 50.0 * (0.05 - above).clamp(min=0.0)
            + 100.0 * (0.12 - motion.q[:, 2]).clamp(min=0.0).mean(0)
            + 300.0 * (motion.q[:, 7:] - LARGEST_ANGLE).clamp(min=0.0).mean((0, 1))
        )
        return Jump(end[0] + flight * velocity[0], energy, faults, landing, motion)
