"""SolverJumper in both precisions and Pinocchio on the same states, for tests of the solver."""

import dataclasses

import numpy as np
import pinocchio as pin
import warp as wp
from scipy.spatial.transform import Rotation

from columns import ANG_VEL, COORDS, DOFS, LIN_VEL, MOTOR_COORDS, MOTOR_DOFS, POS, QUAT
from jumper_warp.robot.description import load_description
from jumper_warp.robot.model import build_model
from jumper_warp.sim.dynamics import JumperDynamics
from pinocchio_model import build_pinocchio

BODIES = 21  # links of a robot
KNEES = np.array([5 * leg + joint for leg in range(4) for joint in (2, 4)])
KNEE_V = 6 + KNEES  # columns of joint_qd
SHANKS = np.array([5, 10, 15, 20])  # Bodies that carry the paws
OPEN_STOPS = 0.35  # [rad] Random states keep this far from the stops


@dataclasses.dataclass
class States:
    """States of the 18 coordinates, one row each."""

    pos: np.ndarray  # (n, 3) [m] of the base origin, world
    quat: np.ndarray  # (n, 4) xyzw, unit
    com_vel: np.ndarray  # (n, 3) [m/s] of the base link's centre of mass, world
    ang_vel: np.ndarray  # (n, 3) [rad/s] world
    angles: np.ndarray  # (n, 12) [rad]
    rates: np.ndarray  # (n, 12) [rad/s]

    def joint_q(self) -> np.ndarray:
        """Return Newton's joint_q with zeros for the passive joints, (n * 43,)."""
        q = np.zeros((len(self.pos), COORDS))
        q[:, POS], q[:, QUAT], q[:, MOTOR_COORDS] = self.pos, self.quat, self.angles
        return q.ravel()

    def joint_qd(self) -> np.ndarray:
        """Return Newton's joint_qd with zeros for the passive joints, (n * 38,)."""
        qd = np.zeros((len(self.pos), DOFS))
        qd[:, LIN_VEL], qd[:, ANG_VEL], qd[:, MOTOR_DOFS] = self.com_vel, self.ang_vel, self.rates
        return qd.ravel()

    @classmethod
    def read(cls, joint_q: np.ndarray, joint_qd: np.ndarray) -> "States":
        """Return the states in Newton's arrays."""
        q = joint_q.reshape(-1, COORDS).astype(float)
        qd = joint_qd.reshape(-1, DOFS).astype(float)
        quat = q[:, QUAT] / np.linalg.norm(q[:, QUAT], axis=1, keepdims=True)
        return cls(q[:, POS], quat, qd[:, LIN_VEL], qd[:, ANG_VEL], q[:, MOTOR_COORDS], qd[:, MOTOR_DOFS])


def random_states(n: int, seed: int, body_rate: float = 2.0, joint_rate: float = 4.0) -> States:
    """Return states in any attitude, angles well inside the stops, all values of single precision."""
    rng = np.random.default_rng(seed)
    lower, upper = np.radians([-50.0, -30.0, -30.0] * 4), np.radians([110.0, 140.0, 140.0] * 4)
    angles = rng.uniform(lower + OPEN_STOPS, upper - OPEN_STOPS, (n, 12))
    for outer in range(1, 12, 3):  # the sum of a leg's transversals lies in 0 to 240 degrees
        total = np.clip(angles[:, outer] + angles[:, outer + 1], OPEN_STOPS, np.radians(240.0) - OPEN_STOPS)
        angles[:, outer] += 0.5 * (total - angles[:, outer] - angles[:, outer + 1])
        angles[:, outer + 1] = total - angles[:, outer]
    values = (
        rng.normal(size=(n, 3)), Rotation.random(n, random_state=seed).as_quat(), rng.normal(size=(n, 3)),
        body_rate * rng.normal(size=(n, 3)), angles, joint_rate * rng.normal(size=(n, 12)),
    )  # fmt: skip
    states = States(*(value.astype(np.float32).astype(float) for value in values))
    states.quat /= np.linalg.norm(states.quat, axis=1, keepdims=True)
    return states


def bare_model(num_worlds: int, **arguments):
    """Return a model in free flight without friction and damping."""
    model = build_model(num_worlds, ground=None, visuals=False, device="cpu", **arguments)
    model.joint_friction.zero_()
    model.joint_damping.zero_()
    return model


