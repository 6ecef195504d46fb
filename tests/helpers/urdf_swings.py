"""The exported robot in Pinocchio, Drake and PyBullet: legs swing for 0.1 s with a fixed body and no motors.

Each function reads robot_urdf/ in the current folder, and returns the front left outer thigh's angle [rad] and the
largest loop gap [m].
"""

import numpy as np


def pinocchio_swing():
    """Let the legs swing in Pinocchio."""
    import pinocchio as pin
    import yaml

    model = pin.buildModelFromUrdf("robot_urdf/jumper.urdf")  # pin.JointModelFreeFlyer() as second argument: floating
    with open("robot_urdf/loop_closures.yaml") as text:
        file = yaml.safe_load(text)
    q, v = pin.neutral(model), np.zeros(model.nv)
    for name, angle in file["default_pose"].items():
        q[model.joints[model.getJointId(name)].idx_q] = angle
    loops, loop_data = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    for loop in file["loops"]:
        ends = []
        for joint, point in zip(loop["joints"], loop["points"], strict=True):
            ends += [model.getJointId(joint), pin.SE3(np.eye(3), np.array(point))]
        constraint = pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, model, *ends, pin.ReferenceFrame.LOCAL)
        constraint.m_baumgarte_parameters.Kp, constraint.m_baumgarte_parameters.Kd = 1.0e4, 200.0
        loops.append(constraint)
        loop_data.append(constraint.createData())
    data = model.createData()
    pin.initConstraintDynamics(model, data, loops, loop_data)
    settings = pin.ProximalSettings(1.0e-10, 1.0e-10, 20)  # a planar loop has three rows of rank two
    for _ in range(480):
        dv = pin.constraintDynamics(model, data, q, v, np.zeros(model.nv), loops, loop_data, settings)
        v = v + dv / 4800.0
        q = pin.integrate(model, q, v / 4800.0)
    pin.forwardKinematics(model, data, q)
    gap = max(
        np.linalg.norm(
            data.oMi[loop.joint1_id].act(loop.joint1_placement.translation)
            - data.oMi[loop.joint2_id].act(loop.joint2_placement.translation)
        )
        for loop in loops
    )
    outer = q[model.joints[model.getJointId("FL_outer")].idx_q]
    return outer, gap


def drake_swing():
    """Let the legs swing in Drake."""
    import yaml
    from pydrake.math import RigidTransform
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import DiscreteContactApproximation, MultibodyPlant
    from pydrake.systems.analysis import Simulator

    plant = MultibodyPlant(1.0 / 480.0)
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)  # ball constraints need SAP
    Parser(plant).AddModels("robot_urdf/jumper.urdf")
    with open("robot_urdf/loop_closures.yaml") as text:
        file = yaml.safe_load(text)
    for loop in file["loops"]:
        first, second = (plant.GetBodyByName(name) for name in loop["links"])
        plant.AddBallConstraint(first, loop["points"][0], second, loop["points"][1])
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("body"), RigidTransform([0.0, 0.0, 1.0]))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    for name, angle in file["default_pose"].items():
        plant.GetJointByName(name).set_angle(context, angle)
    Simulator(plant, context).AdvanceTo(0.1)
    gap = 0.0
    for loop in file["loops"]:
        ends = [
            plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(link)) @ np.array(point)
            for link, point in zip(loop["links"], loop["points"], strict=True)
        ]
        gap = max(gap, np.linalg.norm(ends[0] - ends[1]))
    outer = plant.GetJointByName("FL_outer").get_angle(context)
    return outer, gap


def pybullet_swing():
    """Let the legs swing in PyBullet."""
    import pybullet
    import yaml

    pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0.0, 0.0, -9.81)
    pybullet.setTimeStep(1.0 / 480.0)
    robot = pybullet.loadURDF(
        "robot_urdf/jumper.urdf", [0.0, 0.0, 1.0], useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE
    )
    links = {pybullet.getJointInfo(robot, i)[1].decode(): i for i in range(pybullet.getNumJoints(robot))}
    with open("robot_urdf/loop_closures.yaml") as text:
        file = yaml.safe_load(text)
    for name, angle in file["default_pose"].items():
        pybullet.resetJointState(robot, links[name], angle)
        pybullet.setJointMotorControl2(robot, links[name], pybullet.VELOCITY_CONTROL, force=0.0)  # no default motor

    def in_mass_frame(link, point):
        """Return a point of a link's frame in the frame of its centre of mass, which createConstraint takes."""
        place, rotation = pybullet.getDynamicsInfo(robot, link)[3:5]
        return pybullet.multiplyTransforms(*pybullet.invertTransform(place, rotation), point, [0.0, 0.0, 0.0, 1.0])[0]

    def in_world(link, point):
        """Return a point of a link's frame in the world frame."""
        place, rotation = pybullet.getLinkState(robot, link, computeForwardKinematics=True)[4:6]
        return np.array(pybullet.multiplyTransforms(place, rotation, point, [0.0, 0.0, 0.0, 1.0])[0])

    ends = [
        [(links[j], point) for j, point in zip(loop["joints"], loop["points"], strict=True)] for loop in file["loops"]
    ]
    for (first, point), (second, other) in ends:
        points = in_mass_frame(first, point), in_mass_frame(second, other)
        joint = pybullet.createConstraint(
            robot, first, robot, second, pybullet.JOINT_POINT2POINT, [0.0, 0.0, 0.0], *points
        )
        pybullet.changeConstraint(joint, maxForce=1.0e5)
    for _ in range(48):
        pybullet.stepSimulation()
    gap = max(np.linalg.norm(in_world(*first) - in_world(*second)) for first, second in ends)
    outer = pybullet.getJointState(robot, links["FL_outer"])[0]
    return outer, gap
