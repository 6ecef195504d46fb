import numpy as np
import pytest
import warp as wp

from collision_kernels import make_collision_kernel
from columns import COORDS, XY, X, Z
from jumper_warp.envs.env import Env
from jumper_warp.kernels.collision.robot import SHANK_GROUND
from jumper_warp.kernels.dynamics.contact import BlockLaw, PawContact, block_velocity, push_on_block
from jumper_warp.kernels.scalar import vec3
from jumper_warp.kernels.terrain.ground import Ground, block_normal, ground_distance, surface, world_ground
from jumper_warp.registry import make_task
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.model import PHYSICS_DT, build_model
from jumper_warp.sim.dynamics import TOLERANCE
from jumper_warp.sim.solver import SolverJumper
from simulation_helpers import (
    PAW_RADIUS,
    WEIGHT,
    paw_centres,
    paw_forces,
    simulation,
    slip_velocities,
    stiff_motors,
    thrown,
    write_state,
)
from solver_helpers import Reference, States

wp.set_module_options({"enable_backward": False})

MASS = 14.5  # [kg] robot
TOP = 0.1  # [m] height of the block
WIDE = {"center": (0.0, 0.0), "half": (1.0, 1.0), "height": TOP}
"""A block under the whole robot."""


def on_block(num_worlds, settle=60, **block):
    """Return a simulation of robots on the middle of their blocks after `settle` policy steps; block: of `BlockCfg`."""
    arguments = {name: block.pop(name) for name in ("motors", "friction_paws") if name in block}
    arguments = {"friction": arguments.pop("friction_paws", 0.9), **arguments}
    sim = simulation(num_worlds, block=BlockCfg(**(WIDE | block)), **arguments)
    q = sim.joint_q().copy()
    q[:, Z] += TOP
    write_state(sim, q)
    for _ in range(settle):
        sim.step()
    return sim


def set_block_velocity(sim, velocity):
    """Set the blocks' velocities [m/s], (num_worlds, 2)."""
    blocks = sim.solver.dynamics.robot.ground.blocks
    values = blocks.numpy()
    values["velocity"] = velocity
    blocks.assign(values)


def momenta(sim, reference):
    """Return the robots' horizontal momenta [kg m/s], (num_worlds, 2), by Pinocchio."""
    states = States.read(sim.joint_q(), sim.joint_qd())
    return np.array([reference.momentum(states, i)[:2] for i in range(sim.num_worlds)])


@wp.kernel
def block_velocity_kernel(law: BlockLaw, impulse: wp.array(dtype=vec3), out: wp.array(dtype=vec3)):
    contacts = wp.zeros(shape=(4,), dtype=PawContact)
    for k in range(contacts.shape[0]):
        contacts[k].active = 1
        contacts[k].on_block = wp.where(k < 2, 1, 0)
        contacts[k].impulse = impulse[k]
    out[0] = block_velocity(law, push_on_block(contacts))


@pytest.mark.parametrize(
    ("speed", "paw_impulse", "expected"),  # [m/s] along x, [N s] on the paw in 0.01 s, [m/s]
    [
        # (100 N - 0.5 * 8 kg * 9.81 m/s^2) / 8 kg for 0.01 s
        (0.0, (-1.0, 0.0, 0.0), (1.0 - 0.3924) / 8.0),
        # a load of 60 N on top takes another 0.5 * 60 N
        (0.0, (-1.0, 0.0, 0.6), (1.0 - 0.3924 - 0.3) / 8.0),
        # friction holds against 30 N, and stops a slow block without reversing it
        (0.0, (-0.3, 0.0, 0.0), 0.0),
        (0.04, (0.0, 0.0, 0.0), 0.0),
        (-1.0, (0.0, 0.0, 0.0), -1.0 + 0.3924 / 8.0),
    ],
)
def test_a_paw_force_pushes_the_block_against_friction(speed, paw_impulse, expected):
    law = BlockLaw()
    law.velocity, law.up = vec3(speed, 0.0, 0.0), vec3(0.0, 0.0, 1.0)
    law.mass, law.friction, law.weight = 8.0, 0.5, 8.0 * 9.81 * 0.01
    impulses = np.array([paw_impulse, (0.0,) * 3, (5.0, 5.0, 5.0), (0.0,) * 3])  # the third paw is not on the block
    out = wp.zeros(1, dtype=vec3, device="cpu")
    wp.launch(block_velocity_kernel, 1, inputs=[law, wp.array(impulses, dtype=vec3, device="cpu"), out], device="cpu")
    assert out.numpy()[0] == pytest.approx([expected, 0.0, 0.0], abs=1e-6)


