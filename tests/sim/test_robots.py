"""The project's robots beside the Jumper on SolverJumper: against SolverMuJoCo, their own MJCF, and invariants."""

import mujoco
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from jumper_warp.gym import make_vector_env
from jumper_warp.robot.export import export_robot
from jumper_warp.robot.measures import motors_for
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.robot.overlay import ROBOTS, RobotOverlay, load_overlay
from jumper_warp.sim.apex import OpenLoopJump
from jumper_warp.sim.simulation import Simulation
from simulation_helpers import loop_gap

NAMES = sorted(file.parent.name for file in ROBOTS.glob("*/robot.json"))


@pytest.fixture(scope="module", params=NAMES)
def robot(request):
    """Return each of the robots."""
    return load_overlay(request.param)


def test_open_loop_jump_agrees_with_mujoco_within_two_percent_and_keeps_loops_closed(robot):
    jump, gaps = OpenLoopJump(robot), []
    apex = jump.run(lambda: (jump.sim.write_bodies(), gaps.append(loop_gap(jump.sim)[0])))
    assert apex == pytest.approx(OpenLoopJump(robot, "mujoco").run(), rel=0.02)
    assert max(gaps) < 1.0e-6


def test_ground_carries_the_weight_of_the_standing_robot(robot):
    sim = Simulation(
        1, robot=robot, motors=motors_for(jumping_motors(), robot.description), device="cpu", visuals=False
    )
    for _ in range(180):
        sim.step()
    assert sim.paw_force.numpy()[:, 0, 2].sum() == pytest.approx(9.81 * robot.description.mass, rel=1.0e-3)


def test_mujoco_stands_on_the_exported_model(robot, tmp_path):
    model = mujoco.MjModel.from_xml_path(str(export_robot("mjcf", tmp_path, robot)))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    start = data.qpos[2]
    for _ in range(480):
        mujoco.mj_step(model, data)
    assert model.body_subtreemass[1] == pytest.approx(robot.description.mass)
    assert 0.85 * start < data.qpos[2] < 1.05 * start  # springs lift the heavy robot
    force = np.zeros(6)
    total = 0.0
    for contact in range(data.ncon):
        mujoco.mj_contactForce(model, data, contact, force)
        total += force[0]
    assert total == pytest.approx(9.81 * robot.description.mass, rel=0.02)


def motion(sim):
    """Return momentum [kg m/s], angular momentum about the centre of mass [kg m^2/s], and energy [J] of world 0."""
    pose, twist = (rows[0].astype(float) for rows in sim.links())
    mass = sim.model.body_mass.numpy().astype(float)
    inertia, com = sim.model.body_inertia.numpy().astype(float), sim.model.body_com.numpy().astype(float)
    turn = Rotation.from_quat(pose[:, 3:]).as_matrix()
    place = pose[:, :3] + np.einsum("bij,bj->bi", turn, com)
    spin = np.einsum("bij,bjk,blk,bl->bi", turn, inertia, turn, twist[:, 3:])
    linear = mass @ twist[:, :3]
    about = place - mass @ place / mass.sum()
    angular = (spin + np.cross(about, mass[:, None] * twist[:, :3])).sum(axis=0)
    armature = sim.model.joint_armature.numpy().astype(float)
    rates = sim.joint_qd()[0].astype(float)
    energy = 0.5 * ((mass[:, None] * twist[:, :3] ** 2).sum() + (twist[:, 3:] * spin).sum() + armature @ rates**2)
    return linear, angular, energy + 9.81 * mass @ place[:, 2]


def test_momentum_and_energy_stay_in_flight(robot):
    sim = Simulation(1, robot=robot, ground=None, dt=1.0e-5, substeps=10, device="cpu", visuals=False)
    for name in ("kp", "kd"):
        getattr(sim.motors, name).zero_()
    sim.model.joint_friction.zero_()
    sim.model.joint_damping.zero_()
    sim.dynamics.set_springs(np.zeros((1, 1)), np.zeros((1, 1)))
    sim.dynamics.pack()
    rng = np.random.default_rng(0)
    rates = np.zeros(38)
    rates[:6] = rng.normal(size=6)
    rates[[6 + 5 * leg + joint for leg in range(4) for joint in (1, 3)]] = 4.0 * rng.normal(size=8)
    sim.state.joint_qd.assign(rates.astype(np.float32))
    before = motion(sim)
    for _ in range(200):  # 0.02 s
        sim.step()
    after = motion(sim)
    gravity = np.array([0.0, 0.0, -9.81 * robot.description.mass * 0.02])
    np.testing.assert_allclose(after[0], before[0] + gravity, atol=2.0e-3 * np.abs(before[0]).max())
    np.testing.assert_allclose(after[1], before[1], atol=2.0e-3 * np.abs(before[1]).max())
    assert after[2] == pytest.approx(before[2], rel=1.0e-3)
    assert wp.get_device("cpu") == sim.device


def test_gymnasium_takes_several_robots_in_turn():
    robots = [RobotOverlay({"base_mass": (mass,)}) for mass in (7.0, 9.0)]
    env = make_vector_env("vertical-jump", 3, robot=robots, randomize=False, device="cpu").unwrapped.env
    masses = env.sim.model.body_mass.numpy().reshape(3, -1)[:, 0]
    assert masses == pytest.approx([7.0, 9.0, 7.0])
