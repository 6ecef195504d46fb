"""Physical constants of robots that may differ from the description: identified, or set by an overlay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from jumper_warp.robot.description import MOTOR_JOINTS, RobotDescription, load_description
from jumper_warp.robot.parts import Gains, Motor

LINK_KINDS = ("housing", "outer_thigh", "outer_shank", "inner_thigh", "inner_shank")
"""Kinds of a leg's links; the four links of a kind share one mass ratio."""
LATERAL, TRANSVERSAL = tuple(range(0, 12, 3)), tuple(motor for motor in range(12) if motor % 3)  # motor indices
PAW_FRICTION = 0.9  # [1] Coulomb coefficient of the described robot, the default of `Simulation`
MOTOR_QUANTITIES = (
    "armature", "motor_friction", "kp", "kd", "saturation", "peak", "no_load_speed", "cutoff_speed", "offset",
)  # fmt: skip


@dataclass
class RobotValues:
    """Masses, joint, motor and spring constants of N robots, each an array with one row per robot.

    Motors: legs FL, FR, BL, BR, each lateral, outer, inner.
    """

    base_mass: np.ndarray  # (N, 1) [kg] Mass of the base link
    base_com: np.ndarray  # (N, 3) [m] Centre of mass of the base link, in its frame
    base_inertia: np.ndarray
    """(N, 1) [1] Factor on the described inertia about the centre of mass, which also scales with `base_mass`."""
    link_mass: np.ndarray  # (N, 5) [1] Ratio to the described mass and inertia, one column per entry of `LINK_KINDS`
    armature: np.ndarray  # (N, 12) [kg m^2] Rotor inertia at the gear's output
    motor_friction: np.ndarray  # (N, 12) [N m] Coulomb friction at the gear's output
    kp: np.ndarray  # (N, 12) [1] Ratio to the gain of the motion or task
    kd: np.ndarray  # (N, 12) [1] Ratio to the gain of the motion or task
    saturation: np.ndarray  # (N, 12) [1] Ratio to the torque limit of the motion or task
    peak: np.ndarray  # (N, 12) [1] Ratio to the peak torque of the left front leg's same motor
    no_load_speed: np.ndarray  # (N, 12) [rad/s] Speed at which a motor has no torque left
    cutoff_speed: np.ndarray  # (N, 12) [rad/s] Speed above which the torque falls; less than `no_load_speed`
    offset: np.ndarray  # (N, 12) [rad] Position sensor's reading minus the true angle
    knee_damping: np.ndarray  # (N, 1) [N m s/rad] Viscous damping of each knee
    paw_friction: np.ndarray  # (N, 1) [1] Static and dynamic friction coefficient of the paws
    latency: np.ndarray  # (N, 1) [s] Delay from a commanded target to its effect on the motor
    spring_stiffness: np.ndarray  # (N, 1) [N/m] Stiffness of the spring between the two knees of each leg; 0: no spring
    spring_length: np.ndarray  # (N, 1) [m] Rest length of these springs

    @classmethod
    def nominal(cls, count: int, description: RobotDescription | None = None) -> RobotValues:
        """Return the values of `count` robots equal to a description (default: the Jumper's): factors 1, offsets 0."""
        robot = load_description() if description is None else description
        motors = robot.motors
        first = 4 * (motors[0], motors[1], motors[1])  # those of `MotorCfg`
        pairs = list(zip(motors, first, strict=True))
        peaks = np.array([motor.peak_torque / one.peak_torque for motor, one in pairs])
        base = robot.links[0]
        single = cls(
            base_mass=np.array([base.mass]),
            base_com=np.array(base.com),
            base_inertia=np.ones(1),
            link_mass=np.ones(len(LINK_KINDS)),
            armature=np.array([motor.armature for motor in motors]),
            motor_friction=np.array([motor.coulomb_friction for motor in motors]),
            kp=np.array([ratio(motor.jumping.kp, one.jumping.kp) for motor, one in pairs]),
            kd=np.array([ratio(motor.jumping.kd, one.jumping.kd) for motor, one in pairs]),
            saturation=peaks,
            peak=peaks,
            no_load_speed=np.array([motor.no_load_speed for motor in motors]),
            cutoff_speed=np.array([motor.cutoff_speed for motor in motors]),
            offset=np.zeros(12),
            knee_damping=np.array([robot.knee_damping]),
            paw_friction=np.array([PAW_FRICTION]),
            latency=np.zeros(1),
            spring_stiffness=np.array(robot.spring[:1]),
            spring_length=np.array(robot.spring[1:]),
        )
        return cls(**{name: np.tile(value, (count, 1)) for name, value in vars(single).items()})


def ratio(value: float, reference: float) -> float:
    """Return the ratio of two values of a motor, 1 for equal ones, such as the gains of 0 of a locked axis."""
    return 1.0 if value == reference else value / reference


def described(values: RobotValues, description: RobotDescription) -> RobotDescription:
    """Return a description with the masses, motors and knee damping of the first robot of `values`.

    A motor joint's speed limit becomes the no-load speed, its effort limit is scaled by the lower of `saturation` and
    `peak`. The URDF text is kept. A description has no place for friction of the paws, sensor offsets and latency.
    """
    base = description.links[0]
    ratios: dict[str, float] = dict(zip(LINK_KINDS, map(float, values.link_mass[0]), strict=True))
    nominal = RobotValues.nominal(1, description)
    scale = values.base_mass[0, 0] / base.mass * values.base_inertia[0, 0]
    links = [replace(base, mass=float(values.base_mass[0, 0]), com=values.base_com[0], inertia=scale * base.inertia)]
    for link in description.links[1:]:
        factor = ratios[link.name[3:]]
        links.append(replace(link, mass=factor * link.mass, inertia=factor * link.inertia))
    motors = []
    joints = {joint.name: joint for joint in description.joints}
    for index, (name, motor) in enumerate(zip(MOTOR_JOINTS, description.motors, strict=True)):
        value = {quantity: float(getattr(values, quantity)[0, index]) for quantity in MOTOR_QUANTITIES}
        for quantity in ("kp", "kd", "saturation", "peak"):
            value[quantity] = ratio(value[quantity], float(getattr(nominal, quantity)[0, index]))
        motors.append(_described_motor(motor, value))
        effort = min(value["saturation"], value["peak"]) * joints[name].effort
        joints[name] = replace(joints[name], effort=effort, velocity=value["no_load_speed"])
    damping = float(values.knee_damping[0, 0])
    parts = {"links": tuple(links), "joints": tuple(joints.values()), "motors": tuple(motors)}
    spring = (float(values.spring_stiffness[0, 0]), float(values.spring_length[0, 0]))
    return replace(description, **parts, knee_damping=damping, spring=spring)


def _described_motor(motor: Motor, value: Mapping[str, float]) -> Motor:
    """Return a copy of a motor type with one robot's armature, friction, gains and speeds, by `MOTOR_QUANTITIES`.

    A description has the rotor's inertia before the gear, which counts gear_ratio^2 times at the joint (armature).
    """
    jumping, walking = (Gains(value["kp"] * pd.kp, value["kd"] * pd.kd) for pd in (motor.jumping, motor.walking))
    return replace(
        motor,
        rotor_inertia=motor.rotor_inertia * ratio(value["armature"], motor.armature),
        coulomb_friction=value["motor_friction"],
        peak_torque=value["peak"] * motor.peak_torque,
        no_load_speed=value["no_load_speed"],
        cutoff_speed=value["cutoff_speed"],
        jumping=jumping,
        walking=walking,
    )
