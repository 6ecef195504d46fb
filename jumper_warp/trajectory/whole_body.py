"""Kinematics and momentum of the robot as functions of PyTorch tensors, for objectives of trajectories.

States are rows of `Trajectory`: q (..., 19) and qd (..., 18), coordinates last: base position, orientation (xyzw) and
12 motor angles; velocity of the base's centre of mass, angular velocity and 12 motor rates. Positions and velocities
are in the world frame, z up. Motors of a leg: lateral (positive outward), outer, inner (positive away from the other
thigh). A leg's housing turns about body x by side * lateral; links turn about housing +y, 0 for one along -z. The
formulas are those of the kernels (`five_bar`, `leg_dynamics`); PyTorch differentiates them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from jumper_warp.diff.bodies import moment_rows
from jumper_warp.diff.rollout import Rollout
from jumper_warp.kernels.collision.robot import HOUSING_LENGTH, HOUSING_RADIUS, SHANK_FREE, SHANK_RADIUS, THIGH_RADIUS
from jumper_warp.kernels.layout import BODIES

FRONT = (1.0, 1.0, -1.0, -1.0)
SIDE = (1.0, -1.0, 1.0, -1.0)  # Signs of the legs FL, FR, BL, BR: front +1, hind -1; left +1, right -1
OUTER, INNER = 0, 1  # indices of a leg's two transversal motors, thighs or shanks


class LegFrames(NamedTuple):
    """Poses and velocities of all links of the four legs, world frame; axes (..., leg, link, ...).

    Legs FL, FR, BL, BR; links housing, outer thigh, outer shank, inner thigh, inner shank.
    """

    pos: torch.Tensor  # (..., 4, 5, 3) [m] origins: hip, outer transversal axis, outer knee, inner axis, inner knee
    rotation: torch.Tensor  # (..., 4, 5, 3, 3) link to world
    vel: torch.Tensor  # (..., 4, 5, 3) [m/s] of the origins
    ang: torch.Tensor  # (..., 4, 5, 3) [rad/s] angular velocities
    ankle: torch.Tensor  # (..., 4, 3) [m] centres of the paws


class Momentum(NamedTuple):
    """Centre of mass, its velocity, angular momentum and inertia of the whole robot, world frame."""

    com: torch.Tensor  # (..., 3) [m] centre of mass
    vel: torch.Tensor  # (..., 3) [m/s] velocity of the centre of mass
    spin: torch.Tensor  # (..., 3) [kg m^2/s] angular momentum about the centre of mass
    inertia: torch.Tensor  # (..., 3, 3) [kg m^2] of the present posture, about the centre of mass


def rotation_matrices(quat: torch.Tensor) -> torch.Tensor:
    """Return rotation matrices (..., 3, 3) of quaternions xyzw (..., 4), which are normalised first."""
    x, y, z, w = torch.nn.functional.normalize(quat, dim=-1).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _rotation_x(cos: torch.Tensor, sin: torch.Tensor) -> torch.Tensor:
    """Return rotation matrices (..., 3, 3) about x, given cosine and sine of the angle (...); differentiable."""
    one = torch.ones_like(cos)
    zero = torch.zeros_like(cos)
    return torch.stack([one, zero, zero, zero, cos, -sin, zero, sin, cos], dim=-1).unflatten(-1, (3, 3))


def _rotation_y(cos: torch.Tensor, sin: torch.Tensor) -> torch.Tensor:
    """Return rotation matrices (..., 3, 3) about y, given cosine and sine of the angle (...)."""
    one = torch.ones_like(cos)
    zero = torch.zeros_like(cos)
    return torch.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos], dim=-1).unflatten(-1, (3, 3))


def _apply(rotation: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Return vectors (..., 3) rotated by matrices (..., 3, 3)."""
    return (rotation @ vector.unsqueeze(-1)).squeeze(-1)


