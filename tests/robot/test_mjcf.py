"""The MJCF model against SolverMuJoCo, Pinocchio and the description; loops, motors and overlays in plain MuJoCo."""

import math
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from columns import Z
from jumper_warp.robot.description import LEGS, MOTOR_JOINTS, load_description
from jumper_warp.robot.export import export_robot
from jumper_warp.robot.model import build_model
from jumper_warp.robot.overlay import RobotOverlay
from jumper_warp.sim.mujoco import mujoco_solver
from jumper_warp.utils.assets import ASSETS
from pinocchio_model import build_pinocchio

pytestmark = pytest.mark.usefixtures("one_thread")
FILE = ASSETS / "jumper" / "jumper.xml"
KNEES = [f"{leg}_{bar}_knee" for leg in LEGS for bar in ("outer", "inner")]


def load(file=FILE):
    """Return model and data of an MJCF file, in the default pose."""
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    mujoco.mj_forward(model, data)
    return model, data


def loop_gap(data):
    """Return the largest distance [m] between the two sites of a loop."""
    ends = [[data.site(f"{leg}_ankle_{end}").xpos for leg in LEGS] for end in ("parent", "child")]
    return np.linalg.norm(np.subtract(*ends), axis=1).max()


@pytest.mark.parametrize(("kind", "names"), [("mjcf", ["jumper.xml"]), ("urdf", ["jumper.urdf", "loop_closures.yaml"])])
def test_shipped_files_are_current(kind, names, tmp_path):
    export_robot(kind, tmp_path)
    for name in names:
        assert (tmp_path / name).read_text() == (FILE.parent / name).read_text(), f"export the {kind} again: {name}"
    meshes = {file.name: file.read_bytes() for file in (tmp_path / "meshes").iterdir()}
    assert meshes == {file.name: file.read_bytes() for file in (FILE.parent / "meshes").iterdir()}


def test_file_is_well_formed_and_holds_the_robot():
    ElementTree.parse(FILE)  # MuJoCo accepts more than XML does
    model, data = load()
    assert (model.nq, model.nv, model.nu, model.neq, model.nmesh) == (27, 26, 20, 4, 4)
    assert model.body_mass.sum() == pytest.approx(14.5, abs=1e-9)  # [kg]
    assert model.opt.timestep == pytest.approx(1 / 480)
    assert loop_gap(data) < 1e-9  # [m]
    assert min(data.geom(f"{leg}_paw").xpos[2] for leg in LEGS) == pytest.approx(0.025, abs=1e-9)  # [m], paw radius


def test_constants_agree_with_those_that_newton_compiles():
    model, data = load()
    solver = mujoco_solver(build_model(1, visuals=False, device="cpu"))
    other, warp = solver.mj_model, solver.mjw_model
    for name in ("body_mass", "body_ipos", "jnt_axis", "jnt_range", "dof_armature", "dof_frictionloss"):
        np.testing.assert_allclose(getattr(model, name), getattr(other, name), rtol=1e-5, atol=1e-7, err_msg=name)
    np.testing.assert_allclose(*(mass_matrix(m, data.qpos) for m in (model, other)), atol=1e-6)
    for name in ("geom_solref", "geom_solimp", "geom_friction"):
        values = [getattr(m, name)[m.geom_bodyid > 0][-1] for m in (model, other)]  # of a paw
        np.testing.assert_allclose(*values, rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(model.eq_solimp, warp.eq_solimp.numpy()[0], rtol=1e-6)
    raised = np.maximum(model.eq_solref, [2 * model.opt.timestep, 0.0])  # as MuJoCo does
    np.testing.assert_allclose(raised, warp.eq_solref.numpy()[0], rtol=1e-6)


def mass_matrix(model, qpos):
    """Return the joint-space inertia (26, 26) of a MuJoCo model at a configuration."""
    data, matrix = mujoco.MjData(model), np.zeros((26, 26))
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    return matrix


def test_accelerations_agree_with_rigid_loops_of_pinocchio():
    """Base and motors of ten robots at rest in the air accelerate alike under random motor torques."""
    model, data = load()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    model.eq_solimp[:, :2] = 0.9999  # nearly rigid loops
    reference, rng = build_pinocchio(), np.random.default_rng(3)
    motors, knees = ([model.joint(name) for name in names] for names in (MOTOR_JOINTS, KNEES))
    for _ in range(10):
        angles = load_description().pose("default") + rng.uniform(-0.2, 0.2, 12)
        torques = rng.uniform(-10.0, 10.0, 12)  # [N m]
        q = reference.configuration(np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, 0.0, 1.0]), angles)
        expected = reference.forward_dynamics(q, np.zeros(26), torques)
        data.qpos[:7] = [0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]
        for joint, index in zip(motors + knees, [*reference.motor_q, *reference.knee_q], strict=True):
            data.qpos[joint.qposadr[0]] = q[index]
        data.qfrc_applied[[joint.dofadr[0] for joint in motors]] = torques
        mujoco.mj_forward(model, data)
        measured = data.qacc[[*range(6), *(joint.dofadr[0] for joint in motors)]]
        wanted = expected[[*range(6), *reference.motor_v]]
        np.testing.assert_allclose(measured, wanted, atol=1e-4 * np.abs(wanted).max())


