"""`advance` with a thread per leg (for GPUs) against a thread per world, the oracle, both on the CPU in float64."""

import numpy as np
import pytest
import warp as wp

from columns import MOTOR_DOFS, QUAT, XY, Z
from jumper_warp.robot.grounds import BlockCfg, uneven
from jumper_warp.robot.model import build_model
from jumper_warp.sim.dynamics import JumperDynamics

N = 11  # worlds, not a multiple of the 8 worlds that share a warp


@pytest.fixture(autouse=True)
def blocks_of_threads():
    """Let the CPU run blocks of several threads, which take turns."""
    wp.config.enable_cpu_blocks = True
    yield
    wp.config.enable_cpu_blocks = False


def states(model, height, seed=0):
    """Return random joint_q (N, 43), joint_qd (N, 38), joint_f (N, 38) of robots with the base near a height [m]."""
    rng = np.random.default_rng(seed)
    q = model.joint_q.numpy().reshape(N, 43).astype(np.float64)
    q[:, XY] = rng.normal(size=(N, 2)) * 0.3
    q[:, Z] = height + rng.uniform(-0.04, 0.04, N)
    tilt = np.column_stack([rng.normal(size=(N, 2)) * 0.05, rng.normal(size=N), np.ones(N)])
    q[:, QUAT] = tilt / np.linalg.norm(tilt, axis=1, keepdims=True)
    qd = np.zeros((N, 38))
    qd[:, :6] = rng.normal(size=(N, 6)) * 0.4
    qd[:, MOTOR_DOFS] = rng.normal(size=(N, 12))
    force = np.zeros((N, 38))
    force[:, MOTOR_DOFS] = rng.uniform(-12.0, 12.0, (N, 12))
    return q, qd, force


def squatting(model):
    """Return joint_q, joint_qd, joint_f of robots near the stop of outer + inner, paws near the ground."""
    q, qd, force = states(model, 0.14)
    rng = np.random.default_rng(2)
    half = np.radians(120.0) + rng.uniform(-0.01, 0.01, (N, 4))  # half of outer + inner
    aside = rng.uniform(-0.1, 0.1, (N, 4))
    for leg in range(4):
        q[:, 7 + 5 * leg] = rng.uniform(-0.05, 0.05, N)
        q[:, 8 + 5 * leg], q[:, 10 + 5 * leg] = half[:, leg] + aside[:, leg], half[:, leg] - aside[:, leg]
    return q, qd, force


def advance(dynamics, q, qd, force, by_legs, substeps=4, tolerance=1.0e-12):
    """Return joint_q, joint_qd, impulse, contact force, peak forces (all, paws) and torque after steps of 1/480 s."""
    real = dynamics.real
    q, qd, force = (wp.array(x.ravel(), dtype=real) for x in (q, qd, force))
    wrench = np.zeros((N * 21, 6), dtype=np.float32)
    wrench[::21] = np.random.default_rng(5).normal(size=(N, 6))
    drive = dynamics.drive(force, wp.array(wrench, dtype=wp.spatial_vector))
    dynamics.max_sweeps, dynamics.tolerance = 500, tolerance
    dynamics.advance(1.0 / 480.0, substeps, drive, q, qd, q, qd, by_legs=by_legs)
    work = dynamics.work
    arrays = (work.impulse, work.contact_force, work.peak_force, work.peak_paw_force, work.torque)
    return q.numpy(), qd.numpy(), *(array.numpy() for array in arrays)


GROUNDS = {
    "plane": {"ground": "plane"},
    "heightfield": {"ground": uneven(0.03, seed=3, flat_radius=0.0)},
    "block": {"ground": "plane", "block": BlockCfg((0.1, 0.0), half=(0.3, 0.2), height=0.02, mass=3.0)},
    "springs": {"ground": "plane"},
    "stops": {"ground": "plane"},
}