def test_block_stays_at_rest_under_a_standing_robot():
    sim = on_block(2, settle=0, mass=np.array([5.0, 20.0]))
    for _ in range(60):  # 1 s
        sim.step()
    paws = paw_centres(sim)
    for _ in range(120):  # 2 s
        sim.step()
    assert np.abs(sim.solver.block_position()).max() < 1e-3
    assert np.abs(paw_centres(sim) - paws).max() < 1e-3
    assert paw_centres(sim)[..., Z] == pytest.approx(TOP + PAW_RADIUS, abs=1e-3)
    assert paw_forces(sim).sum(axis=1) == pytest.approx(np.tile([0.0, 0.0, WEIGHT], (2, 1)), abs=1e-3 * WEIGHT)


def test_robot_and_block_accelerate_together_under_a_force():
    masses, force, friction = np.array([5.0, 10.0]), 40.0, 0.1  # [kg], [N], [1] of the floor
    sim = on_block(2, mass=masses, friction=friction, motors=stiff_motors())
    wrench = np.zeros((2, 21, 6), dtype=np.float32)
    wrench[:, 0, 0] = force
    sim.state.body_f.assign(wrench.reshape(-1, 6))
    for _ in range(30):
        sim.step()
    before = sim.solver.block_velocity()[:, X].copy()
    for _ in range(30):
        sim.step()
    acceleration = (sim.solver.block_velocity()[:, X] - before) / 0.5  # 30 policy steps are 0.5 s
    total = MASS + masses
    assert acceleration == pytest.approx((force - friction * total * 9.81) / total, rel=0.01)


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_block_momentum_matches_paw_and_floor_impulses(friction):
    masses = np.array([5.0, 10.0, 40.0, 5.0])
    sim = on_block(4, settle=0, mass=masses, friction=friction, half=(3.0, 3.0))
    thrown(sim, seed=21, height=(0.5, 0.7), speed=1.0)
    moved = 0
    for _ in range(240):
        before = sim.solver.block_velocity().astype(float)
        sim.physics_step()
        force, after = paw_forces(sim).sum(axis=1), sim.solver.block_velocity().astype(float)
        lost = masses[:, None] * (before - after) - PHYSICS_DT * force[:, XY]  # [N s] to the floor
        most = friction * PHYSICS_DT * (masses * 9.81 + force[:, Z])  # [N s] Coulomb limit
        speed = np.linalg.norm(after, axis=1)
        sliding = speed > 1e-4
        expected = most[:, None] * after / np.maximum(speed, 1e-9)[:, None]
        assert lost[sliding] == pytest.approx(expected[sliding], abs=2e-5)
        assert np.all(np.linalg.norm(lost, axis=1) <= most + 2e-5)
        moved += sliding.sum()
    assert moved > 100


def test_sticking_paws_move_with_the_block():
    sim = on_block(4, settle=20, mass=np.array([1.0, 5.0, 10.0, 100.0]), friction=0.05)
    qd = sim.joint_qd().copy()
    qd[:, X] = 0.5
    write_state(sim, qd=qd)
    compared, fastest = 0, 0.0
    for _ in range(120):
        before = sim.joint_q().copy()
        sim.physics_step()
        force, velocity = paw_forces(sim), sim.solver.block_velocity()
        slip = slip_velocities(sim, before)[..., XY] - velocity[:, None]
        sticking = np.linalg.norm(force[..., XY], axis=-1) < 0.85 * force[..., Z]  # paws have friction 0.9
        assert np.abs(slip[sticking]).max(initial=0.0) < 1e-3
        assert sim.solver.residual.numpy().max() <= TOLERANCE
        compared += sticking[:2].sum()
        fastest = max(fastest, np.abs(velocity).max())
    assert compared > 100
    assert fastest > 0.1


