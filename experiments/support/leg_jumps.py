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
from jumper_warp.robot.description import LEGS, RobotDescription, leg_dimensions, load_description
from jumper_warp.robot.model import PHYSICS_DT, build_model
from jumper_warp.robot.motors import horizontal_jump_filter, jumping_motors
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.robot.values import described

POSE = math.radians(45.0)  # [rad] Transversal angle in standing, and target in flight
PUSH = 36  # Policy steps of optimised targets
LARGEST_ANGLE = math.radians(132.0)  # [rad] Larger motor angles are faults: the stops are at 140 degrees
LOWEST = 0.12  # [m] Lower heights of the base are faults
TOUCH = 5.0e-4  # [m] Clearance of a paw from which its motion is extrapolated to the ground
REST_LENGTH = 0.17  # [m] Of the springs
STIFFEST = 1500.0  # [N/m] Unit of a design's stiffness
SAMPLES = np.array([0.6, 0.87, 1.13, 1.4])  # Factors on the lengths of robots that define the parameters' polynomials


class Jump(NamedTuple):
    """Jumps of n robots until the first paw touches down."""

    distance: torch.Tensor  # (n,) [m] Of the base, from standing
    energy: torch.Tensor  # (n,) [J]
    faults: torch.Tensor  # (n,) [1] Sum of penalties, 0 for a good jump
    pitch: torch.Tensor  # (n,) [rad] At touchdown
    flight: torch.Tensor  # (n,) Number of physics steps until touchdown


def overlay_of(design: Sequence[float] | np.ndarray) -> RobotOverlay:
    """Return the robot of a design: thigh and shank in nominal lengths, stiffness in `STIFFEST`."""
    thigh, shank, spring = map(float, design)
    leg = leg_dimensions(load_description(), "FL")
    return RobotOverlay({
        "thigh_length": (thigh * leg.thigh,), "shank_length": (shank * leg.shank,),
        "link_mass": (1.0, thigh, shank, thigh, shank), "spring_stiffness": (STIFFEST * spring,),
        "spring_length": (REST_LENGTH,),
    })  # fmt: skip


def robot_of(design: Sequence[float] | np.ndarray) -> RobotDescription:
    """Return the description of the robot of a design."""
    overlay = overlay_of(design)
    return described(overlay.robots(), overlay.description)


