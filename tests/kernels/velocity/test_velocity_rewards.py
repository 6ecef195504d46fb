"""Rewards of velocity tracking against NumPy formulas, on random robots."""

import inspect
from typing import NamedTuple

import numpy as np
import pytest
import warp as wp

from columns import XY
from jump_helpers import Table, functions, make_view
from jumper_warp.kernels.mdp.view import RobotView, mat43, vec12
from jumper_warp.kernels.velocity import rewards
from jumper_warp.kernels.velocity.state import VelocityState
from jumper_warp.tasks.velocity.flat import velocity_trot
from jumper_warp.tasks.velocity.paper import velocity_paper
from jumper_warp.tasks.velocity.rough import velocity_rough
from mdp_helpers import DEFAULT_ANGLE

NAMES = """linear_velocity yaw_rate yaw_rate_on_course lin_vel_xy_l1 lin_vel_z_l2 ang_vel_xy_l2 flat_orientation_l2
standing_posture lateral_position transversal_position air_time rapid_stepping clamped_rapid_stepping restless_stand
foot_clearance slip touchdown torque_sign_changes trot_schedule shank_lean"""
reward = Table(functions(rewards, NAMES), float, VelocityState)
TRANSVERSAL = np.arange(12) % 3 != 0
N = 16


def make_state(**fields) -> VelocityState:
    """Return a task state with these fields, others 0."""
    state = VelocityState()
    for name, value in fields.items():
        setattr(state, name, type(getattr(state, name))(*value) if np.ndim(value) else value)
    return state


class Sample(NamedTuple):
    """A random robot, as NumPy and as Warp structs."""

    fields: dict  # of view and state, by name
    view: RobotView
    state: VelocityState


def robots(seed: int = 3):
    """Return N random `Sample`s."""
    rng = np.random.default_rng(seed)
    samples = []
    for _ in range(N):
        quat = wp.normalize(wp.quat(*rng.normal(size=4).tolist()))
        contact = rng.integers(0, 2, 4).astype(float)
        view = {
            "quat": tuple(quat), "lin_vel": rng.normal(size=3), "ang_vel": rng.normal(size=3),
            "projected_gravity": np.array(wp.quat_rotate_inv(quat, wp.vec3(0.0, 0.0, -1.0))),
            "angle": DEFAULT_ANGLE + rng.normal(size=12) * 0.4, "torque": rng.normal(size=12),
            "prev_torque": rng.normal(size=12), "contact": contact, "contacts": int(contact.sum()),
            "first_contact": contact * rng.integers(0, 2, 4), "air_time": rng.uniform(0.0, 0.6, 4),
            "paw_height": rng.uniform(0.0, 0.15, 4), "touchdown_speed": rng.uniform(0.0, 2.0, 4),
        }  # fmt: skip
        paw_vel = rng.normal(size=(4, 3))
        state = {
            "command": rng.normal(size=3), "standing": int(rng.integers(0, 2)), "phase": float(rng.uniform()),
            "recent_steps": rng.integers(0, 6, 4).astype(float),
        }  # fmt: skip
        struct = make_view(**view)
        struct.paw_vel = mat43(*paw_vel.ravel())
        vel = np.array(wp.quat_rotate_inv(quat, wp.vec3(*view["lin_vel"])))
        samples.append(Sample(view | state | {"vel": vel, "paw_vel": paw_vel}, struct, make_state(**state)))
    return samples


ROBOTS = robots()


def trot(r, duty):
    """Return the share of paws whose contact is that of a trot at `duty`, 0 if standing; r: `Sample.fields`, as below.

    Legs are FL, FR, BL, BR; FR and BL are half a gait cycle ahead; a paw is scheduled down while its phase < duty.
    """
    phase = np.mod(r["phase"] + np.array([0.0, 0.5, 0.5, 0.0]), 1.0)
    return np.mean((phase < duty) == (r["contact"] > 0.5)) * (1 - r["standing"])


def clearance(r, height):
    """Return the sum over swinging paws of the squared error to `height` [m] times the horizontal speed [m/s]."""
    speed = np.linalg.norm(r["paw_vel"][:, XY], axis=1)
    return np.sum((1.0 - r["contact"]) * (r["paw_height"] - height) ** 2 * speed)


def shank_lean(r, threshold, hip, thigh, shank):
    """Return the sum over shanks of legs on the ground of (lean - threshold)^2 [rad^2] where they lean more than that.

    Ankles are the lower intersections of circles around the knees; lean is the angle off the vertical.
    """
    down, total = r["projected_gravity"][[0, 2]] / np.linalg.norm(r["projected_gravity"][[0, 2]]), 0.0
    for leg, contact in enumerate(r["contact"]):
        front = 1.0 if leg < 2 else -1.0
        outer, inner = r["angle"][3 * leg + 1 : 3 * leg + 3]
        knees = [np.array([front * side * (hip + thigh * np.sin(a)), -thigh * np.cos(a)])
                 for side, a in ((1.0, outer), (-1.0, inner))]  # fmt: skip
        links = []
        for turn in (1.0, -1.0):  # by the law of cosines, at the first knee
            between = knees[1] - knees[0]
            angle = np.arctan2(between[1], between[0]) + turn * np.arccos(np.linalg.norm(between) / (2.0 * shank))
            links.append(knees[0] + shank * np.array([np.cos(angle), np.sin(angle)]))
        ankle = min(links, key=lambda p: p[1])
        leans = [np.arccos(np.dot(ankle - knee, down) / shank) for knee in knees]
        total += contact * sum(max(lean - threshold, 0.0) ** 2 for lean in leans)
    return total


