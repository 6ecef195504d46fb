"""Planned motions of identification, simulated step by step by `Simulation` in single precision."""

import math
from dataclasses import replace

import numpy as np
import warp as wp

from jumper_warp.identification.initial_states import HANGING_HEIGHT, stance
from jumper_warp.identification.recording import REST, SAMPLES, TICK
from jumper_warp.identification.replay import Record
from jumper_warp.robot.description import load_description
from jumper_warp.robot.measures import motors_for
from jumper_warp.robot.motors import MotorCfg, jumping_motors
from jumper_warp.robot.values import RobotValues
from jumper_warp.sim.simulation import Simulation, motor_values

HELD_MASS = 1.0e4  # [kg] mass of a held base, whose pose is also reset after each step


def simulate_plan(plan, robots, description=None):
    """Return the motion at 240 Hz of one robot (`RobotValues`, N = 1) under planned motor targets from rest.

    description: by default the Jumper's.
    """
    dt, stride = 1.0 / 480.0, 2  # [s] physics step, and physics steps a row
    period = TICK / SAMPLES
    held = plan.base == "fixed"
    sim = _make_simulation(plan, robots, description or load_description(), dt, held)
    rows = plan.rows
    rest = round(REST / period)
    target = np.concatenate([np.repeat(rows[:1], rest, axis=0), rows])
    delay = float(robots.latency[0, 0]) / dt  # in physics steps
    delayed_target = wp.zeros((12, 1), dtype=float, device=sim.device)
    rows_read = []
    held_pose = sim.joint_q()[0, :7].copy()
    for row in range(len(target)):
        q = sim.joint_q()[0].copy()
        qd = sim.joint_qd()[0].copy()
        for step in range(stride):
            now = row * stride + step
            whole = math.floor(delay)
            newer, older = (target[max(now - whole - i, 0) // stride] for i in (0, 1))
            blend = (1.0 - (delay - whole)) * newer + (delay - whole) * older
            delayed_target.assign(blend[:, None].astype(np.float32))
            sim.advance(1, delayed_target)
            if step == 0 and row >= rest:  # the torques at the beginning of this step
                torque = sim.torque.numpy()[:, 0]
                rows_read.append(np.concatenate([motor_values(q[7:27]), motor_values(qd[6:26]), torque, q[:7]]))
            if held:
                _reset_base(sim, held_pose)
    table = np.array(rows_read)[:, :, None]
    valid = np.array([bool(np.isfinite(table).all()) and sim.dynamics.work.diverged.numpy()[0] == 0])
    return Record(table[:, :12], table[:, 12:24], table[:, 24:36], table[:, 36:39], table[:, 39:43], valid)


def _make_simulation(plan, robots, description, dt, held):
    """Return a simulation of one robot in the pose of the first targets; held: with a heavy, weightless base.

    A force cancels its weight.
    """
    values = RobotValues(**{name: value[:1].copy() for name, value in vars(robots).items()})
    if held:
        values.base_mass[:] = HELD_MASS
        values.base_com[:] = 0.0
    motors = MotorCfg.from_description(description, "jumping", plan.torque_limit, plan.torque_limit)
    protection = motors_for(jumping_motors(), description)
    motors = replace(motors, fade_start=protection.fade_start, fade_end=protection.fade_end)
    settings = {"dt": dt, "visuals": False, "device": "cpu", "threads": 1}
    sim = Simulation(1, motors=motors, robot=values, description=description, **settings)
    angle = plan.target[0] - values.offset[0]
    q = sim.joint_q()[0].copy()
    q[7 + motor_values(np.arange(20))] = angle
    height = stance(description, angle[None], np.zeros((1, 12))).height[0]
    q[:3] = [0.0, 0.0, HANGING_HEIGHT if held else height + 1.0e-3]
    sim.state.joint_q.assign(q.astype(np.float32))
    sim.write_bodies()
    if held:
        weight = np.zeros((sim.model.body_count, 6), dtype=np.float32)
        weight[0, :3] = -HELD_MASS * sim.model.gravity.numpy().reshape(-1, 3)[0]
        sim.state.body_f.assign(weight)
    return sim


def _reset_base(sim, pose):
    """Reset the base of world 0 to a pose (7,), position [m] and quaternion xyzw in the world frame, at rest."""
    q = sim.state.joint_q.numpy()
    qd = sim.state.joint_qd.numpy()
    q[:7] = pose
    qd[:6] = 0.0
    sim.state.joint_q.assign(q)
    sim.state.joint_qd.assign(qd)