def test_dropped_robot_keeps_its_loops_closed_and_its_legs_within_the_stop_of_their_sum():
    model, data = load()
    data.qpos[2] += 0.2
    data.ctrl[:12] = -0.5  # [rad]; outer + inner cannot fall below 0
    gap, lowest, sums = 0.0, 1.0, []
    for _ in range(480):
        mujoco.mj_step(model, data)
        gap = max(gap, loop_gap(data))
        lowest = min(lowest, *(data.geom(f"{leg}_paw").xpos[2] for leg in LEGS))
        sums += [data.joint(f"{leg}_outer").qpos[0] + data.joint(f"{leg}_inner").qpos[0] for leg in LEGS]
    assert gap < 1e-3 and lowest > 0.02  # [m]
    assert -math.radians(2.0) < min(sums) < math.radians(2.0)


def test_motors_and_knee_dampers_stay_within_their_torques():
    model, data = load()
    data.ctrl[:12] = 100.0  # [rad]
    data.qvel[[model.joint(name).dofadr[0] for name in KNEES]] = [0.0, 1.0, 5.0, -50.0] * 2  # [rad/s]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force[:12], [18.0, 24.8, 24.8] * 4)  # [N m]
    np.testing.assert_allclose(data.actuator_force[12:], [0.0, -0.1, -0.5, 1.0] * 2, atol=1e-12)


def test_paws_grip_as_described_on_any_ground_and_pass_through_each_other():
    model, data = load()
    model.geom("ground").friction[0] = 3.0  # which MuJoCo must not use
    mujoco.mj_forward(model, data)
    data.qpos[Z] -= 0.001  # [m] into the ground
    mujoco.mj_forward(model, data)
    assert data.ncon == 4 and all(contact.friction[0] == pytest.approx(0.9) for contact in data.contact)
    paws = [model.geom(f"{leg}_paw") for leg in LEGS]
    assert not any(a.contype[0] & b.conaffinity[0] for a in paws for b in paws)


def test_overlay_changes_masses_motors_friction_and_springs(tmp_path):
    nominal = RobotOverlay({}).robots()
    values = {
        "base_mass": (8.43,), "base_com": (0.01, 0.0, 0.0), "link_mass": (1.1, 1.0, 1.0, 1.0, 1.0),
        "armature": tuple(2.0 * nominal.armature[0]), "kp": (0.5,) * 12, "saturation": (0.9,) * 12, "peak": (0.8,) * 12,
        "knee_damping": (0.2,), "paw_friction": (0.6,), "spring_stiffness": (1000.0,), "spring_length": (0.17,),
    }  # fmt: skip
    model, data = load(export_robot("mjcf", tmp_path, RobotOverlay(values)))
    assert model.body_mass.sum() == pytest.approx(14.5 + 2.0 + 4 * 0.1437)
    np.testing.assert_allclose(model.body("body").ipos, [0.01, 0.0, 0.0])
    assert model.joint("FL_outer").armature[0] == pytest.approx(2.0 * 0.00414)
    assert model.actuator("FL_outer").gainprm[0] == pytest.approx(8.5)
    np.testing.assert_allclose(model.actuator("FL_outer").forcerange, [-19.84, 19.84])
    assert model.actuator("FL_outer_knee").gainprm[0] == pytest.approx(0.2)
    assert model.geom("FL_paw").friction[0] == pytest.approx(0.6)
    spring = model.tendon("FL_spring")
    length = data.ten_length[spring.id]
    assert length == pytest.approx(0.09 + 2 * 0.175 * math.sin(math.pi / 4))  # [m] between the knees
    pull = 1000.0 * (length - 0.17)  # [N]
    outer = model.joint("FL_outer").dofadr[0]
    assert data.qfrc_spring[outer] == pytest.approx(-pull * 0.175 * math.cos(math.pi / 4), rel=1e-6)  # [N m]
