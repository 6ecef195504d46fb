"""Accelerations, paw positions and paw Jacobians of random flight states, by this project's dynamics and by Pinocchio.

Both robots have the same masses and armatures, without ground, friction, knee damping and springs. The project's
dynamics compute in double precision with masses that Newton's model stores in single precision, so seven digits can
agree. A relative difference is the difference over the largest value of the same state.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from jumper_warp.robot.description import LEGS, MOTOR_JOINTS, RobotDescription, load_description
from jumper_warp.robot.model import MOTOR_DOFS, build_model
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.dynamics import JumperDynamics
from pinocchio_model import build_pinocchio


def random_motors(description: RobotDescription, n: int, rng: np.random.Generator, margin: float = 0.0) -> np.ndarray:
    """Return random motor angles [rad], (12, n), at least a margin [rad] away from the joint stops.

    They are uniform between the stops.
    Rows: legs FL, FR, BL, BR; each lateral, outer, inner. Outer and inner angles also respect the stops of their sum.
    """
    lateral, outer = (description.joint(name) for name in MOTOR_JOINTS[:2])
    lower = outer.lower + margin
    upper = outer.upper - margin
    lateral_angle = rng.uniform(lateral.lower + margin, lateral.upper - margin, (4, 1, n))
    outer_angle = rng.uniform(lower, upper, (4, 1, n))
    lowest = np.maximum(lower, description.transversal_sum[0] + margin - outer_angle)
    highest = np.minimum(upper, description.transversal_sum[1] - margin - outer_angle)
    return np.concatenate([lateral_angle, outer_angle, rng.uniform(lowest, highest)], axis=1).reshape(12, n)


MARGIN = 0.35  # [rad] Distance of the motor angles from the stops; a stretched leg is singular
DT = 1.0e-6  # [s] Time step over which the change of velocity gives the acceleration
States = dict[str, np.ndarray]  # Keys and shapes: `random_states`
Quantities = dict[str, np.ndarray]
"""Arrays by name, first axis states: base_acceleration (3,) [m/s^2] and base_angular_acceleration (3,) [rad/s^2] of the
body's origin, body axes; joint_acceleration (12,) [rad/s^2] of the motors; paw_position (4, 3) [m], body axes;
paw_jacobian (4, 3, 3) [m/rad] with respect to the rates of the leg's motors."""


def random_states(n: int, seed: int, robot: RobotDescription | None = None) -> States:
    """Return n random states of the robot in flight by name.

    quat (n, 4), xyzw, com_vel (n, 3) [m/s], ang_vel (n, 3) [rad/s] of the base, world axes; angles [rad], rates
    [rad/s], torque [N m] of the motors, (n, 12).
    """
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4))
    robot = robot or load_description()
    return {
        "quat": quat / np.linalg.norm(quat, axis=1, keepdims=True), "com_vel": rng.normal(size=(n, 3)),
        "ang_vel": 2.0 * rng.normal(size=(n, 3)), "angles": random_motors(robot, n, rng, MARGIN).T,
        "rates": 4.0 * rng.normal(size=(n, 12)), "torque": rng.uniform(-18.0, 18.0, (n, 12)),
    }  # fmt: skip


def jumper_quantities(values: RobotValues, states: States, robot: RobotDescription | None = None) -> Quantities:
    """Compute accelerations, paw positions and Jacobians in given states by this project's dynamics.

    The dynamics only advance states: accelerations are changes of velocity over one tiny step, DT. The robot is the
    first one of `values`.
    """
    n = len(states["angles"])
    model = build_model(n, ground=None, visuals=False, device="cpu", robot=values, description=robot)
    model.joint_friction.zero_()
    model.joint_damping.zero_()
    dynamics = JumperDynamics(model, double=True, description=robot)
    q, qd, force = (np.zeros((n, width)) for width in (43, 38, 38))
    q[:, 3:7], q[:, [1 + dof for dof in MOTOR_DOFS]] = states["quat"], states["angles"]
    qd[:, :3] = states["com_vel"]
    qd[:, 3:6] = states["ang_vel"]
    qd[:, MOTOR_DOFS] = states["rates"]
    force[:, MOTOR_DOFS] = states["torque"]

    def array(rows: np.ndarray) -> wp.array:
        """Convert a matrix to a flat Warp array in double precision."""
        return wp.array(rows.ravel(), dtype=wp.float64, device="cpu")

    def base_velocity(q: np.ndarray, qd: np.ndarray) -> tuple[Rotation, np.ndarray, np.ndarray]:
        """Return orientation, velocity of the base origin [m/s] (world) and angular velocity [rad/s] (body axes).

        The first three of Newton's rates `qd` are the velocity of the base's centre of mass, in the world.
        """
        turn = Rotation.from_quat(q[:, 3:7])
        origin = qd[:, :3] - np.cross(qd[:, 3:6], turn.apply(values.base_com[0].astype(np.float32)))
        return turn, origin, turn.inv().apply(qd[:, 3:6])

    after = array(q), array(qd)
    drive = dynamics.drive(array(force), wp.zeros(21 * n, dtype=wp.spatial_vectorf, device="cpu"))
    dynamics.advance(DT, 1, drive, *after, *after)
    new_q, new_qd = (rows.numpy().reshape(n, -1) for rows in after)
    (turn, origin, spin) = base_velocity(q, qd)
    (_, new_origin, new_spin) = base_velocity(new_q, new_qd)
    accelerations = {
        "base_acceleration": turn.inv().apply(new_origin - origin) / DT,
        "base_angular_acceleration": (new_spin - spin) / DT,
        "joint_acceleration": (new_qd - qd)[:, MOTOR_DOFS] / DT,
    }
    return accelerations | jumper_paws(dynamics, q)


