"""Resets, targets and base velocity of the simulation, on both solvers."""

import numpy as np
import pytest
import torch
import warp as wp

from columns import LIN_VEL, POS
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter
from jumper_warp.sim.simulation import Simulation

SOLVERS = ("jumper", "mujoco")
RESULTS = ("torque", "paw_force", "peak_force")  # arrays that a reset clears


def simulation(num_worlds, solver, **arguments):
    """Return a simulation on the CPU with the filter of the vertical jump."""
    return Simulation(
        num_worlds, solver=solver, command_filter=vertical_jump_filter(), visuals=False, device="cpu", **arguments
    )


def command(sim, step):
    """Command a squat up to policy step 5, then stretched legs; target angles grow by up to 20 % with the world."""
    degrees = np.array([0.0, 70.0, 70.0] if step < 6 else [0.0, 25.0, 25.0])
    spread = degrees[:, None] * np.linspace(1.0, 1.2, sim.num_worlds)
    sim.target.assign(np.radians(np.tile(spread, (4, 1))).astype(np.float32))


def jump(sim, steps=10):
    """Run a jump; return joint_q, joint_qd and torque of each step, (steps, num_worlds, 93)."""
    log = []
    for step in range(steps):
        command(sim, step)
        sim.step()
        log.append(np.concatenate([sim.joint_q(), sim.joint_qd(), sim.torque.numpy().T], axis=1))
    return np.array(log)


def snapshot(sim):
    """Return state, results and targets of a simulation, arrays (num_worlds, ...)."""
    n = sim.num_worlds
    state = [getattr(sim.state, name).numpy().reshape(n, -1) for name in ("joint_q", "joint_qd", "body_q", "body_qd")]
    results = [np.moveaxis(getattr(sim, name).numpy(), 0 if name == "peak_force" else 1, 0) for name in RESULTS]
    results += [sim.target.numpy().T, sim.peak_paw_force.numpy().T]
    return [values.reshape(n, -1).copy() for values in [*state, *results]]


def break_world(sim, world):
    """Write NaN to a joint rate of a world, which makes it diverge."""
    rates = sim.joint_qd().copy()
    rates[world, 7] = np.nan
    sim.state.joint_qd.assign(rates.ravel())


@pytest.mark.parametrize("solver", SOLVERS)
def test_reset_simulation_matches_a_new_one_bitwise(solver):
    sim = simulation(2, solver)
    fresh = snapshot(sim)
    first = jump(sim)
    assert not np.array_equal(first[-1], first[0])
    sim.reset()
    assert all(np.array_equal(found, expected) for found, expected in zip(snapshot(sim), fresh, strict=True))
    assert np.array_equal(jump(sim), first)


KINDS = {"list": list, "numpy": np.array, "torch": torch.tensor, "warp": lambda x: wp.array(x, dtype=wp.bool)}


@pytest.mark.parametrize(("solver", "kind"), [*(("jumper", kind) for kind in KINDS), ("mujoco", "numpy")])
def test_reset_affects_masked_worlds_only(solver, kind):
    sim, unreset = simulation(3, solver), simulation(3, solver)
    fresh = snapshot(sim)
    for each in (sim, unreset):
        jump(each, 8)
    sim.reset(KINDS[kind]([False, True, False]))
    for actual, start, expected in zip(snapshot(sim), fresh, snapshot(unreset), strict=True):
        assert np.array_equal(actual[1], start[1])
        assert np.array_equal(actual[[0, 2]], expected[[0, 2]])
    assert np.array_equal(jump(sim, 3)[:, [0, 2]], jump(unreset, 3)[:, [0, 2]])


@pytest.mark.parametrize("solver", SOLVERS)
def test_reset_recovers_diverged_world(solver):
    sim = simulation(2, solver)
    first = jump(sim)
    sim.reset()
    jump(sim, 4)
    break_world(sim, 1)
    jump(sim, 3)
    if solver == "mujoco":
        assert np.isnan(sim.joint_q()[1]).any()
    else:
        assert sim.solver.diverged.numpy()[1] == 1
    sim.reset(np.array([False, True]))
    again = jump(sim)
    assert np.array_equal(again[:, 1], first[:, 1])


