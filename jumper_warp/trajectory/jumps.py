"""Objectives and constraints of jumps, for `jumper_warp.trajectory.problem.Problem`.

Each function returns a `Term`: for a motion of `num` worlds an objective (num,) to minimise, or constraints (..., num)
that are satisfied where <= 0, scaled to about 1. speed [m/s]: upward speed of the base that defines takeoff.

Terms are differentiable: roots and bounds have small offsets (1e-12 and the like) that keep gradients finite. Rows of a
motion are policy steps (1/60 s); `motion.q` has the base's position, orientation (xyzw) and 12 motor angles, world
frame, x ahead, z up. Decisions, such as the row of takeoff, have no gradient.
"""

from __future__ import annotations

import math

import torch

from jumper_warp.trajectory.problem import SimulatedMotion, Term

MARGIN = 0.004  # [m] default clearance of links over the ground


def air_time(up: torch.Tensor, drop: torch.Tensor, gravity: float) -> torch.Tensor:
    """Return the time [s] until a projectile has fallen by `drop` [m]. If it never does, about the time to its apex.

    up: upward speed [m/s], of the shape of drop. gravity [m/s^2]: positive. The root is constant below 1e-4 m^2/s^2, so
    that gradients are finite.
    """
    root = up.square() + 2.0 * gravity * drop
    return (up + root.clamp_min(1.0e-4).sqrt()) / gravity