def jumper_paws(dynamics: JumperDynamics, q: np.ndarray) -> Quantities:
    """Compute the paws' positions and Jacobians by this project's dynamics, with the base unrotated at the origin.

    A column of a Jacobian is the velocity of a paw if one motor of its leg turns at 1 rad/s and all others rest.
    Keys: `paw_position` (n, 4, 3) [m] and `paw_jacobian` (n, 4, 3, 3) [m/rad].
    q: joint coordinates (n, 43), whose base orientation is overwritten.
    """
    n = len(q)
    model = dynamics.model
    q[:, 3:7] = 0.0, 0.0, 0.0, 1.0
    shanks = [model.body_label.index(f"world_0/{leg}_inner_shank") for leg in LEGS]
    anchors = np.array([dynamics.description.link(f"{leg}_inner_shank").collisions[0].position for leg in LEGS])
    arms = anchors - model.body_com.numpy()[shanks]
    paws = []
    columns = []
    for motor in range(3):
        rates = np.zeros((n, 38))
        rates[:, MOTOR_DOFS[motor::3]] = 1.0
        angles, speeds = (wp.array(rows.ravel(), dtype=wp.float64, device="cpu") for rows in (q, rates))
        state = model.state()
        dynamics.full_state(angles, speeds, state.body_q, state.body_qd)
        pose, twist = (rows.numpy().reshape(n, 21, -1)[:, shanks] for rows in (state.body_q, state.body_qd))
        turn = Rotation.from_quat(pose[..., 3:].reshape(-1, 4))
        out, arm = (turn.apply(np.tile(rows, (n, 1))).reshape(n, 4, 3) for rows in (anchors, arms))
        paws.append(pose[..., :3] + out)
        columns.append(twist[..., :3] + np.cross(twist[..., 3:], arm))
    return {"paw_position": paws[0], "paw_jacobian": np.stack(columns, axis=3)}


def pinocchio_quantities(values: RobotValues, states: States, robot: RobotDescription | None = None) -> Quantities:
    """Compute accelerations, paw positions and Jacobians in given states by Pinocchio.

    Its base velocity v is that of the body's origin, in body axes; with the spin w, the origin's acceleration in these
    axes is dv/dt + w x v. The robot is the first one of `values`.
    """
    oracle = build_pinocchio(robot, values)
    rows = []
    for quat, com_vel, ang_vel, angles, rates, torque in zip(*states.values(), strict=True):
        turn = Rotation.from_quat(quat)
        spin = turn.inv().apply(ang_vel)
        twist = np.concatenate([turn.inv().apply(com_vel) - np.cross(spin, values.base_com[0]), spin])
        q = oracle.configuration(np.zeros(3), quat, angles)
        v = oracle.closed_velocity(q, twist, rates)
        acceleration = oracle.forward_dynamics(q, v, torque)
        level = oracle.configuration(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), angles)
        rows.append(
            (
                acceleration[:3] + np.cross(v[3:6], v[:3]),
                acceleration[3:6],
                acceleration[oracle.motor_v],
                oracle.paw_positions(level),
                oracle.paw_jacobians(level),
            )
        )
    names = ("base_acceleration", "base_angular_acceleration", "joint_acceleration", "paw_position", "paw_jacobian")
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))


def differences(ours: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Compare arrays of one quantity: return the largest difference over all states, absolute and relative.

    A relative difference is the difference over the state's largest value.
    ours, expected: (states, ...) values of one quantity in its unit.
    """
    size, difference = (np.abs(rows.reshape(len(rows), -1)).max(axis=1) for rows in (expected, ours - expected))
    return float(difference.max()), float((difference / size).max())
