"""Gravity per world: in both solvers, in start states and estimates of tasks, and as a flag of commands."""

import dataclasses

import numpy as np
import pytest

from columns import XY, Z
from jump_helpers import DEG, episodes_of, make_env, only
from jump_starts import Starts
from jumper_warp.registry import make_task
from jumper_warp.robot.gravity import MARS
from jumper_warp.sim.simulation import Simulation

UP = 2.0  # [m/s]
VERTICAL = dataclasses.replace(make_task("vertical-jump"), gravity=MARS)
HORIZONTAL = dataclasses.replace(make_task("horizontal-jump"), gravity=MARS)


@pytest.mark.parametrize("solver", ["jumper", "mujoco"])
def test_a_thrown_robot_follows_the_parabola_of_its_gravity(solver):
    sim = Simulation(1, solver=solver, ground=None, gravity=MARS, visuals=False, device="cpu")
    sim.state.joint_qd.assign(np.eye(38)[2].astype(np.float32) * UP)
    sim.write_bodies()
    mass = sim.model.body_mass.numpy()

    def com() -> float:  # height [m] of the robot's centre of mass
        return float((mass * sim.state.body_q.numpy()[:, Z]).sum() / mass.sum())

    before = com()
    for _ in range(15):  # 0.25 s
        sim.step()
    assert com() - before == pytest.approx(0.25 * UP - 0.5 * MARS * 0.25**2, abs=2e-3)


def test_starts_in_flight_reach_their_apex_in_each_worlds_own_gravity():
    env = make_env(6, task=VERTICAL, reset=only("in_flight", base_xy=0.0, flight_time=(0.01, 0.3)))
    own = np.array([1.62, 3.71, 3.71, 8.87, 9.81, 24.8])
    env.sim.model.gravity.assign(np.pad(np.outer(own, [0.0, 0.0, -1.0]), ((0, 1), (0, 0))).astype(np.float32))
    env.sim.dynamics.parameters_changed()
    env.reset()
    q, qd, goals = env.sim.joint_q(), env.sim.joint_qd(), episodes_of(env)["goal"][:, Z]
    np.testing.assert_allclose(q[:, Z] + qd[:, Z] ** 2 / (2.0 * own), goals, atol=1e-4)
    errors = env.task.layout("critic")["height_errors"][0]
    np.testing.assert_allclose(env.critic_obs[:, errors + 1].numpy(), 0.0, atol=1e-4)


def test_starts_in_flight_come_down_at_their_goal_on_mars():
    env = make_env(64, task=HORIZONTAL)
    found = Starts(env, "in_flight", exact=True, takeoff_angle=(45.0, 45.0))
    up = found.vel[:, Z]
    time = (up + np.sqrt(up**2 + 2.0 * MARS * (found.pos[:, Z] - 0.30))) / MARS
    place = found.pos[:, XY] + time[:, None] * found.vel[:, XY]
    far = found.distance > 0.1
    np.testing.assert_allclose(place[far], found.goal[far, :2], atol=2e-3)
    slope = np.arctan2(found.vel[:, Z], np.linalg.norm(found.vel[:, XY], axis=1)) / DEG
    assert slope.max() < 45.0
