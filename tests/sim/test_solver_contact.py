"""Contact of SolverJumper: friction cone, slopes, convergence, and hard stops under torques and impacts."""

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from columns import DOFS, MOTOR_COORDS, MOTOR_DOFS, QUAT, XY, X, Y, Z
from jumper_warp.sim.dynamics import TOLERANCE
from simulation_helpers import (
    WEIGHT,
    command,
    paw_centres,
    paw_forces,
    simulation,
    slip_velocities,
    slope,
    stiff_motors,
    thrown,
    tilted,
    write_state,
)


@pytest.fixture(scope="module")
def standing():
    """A simulation of one robot that has stood for two seconds."""
    sim = simulation(1)
    for _ in range(120):
        sim.step()
    return sim


def test_standing_robot_carries_its_weight_and_creeps_less_than_a_millimetre_in_ten_seconds(standing):
    assert paw_forces(standing)[0].sum(axis=0) == pytest.approx([0.0, 0.0, WEIGHT], abs=1e-3 * WEIGHT)
    base, paws = standing.joint_q()[0, :7].copy(), paw_centres(standing)[0]
    for _ in range(600):  # 10 s
        standing.step()
    assert np.abs(standing.joint_q()[0, :3] - base[:3]).max() < 1e-3  # [m]
    assert np.abs(paw_centres(standing)[0] - paws).max() < 1e-3


def test_contacts_never_pull_and_stay_in_the_friction_cone():
    sim = simulation(64, friction=0.6)
    thrown(sim, seed=11)
    touched = np.zeros(64, dtype=bool)
    for _ in range(480):
        sim.physics_step()
        force = paw_forces(sim)
        normal, tangential = force[..., Z], np.linalg.norm(force[..., XY], axis=-1)
        assert normal.min() >= 0.0
        assert (tangential <= 0.6 * normal * (1.0 + 1e-4) + 1e-4).all()
        touched |= (normal > 0.0).any(axis=1)
    assert touched.all()


def test_contact_iteration_reaches_its_tolerance(standing):
    standing.step()
    assert standing.solver.residual.numpy()[0] <= TOLERANCE
    sim = simulation(64)
    thrown(sim, seed=12)
    steps, missed = 0, 0
    for _ in range(720):
        sim.physics_step()
        steps += np.count_nonzero(sim.solver.sweeps.numpy())
        missed += np.count_nonzero(sim.solver.residual.numpy() > TOLERANCE)
    assert steps > 10000
    assert missed == 0


def test_friction_opposes_sliding_at_mu_times_the_normal_force():
    sim = simulation(8, friction=0.3)
    qd = np.zeros((8, DOFS))
    heading = np.arange(8) * math.pi / 4.0
    qd[:, X], qd[:, Y] = 2.0 * np.cos(heading), 2.0 * np.sin(heading)  # [m/s]
    write_state(sim, qd=qd)
    checked = 0
    for _ in range(120):
        joint_q = sim.joint_q().copy()
        sim.physics_step()
        force, slip = paw_forces(sim), slip_velocities(sim, joint_q)[..., XY]
        speed = np.linalg.norm(slip, axis=-1)
        sliding = (speed > 0.2) & (force[..., Z] > 1.0)
        friction, normal = force[sliding][:, :2], force[sliding][:, 2]
        checked += sliding.sum()
        assert np.linalg.norm(friction, axis=1) == pytest.approx(0.3 * normal, rel=1e-3)
        cosine = (friction * slip[sliding]).sum(axis=1) / (np.linalg.norm(friction, axis=1) * speed[sliding])
        assert cosine.max() < -0.999
    assert checked > 1000


def on_slope(num_worlds, degrees, friction):
    """Return a simulation of robots with stiff motors on a slope that rises along x, and the rotation of their base."""
    sim = simulation(num_worlds, ground=slope(degrees), friction=friction, motors=stiff_motors())
    return sim, tilted(sim, degrees)


