"""Oracle of the jumps' reward terms: NumPy versions of the paper's formulas, from the robot's arrays.

`robot` is the dict that `between` returns. Functions return one value per world, shape (worlds,).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from columns import ANG_VEL, LIN_VEL, MOTOR_COORDS, MOTOR_DOFS, POS, QUAT, XY, Z
from jump_helpers import DEFAULT_ANGLE

DT = 1.0 / 60.0  # [s] policy step
CONTACT_FORCE = 0.1  # [N] a paw with more is down
G = 9.81  # [m/s^2]
TRANSVERSAL = np.arange(12) % 3 != 0  # mask of the outer and inner motors among the 12
STANCE, FLIGHT, LANDED = 0, 1, 2
EPISODE = """goal heading start phase phase_steps steps command_step took_off touched_down at_apex apex_passed
max_height paws_landed""".split()


def robot_of(env) -> dict[str, np.ndarray]:
    """Return copies of the state that the rewards depend on, by name.

    Base: pos [m], quat (xyzw), vel (of the origin) [m/s], spin [rad/s], all (worlds, ...) in the world frame. Motors,
    (12, worlds): angle [rad], rate [rad/s], torque [N m], action, prev_torque. Paws: force, peak [N], air_time [s],
    (4, worlds); paws [m], (4, worlds, 3). clipped: sum of squared target corrections [rad^2]; and the fields EPISODE.
    """
    q, qd = env.sim.joint_q().astype(float), env.sim.joint_qd().astype(float)
    turn = Rotation.from_quat(q[:, QUAT])
    com = env.sim.model.body_com.numpy().reshape(len(q), -1, 3)[:, 0]
    views, tasks = env.robot, env.skills[0].states.numpy()
    robot = {
        "pos": q[:, POS],
        "quat": q[:, QUAT],
        "vel": qd[:, LIN_VEL] - np.cross(qd[:, ANG_VEL], turn.apply(com)),
        "spin": qd[:, ANG_VEL],
        "angle": q[:, MOTOR_COORDS].T,
        "rate": qd[:, MOTOR_DOFS].T,
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
    """Return `after` (see `robot_of`) plus acc [m/s^2], joint_acc [rad/s^2] over the step, action and prev_action.

    before, after: states at the start and the end of a policy step; action: (12, worlds).
    """
    return after | {
        "acc": (after["vel"] - before["vel"]) / DT,
        "joint_acc": (after["rate"] - before["rate"]) / DT,
        "action": action,
        "prev_action": before["action"],
    }


def phi(x, std):
    """Return the Gaussian kernel exp(-(x / std)^2)."""
    return np.exp(-((x / std) ** 2))


def height_kernel(error, params):
    """Return the height reward of Table IV plus a wide Gaussian kernel, for a height error [m]."""
    return (
        phi(error, params["std_fine"])
        + 3.0 * np.exp(-np.abs(error) / params["scale_sharp"])
        + phi(error, params["std_wide"])
    )


def norm(vectors):
    """Return the lengths of the rows of vectors (worlds, n)."""
    return np.linalg.norm(vectors, axis=1)


def just_landed(robot):
    """Return whether the touchdown was within the last 0.3 s."""
    return (robot["phase"] == LANDED) & (robot["phase_steps"] * DT < 0.3 - 1e-9)


def should_rest(robot):
    """Return whether the robot should rest: it stands without a command, or touched down >= 0.5 s ago."""
    uncommanded = (robot["phase"] == STANCE) & (robot["steps"] < robot["command_step"])
    return uncommanded | ((robot["phase"] == LANDED) & (robot["phase_steps"] * DT >= 0.5 - 1e-9))


def patience(robot, waiting_scale):
    """Return the weight of terms that pay without a jump: waiting_scale while a commanded jump has not begun."""
    return np.where((robot["phase"] == STANCE) & (robot["steps"] >= robot["command_step"]), waiting_scale, 1.0)


def posture(robot, width, shift=0.0):
    """Return phi of the rms offset [rad] of the 12 motors from default, plus `shift` [rad] for transversal motors."""
    offset = robot["angle"] - DEFAULT_ANGLE[:, None] - shift * TRANSVERSAL[:, None]
    return phi(np.sqrt(np.mean(offset**2, axis=0)), width)


def tilt_sine(robot):
    """Return the sine of the angle between body z and world z."""
    return norm(Rotation.from_quat(robot["quat"]).apply([0.0, 0.0, 1.0])[:, XY])


def rotation_error(robot):
    """Return the angle [rad] between the body and the level frame with the commanded heading."""
    level = Rotation.from_euler("z", robot["heading"][:, None])
    return (level.inv() * Rotation.from_quat(robot["quat"])).magnitude()


def goal_distance(robot):
    """Return the horizontal distance [m] of the base from the goal."""
    return norm(robot["goal"][:, XY] - robot["pos"][:, XY])


def landing_error(robot, height):
    """Return the distance [m] from the goal at which a point mass, in free fall, descends through a height [m].

    Where it never reaches the height: of its highest point, or of its present position if it falls.
    """
    distances = []
    for pos, vel, goal in zip(robot["pos"], robot["vel"], robot["goal"], strict=True):
        times = np.roots([-0.5 * G, vel[Z], pos[Z] - height])
        time = max(times.real.max(), 0.0) if np.isreal(times).all() else max(vel[Z] / G, 0.0)
        distances.append(np.linalg.norm(pos[XY] + time * vel[XY] - goal[XY]))
    return np.array(distances)


def deceleration(robot):
    """Return the loss of speed over the step [m/s^2] along the old velocity: all speed where the motion reversed."""
    before = robot["vel"] - DT * robot["acc"]
    speed = norm(before)
    kept = np.sum(robot["vel"] * before, axis=1) / np.maximum(speed, 1e-9)
    return np.where(speed > 1e-6, np.maximum(speed - np.maximum(kept, 0.0), 0.0) / DT, 0.0)


def capture_offset(robot):
    """Return the capture point (of a pendulum of the base's height) relative to the paws' mean [m], (worlds, 2)."""
    omega = np.sqrt(G / robot["pos"][:, Z])
    return (robot["pos"] + robot["vel"] / omega[:, None] - robot["paws"].mean(axis=0))[:, XY]


def symmetry(robot, params):
    """Return the vertical jump's joint symmetry: phi of the transversal angles' variance, of the lateral ones' norm."""
    spread = phi(np.var(robot["angle"][TRANSVERSAL], axis=0), params["std_variance"])
    return spread * phi(np.linalg.norm(robot["angle"][~TRANSVERSAL], axis=0), params["std_lateral"])


def left_right_difference(robot):
    """Return the rms difference [rad] of left and right transversal angles."""
    legs = robot["angle"].reshape(4, 3, -1)
    return np.sqrt(np.mean((legs[[0, 2], 1:] - legs[[1, 3], 1:]) ** 2, axis=(0, 1)))


def estimated_apex(robot):
    """Return the height [m] of the base at the apex of free fall."""
    return robot["pos"][:, Z] + np.maximum(robot["vel"][:, Z], 0.0) ** 2 / (2.0 * G)


TERMS = {
    "jump_height": lambda r, p: r["at_apex"] * height_kernel(r["max_height"] - r["goal"][:, Z], p),
    "estimated_jump_height": lambda r, p: (
        ((r["phase"] == FLIGHT) & (r["apex_passed"] == 0)) * height_kernel(estimated_apex(r) - r["goal"][:, Z], p)
    ),
    "horizontal_velocity": lambda r, p: (
        np.exp(-norm(r["vel"][:, XY]) / p["speed_scale"])
        * np.where(r["phase"] == STANCE, 1.0, 2.0)
        * patience(r, p["waiting_scale"])
    ),
    "orientation": lambda r, p: phi(tilt_sine(r), p["std"]) * patience(r, p["waiting_scale"]),
    "angular_velocity": lambda r, p: phi(norm(r["spin"]), p["std"]) * patience(r, p["waiting_scale"]),
    "joint_symmetry": lambda r, p: symmetry(r, p) * patience(r, p["waiting_scale"]),
    "ground_posture": lambda r, p: (
        (r["phase"] != FLIGHT) * posture(r, p["std"], p["shift"]) * patience(r, p["waiting_scale"])
    ),
    "air_posture": lambda r, p: (r["phase"] == FLIGHT) * posture(r, p["std"]),
    "post_landing_posture": lambda r, p: just_landed(r) * posture(r, p["std"], p["shift"]),
    "tracking": lambda r, p: (
        (r["phase"] != STANCE)
        * (phi(goal_distance(r), p["std_wide"]) + p["fine_weight"] * phi(goal_distance(r), p["std_fine"]))
    ),
    "estimated_tracking": lambda r, p: (
        (r["phase"] == FLIGHT)
        * sum(
            weight * phi(landing_error(r, p["height"]), p[std])
            for weight, std in ((1.0, "std_middle"), (0.1, "std_wide"), (0.3, "std_fine"))
        )
    ),
    "flight_orientation": lambda r, p: (
        ((r["phase"] == FLIGHT) & (np.sum((r["goal"] - r["pos"])[:, XY] * r["vel"][:, XY], axis=1) > 0.0))
        * phi(rotation_error(r), p["std"])
    ),
    "flight_angular_velocity": lambda r, p: (r["phase"] == FLIGHT) * phi(norm(r["spin"]), p["std"]),
    "left_right_symmetry": lambda r, p: phi(left_right_difference(r), p["std"]) * patience(r, p["waiting_scale"]),
    "standing_posture": lambda r, p: should_rest(r) * posture(r, p["std"], p["shift"]),
    "base_at_rest": lambda r, p: (
        should_rest(r) * phi(norm(r["vel"]), p["std_lin_vel"]) * phi(norm(r["spin"]), p["std_ang_vel"])
    ),
    "landing_tilt": lambda r, p: (r["phase"] == LANDED) * (tilt_sine(r) / np.sin(p["angle"])) ** 2,
    "descent_tilt": lambda r, p: (
        (r["phase"] == FLIGHT) * (r["vel"][:, Z] <= 0.0) * (tilt_sine(r) / np.sin(p["angle"])) ** 2
    ),
    "lifted_again": lambda r, p: (
        (r["phase"] == LANDED)
        * np.sum(
            (r["paws_landed"][None] >> np.arange(4)[:, None] & 1 == 1)
            & (r["force"] <= CONTACT_FORCE)
            & (r["air_time"] > p["threshold"]),
            axis=0,
        )
    ),
    "paws_down": lambda r, p: (r["phase"] == LANDED) * np.count_nonzero(r["force"] > CONTACT_FORCE, axis=0),
    "capture_point": lambda r, p: (r["phase"] == LANDED) * phi(norm(capture_offset(r)), p["std"]),
    "resting_action_rate": lambda r, p: should_rest(r) * np.sum((r["action"] - r["prev_action"]) ** 2, axis=0),
    "torque_ripple": lambda r, p: should_rest(r) * np.sum((r["torque"] - r["prev_torque"]) ** 2, axis=0),
    "force_ripple": lambda r, p: should_rest(r) * np.sum(((r["peak"] - r["force"]) / p["weight_force"]) ** 2, axis=0),
    "soft_impact": lambda r, p: just_landed(r) * np.maximum(1.0 - deceleration(r) / p["limit"], 0.0),
    "stance_impact": lambda r, p: -1.0 * (r["phase"] == STANCE) * np.minimum(deceleration(r) / p["limit"], 1.0),
    "catch_landing": lambda r, p: just_landed(r) * np.clip(-r["vel"][:, Z], 0.0, 1.0),
    "damp_landing": lambda r, p: just_landed(r) * np.clip(r["rate"][TRANSVERSAL], 0.0, 1.0).mean(axis=0),
    "ground_force": lambda r, p: np.sum(r["force"] ** 2, axis=0) / p["weight_force"] ** 2,
    "action_clip": lambda r, p: r["clipped"],
    "motor_torque_sq": lambda r, p: np.sum(r["torque"] ** 2, axis=0),
    "joint_acceleration": lambda r, p: np.sum(r["joint_acc"] ** 2, axis=0),
    "action_rate": lambda r, p: np.sum((r["action"] - r["prev_action"]) ** 2, axis=0),
}
"""Name of a term -> function (r: robot, p: params) of its values (worlds,), before the factors weight and DT."""


def params_of(term) -> dict[str, float]:
    """Return the numbers of a reward term without its weight, by name."""
    return {name: value for name, value in term.numbers.items() if name != "weight"}


def expected_terms(task, before: dict, after: dict, action: np.ndarray) -> np.ndarray:
    """Return the weighted reward terms of a step, (terms, worlds); before, after: `robot_of`; action: (12, worlds)."""
    robot = between(before, after, action)
    return np.array(
        [
            TERMS[term.name](robot, params_of(term)) * term.weight * (DT if term.options["scale_by_dt"] else 1.0)
            for term in task.rewards
        ]
    )