def test_static_friction_holds_on_a_moving_block():
    # on a heavy block at 0.5 m/s, pulled by 0.25 of the weight: friction 0.2 slides, static friction 0.8 holds
    sim = on_block(2, mass=1000.0, friction=0.0, friction_paws=0.2, motors=stiff_motors())
    dynamics = sim.solver.dynamics
    dynamics.static_friction_ratio.assign(np.array([4.0, 1.0], dtype=np.float32))
    dynamics.pack()
    qd = sim.joint_qd().copy()
    qd[:, X] = 0.5
    write_state(sim, qd=qd)
    set_block_velocity(sim, [0.5, 0.0])
    before = paw_centres(sim)[..., XY] - sim.solver.block_position()[:, None]
    wrench = np.zeros((2, 21, 6), dtype=np.float32)
    wrench[:, 0, 0] = 0.25 * WEIGHT
    sim.state.body_f.assign(wrench.reshape(-1, 6))
    for _ in range(30):
        sim.step()
    slipped = np.abs(paw_centres(sim)[..., XY] - sim.solver.block_position()[:, None] - before).max(axis=(1, 2))
    assert slipped[0] < 6e-3  # the paws roll as the legs lean
    assert slipped[1] > 0.03


def test_robots_thrown_on_light_blocks_converge_and_stay_finite():
    sim = on_block(32, settle=0, mass=np.repeat([1.0, 5.0], 16), friction=0.0, half=(3.0, 3.0))
    thrown(sim, seed=11, height=(0.5, 1.1))
    for _ in range(90):
        sim.step()
        assert sim.solver.residual.numpy().max() <= TOLERANCE
        assert np.linalg.norm(sim.solver.block_velocity(), axis=1).max() < 10.0  # [m/s]
    assert not sim.solver.diverged.numpy().any()


def test_paws_push_the_side_of_a_block():
    """Robots that move at 1 m/s push blocks ahead of them; momentum along x is conserved on frictionless ground."""
    masses = np.array([5.0, 15.0])
    block = BlockCfg(center=(0.9, 0.0), half=(0.4, 0.6), height=TOP, mass=masses, friction=0.0)
    sim = simulation(2, friction=0.0, block=block)
    qd = sim.joint_qd().copy()
    qd[:, X] = 1.0
    write_state(sim, qd=qd)
    reference = Reference(sim.model)
    before = momenta(sim, reference)
    for _ in range(36):
        sim.step()
        side = sim.solver.block_position()[:, X] - 0.4  # [m], which paws enter by less than 10 mm
        assert np.all(paw_centres(sim)[:, :2, 0].max(axis=1) < side - PAW_RADIUS + 0.01)
    block = masses * sim.solver.block_velocity()[:, X]  # [kg m/s]
    assert block.min() > 2.0
    assert momenta(sim, reference)[:, X] + block == pytest.approx(before[:, X], abs=0.01 * before[0, 0])


@wp.kernel
def probe_kernel(ground: Ground, point: wp.array(dtype=vec3), out: wp.array2d(dtype=float)):
    """Write surface height [m], ground distance [m] and block normal at each point, (worlds * points, 5)."""
    world, i = wp.tid()
    here = world_ground(ground, world)
    normal = block_normal(ground.blocks[world], point[i])
    row = world * point.shape[0] + i
    out[row, 0] = surface(here, point[i][0], point[i][1])[0]
    out[row, 1] = ground_distance(here, point[i])
    for j in range(3):
        out[row, 2 + j] = normal[j]


def test_surface_distance_and_normal_of_a_block():
    block = BlockCfg(center=np.array([[1.0, 0.0], [5.0, 0.0]]), half=(0.4, 0.2), height=0.1)
    ground = SolverJumper(build_model(2, visuals=False, device="cpu"), block=block).dynamics.robot.ground
    points = [(1.3, 0.1, 0.15), (0.5, 0.0, 0.06), (1.43, 0.0, 0.14), (1.0, 0.19, 0.02)]
    out = wp.zeros((8, 5), dtype=float, device="cpu")
    wp.launch(probe_kernel, (2, 4), inputs=[ground, wp.array(points, dtype=vec3, device="cpu"), out], device="cpu")
    found = out.numpy().reshape(2, 4, 5)
    # 0.05 m above the top; 0.06 m above floor and 0.1 m from a wall; 0.05 m off an edge (0.03, 0.04); 0.01 m inside
    assert found[0, :, 0] == pytest.approx([0.1, 0.0, 0.0, 0.1])
    assert found[0, :, 1] == pytest.approx([0.05, 0.06, 0.05, -0.01], abs=1e-6)
    normals = [(0, 0, 1), (-1, 0, 0), (0.6, 0, 0.8), (0, 1, 0)]
    assert found[0, :, 2:] == pytest.approx(np.array(normals, dtype=float), abs=1e-5)
    assert found[1, :, 0] == pytest.approx(np.zeros(4))
    assert found[1, :, 1] == pytest.approx([0.15, 0.06, 0.14, 0.02], abs=1e-6)