@pytest.mark.parametrize("kind", GROUNDS)
def test_thread_per_leg_matches_thread_per_world(kind):
    model = build_model(N, ground=GROUNDS[kind]["ground"], friction=0.5)
    q, qd, force = squatting(model) if kind == "stops" else states(model, 0.34)
    legs, world = (JumperDynamics(model, double=True, block=GROUNDS[kind].get("block")) for _ in range(2))
    if kind == "springs":
        for dynamics in (legs, world):
            dynamics.leg_springs.fill_(wp.vec2(1000.0, 0.17))  # [N/m], [m]
            dynamics.pack()
    found = advance(legs, q, qd, force, by_legs=True)
    expected = advance(world, q, qd, force, by_legs=False)
    assert (np.abs(expected[2]).max(axis=(1, 2)) > 0.0).sum() >= 3  # legs with contact impulses
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1.0e-8, rtol=1.0e-8)
    if kind == "springs":
        springless = advance(JumperDynamics(model, double=True), q, qd, force, by_legs=False)[1]
        assert np.abs(found[1] - springless).max() > 1.0  # [rad/s]
    if kind == "block":
        moved = [dynamics.robot.ground.blocks.numpy()["center"] for dynamics in (legs, world)]
        assert np.abs(moved[1] - [0.1, 0.0]).max() > 1.0e-6  # [m] from its start
        np.testing.assert_allclose(*moved, atol=1.0e-9)
    if kind == "stops":
        angles = expected[0].reshape(N, 43)[:, 7:27].reshape(N, 4, 5)
        pressed = angles[..., 1] + angles[..., 3] > np.radians(240.0)
        touching = np.linalg.norm(expected[2], axis=2).T > 0.0
        assert (pressed & touching).sum() > 5 and (pressed & ~touching).any() and (~pressed & touching).any()


def test_diverged_world_is_frozen_and_others_advance_unchanged():
    model = build_model(N)
    dynamics = JumperDynamics(model, double=True)
    q, qd, force = states(model, 0.34)
    qd[4, 3] = np.nan
    found = advance(dynamics, q, qd, force, by_legs=True)
    np.testing.assert_array_equal(np.flatnonzero(dynamics.work.diverged.numpy()), [4])
    np.testing.assert_allclose(found[0].reshape(N, 43)[4], model.joint_q.numpy().reshape(N, 43)[4], atol=1.0e-7)
    np.testing.assert_array_equal(found[1].reshape(N, 38)[4], 0.0)
    np.testing.assert_array_equal(found[2][:, 4], 0.0)  # impulses
    intact = JumperDynamics(model, double=True)
    qd[4, 3] = 0.0
    others = np.arange(N) != 4
    for a, b in zip(found[:2], advance(intact, q, qd, force, by_legs=True)[:2], strict=True):
        np.testing.assert_array_equal(a.reshape(N, -1)[others], b.reshape(N, -1)[others])


def test_contact_iteration_ends_at_tolerance_and_reports_residual():
    model = build_model(N)
    dynamics = JumperDynamics(model, double=True)
    q, qd, force = states(model, 0.34)
    advance(dynamics, q, qd, force, by_legs=True, tolerance=1.0e-5)
    residual, sweeps = dynamics.work.residual.numpy(), dynamics.work.sweeps.numpy()
    assert 0.0 < residual.max() <= 1.0e-5
    assert 0 < sweeps.max() < 500


@pytest.mark.parametrize("friction", [0.2, 0.5, 1.0])
def test_sliding_paws_converge_in_few_rounds(friction):
    """Steps by the summed response of all paws take 10 to 13 rounds; steps of one paw at a time take more than 9."""
    model = build_model(N, friction=friction)
    dynamics = JumperDynamics(model, double=True)
    found = advance(dynamics, *states(model, 0.34), by_legs=True, tolerance=1.0e-5)
    assert (np.abs(found[2]).max(axis=(1, 2)) > 0.0).sum() >= 3  # legs with contact impulses
    assert 0 < dynamics.work.sweeps.numpy().max() <= 9
