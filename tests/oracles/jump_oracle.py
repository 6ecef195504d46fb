"""The jumps' reward terms once more, in NumPy, from the paper's formulas and the robot's arrays."""

import numpy as np
from scipy.spatial.transform import Rotation

from jump_helpers import DEFAULT_ANGLE

DT = 1.0 / 60.0
CONTACT_FORCE = 0.1  # [N]
G = 9.81
SLOTS = np.array([5 * leg + joint for leg in range(4) for joint in (0, 1, 3)])
T = np.arange(12) % 3 != 0
STANCE, FLIGHT, LANDED = 0, 1, 2
EPISODE = """goal heading start phase phase_steps steps command_step took_off touched_down at_apex apex_passed
max_height paws_landed""".split()


def robot_of(env) -> dict[str, np.ndarray]:
    """Return copies of what the rewards need; the joints' arrays have the world as their last index."""
    q, qd = env.sim.joint_q().astype(float), env.sim.joint_qd().astype(float)
    turn = Rotation.from_quat(q[:, 3:7])
    com = env.sim.model.body_com.numpy().reshape(len(q), -1, 3)[:, 0]
    views, tasks = env.robot, env.skills[0].states.numpy()
    robot = {
        "pos": q[:, :3],
        "quat": q[:, 3:7],
        "vel": qd[:, :3] - np.cross(qd[:, 3:6], turn.apply(com)),
        "spin": qd[:, 3:6],
        "angle": q[:, 7 + SLOTS].T,
        "rate": qd[:, 6 + SLOTS].T,
        "torque": views.torque.numpy().astype(float),
        "action": views.action.numpy().astype(float),
        "force": np.linalg.norm(views.paw_force.numpy().astype(float), axis=2),
        "prev_torque": views.prev_torque.numpy().astype(float),
        "peak": views.peak_force.numpy().astype(float),
        "paws": views.paw_pos.numpy().astype(float),
        "air_time": views.air_time.numpy().astype(float),
        "clipped": np.sum((views.target.numpy().astype(float) - views.filtered_target.numpy()) ** 2, axis=0),
    }
    return robot | {name: tasks[name].copy() for name in EPISODE}


def between(before: dict, after: dict, action: np.ndarray) -> dict[str, np.ndarray]:
    """Return the robot after a step, with what follows from the step; action: (12, worlds)."""
    return after | {
        "acc": (after["vel"] - before["vel"]) / DT,
        "joint_acc": (after["rate"] - before["rate"]) / DT,
        "action": action,
        "prev_action": before["action"],
    }


def phi(x, s):
    """The exponential kernel."""
    return np.exp(-((x / s) ** 2))


def height_kernel(error, p):
    """The height reward of Table III with a third, wide kernel."""
    return phi(error, p["fine"]) + 3.0 * np.exp(-np.abs(error) / p["sharp"]) + phi(error, p["wide"])


def norm(vectors):
    """Lengths of the rows."""
    return np.linalg.norm(vectors, axis=1)


def soon(r):
    """The first 0.3 s after touchdown."""
    return (r["phase"] == LANDED) & (r["phase_steps"] * DT < 0.3 - 1e-9)


def at_ease(r):
    """Standing without a command, or 0.5 s and more after touchdown."""
    unasked = (r["phase"] == STANCE) & (r["steps"] < r["command_step"])
    return unasked | ((r["phase"] == LANDED) & (r["phase_steps"] * DT >= 0.5 - 1e-9))


def due(r, share):
    """Weight of what pays without jumping."""
    return np.where((r["phase"] == STANCE) & (r["steps"] >= r["command_step"]), share, 1.0)


def posture(r, width, shift=0.0):
    """phi of the rms offset of all motors from default, the transversal ones shifted."""
    off = r["angle"] - DEFAULT_ANGLE[:, None] - shift * T[:, None]
    return phi(np.sqrt(np.mean(off**2, axis=0)), width)


def lean(r):
    """Sine of the angle between body z and world z."""
    return norm(Rotation.from_quat(r["quat"]).apply([0.0, 0.0, 1.0])[:, :2])


