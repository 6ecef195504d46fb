"""User additions to every world: sites and shapes on links, obstacles, and refusal of other parts."""

import warnings

import newton
import numpy as np
import pytest
import warp as wp
from newton.sensors import SensorIMU
from scipy.spatial.transform import Rotation

from jumper_warp.robot.model import build_model
from jumper_warp.sim.model_parts import NotThisRobotError
from jumper_warp.sim.simulation import Simulation
from jumper_warp.sim.solver import SolverJumper

CORNER = (0.3, 0.05, 0.1)  # [m], body frame
TILT = Rotation.from_euler("xyz", [0.3, -0.2, 0.5])  # of the site at the corner
GHOST = newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False, has_particle_collision=False)


def link(builder, name):
    """Return the index of a link in the builder of one robot."""
    return builder.body_label.index(name)


def corner_site(builder):
    """Add a rotated site at a corner of the body, and one at the ankle of a shank."""
    builder.add_site(link(builder, "body"), xform=wp.transform(CORNER, wp.quat(*TILT.as_quat())), label="corner")
    builder.add_site(
        link(builder, "FL_inner_shank"), xform=wp.transform((0.0, 0.0, -0.3), wp.quat_identity()), label="ankle"
    )


def mast(builder):
    """Add a visual box to the body."""
    xform = wp.transform((0.0, 0.0, 0.2), wp.quat_identity())
    builder.add_shape_box(link(builder, "body"), xform=xform, hx=0.01, hy=0.02, hz=0.1, cfg=GHOST, label="mast")


def wall(builder):
    """Add a colliding wall, fixed in the world, whose near face is at x = 0.45 m."""
    xform = wp.transform((0.5, 0.0, 0.25), wp.quat_identity())
    builder.add_shape_box(-1, xform=xform, hx=0.05, hy=1.0, hz=0.25, label="wall")


def bumper(builder):
    """Add a colliding sphere to the body."""
    builder.add_shape_sphere(link(builder, "body"), radius=0.1, label="bumper")


def ball(builder):
    """Add a free body."""
    builder.add_shape_sphere(builder.add_body(label="ball"), radius=0.1)


def leash(builder):
    """Add a ball joint between the front shanks."""
    builder.add_joint_ball(link(builder, "FL_inner_shank"), link(builder, "FR_inner_shank"), label="leash")


def test_extras_keep_labels_and_masses_of_the_robot_and_are_in_every_world():
    plain = build_model(2, visuals=False, device="cpu")
    model = build_model(2, visuals=False, device="cpu", extras=lambda b: (corner_site(b), mast(b), wall(b), bumper(b)))
    assert model.body_label == plain.body_label and model.joint_label == plain.joint_label
    assert np.array_equal(model.body_mass.numpy(), plain.body_mass.numpy())
    assert np.array_equal(model.body_inertia.numpy(), plain.body_inertia.numpy())
    for name in ("corner", "ankle", "mast", "wall", "bumper"):
        labels = [label for label in model.shape_label if label.endswith(name)]
        assert labels == [f"world_0/{name}", f"world_1/{name}"]


def test_imu_on_a_falling_and_rotating_robot_measures_centripetal_acceleration():
    sim = Simulation(1, ground=None, visuals=False, device="cpu", extras=corner_site)
    sensor = SensorIMU(sim.model, sites="*/corner", request_state_attributes=False)
    observables = sim.solver.observables(kinds=sensor.solver_observable_kinds)
    rates = sim.joint_qd().copy()
    rates[0, 3:6] = [0.0, 0.0, 6.0]
    sim.state.joint_qd.assign(rates.ravel())
    positions, times = [], 1.0e-3 * np.arange(9)  # of the site [m], [s]
    for _ in times:
        pose = sim.joint_q()[0].astype(float)
        positions.append(pose[:3] + Rotation.from_quat(pose[3:7]).apply(CORNER))
        sim.solver.step(sim.state, sim.state, None, None, 1.0e-3, observables=observables)
        if len(positions) == 5:  # in the middle of the fit
            sensor.update(sim.state, observables=observables)
            turn = Rotation.from_quat(sim.joint_q()[0, 3:7]) * TILT
    # world-frame acceleration of the site by a parabola through its positions, minus gravity [m/s^2]
    acceleration = 2.0 * np.polyfit(times, np.array(positions), 2)[0] - [0.0, 0.0, -9.81]
    assert np.linalg.norm(acceleration) > 8.0  # 6^2 times 0.3 m, towards the axis
    assert sensor.accelerometer.numpy()[0] == pytest.approx(turn.inv().apply(acceleration), abs=1.0)
    assert sensor.gyroscope.numpy()[0] == pytest.approx(turn.inv().apply(sim.joint_qd()[0, 3:6]), abs=0.1)


def test_sites_and_visual_shapes_change_no_motion_and_give_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plain, extended = (
            Simulation(1, visuals=False, device="cpu", extras=extras)
            for extras in (None, lambda b: (corner_site(b), mast(b)))
        )
    for _ in range(10):
        plain.step(), extended.step()
    assert np.array_equal(plain.joint_q(), extended.joint_q())


@pytest.mark.parametrize(("extras", "part"), [(ball, "body 'world_0/ball'"), (leash, "joint 'world_0/leash'")])
def test_solver_refuses_bodies_joints_and_particles(extras, part):
    model = build_model(2, visuals=False, device="cpu", extras=extras)
    with pytest.raises(NotThisRobotError, match=f"{part}.*this robot alone") as refusal:
        SolverJumper(model)
    assert "\n" not in str(refusal.value)
