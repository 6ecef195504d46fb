"""Objectives and constraints of jumps, for `jumper_warp.trajectory.problem.Problem`."""

from __future__ import annotations

import math

import torch

from jumper_warp.trajectory.problem import Motion, Term

MARGIN = 0.004
"""[m] Of links over the ground."""


def air_time(up: torch.Tensor, drop: torch.Tensor, gravity: float) -> torch.Tensor:
    """Return the time [s] of a projectile until it has fallen by `drop` [m], up to its apex if it never does.

    up [m/s]: its upward speed. The square root is continued straight below 1e-4 m^2/s^2, so that gradients are finite.
    """
    root = up.square() + 2.0 * gravity * drop
    return (up + root.clamp_min(1.0e-4).sqrt()) / gravity


def flight(motion: Motion, speed: float, height: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return distance [m] and air time [s] of the centre of mass' parabola from the takeoff on, each (num,).

    From where it stood to where it falls through what it has with the base at `height` [m] in the posture of the start.
    speed [m/s]: least upward at takeoff.
    """

    def found() -> tuple[torch.Tensor, torch.Tensor]:
        now, start = motion.momentum_at_takeoff(speed), motion.start
        landing = height + start.com[:, 2] - motion.q[0, :, 2]
        time = air_time(now.vel[:, 2], now.com[:, 2] - landing, motion.gravity)
        return now.com[:, 0] - start.com[:, 0] + time * now.vel[:, 0], time

    return motion.once(("flight", speed, height), found)


def farthest(speed: float = 0.25, height: float = 0.30) -> Term:
    """Return minus the distance flown [m], see `flight`."""
    return lambda motion: -flight(motion, speed, height)[0]


def highest() -> Term:
    """Return minus the largest base height [m] between takeoff and the first paw that comes down, by full simulation.

    A second hop does not count. The apex lies between two rows: it is that of the parabola through the highest
    row's position and velocity.
    """

    def term(motion: Motion) -> torch.Tensor:
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
    """Return the motors' positive work [J] until takeoff, in units of 100 J."""

    def term(motion: Motion) -> torch.Tensor:
        row = motion.takeoff(0.25)[0]
        return 0.01 * motion.positive_work[row - 1, torch.arange(motion.num, device=row.device)]

    return term


def before_takeoff(motion: Motion, speed: float) -> torch.Tensor:
    """Return which rows (steps + 1, num) are in stance, that of the takeoff excluded."""
    row = motion.takeoff(speed)[0]
    return torch.arange(motion.q.shape[0], device=row.device)[:, None] < row


def pitch_of(quat: torch.Tensor) -> torch.Tensor:
    """Return the pitch [rad] of quaternions xyzw about y, nose down positive, of robots that turn about y alone."""
    return 2.0 * torch.atan2(quat[..., 1], quat[..., 3])


def landing_pitch(most: float, speed: float = 0.25, height: float = 0.30) -> Term:
    """Keep the pitch that the base would have at the end of the flight, posture of the start, within `most` [rad]."""

    def term(motion: Motion) -> torch.Tensor:
        now, time, row = motion.momentum_at_takeoff(speed), flight(motion, speed, height)[1], motion.takeoff(speed)[0]
        spin = now.spin[:, 1] / motion.start.inertia[:, 1, 1]
        pitch = pitch_of(motion.q[row, torch.arange(motion.num, device=row.device), 3:7]) + spin * time
        return torch.stack([pitch - most, -most - pitch])

    return term


def stays(most: float, speed: float = 0.25) -> Term:
    """Keep the base within `most` [m] of its start while in stance, in the plane."""
    away = drifts(most)
    return lambda motion: torch.where(before_takeoff(motion, speed), away(motion), 0.0)


def leans_back(most: float, speed: float = 0.25) -> Term:
    """Return minus how far back of its start the base comes in stance [m], up to `most` [m], (num,)."""

    def term(motion: Motion) -> torch.Tensor:
        back = motion.q[0, :, 0] - motion.q[..., 0]
        return -torch.where(before_takeoff(motion, speed), back, 0.0).amax(0).clamp_max(most)

    return term


def drifts(most: float) -> Term:
    """Keep the base within `most` [m] of its start in the plane, in all rows."""

    def term(motion: Motion) -> torch.Tensor:
        way = motion.q[..., :2] - motion.q[0, :, :2]
        return (way.square().sum(-1) + 1.0e-12).sqrt() - most

    return term


def clear(margin: float = MARGIN, speed: float | None = None) -> Term:
    """Keep housings, thighs, knees and shanks off the ground by a margin [m], in stance or always (speed None)."""

    def term(motion: Motion) -> torch.Tensor:
        gap = 10.0 * (margin - motion.clearance.amin((-1, -2)))
        return gap if speed is None else torch.where(before_takeoff(motion, speed), gap, 0.0)

    return term


def no_run_up(most: float = 0.04, speed: float = 0.25) -> Term:
    """Keep hind paws that are on the ground less than `most` [m] ahead of their start."""

    def term(motion: Motion) -> torch.Tensor:
        paws = motion.ankles[..., 2:, 0]
        ahead = paws[1:].amax(-1) - paws[0].amax(-1) - most
        counts = motion.down[:, 2:].any(1) & before_takeoff(motion, speed)[:-1]
        return torch.where(counts, ahead, 0.0)

    return term


def takes_off(speed: float = 0.25, lift: float = 0.01) -> Term:
    """Ask for paws lifted by `lift` [m] at the end of the motion, and for a takeoff at all."""

    def term(motion: Motion) -> torch.Tensor:
        lowest = (motion.ankles[-1, ..., 2] - motion.body.paw_radius).amin(-1)
        off = motion.takeoff(speed)[1]
        return torch.where(off, 0.0, 10.0 * (lift - lowest).clamp_min(0.0) + 0.01)

    return term


def upright(most: float, at_end: bool = True) -> Term:
    """Keep the angle between body and world z within `most` [rad], in the last row or in all."""

    def term(motion: Motion) -> torch.Tensor:
        quat = motion.q[-1:, :, 3:7] if at_end else motion.q[..., 3:7]
        x, y = quat[..., 0], quat[..., 1]
        sine = 2.0 * (x.square() + y.square() + 1e-12).sqrt()
        return sine - 2.0 * math.sin(0.5 * most)

    return term


def reaches(height: float) -> Term:
    """Ask for an apex of the base of at least `height` [m]."""
    return lambda motion: height + highest()(motion)


def touchdowns(motion: Motion, speed: float = 0.25) -> torch.Tensor:
    """Return from which row each paw has come down after the takeoff, bool (steps + 1, 4, num)."""
    row, _ = motion.takeoff(speed)
    later = torch.arange(motion.q.shape[0], device=row.device)[:, None, None] > row
    down = torch.cat([torch.zeros_like(motion.down[:1]), motion.down])
    return (down & later).int().cummax(0).values.bool()


def soft(most: float, speed: float = 0.25) -> Term:
    """Keep upward accelerations [g] of the base over policy steps after takeoff below `most`; in units of 10 g."""

    def term(motion: Motion) -> torch.Tensor:
        up = motion.base_velocity[..., 2]
        gained = (up[1:] - up[:-1]) / (motion.substeps * motion.dt * motion.gravity)
        later = torch.arange(len(up), device=up.device)[1:, None] > motion.takeoff(speed)[0]
        return torch.where(later, 0.1 * (gained - most), -1.0)

    return term


def lifted(free: float = 0.001) -> Term:
    """Return how far and how long paws are off the ground again after their touchdown [10 mm s], (num,).

    Heights below `free` [m] do not count, those of paws that never come down count from the motion's end.
    """

    def term(motion: Motion) -> torch.Tensor:
        height = (motion.ankles[..., 2] - motion.body.paw_radius - free).clamp_min(0.0).movedim(2, 1)
        counts = touchdowns(motion)
        step = motion.substeps * motion.dt
        return 100.0 * (step * torch.where(counts, height, 0.0).sum((0, 1)) + height[-1].sum(0))

    return term


def rest() -> Term:
    """Return the squared speed [m^2/s^2] and a tenth of the squared angular velocity [rad^2/s^2] at the end, (num,)."""

    def term(motion: Motion) -> torch.Tensor:
        last = motion.qd[-1]
        return last[:, :3].square().sum(-1) + 0.1 * last[:, 3:6].square().sum(-1)

    return term


def still(free: float = 0.001) -> Term:
    """Return `lifted` and half of `rest`, (num,)."""
    return lambda motion: lifted(free)(motion) + 0.5 * rest()(motion)
