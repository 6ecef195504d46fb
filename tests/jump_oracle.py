"""The vertical jump's reward table once more, in NumPy, from the paper's formulas and the robot's arrays."""

import numpy as np
from jump_helpers import DEFAULT_ANGLE
from scipy.spatial.transform import Rotation

DT = 1.0 / 60.0
SLOTS = np.array([5 * leg + joint for leg in range(4) for joint in (0, 1, 3)])
T = np.arange(12) % 3 != 0
STANCE, FLIGHT, LANDED = 0, 1, 2


def robot_of(env) -> dict[str, np.ndarray]:
    """Return copies of what the rewards need; worlds are the last index."""
    q, qd = env.sim.joint_q().astype(float), env.sim.joint_qd().astype(float)
    turn = Rotation.from_quat(q[:, 3:7])
    com = env.sim.model.body_com.numpy().reshape(len(q), -1, 3)[:, 0]
    views, tasks = env._views, env.tasks.numpy()
    robot = {
        "z": q[:, 2],
        "vel": qd[:, :3] - np.cross(qd[:, 3:6], turn.apply(com)),
        "spin": np.linalg.norm(qd[:, 3:6], axis=1),
        "lean": np.linalg.norm(turn.inv().apply([0.0, 0.0, 1.0])[:, :2], axis=1),
        "angle": q[:, 7 + SLOTS].T,
        "rate": qd[:, 6 + SLOTS].T,
        "torque": views.torque.numpy().astype(float),
        "action": views.action.numpy().astype(float),
        "force": np.linalg.norm(views.paw_force.numpy().astype(float), axis=2),
        "clipped": np.sum((views.target.numpy().astype(float) - views.safe_target.numpy()) ** 2, axis=0),
        "goal": tasks["goal"][:, 2].astype(float),
    }
    names = ("phase", "phase_steps", "steps", "command_step", "at_apex", "apex_passed", "max_height")
    return robot | {name: tasks[name].copy() for name in names}


def phi(x, s):
    """The exponential kernel."""
    return np.exp(-((x / s) ** 2))


def height_kernel(error, p):
    """The height reward of Table III with a third, wide kernel."""
    return phi(error, p[0]) + 3.0 * np.exp(-np.abs(error) / p[1]) + phi(error, p[2])


def expected_terms(task, before: dict, after: dict, action: np.ndarray) -> np.ndarray:
    """Return the weighted terms of the step between two states, (terms, worlds); action: (12, worlds)."""
    p = {term.name: term.params for term in task.terms}
    stance, flight, landed = (after["phase"] == phase for phase in (STANCE, FLIGHT, LANDED))
    soon = landed & (after["phase_steps"] < 18)
    waiting = stance & (after["steps"] >= after["command_step"])
    vel, speed = after["vel"], np.linalg.norm(after["vel"], axis=1)
    along = np.sum((vel - before["vel"]) / DT * vel, axis=1) / np.maximum(speed, 1e-9)
    deceleration = np.where(speed > 1e-6, np.maximum(-along, 0.0), 0.0)
    apex = after["z"] + np.maximum(vel[:, 2], 0.0) ** 2 / 19.62

    def posture(name, shift=0.0):
        off = after["angle"] - DEFAULT_ANGLE[:, None] - shift * T[:, None]
        return phi(np.sqrt(np.mean(off**2, axis=0)), p[name][0])

    def due(name):
        return np.where(waiting, p[name][-1], 1.0)

    transversal, lateral = after["angle"][T], after["angle"][~T]
    symmetric = phi(np.var(transversal, axis=0), p["joint_symmetry"][0])
    symmetric = symmetric * phi(np.linalg.norm(lateral, axis=0), p["joint_symmetry"][1])
    rising = flight & (after["apex_passed"] == 0)
    values = {
        "jump_height": after["at_apex"] * height_kernel(after["max_height"] - after["goal"], p["jump_height"]),
        "estimated_jump_height": rising * height_kernel(apex - after["goal"], p["estimated_jump_height"]),
        "horizontal_velocity": np.exp(-np.linalg.norm(vel[:, :2], axis=1) / p["horizontal_velocity"][0])
        * np.where(stance, 1.0, 2.0)
        * due("horizontal_velocity"),
        "orientation": phi(after["lean"], p["orientation"][0]) * due("orientation"),
        "angular_velocity": phi(after["spin"], p["angular_velocity"][0]) * due("angular_velocity"),
        "joint_symmetry": symmetric * due("joint_symmetry"),
        "ground_posture": ~flight * posture("ground_posture", p["ground_posture"][1]) * due("ground_posture"),
        "air_posture": flight * posture("air_posture"),
        "retract": soon * posture("retract", p["retract"][1]),
        "soft_impact": soon * np.maximum(1.0 - deceleration / p["soft_impact"][0], 0.0),
        "stance_impact": -1.0 * stance * np.minimum(deceleration / p["stance_impact"][0], 1.0),
        "catch_landing": soon * np.clip(-vel[:, 2], 0.0, 1.0),
        "damp_landing": soon * np.clip(after["rate"][T], 0.0, 1.0).mean(axis=0),
        "ground_force": np.sum(after["force"] ** 2, axis=0) / p["ground_force"][0] ** 2,
        "action_clip": after["clipped"],
        "motor_torque_sq": np.sum(after["torque"] ** 2, axis=0),
        "joint_acceleration": np.sum(((after["rate"] - before["rate"]) / DT) ** 2, axis=0),
        "action_rate": np.sum((action - before["action"]) ** 2, axis=0),
    }
    return np.array([values[term.name] * term.weight * (1.0 if term.once else DT) for term in task.terms])