LEG = {"threshold": 0.5, "hip": 0.045, "thigh": 0.175, "shank": 0.3}  # [rad], [m], [m], [m]


def offset(r):
    """Return the motors' angles [rad] (12,) less those of the default pose."""
    return r["angle"] - DEFAULT_ANGLE


def error(r):
    """Return velocity ahead, to the left [m/s] and yaw rate [rad/s] less the command (3,)."""
    return np.array([*r["vel"][:2], r["ang_vel"][2]]) - r["command"]


EXPECTED = {  # name of a reward: its numbers, and its value for the fields of a `Sample`
    "linear_velocity": ({"std": 0.5}, lambda r: np.exp(-np.sum((r["vel"] - r["command"])[:2] ** 2) / 0.25)),
    "yaw_rate": ({"std": 0.5}, lambda r: np.exp(-((r["ang_vel"][2] - r["command"][2]) ** 2) / 0.25)),
    "yaw_rate_on_course": (
        {"std": 0.5, "std_lin_vel": 1.5},
        lambda r: np.exp(-4.0 * error(r)[2] ** 2 - np.sum(error(r)[:2] ** 2) / 2.25),
    ),
    "lin_vel_xy_l1": ({}, lambda r: np.linalg.norm(error(r)[:2])),
    "lin_vel_z_l2": ({}, lambda r: r["vel"][2] ** 2),
    "ang_vel_xy_l2": ({}, lambda r: np.sum(r["ang_vel"][:2] ** 2)),
    "flat_orientation_l2": ({}, lambda r: np.sum(r["projected_gravity"][:2] ** 2)),
    "standing_posture": (
        {"std": 0.5, "shift": 0.2},
        lambda r: np.exp(-np.mean((offset(r)[TRANSVERSAL] - 0.2) ** 2) / 0.25) * r["standing"],
    ),
    "lateral_position": (
        {"steepness": 100.0},
        lambda r: np.sum(np.exp(-100.0 * offset(r)[~TRANSVERSAL] ** 8) - 1.0),
    ),
    "transversal_position": (
        {"steepness": 50.0, "shift": 0.2},
        lambda r: np.sum(np.exp(-50.0 * (offset(r)[TRANSVERSAL] - 0.2) ** 20) - 1.0),
    ),
    "air_time": (
        {"threshold": 0.25},
        lambda r: np.sum(r["first_contact"] * (r["air_time"] - 0.25)) * (1 - r["standing"]),
    ),
    "rapid_stepping": ({"threshold": 2.0}, lambda r: np.sum(np.maximum(r["recent_steps"] - 2.0, 0.0))),
    "clamped_rapid_stepping": (
        {"threshold": 2.0, "limit": 5.0},
        lambda r: min(np.sum(np.exp(np.maximum(r["recent_steps"] - 2.0, 0.0)) - 1.0), 5.0),
    ),
    "restless_stand": ({}, lambda r: np.sum(1.0 - r["contact"]) * r["standing"]),
    "foot_clearance": ({"target_height": 0.07}, lambda r: clearance(r, 0.07)),
    "slip": ({}, lambda r: np.sum(r["contact"] * np.sum(r["paw_vel"][:, XY] ** 2, axis=1))),
    "touchdown": ({}, lambda r: np.sum(r["first_contact"] * r["touchdown_speed"] ** 2)),
    "torque_sign_changes": ({}, lambda r: np.sum(np.sign(r["torque"]) != np.sign(r["prev_torque"]))),
    "shank_lean": (LEG, lambda r: shank_lean(r, **LEG)),
    "trot_schedule": ({"duty": 0.55}, lambda r: trot(r, 0.55)),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES.split())
def test_reward_equals_its_numpy_formula(name):
    numbers, expected = EXPECTED[name]
    values = reward.all(name, [robot.view for robot in ROBOTS], [robot.state for robot in ROBOTS], **numbers)
    expected_values = [expected(robot.fields) for robot in ROBOTS]
    np.testing.assert_allclose(values, expected_values, rtol=2e-4, atol=2e-6)
    assert np.ptp(expected_values) > 1e-3


def test_expected_covers_every_velocity_reward_of_the_tasks():
    tasks = (velocity_rough(), velocity_trot(), velocity_paper())
    used = {term.func.func for task in tasks for term in task.rewards}
    names = {f.__name__ for f in used if inspect.getmodule(f).__name__ == "jumper_warp.kernels.velocity.rewards"}
    assert names | {"torque_sign_changes"} == set(EXPECTED)  # one of those for any task


def test_shank_lean_in_the_default_pose_is_that_of_the_geometry():
    """In the default pose a shank is off vertical by asin of (0.045 + 0.175 sin 45 deg) / 0.3: 34.3 degrees."""
    view = make_view(contact=np.ones(4), projected_gravity=(0.0, 0.0, -1.0))
    lean = np.arcsin((0.045 + 0.175 * np.sin(np.pi / 4.0)) / 0.3)
    assert reward("shank_lean", view, make_state(), **(LEG | {"threshold": 0.0})) == pytest.approx(
        8.0 * lean**2, rel=1e-5
    )
    assert reward("shank_lean", view, make_state(), **(LEG | {"threshold": lean + 0.01})) == 0.0


def test_a_robot_at_rest_in_the_default_pose_gets_full_standing_rewards():
    state = make_state(standing=1)
    assert reward("linear_velocity", make_view(), state, std=0.1) == pytest.approx(1.0)
    assert reward("standing_posture", make_view(), state, std=0.1, shift=0.0) == pytest.approx(1.0)
    assert vec12(*DEFAULT_ANGLE) == make_view().default_angle