def test_robot_holds_on_a_slope_below_the_friction_angle():
    # atan(0.3) is 16.7 degrees
    sim, _ = on_slope(1, 12.0, friction=0.3)
    for _ in range(60):
        sim.step()
    before = paw_centres(sim)
    for _ in range(120):
        sim.step()
    assert np.abs(paw_centres(sim) - before).max() < 1e-3
    assert paw_forces(sim)[0].sum(axis=0) == pytest.approx([0.0, 0.0, WEIGHT], abs=1e-3 * WEIGHT)


def test_robot_slides_down_a_slope_above_the_friction_angle():
    # atan(0.15) is 8.5 degrees; downhill is -x of the tilted base
    sim, tilt = on_slope(1, 12.0, friction=0.15)
    for _ in range(60):
        sim.step()
    before = -tilt.inv().apply(sim.base_velocity()[0])[0]
    for _ in range(30):
        sim.step()
    gained = -tilt.inv().apply(sim.base_velocity()[0])[0] - before
    expected = 9.81 * (math.sin(math.radians(12.0)) - 0.15 * math.cos(math.radians(12.0)))
    assert gained / 0.5 == pytest.approx(expected, rel=0.02)


def test_static_friction_holds_where_dynamic_friction_slides():
    # atan(0.20) = 11.3 degrees < 12.4 degrees < atan(0.24) = 13.5 degrees
    sim, _ = on_slope(2, 12.4, friction=0.2)
    ratio = sim.solver.dynamics.static_friction_ratio
    ratio.fill_(5.0)
    sim.solver.dynamics.pack()
    for _ in range(60):
        sim.step()
    ratio.assign(np.array([1.2, 1.0], dtype=np.float32))
    sim.solver.dynamics.pack()
    before = paw_centres(sim)
    for _ in range(60):
        sim.step()
    start = paw_centres(sim)
    for _ in range(60):
        sim.step()
    assert np.abs(paw_centres(sim) - start)[0].max() < 1e-3
    moved = np.abs(paw_centres(sim) - before).max(axis=(1, 2))
    # 0.5 (sin 12.4 - 0.2 cos 12.4) g t^2 = 0.38 m for t = 2 s
    assert moved[1] == pytest.approx(0.38, rel=0.1)


def test_flat_heightfield_matches_the_plane():
    height = 0.4  # [m]
    plane, field = simulation(16), simulation(16, ground=slope(0.0, height))
    for sim in (plane, field):
        thrown(sim, seed=13, height=(0.5, 0.8), speed=0.5)
    q = field.joint_q().copy()
    q[:, Z] += height
    write_state(field, q)
    for _ in range(20):
        plane.step()
        field.step()
    difference = field.joint_q() - plane.joint_q()
    difference[:, 2] -= height
    assert np.abs(difference).max() < 1e-3  # [m], [rad]


def worst_excess(sim, worlds=slice(None)):
    """Return the largest excess [deg] beyond the stops, of motors and of outer + inner; negative: within them."""
    angles = np.degrees(sim.joint_q()[worlds][:, MOTOR_COORDS].astype(float))
    total = angles[:, 1::3] + angles[:, 2::3]
    lower, upper = np.array([-50.0, -30.0, -30.0] * 4), np.array([110.0, 140.0, 140.0] * 4)
    motors = max((lower - angles).max(), (angles - upper).max())
    return motors, max(-total.min(), total.max() - 240.0)


def lowest_corner(sim):
    """Return the height [m] of the lowest corner of the body's bounding box, (num_worlds,)."""
    q = sim.joint_q()
    corners = np.array(list(itertools.product((-0.343, 0.343), (-0.2, 0.2), (-0.049, 0.099))))
    heights = [Rotation.from_quat(quat).apply(corners)[:, 2].min() for quat in q[:, QUAT]]
    return q[:, Z] + np.array(heights)