def rotation_error(r):
    """Angle [rad] between the body and the level frame with the heading."""
    level = Rotation.from_euler("z", r["heading"][:, None])
    return (level.inv() * Rotation.from_quat(r["quat"])).magnitude()


def error(r):
    """Distance [m] from the goal in the plane."""
    return norm(r["goal"][:, :2] - r["pos"][:, :2])


def estimated_error(r, height):
    """Distance from the goal [m] at which a point mass falls through a height [m]; where it is, if it is below."""
    found = []
    for pos, vel, goal in zip(r["pos"], r["vel"], r["goal"], strict=True):
        times = np.roots([-0.5 * G, vel[2], pos[2] - height])
        time = max(times.real.max(), 0.0) if np.isreal(times).all() else max(vel[2] / G, 0.0)
        found.append(np.linalg.norm(pos[:2] + time * vel[:2] - goal[:2]))
    return np.array(found)


def deceleration(r):
    """Speed of the step before that was lost over the step [m/s^2]: all of it where the motion turned round."""
    before = r["vel"] - DT * r["acc"]
    speed = norm(before)
    kept = np.sum(r["vel"] * before, axis=1) / np.maximum(speed, 1e-9)
    return np.where(speed > 1e-6, np.maximum(speed - np.maximum(kept, 0.0), 0.0) / DT, 0.0)


def capture_offset(r):
    """Where a pendulum of the base's height, moving as it does, comes to rest, from the middle of the paws [m]."""
    omega = np.sqrt(G / r["pos"][:, 2])
    return (r["pos"] + r["vel"] / omega[:, None] - r["paws"].mean(axis=0))[:, :2]


def symmetry(r, p):
    """Vertical jump: variance of the transversal, size of the lateral angles."""
    spread = phi(np.var(r["angle"][T], axis=0), p["variance"])
    return spread * phi(np.linalg.norm(r["angle"][~T], axis=0), p["lateral"])


def left_right(r):
    """Rms difference [rad] of left and right transversal angles."""
    legs = r["angle"].reshape(4, 3, -1)
    return np.sqrt(np.mean((legs[[0, 2], 1:] - legs[[1, 3], 1:]) ** 2, axis=(0, 1)))


def rising_to(r):
    """Ballistic apex [m]."""
    return r["pos"][:, 2] + np.maximum(r["vel"][:, 2], 0.0) ** 2 / (2.0 * G)


