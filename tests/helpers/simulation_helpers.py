"""Functions that set states and commands of a simulation, and read its paws."""

import dataclasses
import math

import newton
import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from columns import POS, QUAT
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.sim.simulation import Simulation
from solver_helpers import BODIES, SHANKS, random_states

WEIGHT = 14.5 * 9.81
PAW_RADIUS = 0.025


def simulation(num_worlds, **arguments):
    """Return a `Simulation` on the CPU without visual shapes; arguments: of `Simulation`."""
    return Simulation(num_worlds, visuals=False, device="cpu", **arguments)


def write_state(sim, q=None, qd=None):
    """Write joint_q (num_worlds, 43) and joint_qd (num_worlds, 38); knees and bodies follow."""
    state = sim.state
    if q is not None:
        state.joint_q.assign(np.asarray(q, dtype=np.float32).ravel())
    if qd is not None:
        state.joint_qd.assign(np.asarray(qd, dtype=np.float32).ravel())
    sim.solver.dynamics.full_state(state.joint_q, state.joint_qd, state.body_q, state.body_qd)


def loop_gap(sim):
    """Return the largest distance [m] between the two anchors of an ankle, over the four legs, (num_worlds,)."""
    model, frames = sim.model, sim.state.body_q.numpy()
    gaps = []
    for joint in (i for i, label in enumerate(model.joint_label) if label.endswith("_ankle")):
        ends = []
        for body_of, anchor in ((model.joint_parent, model.joint_X_p), (model.joint_child, model.joint_X_c)):
            frame = frames[body_of.numpy()[joint]]
            ends.append(frame[:3] + Rotation.from_quat(frame[3:]).apply(anchor.numpy()[joint, :3]))
        gaps.append(np.linalg.norm(ends[0] - ends[1]))
    return np.array(gaps).reshape(sim.num_worlds, 4).max(axis=1)


def command(sim, angles):
    """Command motor angles [rad], (num_worlds, 12)."""
    sim.target.assign(np.ascontiguousarray(np.broadcast_to(angles, (sim.num_worlds, 12)).T, dtype=np.float32))


def paw_forces(sim):
    """Return the ground forces on the paws [N], (num_worlds, 4, 3)."""
    return sim.paw_force.numpy().transpose(1, 0, 2).astype(float)


def paw_centres(sim):
    """Return the paw centres [m], (num_worlds, 4, 3)."""
    poses = sim.state.body_q.numpy().reshape(-1, BODIES, 7)[:, SHANKS].astype(float)
    arm = Rotation.from_quat(poses[..., 3:].reshape(-1, 4)).apply([0.0, 0.0, -0.3]).reshape(-1, 4, 3)
    return poses[..., POS] + arm


def slip_velocities(sim, joint_q):
    """Return the velocities [m/s] of the lowest material points of the paws, (num_worlds, 4, 3), at current rates.

    joint_q: coordinates at the start of the last step, where the contact was solved.
    """
    model, q, qd = sim.model, wp.array(joint_q.ravel(), dtype=float, device="cpu"), wp.clone(sim.state.joint_qd)
    body_q, body_qd = wp.empty_like(sim.state.body_q), wp.empty_like(sim.state.body_qd)
    sim.solver.dynamics.full_state(q, qd, body_q, body_qd)
    poses = body_q.numpy().reshape(-1, BODIES, 7)[:, SHANKS].astype(float)
    twists = body_qd.numpy().reshape(-1, BODIES, 6)[:, SHANKS].astype(float)
    turn = Rotation.from_quat(poses[..., 3:].reshape(-1, 4))
    com = turn.apply(model.body_com.numpy().reshape(-1, BODIES, 3)[:, SHANKS].reshape(-1, 3))
    bottom = turn.apply([0.0, 0.0, -0.3]) - [0.0, 0.0, PAW_RADIUS] - com
    return twists[..., :3] + np.cross(twists[..., 3:], bottom.reshape(-1, 4, 3))


def thrown(sim, seed, height=(0.4, 1.0), speed=1.5, joint_rate=4.0):
    """Set random attitudes, positions and velocities of all robots, and command random angles."""
    n = sim.num_worlds
    rng, states = np.random.default_rng(seed), random_states(n, seed, joint_rate=joint_rate)
    states.pos = rng.uniform([-1.0, -1.0, height[0]], [1.0, 1.0, height[1]], (n, 3))
    states.quat = Rotation.from_rotvec(0.3 * rng.normal(size=(n, 3))).as_quat()
    states.com_vel = speed * rng.normal(size=(n, 3))
    write_state(sim, states.joint_q(), states.joint_qd())
    command(sim, states.angles)
    sim.filter_targets()


def slope(degrees, height=0.0):
    """Return a heightfield with a plane that rises along x."""
    x = np.linspace(-20.0, 20.0, 41)
    heights = np.tile(height + math.tan(math.radians(degrees)) * x, (41, 1))
    return newton.Heightfield(data=heights.astype(np.float32), nrow=41, ncol=41, hx=20.0, hy=20.0)


def tilted(sim, degrees):
    """Place all robots on a slope, the base parallel to it, and return its rotation."""
    q, turn = sim.joint_q().copy(), Rotation.from_euler("y", -degrees, degrees=True)
    q[:, POS], q[:, QUAT] = turn.apply([0.0, 0.0, q[0, 2]]), turn.as_quat()
    write_state(sim, q)
    return turn


def stiff_motors():
    """Return motors with gains so high that the legs keep their shape."""
    motors = jumping_motors(24.8)
    return dataclasses.replace(
        motors,
        lateral=dataclasses.replace(motors.lateral, kp=300.0, kd=3.0),
        transversal=dataclasses.replace(motors.transversal, kp=300.0, kd=3.0),
    )
