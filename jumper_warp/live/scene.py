"""Robot as live viewers draw it, without Newton: meshes of links, and the poses of links from joint coordinates.

Any viewer can use it: the scene is sent once to the viewer's process, which then receives joint coordinates only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jumper_warp.utils.rotations import CONJUGATE, multiply, rotate

if TYPE_CHECKING:
    from jumper_warp.robot.parts import RobotDescription
    from jumper_warp.utils.newton_types import Model
    from jumper_warp.viz.shapes import ShapeMesh


@dataclass(frozen=True)
class RobotScene:
    """Meshes of ground and links, and the geometry of the legs.

    Link 0 is the base; five links a leg follow: housing, outer thigh, outer shank, inner thigh, inner shank.
    """

    shapes: tuple[ShapeMesh, ...]  # their body is a link's index, -1: the ground
    links: tuple[str, ...]  # names of the links
    anchors: np.ndarray  # (4, 5, 3) [m] hinge of each link in its parent's frame
    axes: np.ndarray  # (4, 5, 3) unit vector of the hinge
    shank: float  # [m] distance from knee to ankle

    def link_poses(self, joint_q: np.ndarray) -> np.ndarray:
        """Return the poses of all links, (..., 21, 7): position [m] and quaternion xyzw, world frame.

        joint_q: (..., 27 or more), as `RobotArrays.joint_q`; knee angles are not read, since the shanks meet at the
        ankle.
        """
        base = joint_q[..., None, :7]
        half = 0.5 * joint_q[..., 7:27].reshape(*joint_q.shape[:-1], 4, 5, 1)
        turns = np.concatenate([np.sin(half) * self.axes, np.cos(half)], axis=-1)
        housing = self._placed(base, 0, turns)
        thighs = [self._placed(housing, link, turns) for link in (1, 3)]
        knees = [self._placed(thigh, link, turns)[..., :3] for thigh, link in zip(thighs, (2, 4), strict=True)]
        across = rotate(housing[..., 3:], np.broadcast_to([0.0, 1.0, 0.0], knees[0].shape))
        gap = knees[1] - knees[0]
        gap = gap - np.sum(gap * across, axis=-1, keepdims=True) * across
        below = np.sign(self.anchors[:, 3, :1] - self.anchors[:, 1, :1]) * np.cross(across, gap)
        below = below / np.linalg.norm(gap, axis=-1, keepdims=True)
        squared = self.shank**2 - 0.25 * np.sum(gap * gap, axis=-1, keepdims=True)
        ankle = 0.5 * gap + np.sqrt(np.maximum(squared, 0.0)) * below  # from the outer knee
        shanks = [self._hanging(housing, knee, end) for knee, end in zip(knees, (ankle, ankle - gap), strict=True)]
        legs = np.stack([housing, thighs[0], shanks[0], thighs[1], shanks[1]], axis=-2)
        return np.concatenate([base, legs.reshape(*joint_q.shape[:-1], 20, 7)], axis=-2)

    def _placed(self, parent: np.ndarray, link: int, turns: np.ndarray) -> np.ndarray:
        """Return the poses (..., 4, 7) of a link of each leg; parent: its parent's; turns: of hinges, quaternions."""
        quat = np.broadcast_to(parent[..., 3:], turns[..., link, :].shape)
        pos = parent[..., :3] + rotate(quat, np.broadcast_to(self.anchors[:, link], (*quat.shape[:-1], 3)))
        return np.concatenate([pos, multiply(quat, turns[..., link, :])], axis=-1)

    def _hanging(self, housing: np.ndarray, knee: np.ndarray, ankle: np.ndarray) -> np.ndarray:
        """Return the poses (..., 4, 7) of shanks from their knee [m] to the ankle, relative to the knee [m]."""
        local = rotate(housing[..., 3:] * CONJUGATE, ankle)
        half = 0.5 * np.arctan2(-local[..., :1], -local[..., 2:])
        turn = np.concatenate([0.0 * half, np.sin(half), 0.0 * half, np.cos(half)], axis=-1)
        return np.concatenate([knee, multiply(housing[..., 3:], turn)], axis=-1)


def robot_scene(model: Model, robot: RobotDescription | None = None) -> RobotScene:
    """Return the scene of a simulation's model: drawn shapes of the robot (default: Jumper), the ground, the legs."""
    from jumper_warp.robot.model import build_model
    from jumper_warp.viz.shapes import shape_meshes

    start = np.asarray(model.joint_qd_start.numpy()[1:21], dtype=int)  # joint 0 is the base's, the ankles are the last
    anchors = model.joint_X_p.numpy()[:, :3]
    return RobotScene(
        tuple(shape_meshes(build_model(1, description=robot, device="cpu", mujoco=False), (0,))),
        tuple(label.split("/")[-1] for label in model.body_label[:21]), anchors[1:21].reshape(4, 5, 3),
        model.joint_axis.numpy()[start].reshape(4, 5, 3), float(np.linalg.norm(anchors[-1])),
    )  # fmt: skip
