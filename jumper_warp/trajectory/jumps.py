"""Objectives and constraints of jumps, for `jumper_warp.trajectory.problem.Problem`."""

from __future__ import annotations

import math

import torch

from jumper_warp.trajectory.problem import SimulatedMotion, Term

MARGIN = 0.004
"""[m] Clearance of links over the ground."""


def air_time(up: torch.Tensor, drop: torch.Tensor, gravity: float) -> torch.Tensor:
    """Return the time [s] until a projectile has fallen by `drop` [m]; the time to its apex if it never does.

    up [m/s]: upward speed. The square root is constant below 1e-4 m^2/s^2, so that gradients are finite.
    """
    root = up.square() + 2.0 * gravity * drop
    return (up + root.clamp_min(1.0e-4).sqrt()) / gravity


def flight(motion: SimulatedMotion, speed: float, height: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return distance [m] and air time [s] of the flight of the centre of mass, (num,) each.

    The flight is a parabola from takeoff down to the height of the centre of mass with the base at `height` [m] in the
    initial posture; the distance counts from the start. speed [m/s]: upward speed that defines takeoff.
    """

    def distance_and_time() -> tuple[torch.Tensor, torch.Tensor]:
        now, start = motion.momentum_at_takeoff(speed), motion.start
        landing = height + start.com[:, 2] - motion.q[0, :, 2]
        time = air_time(now.vel[:, 2], now.com[:, 2] - landing, motion.gravity)
        return now.com[:, 0] - start.com[:, 0] + time * now.vel[:, 0], time

    return motion.once(("flight", speed, height), distance_and_time)


def farthest(speed: float = 0.25, height: float = 0.30) -> Term:
    """Objective: minus the distance of the flight [m], (num,), see `flight`."""
    return lambda motion: -flight(motion, speed, height)[0]


def highest() -> Term:
    """Objective: minus the apex height of the base [m] between takeoff and the first touchdown, (num,).

    The apex lies on the parabola through position and velocity of the highest row.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        height, up = motion.q[..., 2], motion.base_velocity[..., 2]
        row, _ = motion.takeoff(0.25)
        later = torch.arange(len(height), device=row.device)[:, None] >= row
        flying = later & ~touchdowns(motion).any(dim=1)
        top = torch.where(flying, height.detach(), -torch.inf).argmax(0)
        worlds = torch.arange(motion.num, device=row.device)
        z, v = height[top, worlds], up[top, worlds]
        return -(z + v.abs() * v / (2.0 * motion.gravity)).where(v.detach() > 0.0, z)

    return term


def positive_work() -> Term:
    """Objective: the motors' positive work until takeoff [100 J], (num,)."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        row = motion.takeoff(0.25)[0]
        return 0.01 * motion.positive_work[row - 1, torch.arange(motion.num, device=row.device)]

    return term


def before_takeoff(motion: SimulatedMotion, speed: float) -> torch.Tensor:
    """Return which rows are before takeoff, bool (steps + 1, num)."""
    row = motion.takeoff(speed)[0]
    return torch.arange(motion.q.shape[0], device=row.device)[:, None] < row


def pitch_of(quat: torch.Tensor) -> torch.Tensor:
    """Return the pitch [rad], nose down positive, of quaternions xyzw (..., 4) that rotate about y alone."""
    return 2.0 * torch.atan2(quat[..., 1], quat[..., 3])


def landing_pitch(most: float, speed: float = 0.25, height: float = 0.30) -> Term:
    """Constraint: the predicted pitch at the end of the flight, in the initial posture, is within ±`most` [rad]."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        now, time, row = motion.momentum_at_takeoff(speed), flight(motion, speed, height)[1], motion.takeoff(speed)[0]
        spin = now.spin[:, 1] / motion.start.inertia[:, 1, 1]
        pitch = pitch_of(motion.q[row, torch.arange(motion.num, device=row.device), 3:7]) + spin * time
        return torch.stack([pitch - most, -most - pitch])

    return term


def stays(most: float, speed: float = 0.25) -> Term:
    """Constraint: before takeoff the base stays within `most` [m] of its start in the plane."""
    drift = drifts(most)
    return lambda motion: torch.where(before_takeoff(motion, speed), drift(motion), 0.0)


def leans_back(most: float, speed: float = 0.25) -> Term:
    """Objective: minus the distance that the base moves back before takeoff [m], at most `most`, (num,)."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        back = motion.q[0, :, 0] - motion.q[..., 0]
        return -torch.where(before_takeoff(motion, speed), back, 0.0).amax(0).clamp_max(most)

    return term


def drifts(most: float) -> Term:
    """Constraint: in all rows the base is within `most` [m] of its start in the plane."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        offset = motion.q[..., :2] - motion.q[0, :, :2]
        return (offset.square().sum(-1) + 1.0e-12).sqrt() - most

    return term


def clear(margin: float = MARGIN, speed: float | None = None) -> Term:
    """Constraint: housings, thighs, knees and shanks clear the ground by a margin [m].

    speed [m/s]: only before takeoff, see `SimulatedMotion.takeoff`; None: always.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        gap = 10.0 * (margin - motion.clearance.amin((-1, -2)))
        return gap if speed is None else torch.where(before_takeoff(motion, speed), gap, 0.0)

    return term


def no_run_up(most: float = 0.04, speed: float = 0.25) -> Term:
    """Constraint: before takeoff hind paws on the ground are less than `most` [m] ahead of their start."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        paws = motion.ankles[..., 2:, 0]
        ahead = paws[1:].amax(-1) - paws[0].amax(-1) - most
        counts = motion.down[:, 2:].any(1) & before_takeoff(motion, speed)[:-1]
        return torch.where(counts, ahead, 0.0)

    return term


def takes_off(speed: float = 0.25, lift: float = 0.01) -> Term:
    """Constraint: the robot takes off; else its paws are below `lift` [m] at the end, which gives a gradient."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        lowest = (motion.ankles[-1, ..., 2] - motion.body.paw_radius).amin(-1)
        took_off = motion.takeoff(speed)[1]
        return torch.where(took_off, 0.0, 10.0 * (lift - lowest).clamp_min(0.0) + 0.01)

    return term


def upright(most: float, at_end: bool = True) -> Term:
    """Constraint: the tilt of the base is within `most` [rad], in the last row or in all."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        quat = motion.q[-1:, :, 3:7] if at_end else motion.q[..., 3:7]
        x, y = quat[..., 0], quat[..., 1]
        sine = 2.0 * (x.square() + y.square() + 1e-12).sqrt()
        return sine - 2.0 * math.sin(0.5 * most)

    return term


def reaches(height: float) -> Term:
    """Constraint: the apex of the base is at least `height` [m], see `highest`."""
    return lambda motion: height + highest()(motion)


def touchdowns(motion: SimulatedMotion, speed: float = 0.25) -> torch.Tensor:
    """Return whether each paw has touched down since takeoff, bool (steps + 1, 4, num)."""
    row, _ = motion.takeoff(speed)
    later = torch.arange(motion.q.shape[0], device=row.device)[:, None, None] > row
    down = torch.cat([torch.zeros_like(motion.down[:1]), motion.down])
    return (down & later).int().cummax(0).values.bool()


def soft(most: float, speed: float = 0.25) -> Term:
    """Constraint: after takeoff the base's upward acceleration per policy step is below `most` [g], scaled to 10 g."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        up = motion.base_velocity[..., 2]
        acceleration = (up[1:] - up[:-1]) / (motion.substeps * motion.dt * motion.gravity)
        later = torch.arange(len(up), device=up.device)[1:, None] > motion.takeoff(speed)[0]
        return torch.where(later, 0.1 * (acceleration - most), -1.0)

    return term


def lifted(free: float = 0.001) -> Term:
    """Objective: height times duration of paws lifted after touchdown [10 mm s], (num,).

    Heights up to `free` [m] do not count. Paws in the air at the end of the motion add their height there.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        height = (motion.ankles[..., 2] - motion.body.paw_radius - free).clamp_min(0.0).movedim(2, 1)
        counts = touchdowns(motion)
        step = motion.substeps * motion.dt
        return 100.0 * (step * torch.where(counts, height, 0.0).sum((0, 1)) + height[-1].sum(0))

    return term


def rest() -> Term:
    """Objective: squared speed [m^2/s^2] plus a tenth of squared angular velocity [rad^2/s^2] at the end, (num,)."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        last = motion.qd[-1]
        return last[:, :3].square().sum(-1) + 0.1 * last[:, 3:6].square().sum(-1)

    return term


def still(free: float = 0.001) -> Term:
    """Objective: `lifted` plus half of `rest`, (num,)."""
    return lambda motion: lifted(free)(motion) + 0.5 * rest()(motion)