def test_shank_in_a_block_is_a_collision():
    # world 0: the front shanks intersect a block; world 1: the block is far away
    block = BlockCfg(center=np.array([[0.69, 0.0], [3.0, 0.0]]), half=(0.4, 0.5), height=0.15)
    sim = simulation(2, block=block)
    flags, clearance = wp.zeros(2, dtype=int, device="cpu"), wp.zeros(2, dtype=float, device="cpu")
    robot = sim.solver.dynamics.robot
    inputs = [robot.geometry, robot.ground, sim.state.joint_q, COORDS, 0.0]
    wp.launch(make_collision_kernel(), 2, inputs=inputs, outputs=[flags, clearance], device="cpu")
    assert flags.numpy()[0] & int(SHANK_GROUND)
    assert flags.numpy()[1] == 0


def test_blocks_are_placed_and_reset_by_indices_mask_and_solver_reset():
    sim = on_block(3, settle=0, mass=5.0, friction=0.0)
    starts = np.array([[0.1, 0.0], [0.0, 0.2], [0.3, 0.1]], dtype=np.float32)
    sim.solver.place_blocks(starts)
    thrown(sim, seed=3, height=(0.5, 0.6))
    for _ in range(40):
        sim.step()
    moved = sim.solver.block_position()
    assert np.abs(moved - starts).max(axis=1).min() > 1e-3
    sim.solver.reset_blocks([1])
    assert np.array_equal(sim.solver.block_position(), [moved[0], starts[1], moved[2]])
    assert not sim.solver.block_velocity()[1].any()
    sim.solver.reset_blocks(wp.array([True, False, False], dtype=wp.bool, device="cpu"))
    assert np.array_equal(sim.solver.block_position(), [starts[0], starts[1], moved[2]])
    sim.solver.reset(sim.state)
    assert np.array_equal(sim.solver.block_position(), starts)


def test_block_of_a_diverged_world_returns_to_its_start():
    sim = on_block(2, settle=2, mass=5.0, friction=0.0)
    set_block_velocity(sim, [[1.0, 0.0], [1.0, 0.0]])
    sim.step()
    assert sim.solver.block_position()[:, X].min() > 1e-3
    rates = sim.joint_qd().copy()
    rates[0, 7] = np.nan  # FL_outer of world 0
    sim.state.joint_qd.assign(rates.ravel())
    sim.step()
    sim.step()
    assert sim.solver.diverged.numpy().tolist() == [1, 0]
    assert np.array_equal(sim.solver.block_position()[0], [0.0, 0.0])
    assert np.isfinite(sim.solver.block_velocity()).all()


def test_refuses_blocks_on_mujoco():
    with pytest.raises(ValueError, match="needs solver='jumper'"):
        simulation(1, solver="mujoco", block=BlockCfg(center=(1.0, 0.0)))


@pytest.mark.parametrize("begin", ["reset", "evaluation_reset"])
def test_new_episode_resets_the_block_and_a_loaded_state_restores_it(begin):
    block = BlockCfg(center=(1.0, 0.0), half=(0.3, 0.3), height=0.05, mass=10.0, friction=0.4)
    env = Env(make_task("horizontal-jump"), 2, device="cpu", block=block)
    start = env.sim.solver.block_position()
    blocks = env.sim.dynamics.robot.ground.blocks
    moved = blocks.numpy().copy()
    moved["center"] += 0.2
    moved["velocity"] = 0.5
    blocks.assign(moved)
    assert np.abs(env.sim.solver.block_position() - start).min() > 0.1
    state = env.state_dict()
    if begin == "reset":
        env.reset()
    else:
        env.evaluation_reset(np.tile([0.8, 0.0, 0.0], (2, 1)))
    np.testing.assert_allclose(env.sim.solver.block_position(), start, atol=1e-6)
    assert not env.sim.solver.block_velocity().any()
    env.load_state_dict(state)
    np.testing.assert_array_equal(env.sim.solver.block_position(), moved["center"])
    np.testing.assert_array_equal(env.sim.solver.block_velocity(), np.full((2, 2), 0.5))
