"""Newton's MuJoCo solver with settings for this robot."""

from __future__ import annotations

import math

import newton
import warp as wp

from jumper_warp.robot.model import LOOP_IMPEDANCE, PAWS, PHYSICS_DT, other_colliders
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.newton_types import Model

MUJOCO_FRICTION = 0.005
"""[1] Least friction of the paws on SolverMuJoCo: at 0.001 its pyramidal cone gives NaN in single precision."""


def mujoco_solver(model: Model, *, dt: float = PHYSICS_DT, **overrides) -> newton.solvers.SolverMuJoCo:
    """Return Newton's MuJoCo solver, set so that the robot's closed leg loops stay stiff at physics steps of `dt` [s].

    MuJoCo has neither a damper with a torque limit nor a stop of the sum of two angles: here the knees' damping is
    unlimited and outer + inner has no stop. `Simulation` adds both as torques (`kernels.actuation.passive`).

    overrides: arguments of `newton.solvers.SolverMuJoCo`. Raises InputError: paw friction below `MUJOCO_FRICTION`, or
    `save_to_mjcf`, whose file has open loops: it anchors them where the joint angles are 0.
    """
    if overrides.get("save_to_mjcf"):
        raise InputError("save_to_mjcf writes open loops; use: jumper export robot --format mjcf --out FOLDER")
    paws = [index for index, label in enumerate(model.shape_label) if label.split("/")[-1] in PAWS]
    friction = model.shape_material_mu.numpy()[paws].min(initial=math.inf)
    if not friction >= MUJOCO_FRICTION:
        raise InputError(f"SolverMuJoCo needs paws of friction {MUJOCO_FRICTION:g} or more, got {friction:g}")
    many_contacts = newton.GeoType.HFIELD in model.shape_type.numpy() or len(other_colliders(model)) > 0
    settings = {
        "njmax": 128 if many_contacts else 64,  # constraint rows of a world
        "nconmax": None if many_contacts else 12,  # contacts of a world; None: estimated from the shapes
        "iterations": 6,
        "ls_iterations": 6,
        "cone": "pyramidal",
        "integrator": "implicitfast",
        "kinematic_switchable_roots": False,
    }
    solver = newton.solvers.SolverMuJoCo(model, **(settings | overrides))
    solver.mjw_model.opt.warn_overflow = 0
    solver.mjw_model.eq_solref.fill_(wp.vec2(2.0 * dt, 1.0))
    impedance = solver.mjw_model.eq_solimp.numpy()
    impedance[:] = LOOP_IMPEDANCE
    solver.mjw_model.eq_solimp.assign(impedance)
    return solver