def push(sim, torque_of_step, steps):
    """Apply torque_of_step(i) [N m], (num_worlds, 12), below the no-load speed; return the worst `worst_excess` [deg].

    A robot counts until its body would touch the ground, with which only the paws collide.
    """
    joint_f = np.zeros((sim.num_worlds, DOFS), dtype=np.float32)
    no_load = np.tile([49.2, 40.0, 40.0], 4)  # [rad/s]
    worst = np.array([-np.inf, -np.inf])
    counts = np.ones(sim.num_worlds, dtype=bool)
    on_ground = "ground" in sim.model.shape_label
    for i in range(steps):
        torque, rate = torque_of_step(i), sim.joint_qd()[:, MOTOR_DOFS]
        joint_f[:, MOTOR_DOFS] = np.where((np.abs(rate) < no_load) | (rate * torque < 0.0), torque, 0.0)
        sim.control.joint_f.assign(joint_f.ravel())
        sim.solver.step(sim.state, sim.state, sim.control, None, sim.dt)
        if on_ground:
            counts &= lowest_corner(sim) > 0.0
        if not counts.any():
            break
        worst = np.maximum(worst, worst_excess(sim, counts))
    assert not sim.solver.diverged.numpy().any()
    return worst


@pytest.mark.parametrize("ground", ["plane", None])
def test_stops_hold_constant_torque(ground):
    # worlds 0 to 23: one motor each, both ways; then both transversals of every leg together, and against each other
    torque = np.zeros((28, 12))
    for motor in range(12):
        torque[2 * motor, motor], torque[2 * motor + 1, motor] = 24.8, -24.8
    for world, (outer, inner) in enumerate(((1, 1), (-1, -1), (1, -1), (-1, 1)), start=24):
        torque[world, 1::3], torque[world, 2::3] = 24.8 * outer, 24.8 * inner
    motors, sums = push(simulation(28, ground=ground), lambda _: torque, 480)
    assert motors < 0.3  # [deg]
    assert sums < 0.1


# [deg] impacts on nearly singular legs are of several kN
@pytest.mark.parametrize(("ground", "most"), [("plane", 1.0), (None, 0.3)])
def test_stops_hold_random_torque(ground, most):
    sim = simulation(64, ground=ground)
    for seed in range(14, 18):
        thrown(sim, seed)
        torques = np.repeat(np.random.default_rng(seed).uniform(-24.8, 24.8, (12, 64, 12)), 20, axis=0)
        motors, sums = push(sim, lambda i, torques=torques: torques[i], 240)
        assert motors < most
        assert sums < most


def test_stops_hold_in_drops_from_two_metres_on_stiff_legs():
    sim = simulation(64, motors=stiff_motors())
    thrown(sim, seed=16, height=(2.4, 2.5), joint_rate=0.0)
    worst, counts, landed = np.array([-np.inf, -np.inf]), np.ones(64, dtype=bool), np.zeros(64, dtype=bool)
    for _ in range(480):
        sim.physics_step()
        counts &= lowest_corner(sim) > 0.0
        landed |= counts & (paw_forces(sim)[..., Z] > 0.0).any(axis=1)
        worst = np.maximum(worst, worst_excess(sim, counts)) if counts.any() else worst
    assert landed.sum() > 40
    assert not sim.solver.diverged.numpy().any()
    assert worst[0] < 1.0  # [deg] motors
    assert worst[1] < 0.3  # [deg] outer + inner


def test_thousand_policy_steps_of_random_targets_stay_finite():
    sim = simulation(64)
    rng = np.random.default_rng(17)
    lower, upper = np.radians([-50.0, -30.0, -30.0] * 4), np.radians([110.0, 140.0, 140.0] * 4)
    for _ in range(1000):
        command(sim, rng.uniform(lower, upper, (64, 12)))
        sim.step()
    assert not sim.solver.diverged.numpy().any()
    assert np.isfinite(sim.joint_q()).all()
    assert np.abs(sim.joint_qd()).max() < 500.0  # [rad/s]
