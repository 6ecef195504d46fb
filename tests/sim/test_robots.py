"""The project's robots beside the Jumper on SolverJumper: against SolverMuJoCo, their own MJCF, and invariants."""

import mujoco
import numpy as np
import pytest

from jumper_warp.robot.export import export_robot
from jumper_warp.robot.measures import motors_for
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.robot.overlay import ROBOTS, load_overlay
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