TERMS = {
    "jump_height": lambda r, p: r["at_apex"] * height_kernel(r["max_height"] - r["goal"][:, 2], p),
    "estimated_jump_height": lambda r, p: (
        ((r["phase"] == FLIGHT) & (r["apex_passed"] == 0)) * height_kernel(rising_to(r) - r["goal"][:, 2], p)
    ),
    "horizontal_velocity": lambda r, p: (
        np.exp(-norm(r["vel"][:, :2]) / p["width"]) * np.where(r["phase"] == STANCE, 1.0, 2.0) * due(r, p["share"])
    ),
    "orientation": lambda r, p: phi(lean(r), p["width"]) * due(r, p["share"]),
    "angular_velocity": lambda r, p: phi(norm(r["spin"]), p["width"]) * due(r, p["share"]),
    "joint_symmetry": lambda r, p: symmetry(r, p) * due(r, p["share"]),
    "ground_posture": lambda r, p: (r["phase"] != FLIGHT) * posture(r, p["width"], p["shift"]) * due(r, p["share"]),
    "air_posture": lambda r, p: (r["phase"] == FLIGHT) * posture(r, p["width"]),
    "retract": lambda r, p: soon(r) * posture(r, p["width"], p["shift"]),
    "tracking": lambda r, p: (
        (r["phase"] != STANCE) * (phi(error(r), p["wide"]) + p["fine_share"] * phi(error(r), p["fine"]))
    ),
    "estimated_tracking": lambda r, p: (
        (r["phase"] == FLIGHT)
        * sum(
            share * phi(estimated_error(r, p["height"]), p[width])
            for share, width in ((1.0, "middle"), (0.1, "wide"), (0.3, "fine"))
        )
    ),
    "flight_orientation": lambda r, p: (
        ((r["phase"] == FLIGHT) & (np.sum((r["goal"] - r["pos"])[:, :2] * r["vel"][:, :2], axis=1) > 0.0))
        * phi(rotation_error(r), p["width"])
    ),
    "flight_angular_velocity": lambda r, p: (r["phase"] == FLIGHT) * phi(norm(r["spin"]), p["width"]),
    "left_right_symmetry": lambda r, p: phi(left_right(r), p["width"]) * due(r, p["share"]),
    "standing_posture": lambda r, p: at_ease(r) * posture(r, p["width"], p["shift"]),
    "rest": lambda r, p: at_ease(r) * phi(norm(r["vel"]), p["speed"]) * phi(norm(r["spin"]), p["spin"]),
    "landing_tilt": lambda r, p: (r["phase"] == LANDED) * (lean(r) / np.sin(p["width"])) ** 2,
    "descent_tilt": lambda r, p: (r["phase"] == FLIGHT) * (r["vel"][:, 2] <= 0.0) * (lean(r) / np.sin(p["width"])) ** 2,
    "lifted_again": lambda r, p: (
        (r["phase"] == LANDED)
        * np.sum(
            (r["paws_landed"][None] >> np.arange(4)[:, None] & 1 == 1)
            & (r["force"] <= CONTACT_FORCE)
            & (r["air_time"] > p["free"]),
            axis=0,
        )
    ),
    "paws_down": lambda r, p: (r["phase"] == LANDED) * np.count_nonzero(r["force"] > CONTACT_FORCE, axis=0),
    "capture_point": lambda r, p: (r["phase"] == LANDED) * phi(norm(capture_offset(r)), p["width"]),
    "resting_action_rate": lambda r, p: at_ease(r) * np.sum((r["action"] - r["prev_action"]) ** 2, axis=0),
    "torque_ripple": lambda r, p: at_ease(r) * np.sum((r["torque"] - r["prev_torque"]) ** 2, axis=0),
    "force_ripple": lambda r, p: at_ease(r) * np.sum(((r["peak"] - r["force"]) / p["weight_force"]) ** 2, axis=0),
    "soft_impact": lambda r, p: soon(r) * np.maximum(1.0 - deceleration(r) / p["limit"], 0.0),
    "stance_impact": lambda r, p: -1.0 * (r["phase"] == STANCE) * np.minimum(deceleration(r) / p["limit"], 1.0),
    "catch_landing": lambda r, p: soon(r) * np.clip(-r["vel"][:, 2], 0.0, 1.0),
    "damp_landing": lambda r, p: soon(r) * np.clip(r["rate"][T], 0.0, 1.0).mean(axis=0),
    "ground_force": lambda r, p: np.sum(r["force"] ** 2, axis=0) / p["weight_force"] ** 2,
    "action_clip": lambda r, p: r["clipped"],
    "motor_torque_sq": lambda r, p: np.sum(r["torque"] ** 2, axis=0),
    "joint_acceleration": lambda r, p: np.sum(r["joint_acc"] ** 2, axis=0),
    "action_rate": lambda r, p: np.sum((r["action"] - r["prev_action"]) ** 2, axis=0),
}
"""(robot, numbers) -> value of every world, before weight and step."""


def params_of(term) -> dict[str, float]:
    """Return a reward term's numbers but its weight."""
    return {name: value for name, value in term.numbers.items() if name != "weight"}


def expected_terms(task, before: dict, after: dict, action: np.ndarray) -> np.ndarray:
    """Return the weighted terms of the step between two states, (terms, worlds); action: (12, worlds)."""
    robot = between(before, after, action)
    return np.array(
        [
            TERMS[term.name](robot, params_of(term)) * term.weight * (1.0 if term.options["once"] else DT)
            for term in task.rewards
        ]
    )