@pytest.mark.parametrize("solver", SOLVERS)
def test_captured_reset_reads_its_mask_at_every_replay(solver):
    sim = simulation(3, solver)
    start = sim.joint_q().copy()
    mask = wp.zeros(3, dtype=wp.bool, device="cpu")
    jump(sim, 3)
    sim.reset(mask)
    with wp.ScopedCapture(device=sim.device) as capture:
        sim.reset(mask)
    for world in range(3):
        jump(sim, 3)
        moved = sim.joint_q().copy()
        mask.assign(np.arange(3) == world)
        wp.capture_launch(capture.graph)
        expected = np.where((np.arange(3) == world)[:, None], start, moved)
        assert np.array_equal(sim.joint_q(), expected)


@pytest.mark.parametrize("solver", SOLVERS)
def test_base_velocity_matches_differences_of_position(solver):
    sim = simulation(2, solver, ground=None)
    rates = sim.joint_qd().copy()
    rates[:, :6] = [[1.0, -2.0, 0.5, 2.0, -3.0, 1.0], [0.0, 0.0, 0.0, -4.0, 0.0, 5.0]]
    sim.state.joint_qd.assign(rates.ravel())
    for _ in range(5):
        before = sim.joint_q()[:, POS].astype(float)
        sim.physics_step()
        found = sim.base_velocity()
        expected = (sim.joint_q()[:, POS].astype(float) - before) / sim.dt
        assert found.shape == (2, 3)
        # [m/s] MuJoCo integrates the mean of two velocities
        assert found == pytest.approx(expected, abs=1e-3 if solver == "jumper" else 5e-3)
    com_velocity = sim.joint_qd()[:, LIN_VEL]
    assert np.abs(found - com_velocity).max() > 0.02  # origin and COM differ


def test_set_targets_broadcasts_and_refuses_bad_targets():
    sim, angles = Simulation(3, visuals=False, device="cpu"), np.arange(36.0).reshape(12, 3) / 36.0
    for targets in (angles, torch.tensor(angles), angles.tolist()):
        sim.set_targets(targets)
        np.testing.assert_array_equal(sim.target.numpy(), angles.astype(np.float32))
    sim.set_targets(angles[:, 1])
    np.testing.assert_array_equal(sim.target.numpy(), np.repeat(angles[:, 1:2], 3, axis=1).astype(np.float32))
    with pytest.raises(ValueError, match="targets must"):
        sim.set_targets(np.full(12, np.nan))


def test_motors_commanded_beyond_a_squat_give_way_until_virtual_work_balances():
    sim = Simulation(1, motors=jumping_motors(18.0), command_filter=vertical_jump_filter(), device="cpu")
    sim.set_targets(np.tile([0.0, 1.0, 1.0], 4))
    for _ in range(60):
        sim.step()
    # Motors of 17 N m/rad commanded to 1 rad give way under the weight of 14.5 kg, 35.6 N per leg: with the ankle
    # 0.175 cos(t) + sqrt(0.3^2 - (0.045 + 0.175 sin(t))^2) below the hips, virtual work balances at t = 1.232 rad,
    # ankle 0.272 m and paw 0.297 m below. (A little less is borne by the motors: shanks and paws rest on the ground.)
    assert sim.joint_q()[0, 2] == pytest.approx(0.297, abs=0.02)


def test_distances_far_from_the_origin_have_the_documented_errors():
    """Weightless robots move for 10 s; docs/explanation/reproducibility.md has a table of the errors."""
    expected = {
        (0.01, 10.0): 0.007,
        (0.1, 10.0): -0.002,
        (0.1, 1.0e3): -0.12,
        (1.0, 1.0e3): -0.004,
        (0.01, 1.0e3): -1.0,
    }
    speed, start = np.array(list(expected)).T
    sim = Simulation(len(expected), gravity=0.0, visuals=False, device="cpu")
    q, qd = (array.numpy().reshape(len(expected), -1).copy() for array in (sim.state.joint_q, sim.state.joint_qd))
    q[:, POS], qd[:, LIN_VEL] = np.stack([start, 0.0 * start, 2.0 + 0.0 * start], 1), np.outer(speed, [1.0, 0.0, 0.0])
    sim.state.joint_q.assign(q.ravel())
    sim.state.joint_qd.assign(qd.ravel())
    for _ in range(600):
        sim.step()
    covered = sim.joint_q()[:, 0] - start
    np.testing.assert_allclose(covered / (10.0 * speed) - 1.0, list(expected.values()), atol=0.005)
    np.testing.assert_allclose(sim.joint_qd()[:, 0], speed, rtol=1e-5)