def _cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return cross products a x b (..., 3); a and b are broadcast."""
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


class WholeBody:
    """Differentiable kinematics and momentum of the robot of a rollout, with the masses of its world 0."""

    def __init__(self, rollout: Rollout):
        """Copy lengths and masses of a rollout; later changes of the rollout have no effect."""
        self._real = torch.float64 if rollout.real is wp.float64 else torch.float32
        device = str(rollout.device)
        lengths = torch.as_tensor(rollout.geometry(), dtype=self._real, device=device)
        self._hip = lengths[:, :3]
        self._outer_x, self._inner_x, self._plane_y, self._knee_y, self._thigh, self._shank, self.paw_radius = lengths[
            :, 3:
        ].unbind(1)
        """Lengths [m] of the four legs, (4,) each, as `jumper_warp.diff.rollout.GEOMETRY_NAMES`."""
        self._front = lengths.new_tensor(FRONT)
        self._side = lengths.new_tensor(SIDE)
        self._flip = torch.stack([self._front, -self._front], dim=-1)
        table = rollout.parameters["table"].numpy()[:, 0].astype(np.float64)
        moments = np.stack([table[moment_rows(body)] for body in range(int(BODIES))])
        moments = torch.as_tensor(moments, dtype=self._real, device=device)
        self._mass = moments[:, 0]
        self._first = moments[:, 1:4]
        xx, yy, zz, xy, xz, yz = moments[:, 4:10].unbind(1)
        self._second = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=1).unflatten(1, (3, 3))
        self.mass = float(self._mass.sum())  # [kg] of the whole robot

    def _base(self, q: torch.Tensor, qd: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return rotation, position, velocity and angular velocity of the base, world frame.

        Rotation (..., 3, 3), origin [m], its velocity [m/s], angular velocity [rad/s]. Arguments q (..., 19), qd (...,
        18), whose first entries are the velocity of the base link's centre of mass. Vectors: (..., 3), world frame.
        """
        rotation = rotation_matrices(q[..., 3:7])
        ang = qd[..., 3:6]
        vel = qd[..., :3] - _cross(ang, _apply(rotation, (self._first[0] / self._mass[0]).expand_as(ang)))
        return rotation, q[..., :3], vel, ang

    def base_velocity(self, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor:
        """Return the velocity [m/s] of the base's origin, world frame, (..., 3). q: (..., 19), qd: (..., 18)."""
        return self._base(q, qd)[2]

    def legs(self, q: torch.Tensor, qd: torch.Tensor) -> LegFrames:
        """Return poses and velocities of the legs' links. q: (..., 19), qd: (..., 18)."""
        base_rotation, base_pos, base_vel, base_ang = self._base(q, qd)
        base_rotation = base_rotation.unsqueeze(-3)
        angle = q[..., 7:].unflatten(-1, (4, 3))
        rate = qd[..., 6:].unflatten(-1, (4, 3))
        arm = _apply(base_rotation, self._hip.expand(*angle.shape))
        pos = base_pos.unsqueeze(-2) + arm
        ang = base_ang.unsqueeze(-2)
        vel = base_vel.unsqueeze(-2) + _cross(ang, arm)
        rotation = base_rotation @ _rotation_x(angle[..., 0].cos(), self._side * angle[..., 0].sin())
        ang = ang + base_rotation[..., 0] * (self._side * rate[..., 0]).unsqueeze(-1)
        local, ankle, shank_dir = self._planar(angle[..., 1:])
        plane_vel, cosines, sines, rates = self._planar_rates(angle[..., 1:], rate[..., 1:], shank_dir)
        arms = rotation.unsqueeze(-3) @ local.unsqueeze(-1)
        arms = arms.squeeze(-1)
        moving = (rotation.unsqueeze(-3) @ plane_vel.unsqueeze(-1)).squeeze(-1)
        return LegFrames(
            torch.cat([pos.unsqueeze(-2), pos.unsqueeze(-2) + arms], dim=-2),
            torch.cat([rotation.unsqueeze(-3), rotation.unsqueeze(-3) @ _rotation_y(cosines, sines)], dim=-3),
            torch.cat(
                [vel.unsqueeze(-2), vel.unsqueeze(-2) + _cross(ang.unsqueeze(-2), arms) + moving], dim=-2
            ),
            torch.cat(
                [ang.unsqueeze(-2), ang.unsqueeze(-2) + rotation[..., 1].unsqueeze(-2) * rates.unsqueeze(-1)], dim=-2
            ),
            pos + _apply(rotation, ankle),
        )  # fmt: skip

    def _planar(self, angle: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return positions of the five-bars in their housing frames, given outer and inner angles [rad] (..., 4, 2).

        Returned: origins (..., 4, 4, 3) [m] of outer thigh, outer shank, inner thigh, inner shank; ankles (..., 4, 3)
        [m]; unit vectors along the shanks (..., 4, 2, 2): outer and inner, x and z.
        """
        zero = torch.zeros_like(angle[..., 0])
        axis = torch.stack([self._outer_x, self._inner_x], dim=-1)
        thigh, shank = self._thigh[:, None], self._shank[:, None]
        knee_x = axis + self._flip * thigh * angle.sin()
        knee_z = -thigh * angle.cos()
        span_x = knee_x[..., OUTER] - knee_x[..., INNER]
        span_z = knee_z[..., OUTER] - knee_z[..., INNER]
        span_sq = (span_x**2 + span_z**2).clamp_min(1.0e-8)
        ratio = self._front * ((self._shank**2 - 0.25 * span_sq).clamp_min(1.0e-8) / span_sq).sqrt()
        ankle_x = knee_x.mean(-1) + ratio * span_z
        ankle_z = knee_z.mean(-1) - ratio * span_x
        shank_dir = torch.stack([(ankle_x[..., None] - knee_x) / shank, (ankle_z[..., None] - knee_z) / shank], dim=-1)
        hip_y = self._plane_y.expand_as(zero)
        knee_y = (self._plane_y + self._knee_y).expand_as(zero)
        origins = []
        for side in (OUTER, INNER):
            origins.append(torch.stack([axis[:, side].expand_as(zero), hip_y, zero], dim=-1))
            origins.append(torch.stack([knee_x[..., side], knee_y, knee_z[..., side]], dim=-1))
        return torch.stack(origins, dim=-2), torch.stack([ankle_x, knee_y, ankle_z], dim=-1), shank_dir

    def _planar_rates(
        self, angle: torch.Tensor, rate: torch.Tensor, shank_dir: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return velocities and rotation of the five-bars' links in their housing frames.

        angle [rad], rate [rad/s]: (..., 4, 2); shank_dir: (..., 4, 2, 2), see `_planar`. Returned, in the housing
        frame: velocities (..., 4, 4, 3) [m/s] of the origins of `_planar`; cosines, sines and rates [rad/s] of the
        links' rotation about y, (..., 4, 4) each.
        """
        sin = angle.sin()
        cos = angle.cos()
        thigh = self._thigh[:, None]
        shank = self._shank[:, None]
        knee_vx = self._flip * thigh * cos * rate
        knee_vz = thigh * sin * rate
        shank_x, shank_z = shank_dir.unbind(-1)
        along = shank_x * knee_vx + shank_z * knee_vz
        det = shank_x[..., OUTER] * shank_z[..., INNER] - shank_z[..., OUTER] * shank_x[..., INNER]
        det = torch.where(det.abs() < 1.0e-4, torch.where(det < 0.0, -1.0e-4, 1.0e-4), det)
        ankle_vx = (along[..., OUTER] * shank_z[..., INNER] - along[..., INNER] * shank_z[..., OUTER]) / det
        ankle_vz = (along[..., INNER] * shank_x[..., OUTER] - along[..., OUTER] * shank_x[..., INNER]) / det
        shank_rate = (shank_z * (ankle_vx[..., None] - knee_vx) - shank_x * (ankle_vz[..., None] - knee_vz)) / shank
        zero = torch.zeros_like(knee_vx[..., 0])
        rest = torch.stack([zero, zero, zero], dim=-1)
        outer, inner = (torch.stack([knee_vx[..., i], zero, knee_vz[..., i]], dim=-1) for i in (OUTER, INNER))

        def links(thighs: torch.Tensor, shanks: torch.Tensor) -> torch.Tensor:
            """Interleave values (..., 2) of thighs and shanks: outer thigh, outer shank, inner thigh, inner shank."""
            return torch.stack([thighs, shanks], dim=-1).flatten(-2)

        return (
            torch.stack([rest, outer, rest, inner], dim=-2), links(cos, -shank_z), links(-self._flip * sin, -shank_x),
            links(-self._flip * rate, shank_rate),
        )  # fmt: skip

    def momentum(self, q: torch.Tensor, qd: torch.Tensor) -> Momentum:
        """Return centre of mass and momentum of the whole robot, world frame. q: (..., 19), qd: (..., 18)."""
        base_rotation, base_pos, base_vel, base_ang = self._base(q, qd)
        legs = self.legs(q, qd)

        def links(base: torch.Tensor, legs_part: torch.Tensor, axes: int) -> torch.Tensor:
            """Join values of the base and of the 20 leg links along one axis; axes: axes of a link's value."""
            first = base.dim() - axes
            return torch.cat([base.unsqueeze(first), legs_part.flatten(first, first + 1)], dim=first)

        rotation = links(base_rotation, legs.rotation, 2)
        pos, vel, ang = (
            links(base, legs_part, 1)
            for base, legs_part in ((base_pos, legs.pos), (base_vel, legs.vel), (base_ang, legs.ang))
        )
        mass = self._mass[:, None]
        first = _apply(rotation, self._first.expand_as(pos))
        second = rotation @ self._second @ rotation.transpose(-1, -2)
        com = (mass * pos + first).sum(-2) / self.mass
        com_vel = (mass * vel + _cross(ang, first)).sum(-2) / self.mass
        arm = pos - com.unsqueeze(-2)
        moving = vel - com_vel.unsqueeze(-2)
        # second moments about the centre of mass
        outer = mass[..., None] * arm.unsqueeze(-1) * arm.unsqueeze(-2) + second
        mixed = arm.unsqueeze(-1) * first.unsqueeze(-2)
        outer = outer + mixed + mixed.transpose(-1, -2)
        link_inertia = _inertia(second)
        spin = (
            mass * _cross(arm, moving)
            + _cross(arm, _cross(ang, first))
            + _cross(first, moving)
            + _apply(link_inertia, ang)
        )
        return Momentum(com, com_vel, spin.sum(-2), _inertia(outer.sum(-3)))

    def points(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions of the links' origins and of the paws' centres [m], world frame.

        `LegFrames.pos` (..., 4, 5, 3) and `LegFrames.ankle` (..., 4, 3). q: (..., 19).
        """
        rotation = rotation_matrices(q[..., 3:7]).unsqueeze(-3)
        angle = q[..., 7:].unflatten(-1, (4, 3))
        origins, ankle = self._planar(angle[..., 1:])[:2]
        local = torch.cat([torch.zeros_like(origins[..., :1, :]), origins, ankle.unsqueeze(-2)], dim=-2)
        cos = angle[..., 0].cos().unsqueeze(-1)
        sin = (self._side * angle[..., 0].sin()).unsqueeze(-1)
        x, y, z = local.unbind(-1)
        hip = self._hip[:, None]
        inside = torch.stack([x + hip[..., 0], cos * y - sin * z + hip[..., 1], sin * y + cos * z + hip[..., 2]], -1)
        world = q[..., None, None, :3] + inside @ rotation.transpose(-1, -2)
        return world[..., :5, :], world[..., 5, :]

    def clearance(self, q: torch.Tensor) -> torch.Tensor:
        """Return the heights [m] of each leg's housing, thighs, knees and shanks above level ground, (..., 4 legs, 4).

        They are negative in the ground; the shanks are without paw. Each is the minimum over the shapes of its kind in
        `jumper_warp.kernels.collision.robot`. q: (..., 19).
        """
        return self.clearance_of(q, *self.points(q))

    def clearance_of(self, q: torch.Tensor, pos: torch.Tensor, ankle: torch.Tensor) -> torch.Tensor:
        """Return the heights [m] of the legs' links above level ground, from known positions of the links.

        As `clearance`, (..., 4, 4), from q (..., 19) and `pos`, `ankle` of `points`.
        """
        height, ankle = pos[..., 2], ankle[..., 2]
        tip = height[..., 0] + rotation_matrices(q[..., 3:7])[..., 2, 0, None] * self._front * float(HOUSING_LENGTH)
        axes, knees = height[..., 1::2], height[..., 2::2]
        # one end of a straight link is its lowest point
        lowest = knees + float(SHANK_FREE) * (ankle[..., None] - knees)
        distances = (
            torch.minimum(height[..., 0], tip) - float(HOUSING_RADIUS),
            torch.minimum(axes, 0.5 * (axes + knees)).amin(-1) - float(THIGH_RADIUS),
            knees.amin(-1) - float(THIGH_RADIUS),
            torch.minimum(knees, lowest).amin(-1) - float(SHANK_RADIUS),
        )
        return torch.stack(distances, dim=-1)


def _inertia(second: torch.Tensor) -> torch.Tensor:
    """Convert second moments of mass, the integral of r r^T dm, to inertia tensors (..., 3, 3) [kg m^2]."""
    trace = second.diagonal(dim1=-2, dim2=-1).sum(-1)
    return trace[..., None, None] * torch.eye(3, dtype=second.dtype, device=second.device) - second
