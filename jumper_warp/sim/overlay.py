"""Replacement of masses, joints, springs and motors of a simulation by those of other robots (`RobotValues`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from jumper_warp.kernels.layout import BODIES, DOFS
from jumper_warp.robot.model import KNEE_DOFS
from jumper_warp.robot.values import LINK_KINDS, RobotValues
from jumper_warp.sim.dynamics import JumperDynamics, find_paws
from jumper_warp.utils.newton_types import Model

MOTOR_DOFS = [6 + 5 * leg + joint for leg in range(4) for joint in (0, 1, 3)]
"""Indices of a world's 12 motors in its 38 `joint_qd`."""


def write_model(model: Model, robots: RobotValues, *, paws: bool = True) -> None:
    """Replace masses, joint constants and paw friction of a Newton model by those of given robots.

    Call it before a solver reads the model, which must be of the described robot. robots: N = 1 for all worlds, or N =
    num_worlds. paws: whether to write the paws' friction.
    """
    n = model.world_count
    mass = model.body_mass.numpy().reshape(n, -1)
    com = model.body_com.numpy().reshape(n, int(BODIES), 3)
    inertia = model.body_inertia.numpy().reshape(n, int(BODIES), 3, 3)
    scale = np.tile(robots.link_mass, (1, 4)) * np.ones((n, 4 * len(LINK_KINDS)))
    base_ratio = robots.base_mass[:, 0] / mass[:, 0]
    inertia[:, 0] *= (base_ratio * robots.base_inertia[:, 0])[:, None, None]
    inertia[:, 1:] *= scale[:, :, None, None]
    mass[:, 0], com[:, 0] = robots.base_mass[:, 0], robots.base_com
    mass[:, 1:] *= scale
    for array, values in (
        (model.body_mass, mass),
        (model.body_inv_mass, 1.0 / mass),
        (model.body_com, com),
        (model.body_inertia, inertia),
        (model.body_inv_inertia, np.linalg.inv(inertia.astype(np.float64))),
    ):
        array.assign(np.ascontiguousarray(values, dtype=np.float32).reshape(array.numpy().shape))
    for array, dofs, values in (
        (model.joint_armature, MOTOR_DOFS, robots.armature),
        (model.joint_friction, MOTOR_DOFS, robots.motor_friction),
        (model.joint_damping, KNEE_DOFS, robots.knee_damping),
    ):
        table = array.numpy().reshape(n, int(DOFS))
        table[:, dofs] = values
        array.assign(table.ravel())
    if paws:
        friction = model.shape_material_mu.numpy()
        friction[find_paws(model)] = robots.paw_friction
        model.shape_material_mu.assign(friction)


def write_springs(dynamics: JumperDynamics, robots: RobotValues) -> None:
    """Set stiffness and rest length of the springs between the knees of each leg to those of given robots.

    robots: N = 1 for all worlds, or N = num_worlds. The kernels' parameter table is updated.
    """
    values = np.hstack([robots.spring_stiffness, robots.spring_length])
    dynamics.leg_springs.assign(np.broadcast_to(values, (dynamics.num_worlds, 2)).astype(np.float32))
    dynamics.pack_springs()


def write_motors(motors: Any, robots: RobotValues) -> None:
    """Set gains, torque limits, speeds and sensor offsets of the motors to those of given robots.

    kp, kd and saturation of `MotorArrays`, which hold the description's values, are scaled. robots: N = 1 for all
    worlds, or N = num_worlds.
    """
    for name in ("kp", "kd", "saturation"):
        array: wp.array = getattr(motors, name)
        array.assign((array.numpy() * getattr(robots, name).T).astype(np.float32))
    for name in ("no_load_speed", "cutoff_speed", "offset"):
        array = getattr(motors, name)
        array.assign((np.zeros(array.shape) + getattr(robots, name).T).astype(np.float32))