class Jumps:
    """Differentiable jumps of n robots with legs of their own on one planet."""

    def __init__(self, count: int, gravity: float, distance: float, *, double: bool = False, device: str | None = None,
                 threads: int | None = None):  # fmt: skip
        """Build the simulation, and the kernels' parameters as polynomials of the factors on the lengths.

        distance [m]: of a typical jump, for which the simulated time is long enough.
        """
        self.real = torch.float64 if double else torch.float32
        self.steps = PUSH + round(60.0 * 1.3 * math.sqrt(2.0 * distance / gravity))
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
        legs = [leg_dimensions(load_description(), leg) for leg in LEGS]
        self.size = legs[0]
        self.front = self.tensor([[leg.front] for leg in legs])
        hips = [[[leg.hip[0] + leg.outer_x], [leg.hip[0] + leg.inner_x]] for leg in legs]
        self.outer_hip, self.inner_hip = self.tensor(hips).unbind(1)  # (4, 1) [m] x of the thighs' axes, body frame
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

    def joints(self, angles: torch.Tensor, design: torch.Tensor) -> torch.Tensor:
        """Return outer knees, inner knees and paws [m], (3, x and z, ..., 4 legs, n), in the hips' plane, body frame.

        angles [rad]: (..., 12, n), of motors with 0 lateral.
        """
        outer, inner = self.front * angles[..., 1::3, :], -self.front * angles[..., 2::3, :]
        thigh, shank = self.size.thigh * design[0], self.size.shank * design[1]
        outer_knee = torch.stack([self.outer_hip + thigh * outer.sin(), -thigh * outer.cos()])
        inner_knee = torch.stack([self.inner_hip + thigh * inner.sin(), -thigh * inner.cos()])
        span = self.front * (outer_knee - inner_knee)
        below = (shank.square() / span.square().sum(0) - 0.25).clamp(min=1.0e-4).sqrt()
        paw = 0.5 * (outer_knee + inner_knee) + below * torch.stack([span[1], -span[0]])
        return torch.stack([outer_knee, inner_knee, paw])

    def clearance(self, q: torch.Tensor, design: torch.Tensor) -> torch.Tensor:
        """Return the height [m] of the lowest paw's lowest point, (...), for coordinates (..., 19, n)."""
        x, z = self.joints(q[..., 7:, :], design)[2]
        sine, cosine = 2.0 * q[..., 6, :] * q[..., 4, :], 1.0 - 2.0 * q[..., 4, :].square()
        low = (cosine[..., None, :] * z - sine[..., None, :] * x).amin(-2)
        return q[..., 2, :] + low - self.size.paw_radius

    def simulate(self, targets: torch.Tensor, design: torch.Tensor) -> TorchTrajectory:
        """Simulate robots that stand at rest.

        targets [rad]: (PUSH, 4, n), of outer and inner motors of both front legs, then of both back legs; design:
        (3, n).
        """
        n = targets.shape[-1]
        full = torch.zeros(self.steps, 2, 2, 3, n, dtype=self.real)  # ends, sides, motors
        full[:PUSH, :, :, 1:] = targets.reshape(PUSH, 2, 1, 2, n)
        full[PUSH:, :, :, 1:] = POSE
        q = torch.zeros(19, n, dtype=self.real)
        q[6] = 1.0
        q[7:] = full[-1].reshape(12, n)
        q = torch.cat([q[:2], -self.clearance(q, design)[None], q[3:]])
        qd = torch.zeros(18, n, dtype=self.real)
        return simulate(self.rollout, full.reshape(-1, 12, n), q, qd, trusted=True, **self.parameters(design))

    def measure(self, q: torch.Tensor, torque: torch.Tensor, design: torch.Tensor) -> Jump:
        """Return distance, energy and faults of a motion until its first paw touches down after the largest clearance.

        The two rows ahead of the contact give the instant between physics steps, and all values there. q: (T + 1, 19,
        n) as in `Trajectory.q`; torque: (T, 12, n) [N m] in the physics steps.
        """
        work = (torque * q[:, 7:].diff(dim=0)).clamp(min=0.0)
        energy = (work + PHYSICS_DT * self.loss * torque.square()).sum(1).cumsum(0)
        clearance = self.clearance(q, design)
        rows = torch.arange(len(q))[:, None]
        down = (clearance < TOUCH) & (rows > clearance.argmax(0))
        last = torch.where(down, rows, len(q)).amin(0).clamp(min=3) - 1
        values = torch.stack([q[1:, 0], 2.0 * q[1:, 4].clamp(-0.9, 0.9).asin(), energy, clearance[1:]])
        x, pitch, joules, gap = values.gather(1, (last - 1).expand(4, 1, -1))[:, 0]
        *steps, step = (values.diff(dim=1)).gather(1, (last - 2).expand(4, 1, -1))[:, 0]
        part = (gap / (-step).clamp(min=1.0e-5)).clamp(0.0, 2.0)
        x, pitch, joules = (value + part * step for value, step in zip((x, pitch, joules), steps, strict=True))
        faults = (
            (pitch / 0.1).square()
            + 100.0 * (LOWEST - q[:, 2]).clamp(min=0.0).mean(0)
            + 300.0 * (q[:, 7:] - LARGEST_ANGLE).clamp(min=0.0).mean((0, 1))
        )
        return Jump(x, joules, faults, pitch, last + part)

    def __call__(self, targets: torch.Tensor, design: torch.Tensor) -> Jump:
        """Return the jumps of robots from standing; see `simulate`."""
        motion = self.simulate(targets, design)
        return self.measure(motion.q, motion.torque, design)
