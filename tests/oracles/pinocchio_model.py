"""The robot in Pinocchio: an independent reference for kinematics and rigid-body dynamics.

`build_pinocchio()` returns the described robot or that of an overlay, without ground, friction, knee damping and
springs. `dynamics_oracle.py` compares the project's dynamics with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio

from jumper_warp.robot.description import LEGS, MOTOR_JOINTS, RobotDescription, load_description
from jumper_warp.robot.urdf_writer import urdf
from jumper_warp.robot.values import RobotValues, described
from jumper_warp.utils.errors import InputError

pin: Any = pinocchio  # a compiled module without types
PROXIMAL_ACCURACY = 1.0e-12  # residual at which Pinocchio's proximal iteration ends
PROXIMAL_DAMPING = 1.0e-10  # proximal mu: keeps the solve regular, since a planar loop has three rows of rank two
PROXIMAL_ITERATIONS = 20
MAX_GAP = 1.0e-9  # [m] largest distance of the anchors of a closed loop


@dataclass(frozen=True, eq=False)
class PinocchioRobot:
    """Pinocchio model of the robot with rigid constraints that close its loops.

    Velocities follow Pinocchio: the base's six are the linear velocity of the body origin [m/s] and the angular
    velocity [rad/s], both in the body frame. Joints are in Pinocchio's own order; the index arrays map to it.
    Every call overwrites the buffers in `data`. q: configuration (27,), v: velocity (26,).
    """

    model: Any  # pinocchio.Model
    data: Any  # pinocchio.Data
    constraints: Any  # four RigidConstraintModel, one per loop, in leg order
    constraint_data: Any  # four RigidConstraintData
    motor_q: np.ndarray  # (12,) index into q of each motor, in motor order
    motor_v: np.ndarray  # (12,) index into v of each motor
    knee_q: np.ndarray  # (8,) index into q of the knees: outer, inner of each leg
    knee_v: np.ndarray  # (8,) index into v of the knees
    paws: np.ndarray  # (4, 3) [m] centre of each paw in the frame of its inner shank

    def configuration(self, base_pos: np.ndarray, base_quat_xyzw: np.ndarray, motors: np.ndarray) -> np.ndarray:
        """Return Pinocchio's configuration q, (27,), of base and motors, with knee angles that close the loops.

        Ankles are below the knees. base_pos: body origin (3,) [m], world frame. base_quat_xyzw: (4,) body to world,
        unit. motors: angles (12,) [rad] in motor order. Raises InputError: a loop cannot be closed.
        """
        q = pin.neutral(self.model)
        q[0:3] = base_pos
        q[3:7] = base_quat_xyzw
        q[self.motor_q] = motors
        for leg, name in enumerate(LEGS):
            q[self.knee_q[2 * leg : 2 * leg + 2]] = self._knees(name, motors[3 * leg + 1], motors[3 * leg + 2])
        gap = self.loop_gap(q)
        if not gap < MAX_GAP:
            raise InputError(f"expected closed loops, found a gap of {gap:.3g} m")
        return q

    def loop_gap(self, q: np.ndarray) -> float:
        """Return the largest distance [m] between the two anchors of a loop, over all loops; q: (27,)."""
        pin.forwardKinematics(self.model, self.data, q)
        pose = self.data.oMi
        gaps = (
            pose[c.joint1_id].act(c.joint1_placement.translation)
            - pose[c.joint2_id].act(c.joint2_placement.translation)
            for c in self.constraints
        )
        return max(float(np.linalg.norm(gap)) for gap in gaps)

    def paw_positions(self, q: np.ndarray) -> np.ndarray:
        """Return the paws' centres [m], shape (4, 3), world frame, legs FL, FR, BL, BR, of a configuration (27,)."""
        pin.forwardKinematics(self.model, self.data, q)
        pairs = zip(self.constraints, self.paws, strict=True)
        return np.array([self.data.oMi[c.joint1_id].act(paw) for c, paw in pairs])

    def paw_velocities(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the velocities of the paws' centres [m/s], shape (4, 3), world frame, legs FL, FR, BL, BR.

        q: (27,); v: (26,), as `closed_velocity` returns it.
        """
        pin.forwardKinematics(self.model, self.data, q, v)
        velocities = []
        for c, paw in zip(self.constraints, self.paws, strict=True):
            twist = self.data.v[c.joint1_id]
            rotation = self.data.oMi[c.joint1_id].rotation
            velocities.append(rotation @ (twist.linear + np.cross(twist.angular, paw)))
        return np.array(velocities)

    def paw_jacobians(self, q: np.ndarray) -> np.ndarray:
        """Return the paws' Jacobians [m], (4, 3, 3): velocity in the world frame per motor rate, with the base at rest.

        Axes: legs FL, FR, BL, BR; x, y, z; the leg's motors lateral, outer, inner. q: configuration (27,).
        """
        rates = (np.tile(motor, 4) for motor in np.eye(3))
        return np.stack([self.paw_velocities(q, self.closed_velocity(q, np.zeros(6), rate)) for rate in rates], axis=2)

    def closed_velocity(self, q: np.ndarray, base_twist: np.ndarray, motor_rates: np.ndarray) -> np.ndarray:
        """Return Pinocchio's velocity v, (26,), for given base and motor rates, with knee rates that keep loops closed.

        q: configuration (27,). base_twist: (6,) linear velocity [m/s] of the body origin, then angular velocity
        [rad/s], body frame. motor_rates: (12,) [rad/s], motor order.
        """
        v = np.zeros(self.model.nv)
        v[self.motor_v] = motor_rates
        pin.computeJointJacobians(self.model, self.data, q)
        for constraint, data in zip(self.constraints, self.constraint_data, strict=True):
            constraint.calc(self.model, self.data, data)
        jacobian = pin.getConstraintsJacobian(self.model, self.data, self.constraints, self.constraint_data)
        v[self.knee_v] = np.linalg.lstsq(jacobian[:, self.knee_v], -jacobian @ v, rcond=1.0e-9)[0]
        v[0:6] = base_twist
        return v

    def forward_dynamics(self, q: np.ndarray, v: np.ndarray, motor_torques: np.ndarray) -> np.ndarray:
        """Return the acceleration dv/dt, (26,), of the robot in free flight under gravity, with its loops kept closed.

        The first six entries are time derivatives of the base's body-frame components: add omega x v to the linear
        three for the acceleration of the origin. q: (27,), loops closed; v: (26,), which keeps them closed;
        motor_torques: (12,) [N m], motor order. Motors have armature but no friction.
        """
        torques = np.zeros(self.model.nv)
        torques[self.motor_v] = motor_torques
        pin.initConstraintDynamics(self.model, self.data, self.constraints, self.constraint_data)
        settings = pin.ProximalSettings(PROXIMAL_ACCURACY, PROXIMAL_DAMPING, PROXIMAL_ITERATIONS)
        return pin.constraintDynamics(
            self.model, self.data, q, v, torques, self.constraints, self.constraint_data, settings
        ).copy()

    def _knees(self, leg: str, outer: float, inner: float) -> tuple[float, float]:
        """Return the knee angles (outer, inner) [rad] that close a leg's loop at given thigh angles [rad]."""
        origin = {
            name: self.model.jointPlacements[self.model.getJointId(f"{leg}_{name}")].translation
            for name in ("outer", "inner", "outer_knee")
        }
        separation = abs(origin["outer"][0] - origin["inner"][0])
        thigh = -origin["outer_knee"][2]
        constraint = self.constraints[LEGS.index(leg)]
        shank, outer_shank = (-end.translation[2] for end in (constraint.joint1_placement, constraint.joint2_placement))
        # vector [m] from inner to outer knee in the leg's plane: across, toward the outer side, and down
        across = separation + thigh * (math.sin(outer) + math.sin(inner))
        down = thigh * (math.cos(outer) - math.cos(inner))
        apart = math.hypot(across, down)
        if not abs(shank - outer_shank) < apart < shank + outer_shank:
            raise InputError(f"expected knees of {leg} within reach of the shanks, found {apart:.4f} m")
        slope = math.atan2(down, across)
        # angles of the triangle of knees and ankle, by the law of cosines
        base, outer_base = (
            math.acos((apart**2 + one**2 - other**2) / (2.0 * apart * one))
            for one, other in ((shank, outer_shank), (outer_shank, shank))
        )
        return outer + 0.5 * math.pi + slope - outer_base, inner + 0.5 * math.pi - slope - base


def build_pinocchio(description: RobotDescription | None = None, values: RobotValues | None = None) -> PinocchioRobot:
    """Build the Pinocchio model of a robot description, by default the project's own, with a free-flying base.

    values: a robot that differs from the description, as `RobotOverlay.robots()` returns it. Of the first robot,
    `base_mass`, `base_com`, `base_inertia`, `link_mass` and `armature` are used.
    """
    description = load_description() if description is None else description
    values = RobotValues.nominal(1, description) if values is None else values
    robot = described(values, description)
    model = pin.buildModelFromXML(urdf(robot), pin.JointModelFreeFlyer())
    joints = [model.joints[model.getJointId(name)] for name in MOTOR_JOINTS]
    knees = [model.joints[model.getJointId(f"{leg}_{bar}_knee")] for leg in LEGS for bar in ("outer", "inner")]
    armature = np.zeros(model.nv)
    armature[[joint.idx_v for joint in joints]] = [motor.armature for motor in robot.motors]
    model.armature = armature
    constraints = pin.StdVec_RigidConstraintModel()
    constraint_data = pin.StdVec_RigidConstraintData()
    link_joint = {joint.child: model.getJointId(joint.name) for joint in description.joints}
    for loop in description.loops:
        ends = []
        for link, anchor in ((loop.parent, loop.parent_anchor), (loop.child, loop.child_anchor)):
            ends += [link_joint[link], pin.SE3(np.eye(3), anchor)]
        constraint = pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, model, *ends, pin.ReferenceFrame.LOCAL)
        constraints.append(constraint)
        constraint_data.append(constraint.createData())
    return PinocchioRobot(
        model=model,
        data=model.createData(),
        constraints=constraints,
        constraint_data=constraint_data,
        motor_q=np.array([joint.idx_q for joint in joints]),
        motor_v=np.array([joint.idx_v for joint in joints]),
        knee_q=np.array([knee.idx_q for knee in knees]),
        knee_v=np.array([knee.idx_v for knee in knees]),
        paws=np.array([robot.link(f"{leg}_inner_shank").collisions[0].position for leg in LEGS]),
    )
