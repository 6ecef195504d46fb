"""The exported robot in other simulators, where they are installed: its jump, loops, masses and stops."""

from pathlib import Path

import mujoco
import newton
import numpy as np
import pinocchio as pin
import pytest

from jumper_warp.robot.description import MOTOR_JOINTS, load_description
from jumper_warp.robot.export import export_robot
from jumper_warp.robot.model import build_model
from jumper_warp.robot.motors import jumping_motors
from jumper_warp.sim.simulation import Simulation, motor_values
from jumper_warp.utils.rotations import CONJUGATE, rotate

POLICY = Path(__file__).parents[2] / "assets" / "policies" / "horizontal_jump" / "policy.onnx"
PLACE = np.array([0.8, 0.0])  # [m] goal of the jump
LEGS = ("FL", "FR", "BL", "BR")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Folder with the exported MJCF, URDF and USD."""
    folder = tmp_path_factory.mktemp("simulators")
    for kind in ("mjcf", "urdf"):
        export_robot(kind, folder / f"robot_{kind}")
    return folder


@pytest.fixture
def exported(files, monkeypatch):
    """The folder with the exported files, as the current one."""
    monkeypatch.chdir(files)
    return files


@pytest.mark.parametrize(("rate", "gap"), [(480, 1.0e-3), (1920, 1.0e-4)])  # [1/s], [m]
def test_jump_in_mujoco_reaches_its_height_with_closed_loops(exported, rate, gap):
    pytest.importorskip("onnxruntime")
    apex, largest_gap = jump_in_mujoco(rate)
    assert largest_gap < gap
    assert apex == pytest.approx(apex_in_solver_mujoco(rate), abs=0.005)  # [m]


def way_to_place(q, tick):
    """Return the way from a base at q[:3], with heading 0, to PLACE [m]; none before the command, at 0.5 s."""
    return PLACE - q[:2] if tick >= 30 else np.zeros(2)


def jump_in_mujoco(rate):
    """Return apex and largest loop gap [m] of the policy's jump to PLACE; rate: physics steps a second."""
    deploy = pytest.importorskip("jumper_warp.deploy.policy")
    policy = deploy.DeployedPolicy(POLICY)
    model = mujoco_model_of(policy)
    model.opt.timestep = 1.0 / rate
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("default").id)
    mujoco.mj_forward(model, data)
    joints = [model.joint(name) for name in policy.interface["joint_names"]]
    angles, rates = (np.array([getattr(joint, address)[0] for joint in joints]) for address in ("qposadr", "dofadr"))
    apex = gap = 0.0
    for tick in range(180):
        to_body = data.body("body").xmat.reshape(3, 3).T
        readings = {
            "height": data.qpos[2],
            "lin_vel": to_body @ data.qvel[:3],
            "ang_vel": data.qvel[3:6],  # MuJoCo has it in body axes
            "gravity": to_body @ [0.0, 0.0, -1.0],
            "angle": data.qpos[angles],
            "rate": data.qvel[rates],
            "goal": way_to_place(data.qpos, tick),
        }
        data.ctrl[:12] = policy.targets(readings)
        for _ in range(rate // 60):
            mujoco.mj_step(model, data)
            apex, gap = max(apex, data.qpos[2]), max(gap, *(ankle_gap(data, leg) for leg in LEGS))
    return apex, gap


def mujoco_model_of(policy):
    """Return the exported MuJoCo model with the gains and torque limits of a policy."""
    model = mujoco.MjModel.from_xml_path("robot_mjcf/jumper.xml")
    kp, kd, limit = (np.array(policy.interface[name]) for name in ("joint_stiffness", "joint_damping", "torque_limit"))
    model.actuator_gainprm[:12, 0], model.actuator_biasprm[:12, 1], model.actuator_biasprm[:12, 2] = kp, -kp, -kd
    model.actuator_forcerange[:12] = np.stack([-limit, limit], axis=1)
    return model


def ankle_gap(data, leg):
    """Return the distance [m] between the two ends of a leg's ankle in MuJoCo."""
    first, second = (data.site(f"{leg}_ankle_{end}").xpos for end in ("parent", "child"))
    return np.linalg.norm(first - second)


def apex_in_solver_mujoco(rate):
    """Return the apex [m] of the jump to PLACE on this project's SolverMuJoCo; rate: physics steps a second."""
    deploy = pytest.importorskip("jumper_warp.deploy.policy")
    policy = deploy.DeployedPolicy(POLICY)
    motors = jumping_motors(18.0, lateral_torque=12.0)
    robot = Simulation(1, solver="mujoco", motors=motors, dt=1.0 / rate, substeps=rate // 60, device="cpu")
    apex = 0.0
    for tick in range(90):
        q, qd, velocity = robot.joint_q()[0], robot.joint_qd()[0], robot.base_velocity()[0]
        readings = {
            "height": q[2],
            "angle": motor_values(q[7:]),
            "rate": motor_values(qd[6:]),
            "goal": way_to_place(q, tick),
        }
        vectors = {"lin_vel": velocity, "ang_vel": qd[3:6], "gravity": np.array([0.0, 0.0, -1.0])}
        readings |= {name: rotate(q[3:7] * CONJUGATE, vector) for name, vector in vectors.items()}
        robot.set_targets(policy.targets(readings))
        robot.step()
        apex = max(apex, robot.joint_q()[0, 2])
    return apex


def test_loop_closures_of_the_urdf_are_those_of_the_description(exported):
    yaml = pytest.importorskip("yaml")
    file, robot = yaml.safe_load((exported / "robot_urdf" / "loop_closures.yaml").read_text()), load_description()
    model = pin.buildModelFromUrdf(str(exported / "robot_urdf" / "jumper.urdf"))
    assert [file["default_pose"][name] for name in MOTOR_JOINTS] == pytest.approx(list(robot.pose("default")))
    q = pin.neutral(model)
    for name, angle in file["default_pose"].items():
        q[model.joints[model.getJointId(name)].idx_q] = angle
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    for loop, described in zip(file["loops"], robot.loops, strict=True):
        np.testing.assert_allclose(loop["points"], [described.parent_anchor, described.child_anchor])
        first, second = (data.oMi[model.getJointId(joint)].act(np.array(point))
                         for joint, point in zip(loop["joints"], loop["points"], strict=True))  # fmt: skip
        np.testing.assert_allclose(first, second, atol=1e-5)  # [m] closed


def test_newton_reads_masses_stops_and_loops_from_usd(exported):
    pytest.importorskip("pxr")
    pytest.importorskip("newton_usd_schemas")
    export_robot("usd", exported / "robot_usd")
    builder, usd = newton.ModelBuilder(), newton.usd
    resolvers = [usd.SchemaResolverNewton(), usd.SchemaResolverPhysx()]
    builder.add_usd("robot_usd/jumper.usda", schema_resolvers=resolvers)
    read, described = builder.finalize(device="cpu"), build_model(1, ground=None, device="cpu")
    bodies, joints = ([by_name(model, kind) for model in (read, described)] for kind in ("body", "joint"))
    for name, index in bodies[1].items():
        for quantity, tolerance in (("body_mass", 1e-6), ("body_com", 1e-7), ("body_inertia", 1e-8)):
            values = [getattr(read, quantity).numpy()[bodies[0][name]], getattr(described, quantity).numpy()[index]]
            np.testing.assert_allclose(*values, atol=tolerance, err_msg=f"{name} {quantity}")
    for name, index in joints[1].items():
        if name == "base":
            continue
        first, second = joints[0][name], index
        assert read.joint_type.numpy()[first] == described.joint_type.numpy()[second], name
        if name.endswith("ankle"):
            assert_same_loop(read, first, described, second)
        else:
            dofs = read.joint_qd_start.numpy()[first], described.joint_qd_start.numpy()[second]
            for quantity in ("joint_limit_lower", "joint_limit_upper", "joint_armature", "joint_friction"):
                values = [
                    getattr(model, quantity).numpy()[dof] for model, dof in zip((read, described), dofs, strict=True)
                ]
                assert values[0] == pytest.approx(values[1], abs=1e-6), f"{name} {quantity}"


def by_name(model, kind):
    """Return the indices of a Newton model's bodies or joints by the last part of their labels."""
    labels = [label.split("/")[-1] for label in getattr(model, f"{kind}_label")]
    return {"base" if label.startswith("joint_") else label: index for index, label in enumerate(labels)}


def assert_same_loop(read, first, described, second):
    """Assert that joint `first` of one model and `second` of another join the same points of the same bodies."""
    for end in ("parent", "child"):
        labels = [model.body_label[getattr(model, f"joint_{end}").numpy()[joint]].split("/")[-1]
                  for model, joint in ((read, first), (described, second))]  # fmt: skip
        points = [getattr(model, f"joint_X_{end[0]}").numpy()[joint, :3]
                  for model, joint in ((read, first), (described, second))]  # fmt: skip
        assert labels[0] == labels[1]
        np.testing.assert_allclose(*points, atol=1e-7)
    assert read.articulation_count == 1 and first >= read.articulation_end.numpy()[0]