def flight(motion: SimulatedMotion, speed: float, height: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return distance along x [m] and air time [s] of the flight of the centre of mass (COM), (num,) each.

    The flight is a parabola from takeoff to the COM's height with the base at `height` [m] in the initial posture; the
    distance is measured from the COM's initial position.
    """

    def distance_and_time() -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the flight; `motion.once` calls it at the first use, since several terms share the result."""
        takeoff = motion.momentum_at_takeoff(speed)
        start = motion.start
        landing = height + start.com[:, 2] - motion.q[0, :, 2]
        time = air_time(takeoff.vel[:, 2], takeoff.com[:, 2] - landing, motion.gravity)
        return takeoff.com[:, 0] - start.com[:, 0] + time * takeoff.vel[:, 0], time

    return motion.once(("flight", speed, height), distance_and_time)


def farthest(speed: float = 0.25, height: float = 0.30) -> Term:
    """Return the objective of the farthest jump: minus the distance [m] to a landing with the base at `height` [m]."""
    return lambda motion: -flight(motion, speed, height)[0]


def highest() -> Term:
    """Return the objective of the highest jump: minus the base's apex height [m] before the first touchdown.

    Counted from takeoff (0.25 m/s) on. The apex lies on the parabola through position and velocity of the base in its
    highest row.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return minus the apex: z + v^2 / 2g of the highest flying row, or z alone where the base falls already."""
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
    """Return the objective of saving energy: the motors' positive work until takeoff, in units of 100 J.

    Takeoff is `SimulatedMotion.takeoff` at 0.25 m/s.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return the work until takeoff; entry i of `positive_work` is the work until row i + 1."""
        row = motion.takeoff(0.25)[0]
        return 0.01 * motion.positive_work[row - 1, torch.arange(motion.num, device=row.device)]

    return term


def before_takeoff(motion: SimulatedMotion, speed: float) -> torch.Tensor:
    """Return whether the robot has not taken off yet at each policy step of a motion, bool (steps + 1, num)."""
    row = motion.takeoff(speed)[0]
    return torch.arange(motion.q.shape[0], device=row.device)[:, None] < row


def pitch_of(quat: torch.Tensor) -> torch.Tensor:
    """Return the pitch [rad] (...), nose down positive, of quaternions xyzw (..., 4) that rotate about y alone."""
    return 2.0 * torch.atan2(quat[..., 1], quat[..., 3])


def landing_pitch(limit: float, speed: float = 0.25, height: float = 0.30) -> Term:
    """Return the constraint that the pitch predicted for the landing, at the end of `flight`, is within ±`limit` [rad].

    The pitch rate is the angular momentum at takeoff over the pitch inertia of the initial posture.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return how far the landing pitch is above +limit and below -limit [rad], (2, num)."""
        (row, _) = motion.takeoff(speed)
        (_, time) = flight(motion, speed, height)
        rate = motion.momentum_at_takeoff(speed).spin[:, 1] / motion.start.inertia[:, 1, 1]
        pitch = pitch_of(motion.q[row, torch.arange(motion.num, device=row.device), 3:7]) + rate * time
        return torch.stack([pitch - limit, -limit - pitch])

    return term


def stays(limit: float, speed: float = 0.25) -> Term:
    """Return the constraint that the base moves horizontally by at most `limit` [m] until takeoff."""
    drift = drifts(limit)
    return lambda motion: torch.where(before_takeoff(motion, speed), drift(motion), 0.0)


def leans_back(limit: float, speed: float = 0.25) -> Term:
    """Return the objective that rewards moving the base back before takeoff: minus the distance [m], up to `limit`.

    The base then has a longer way to accelerate ahead.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return minus the largest distance behind the start (-x) before takeoff, (num,)."""
        back = motion.q[0, :, 0] - motion.q[..., 0]
        return -torch.where(before_takeoff(motion, speed), back, 0.0).amax(0).clamp_max(limit)

    return term


def drifts(limit: float) -> Term:
    """Return the constraint that the base moves horizontally by at most `limit` [m] during the whole motion."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return the horizontal distance from the start less the limit [m], (steps + 1, num)."""
        offset = motion.q[..., :2] - motion.q[0, :, :2]
        return (offset.square().sum(-1) + 1.0e-12).sqrt() - limit

    return term


def clear(margin: float = MARGIN, speed: float | None = None) -> Term:
    """Return the constraint that housings, thighs, knees and shanks stay at least `margin` [m] above the ground.

    It is scaled to 0.1 m. speed [m/s]: only the rows before this takeoff count; None: all rows.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return the lacking height of the lowest link in units of 0.1 m, (steps + 1, num); 0 in rows that are out."""
        gap = 10.0 * (margin - motion.clearance.amin((-1, -2)))
        return gap if speed is None else torch.where(before_takeoff(motion, speed), gap, 0.0)

    return term


def no_run_up(limit: float = 0.04, speed: float = 0.25) -> Term:
    """Return the constraint that hind paws on the ground are at most `limit` [m] ahead of their start until takeoff.

    The distance of a jump counts from the start; steps ahead before the takeoff would be part of it.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return how far the foremost hind paw is beyond the limit [m], (steps, num); 0 in rows that do not count."""
        hind_x = motion.ankles[..., 2:, 0]  # paws BL, BR
        ahead = hind_x[1:].amax(-1) - hind_x[0].amax(-1) - limit
        counts = motion.down[:, 2:].any(1) & before_takeoff(motion, speed)[:-1]
        return torch.where(counts, ahead, 0.0)

    return term


def takes_off(speed: float = 0.25, lift: float = 0.01) -> Term:
    """Return the constraint that the robot takes off; without takeoff its value falls as the lowest paw rises.

    That value, which has a gradient, is how far the paw is below `lift` [m] at the end, scaled to 0.1 m, plus 0.01.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return 0 for worlds that take off, else a positive value that shrinks as the lowest paw rises, (num,)."""
        lowest = (motion.ankles[-1, ..., 2] - motion.body.paw_radius).amin(-1)
        took_off = motion.takeoff(speed)[1]
        return torch.where(took_off, 0.0, 10.0 * (lift - lowest).clamp_min(0.0) + 0.01)

    return term


def upright(limit: float, at_end: bool = True) -> Term:
    """Return the constraint that the base tilts by at most `limit` [rad], at the end or (not at_end) at all times."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return 2 sin(tilt / 2) - 2 sin(limit / 2), about tilt - limit [rad]; x, y of the quaternion give the tilt."""
        quat = motion.q[-1:, :, 3:7] if at_end else motion.q[..., 3:7]
        x, y = quat[..., 0], quat[..., 1]
        return 2.0 * (x.square() + y.square() + 1e-12).sqrt() - 2.0 * math.sin(0.5 * limit)

    return term


def reaches(height: float) -> Term:
    """Return the constraint that the base reaches an apex (see `highest`) of at least `height` [m]."""
    return lambda motion: height + highest()(motion)


def touchdowns(motion: SimulatedMotion, speed: float = 0.25) -> torch.Tensor:
    """Return whether each paw has touched down since takeoff, bool (steps + 1, 4 paws FL, FR, BL, BR, num).

    It stays true after a paw's first contact, even if the paw lifts again.
    """
    row, _ = motion.takeoff(speed)
    later = torch.arange(motion.q.shape[0], device=row.device)[:, None, None] > row
    down = torch.cat([torch.zeros_like(motion.down[:1]), motion.down])
    return (down & later).int().cummax(0).values.bool()


def soft(limit: float, speed: float = 0.25) -> Term:
    """Return the constraint that the base accelerates upward by at most `limit` [g] after takeoff, for a soft landing.

    It is scaled to 10 g. The acceleration is the mean over a policy step.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return the acceleration above the limit in units of 10 g, (steps, num); -1, satisfied, before takeoff."""
        up = motion.base_velocity[..., 2]
        acceleration = (up[1:] - up[:-1]) / (motion.substeps * motion.dt * motion.gravity)
        later = torch.arange(len(up), device=up.device)[1:, None] > motion.takeoff(speed)[0]
        return torch.where(later, 0.1 * (acceleration - limit), -1.0)

    return term


def lifted(dead_band: float = 0.001) -> Term:
    """Return the objective that penalises lifting paws again after touchdown: time integral of their height.

    The integral is in units of 10 mm s. Heights are counted above `dead_band` [m]. Each paw's height in the last row is
    added in units of 10 mm.
    """

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return the penalty (num,): heights of paws that have touched down, over time, and of all at the end."""
        height = (motion.ankles[..., 2] - motion.body.paw_radius - dead_band).clamp_min(0.0).movedim(2, 1)
        step = motion.substeps * motion.dt
        return 100.0 * (step * torch.where(touchdowns(motion), height, 0.0).sum((0, 1)) + height[-1].sum(0))

    return term


def rest() -> Term:
    """Return the objective of ending at rest: squared final speed [m^2/s^2] + angular velocity [rad^2/s^2] / 10."""

    def term(motion: SimulatedMotion) -> torch.Tensor:
        """Return the penalty (num,), from the last row's rates: com velocity, then angular velocity of the base."""
        last = motion.qd[-1]
        return last[:, :3].square().sum(-1) + 0.1 * last[:, 3:6].square().sum(-1)

    return term


def still(dead_band: float = 0.001) -> Term:
    """Return the objective of ending at rest on planted paws: `lifted` plus half of `rest`."""
    return lambda motion: lifted(dead_band)(motion) + 0.5 * rest()(motion)
