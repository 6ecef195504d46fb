"""The robot's parts in a Newton model: its paws, ground and blocks, and whether the model is this robot at all."""

from __future__ import annotations

import itertools
import warnings
from types import ModuleType
from typing import Any

import newton
import numpy as np
import warp as wp

from jumper_warp.kernels.dynamics.restore import StateArrays
from jumper_warp.robot.description import LEGS
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.model import other_colliders
from jumper_warp.sim.precision import KernelModules
from jumper_warp.utils.checks import check_type
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import KernelStruct
from jumper_warp.utils.newton_types import Model, State

LINKS = ("housing", "outer_thigh", "outer_shank", "inner_thigh", "inner_shank")
JOINTS = ("lateral", "outer", "outer_knee", "inner", "inner_knee")
ALONE = "this robot alone, besides shapes and sites"


class NotThisRobotError(InputError):
    """Error raised for a Newton model whose bodies, joints or shapes are not those of this robot."""


def check_model(model: Model) -> None:
    """Raise NotThisRobotError unless every world of a model is this robot, with its labels in the expected order.

    Raises InputError: it is no Newton model.
    """
    check_type("model", model, newton.Model)
    bodies = ["body"] + [f"{leg}_{link}" for leg in LEGS for link in LINKS]
    joints = ["base"] + [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS] + [f"{leg}_ankle" for leg in LEGS]
    count = model.world_count
    if count < 1:
        raise NotThisRobotError("the model has no worlds; build it with jumper_warp.robot.model.build_model")
    for noun, labels, expected in (("body", model.body_label, bodies), ("joint", model.joint_label, joints)):
        for label, name in itertools.zip_longest(labels, count * expected):
            if label is None or label.split("/")[-1] != name:
                found = f"{noun} {label!r:.60} cannot be simulated in place of {name!r}"
                raise NotThisRobotError(f"{found}: every world must hold {ALONE}")
    for name, size, per_world in (("joint_q", model.joint_coord_count, 43), ("joint_qd", model.joint_dof_count, 38)):
        if size != count * per_world:
            raise NotThisRobotError(f"{name} must hold {per_world} values a world, found {size / count:g}")
    unsupported = {
        "particles": model.particle_count,
        "muscles": model.muscle_count,
        "tendons": model.tendon_count,
        "mimic joints": np.count_nonzero(model.joint_mimic_joint.numpy() >= 0) + model.constraint_mimic_count,
        **{name: n for name, n in model.custom_frequency_counts.items() if name.startswith("mujoco:")},
    }
    for noun, number in unsupported.items():
        if number > 0:
            raise NotThisRobotError(f"{number} {noun} cannot be simulated: every world must hold {ALONE}")


def warn_of_colliders(model: Model) -> None:
    """Emit one UserWarning if the model has colliding shapes that `JumperDynamics` ignores."""
    ignored = other_colliders(model)
    if len(ignored) > 0:
        warnings.warn(
            f"SolverJumper ignores the collisions of {len(ignored)} shapes, such as "
            f"{model.shape_label[ignored[0]]!r:.60}: only paws, ground and blocks have contact",
            stacklevel=4,  # this function, the constructor, and its lock
        )


def find_paws(model: Model) -> np.ndarray:
    """Return the shape indices of the four paws in every world of a Newton model.

    Shape (num_worlds, 4) int32, legs FL, FR, BL, BR. Raises NotThisRobotError.
    """
    paws = {leg: [] for leg in LEGS}
    for i, label in enumerate(model.shape_label):
        name = label.split("/")[-1]
        if name.endswith("_paw") and name[:2] in paws:
            paws[name[:2]].append(i)
    for leg, shapes in paws.items():
        if len(shapes) != model.world_count:
            raise NotThisRobotError(f"each world must have one shape {leg}_paw, found {len(shapes)} in all")
    return np.array([paws[leg] for leg in LEGS], dtype=np.int32).T


def find_ground(model: Model) -> int:
    """Return the index of the ground shape that all worlds share, a plane or a heightfield; -1 without one.

    Raises NotThisRobotError for several, a plane other than z = 0, or a tilted heightfield.
    """
    worlds, types = model.shape_world.numpy(), model.shape_type.numpy()
    kinds = (int(newton.GeoType.PLANE), int(newton.GeoType.HFIELD))
    grounds = [i for i in np.flatnonzero(worlds == -1) if types[i] in kinds]
    if len(grounds) > 1:
        raise NotThisRobotError(f"the ground must be one plane or heightfield, found {len(grounds)}")
    if not grounds:
        return -1
    pose = model.shape_transform.numpy()[grounds[0]]
    tilted = np.abs(pose[3:5]).max() > 1e-6
    if tilted or (types[grounds[0]] == kinds[0] and abs(pose[2]) > 1e-6):
        raise NotThisRobotError("the ground plane must be z = 0 and a heightfield must not be tilted")
    return int(grounds[0])


def ground_struct(model: Model, shape: int, ground_module: ModuleType) -> KernelStruct:
    """Return the ground of a Newton model, a plane or heightfield, as the struct that the contact kernels read.

    shape: index from `find_ground`; for -1 a plane that nothing reaches.
    """
    ground = ground_module.Ground()
    heights = np.zeros((1, 1), dtype=np.float32)
    if shape < 0:
        heights = np.full((2, 2), -1000.0, dtype=np.float32)  # [m] far below every robot
        ground.rows, ground.cols, ground.half_x, ground.half_y = 2, 2, 1.0, 1.0
    elif model.shape_type.numpy()[shape] == int(newton.GeoType.HFIELD):
        field = model.shape_source[shape]
        pose = model.shape_transform.numpy()[shape]
        heights = field.min_z + np.asarray(field.data, dtype=np.float32) * (field.max_z - field.min_z) + pose[2]
        ground.rows, ground.cols = heights.shape
        ground.center_x, ground.center_y = float(pose[0]), float(pose[1])
        ground.half_x, ground.half_y = field.hx, field.hy
    ground.heights = wp.array(heights.astype(np.float32), dtype=wp.float32, device=model.device)
    return ground


def block_array(cfg: BlockCfg | None, num_worlds: int, modules: KernelModules, device: wp.DeviceLike) -> wp.array:
    """Return the sliding blocks of all worlds as an array of structs for the kernels, at rest at their starts.

    Shape (num_worlds,), or (0,) if cfg is None.
    """
    block = modules.ground.Block
    fields = {} if cfg is None else cfg.per_world(num_worlds)
    layout: Any = block.numpy_dtype()
    values: Any = np.zeros(num_worlds if fields else 0, dtype=layout)
    for name, value in fields.items():
        values[name] = value
    if fields:
        values["exists"] = 1
        values["start"] = values["center"]
    return wp.array(values, dtype=block, device=device)


def state_arrays(state: State | Model) -> KernelStruct:
    """Return the joint and body arrays of a Newton state as the struct that the kernels read.

    For a model: the arrays of its reference pose.
    """
    arrays = StateArrays()
    for name in StateArrays.vars:
        setattr(arrays, name, getattr(state, name))
    return arrays
