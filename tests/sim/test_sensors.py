"""Newton's SensorIMU and SensorContact on SolverJumper and on SolverMuJoCo: free fall, standing, a jump."""

import newton
import numpy as np
import pytest
import warp as wp
from newton.sensors import SensorContact, SensorIMU

from columns import MOTOR_COORDS, MOTOR_DOFS, Z
from jumper_warp.robot.grounds import BlockCfg
from jumper_warp.robot.model import build_model
from jumper_warp.sim.mujoco import mujoco_solver
from jumper_warp.sim.solver import SolverJumper

DT, N = 1.0 / 480.0, 2
WEIGHT = 14.5 * 9.81  # [N]
WAYS = pytest.mark.parametrize(
    ("kind", "way"), [("jumper", "observables"), ("jumper", "state"), ("mujoco", "observables")]
)
"""Solver, and where the sensors read: a step's observables, or the state and contacts."""


def site(builder):
    """Add a site at the body's origin."""
    builder.add_site(builder.body_label.index("body"), label="imu")


class Robots:
    """Robots on a solver, with an accelerometer at the body and a contact sensor for each paw."""

    def __init__(self, kind, way="observables", **arguments):
        self.model = build_model(N, visuals=False, device="cpu", extras=site, **arguments)
        legacy = way == "state"
        self.imu = SensorIMU(self.model, sites="*/imu", request_state_attributes=legacy)
        self.touch = SensorContact(self.model, sensing_shapes="*_paw", request_contact_attributes=legacy)
        self.solver = SolverJumper(self.model) if kind == "jumper" else mujoco_solver(self.model)
        rows = 4 * N if kind == "jumper" else self.solver.get_max_contact_count()
        pipeline = newton.CollisionPipeline(self.model, rigid_contact_max=rows, soft_contact_max=0)
        self.contacts, self.state, self.control = pipeline.contacts(), self.model.state(), self.model.control()
        kinds = self.imu.solver_observable_kinds | self.touch.solver_observable_kinds
        self.observables = None if legacy else self.solver.observables(kinds=kinds, contacts=self.contacts)

    def q(self):
        """Return joint_q, (N, 43)."""
        return self.state.joint_q.numpy().reshape(N, -1).astype(float)

    def qd(self):
        """Return joint_qd, (N, 38)."""
        return self.state.joint_qd.numpy().reshape(N, -1).astype(float)

    def lift(self, height):
        """Move all robots up by a height [m]."""
        q = self.q()
        q[:, Z] += height
        self.state.joint_q.assign(q.ravel().astype(np.float32))
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    def drive(self, degrees):
        """Set torques of motors that hold angles [deg] of lateral, outer and inner with 60 N m/rad and 1 N m s/rad."""
        error = np.tile(np.radians(degrees), 4) - self.q()[:, MOTOR_COORDS]
        torque = np.zeros_like(self.qd())
        torque[:, MOTOR_DOFS] = np.clip(60.0 * error - self.qd()[:, MOTOR_DOFS], -18.0, 18.0)
        self.control.joint_f.assign(torque.ravel().astype(np.float32))

    def step(self, degrees=None):
        """Advance one step, and read the sensors: accelerations (N, 3) [m/s^2] and paw forces (N, 4, 3) [N]."""
        if degrees is not None:
            self.drive(degrees)
        self.solver.step(self.state, self.state, self.control, self.contacts, DT, observables=self.observables)
        if self.observables is None:
            self.solver.update_contacts(self.contacts, self.state)
        self.imu.update(self.state, observables=self.observables)
        self.touch.update(self.state, self.contacts, observables=self.observables)
        force = self.touch.total_force.numpy().reshape(N, 4, 3)
        return self.imu.accelerometer.numpy().astype(float), force.astype(float)


pytestmark = pytest.mark.filterwarnings("ignore::newton.NewtonDeprecationWarning")


@WAYS
def test_free_fall_feels_neither_gravity_nor_ground(kind, way):
    robots = Robots(kind, way)
    robots.lift(0.5)
    for _ in range(20):
        acceleration, force = robots.step()
    # released legs fall as fast as the body
    assert np.abs(acceleration).max() < 0.05 and not force.any()
    assert robots.qd()[:, Z] == pytest.approx(-9.81 * 20 * DT, rel=1e-2)


