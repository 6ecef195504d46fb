"""`RobotParameters`: the arrays that domain randomisation writes, as views of a simulation's arrays."""

from __future__ import annotations

import numpy as np
import warp as wp

from jumper_warp.kernels.layout import BODIES, DOFS
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.model_parts import find_paws
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.overlay_ranges import RangeMoves
from jumper_warp.utils.kernels import KernelStruct

MODEL = (
    "body_mass", "body_inv_mass", "body_com", "body_inertia", "body_inv_inertia", "joint_armature", "joint_friction",
)  # fmt: skip
"""Arrays of Newton's model that `RobotParameters` shares under the same name."""
NOMINAL = {
    "body_mass": "mass", "body_com": "com", "body_inertia": "inertia", "body_inv_inertia": "inv_inertia",
    "joint_armature": "armature",
}  # fmt: skip
"""Arrays of the model whose values of one world of each robot are copied to `nominal_<value>`."""


def robot_parameters(
    sim: Simulation, tasks: tuple[TaskCfg, ...], skill: wp.array, moves: RangeMoves | None = None
) -> KernelStruct:  # fmt: skip
    """Return the arrays of robot parameters that domain randomisation writes, as views of a simulation's arrays.

    The model's current values become the nominal ones. skill: (num_worlds,) int, index in `tasks` of each world's
    active task. moves: differences of the robot from the described one, None for the described one.
    """
    model = sim.model
    n = sim.num_worlds
    device = sim.device
    robots = RobotValues.nominal(1) if sim.robot is None else sim.robot
    one_of_each = slice(min(len(sim.descriptions), n))
    robot = RobotParameters()
    for name in MODEL:
        setattr(robot, name, getattr(model, name))
    for name, short in NOMINAL.items():
        array = getattr(model, name)
        count = int(BODIES) if name.startswith("body") else int(DOFS)
        first_worlds = array.numpy()[: count * one_of_each.stop]
        setattr(robot, f"nominal_{short}", wp.array(first_worlds, dtype=array.dtype, device=device))
    robot.shape_mu = model.shape_material_mu
    robot.paw_shapes = wp.array(find_paws(model).flatten(), dtype=int, device=device)
    robot.static_ratio = sim.dynamics.static_friction_ratio
    robot.motors = sim.motors
    robot.physics_dt = sim.dt
    robot.skill = skill
    latency = np.round(robots.latency[one_of_each, 0] / sim.dt).astype(np.int32)
    robot.latency = wp.array(np.resize(latency, n), dtype=int, device=device)
    robot.observation_latency = wp.zeros(n, dtype=int, device=device)
    robot.push = wp.zeros(n, dtype=wp.spatial_vectorf, device=device)
    for name in ("gain_ratio", "speed_ratio"):
        setattr(robot, name, wp.full((12, n), wp.vec2(1.0, 1.0), dtype=wp.vec2, device=device))
    robot.torque_ratio = wp.full((12, n), 1.0, dtype=float, device=device)
    for name, attribute in (("kp", "kp"), ("kd", "kd"), ("no_load", "no_load_speed"), ("cutoff", "cutoff_speed"),
                            ("saturation", "saturation")):  # fmt: skip
        rows = []
        for task in tasks:
            lateral, transversal = getattr(task.motors.lateral, attribute), getattr(task.motors.transversal, attribute)
            row = np.array(4 * [lateral, transversal, transversal])
            if sim.robot is not None:  # speeds of an overlay are absolute [rad/s], gains and saturation are factors
                value = getattr(robots, attribute)[one_of_each]
                row = value if attribute.endswith("speed") else row * value
            rows.append(row.ravel())
        setattr(robot, f"nominal_{name}", wp.array(np.array(rows, dtype=np.float32), dtype=float, device=device))
    robot.nominal_offset = wp.array(robots.offset[one_of_each].ravel(), dtype=float, device=device)
    moves = RangeMoves() if moves is None else moves
    robot.motor_friction_move = wp.array(np.array(moves.motor_friction), dtype=float, device=device)
    robot.friction_move = wp.vec2(moves.dynamic_friction, moves.static_friction)
    robot.latency_move = 1.0e-3 * moves.latency
    robot.zero_latency = 1.0e-3 * moves.zero_latency
    return robot