class Flight:
    """The dynamics of a model in single or double precision, on `States`."""

    def __init__(self, model, *, double: bool):
        """Pack the parameters of a model; double: whether the precision is double."""
        self.model = model
        self.dynamics = JumperDynamics(model, double=double)
        self.dtype = wp.float64 if double else wp.float32

    def run(self, states: States, dt: float, steps: int = 1, torque=0.0, body_f=None, base_joint_f=0.0) -> States:
        """Return the states after `steps` steps; torque [N m] (n, 12); wrenches (n, 6) on the base."""
        n = len(states.pos)
        joint_f = np.zeros((n, DOFS))
        joint_f[:, MOTOR_DOFS], joint_f[:, :6] = torque, base_joint_f
        wrench = np.zeros((n, BODIES, 6))
        if body_f is not None:
            wrench[:, 0] = body_f
        d = self.dynamics
        q, qd = (wp.array(v, dtype=self.dtype, device="cpu") for v in (states.joint_q(), states.joint_qd()))
        drive = d.drive(
            wp.array(joint_f.ravel(), dtype=self.dtype, device="cpu"),
            wp.array(wrench.reshape(-1, 6), dtype=wp.spatial_vector, device="cpu"),
        )
        d.advance(dt, steps, drive, q, qd, q, qd)
        return States.read(q.numpy(), qd.numpy())


class Reference:
    """Pinocchio with the masses, armatures and gravity of a Newton model's worlds."""

    def __init__(self, model):
        """Set armatures and gravity, which all worlds share; `use_world` sets the masses."""
        self.robot = build_pinocchio()
        description = load_description()
        joints = [1] + [self.robot.model.getJointId(joint.name) for joint in description.joints]
        self._joint_of_body = joints
        self._mass, self._com = model.body_mass.numpy().astype(float), model.body_com.numpy().astype(float)
        self._inertia = model.body_inertia.numpy().astype(float)
        armature = np.zeros(self.robot.model.nv)
        armature[self.robot.motor_v] = model.joint_armature.numpy()[MOTOR_DOFS]
        self.robot.model.armature = armature
        self.robot.model.gravity.linear = model.gravity.numpy()[0].astype(float)
        self.use_world(0)

    def use_world(self, world: int) -> None:
        """Set the masses to those of a world."""
        for body, joint in enumerate(self._joint_of_body):
            i = world * BODIES + body
            self.robot.model.inertias[joint] = pin.Inertia(self._mass[i], self._com[i], self._inertia[i])
        self.base_com = self._com[world * BODIES]
        self.mass = self._mass[world * BODIES : (world + 1) * BODIES].sum()

    def base_twist(self, states: States, i: int) -> np.ndarray:
        """Return the twist of state i's base origin in body axes, (6,)."""
        turn = Rotation.from_quat(states.quat[i])
        origin = states.com_vel[i] - np.cross(states.ang_vel[i], turn.apply(self.base_com))
        return np.concatenate([turn.inv().apply(origin), turn.inv().apply(states.ang_vel[i])])

    def state(self, states: States, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return Pinocchio's q and v of state i."""
        q = self.robot.configuration(states.pos[i], states.quat[i], states.angles[i])
        return q, self.robot.closed_velocity(q, self.base_twist(states, i), states.rates[i])

    def accelerations(self, states: States, i: int, torque: np.ndarray) -> np.ndarray:
        """Return accelerations of state i under motor torques [N m]: 6 of the base origin in body axes, 12 motors."""
        q, v = self.state(states, i)
        accelerations = self.robot.forward_dynamics(q, v, torque)[[*range(6), *self.robot.motor_v]]
        # Pinocchio differentiates the body-frame components; add omega x v for the acceleration of the origin
        accelerations[:3] += np.cross(v[3:6], v[:3])
        return accelerations

    def energy(self, states: States, i: int) -> float:
        """Return kinetic energy, rotors included, plus potential energy [J]."""
        q, v = self.state(states, i)
        upper = np.triu(pin.crba(self.robot.model, self.robot.data, q))
        kinetic = v @ upper @ v - 0.5 * np.diag(upper) @ v**2
        return kinetic + pin.computePotentialEnergy(self.robot.model, self.robot.data, q)

    def momentum(self, states: States, i: int) -> np.ndarray:
        """Return linear [kg m/s] and angular momentum [kg m^2/s] about the robot's com, world axes, (6,)."""
        q, v = self.state(states, i)
        return pin.computeCentroidalMomentum(self.robot.model, self.robot.data, q, v).vector.copy()

    def centre_of_mass(self, states: States, i: int) -> np.ndarray:
        """Return the robot's centre of mass [m], world, (3,)."""
        q = self.robot.configuration(states.pos[i], states.quat[i], states.angles[i])
        return pin.centerOfMass(self.robot.model, self.robot.data, q).copy()