@WAYS
def test_standing_robot_feels_gravity_and_its_weight(kind, way):
    robots = Robots(kind, way)
    readings = [robots.step((0.0, 45.0, 45.0)) for _ in range(240)][-48:]
    acceleration, force = (np.mean(values, axis=0) for values in zip(*readings, strict=True))
    assert acceleration == pytest.approx(np.tile([0.0, 0.0, 9.81], (N, 1)), abs=0.15)
    assert force.sum(axis=1) == pytest.approx(np.tile([0.0, 0.0, WEIGHT], (N, 1)), abs=0.01 * WEIGHT)
    assert (force[:, :, Z] > 0.15 * WEIGHT).all()


def push_off(kind):
    """Return gains of vertical velocity [m/s] of the body, by its IMU and by the paws, and the peak force [N]."""
    robots = Robots(kind)
    for _ in range(120):
        robots.step((0.0, 60.0, 60.0))
    before = robots.qd()[:, Z].copy()
    readings = [robots.step((0.0, 5.0, 5.0)) for _ in range(60)]
    felt = sum(acceleration[:, Z] for acceleration, _ in readings) * DT - 9.81 * 60 * DT
    pushed = sum(force[:, :, Z].sum(axis=1) for _, force in readings) * DT / 14.5 - 9.81 * 60 * DT
    peak = max(force[:, :, Z].sum(axis=1).max() for _, force in readings)
    return robots.qd()[:, Z] - before, felt, pushed, peak


def test_push_off_of_a_jump_is_felt_alike_on_both_solvers():
    (gain, felt, pushed, peak), (other_gain, other_felt, other_pushed, _) = (push_off(k) for k in ("jumper", "mujoco"))
    assert gain.min() > 1.0 and peak > 1.5 * WEIGHT  # [m/s]
    for actual, expected in ((felt, gain), (other_felt, other_gain)):
        assert actual == pytest.approx(expected, abs=0.03)  # the body stays level
    assert (felt, pushed) == (pytest.approx(other_felt, rel=0.05), pytest.approx(other_pushed, rel=0.05))


def test_rows_name_paw_and_ground_and_meet_between_them():
    robots = Robots("jumper")
    for _ in range(60):
        robots.step((0.0, 45.0, 45.0))
    contacts, model = robots.contacts, robots.model
    assert contacts.rigid_contact_count.numpy()[0] == 4 * N
    names = [model.shape_label[i] for i in contacts.rigid_contact_shape0.numpy()]
    assert names == [f"world_{i}/{leg}_paw" for i in range(N) for leg in ("FL", "FR", "BL", "BR")]
    assert {model.shape_label[i] for i in contacts.rigid_contact_shape1.numpy()} == {"ground"}
    assert contacts.rigid_contact_normal.numpy() == pytest.approx(np.tile([0.0, 0.0, -1.0], (4 * N, 1)))
    bodies = model.shape_body.numpy()[contacts.rigid_contact_shape0.numpy()]
    for body, local, ground in zip(bodies, contacts.rigid_contact_point0.numpy(), contacts.rigid_contact_point1.numpy(),
                                   strict=True):  # fmt: skip
        pose = robots.state.body_q.numpy()[body]
        world = np.array(wp.transform_point(wp.transform(*pose), wp.vec3(*local)))
        assert world == pytest.approx(ground, abs=1e-4) and ground[2] == 0.0


def test_block_counts_as_ground():
    model = build_model(1, visuals=False, device="cpu")
    state, contacts = model.state(), newton.Contacts(4, 0, device="cpu")
    solver = SolverJumper(model, block=BlockCfg((0.0, 0.0), half=(1.0, 1.0), height=0.2))
    q = state.joint_q.numpy()
    q[0] = 0.7  # [m]: the front paws are 0.06 m behind the wall at x = 1 m, the hind paws far below the top
    state.joint_q.assign(q)
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    solver.update_contacts(contacts, state)
    assert contacts.rigid_contact_normal.numpy() == pytest.approx(np.array([[-1.0, 0, 0]] * 2 + [[0, 0, -1.0]] * 2))
