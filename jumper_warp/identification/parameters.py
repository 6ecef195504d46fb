"""Unknown parameters of a robot, each with a prior and bounds, and prior measurements such as a weighed mass."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from jumper_warp.robot.description import LEGS, MOTOR_JOINTS, RobotDescription, load_description
from jumper_warp.robot.folder import LOCKED
from jumper_warp.robot.values import LATERAL, LINK_KINDS, MOTOR_QUANTITIES, PAW_FRICTION, TRANSVERSAL, RobotValues
from jumper_warp.utils.checks import check_within
from jumper_warp.utils.errors import InputError

GROUPS = ("motors", "masses", "friction", "latency", "offsets")  # Groups of parameters, see `jumper_parameters`
BASE_ONLY = ("base_mass", "base_com", "base_inertia", "paw_friction")
"""Quantities without effect on the motion while the base is held and the paws hang free."""


@dataclass(frozen=True)
class Parameter:
    """Unknown parameter of the robot that an identification estimates, with prior and bounds.

    It is one value that is written to some columns of a quantity of `RobotValues`. The optimiser works on z = (value -
    nominal) / prior, or for a ratio on z = ln(value / nominal) / prior; the prior of z is a normal distribution of mean
    0 and standard deviation 1.
    """

    name: str
    quantity: str  # a field of `RobotValues`
    places: tuple[int, ...]  # columns of the quantity that take this value, such as motor indices
    unit: str
    nominal: float  # [unit] Mean of the prior
    prior: float  # [unit] Standard deviation of the prior; for a ratio, of ln(value / nominal) [1]
    bounds: tuple[float, float]  # [unit] lower and upper
    scale: Literal["ratio", "absolute"] = "ratio"  # whether the prior is normal in ln(value / nominal) or in the value
    group: str = ""  # one of `GROUPS`

    def __post_init__(self) -> None:
        """Raise InputError if bounds exclude the nominal value or (ratio) reach 0, or the prior is not positive."""
        low, high = self.bounds
        if not (math.isfinite(low) and math.isfinite(high) and low <= self.nominal <= high and low < high):
            raise InputError(f"parameter {self.name}: bounds {self.bounds} must be finite and contain {self.nominal}")
        if not 0.0 < self.prior < math.inf:
            raise InputError(f"parameter {self.name}: prior must be positive and finite, got {self.prior}")
        if self.scale == "ratio" and not low > 0.0:
            raise InputError(f"parameter {self.name}: a ratio needs a lower bound above 0, got {low}")

    @property
    def leg(self) -> int | None:
        """Index of the leg (FL, FR, BL, BR) whose single motor the parameter acts on; None if it acts on more."""
        return self.places[0] // 3 if self.quantity in MOTOR_QUANTITIES and len(self.places) == 1 else None

    @property
    def z_per_growth(self) -> float:
        """Change of the normalised coordinate z per relative change of the parameter's value, at the nominal value.

        With it a direction in z can be compared with the growth of several parameters by one factor.
        """
        return (1.0 if self.scale == "ratio" else self.nominal) / self.prior

    def value(self, z: np.ndarray) -> np.ndarray:
        """Convert normalised coordinates z to values of the parameter [unit], in the shape of z."""
        if self.scale == "ratio":
            return self.nominal * np.exp(self.prior * z)
        return self.nominal + self.prior * z

    def normalised(self, value: np.ndarray | float) -> np.ndarray:
        """Convert values of the parameter [unit] to normalised coordinates z, in the shape of `value`."""
        if self.scale == "ratio":
            return np.log(np.asarray(value) / self.nominal) / self.prior
        return (np.asarray(value) - self.nominal) / self.prior

    def std(self, z: float, z_std: float) -> float:
        """Return the standard deviation [unit] of the parameter's value at z, given that of z, z_std."""
        return z_std * self.prior * (float(self.value(np.array(z))) if self.scale == "ratio" else 1.0)


@dataclass(frozen=True)
class ParameterSet:
    """The P unknown parameters of an identification, in the order of the vector z; iterable."""

    parameters: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        """Raise InputError if there are no parameters, or two parameters of one name."""
        names = self.names
        if not names:
            raise InputError("there must be at least one parameter")
        if len(set(names)) < len(names):
            raise InputError(f"every parameter needs a name of its own, got {max(names, key=names.count)!r} twice")

    def __len__(self) -> int:  # number P of parameters
        return len(self.parameters)

    def __iter__(self) -> Iterator[Parameter]:  # the parameters in order
        return iter(self.parameters)

    @property
    def names(self) -> list[str]:
        """Names of the parameters in order."""
        return [parameter.name for parameter in self.parameters]

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds in normalised coordinates, (P,) each."""
        low, high = ([float(p.normalised(p.bounds[i])) for p in self.parameters] for i in (0, 1))
        return np.array(low), np.array(high)

    def values(self, z: np.ndarray) -> np.ndarray:
        """Convert normalised coordinates z (..., P) to values of the parameters, each in its unit, (..., P)."""
        return np.stack([p.value(z[..., i]) for i, p in enumerate(self.parameters)], axis=-1)

    def normalised(self, values: np.ndarray) -> np.ndarray:
        """Convert values of the parameters, each in its unit, (..., P) to normalised coordinates z (..., P)."""
        return np.stack([p.normalised(values[..., i]) for i, p in enumerate(self.parameters)], axis=-1)

    def robots(self, z: np.ndarray, description: RobotDescription | None = None) -> RobotValues:
        """Return N robots with the parameter values of normalised coordinates z (N, P), otherwise as described."""
        z = np.atleast_2d(z)
        robots = RobotValues.nominal(len(z), description)
        values = self.values(z)
        for i, parameter in enumerate(self.parameters):
            getattr(robots, parameter.quantity)[:, parameter.places] = values[:, i, None]
        return robots

    def without(self, names: Iterable[str]) -> ParameterSet:
        """Return a copy without the parameters whose name, group or quantity is in `names`.

        Raises InputError: a name that is none of these.
        """
        left_out = set(names)
        known = {*GROUPS, *self.names, *(p.quantity for p in self.parameters)}
        if left_out - known:
            raise InputError(
                f"unknown parameter {min(left_out - known)!r:.60} to exclude; expected one of {', '.join(self.names)}"
            )
        return ParameterSet(tuple(p for p in self.parameters if not left_out & {p.name, p.group, p.quantity}))


def jumper_parameters(groups: Sequence[str] = GROUPS, description: RobotDescription | None = None) -> ParameterSet:
    """Return the unknown parameters of the robot in some groups, by default all: 79 of the Jumper.

    motors: kp, kd, armature by motor; torque limit, cutoff and no-load speed by kind and type of motor. masses: mass,
    com and inertia of the base, mass ratio by kind of link. friction: friction of each motor, the knees and the paws.
    latency: latency of the targets. offsets: offsets of the angle sensors. A locked lateral axis has no motor: these
    parameters have no effect on it, and are left out. Raises InputError: an unknown group or none.
    """
    unknown = [group for group in groups if group not in GROUPS]
    if unknown or not groups:
        problem = f"unknown group of parameters {unknown[0]!r:.60}" if unknown else "no group of parameters"
        raise InputError(f"{problem}; expected one of {', '.join(GROUPS)}")
    robot = load_description() if description is None else description
    every = (*motor_parameters(robot), *mass_parameters(robot), *friction_parameters(robot))
    every += (
        Parameter("latency", "latency", (0,), "s", 0.0, 0.005, (0.0, 0.04), "absolute", "latency"),
        *(
            Parameter(f"offset/{joint}", "offset", (i,), "rad", 0.0, math.radians(2.0),
                      (-math.radians(10.0), math.radians(10.0)), "absolute", "offsets")
            for i, joint in driven_joints(robot)
        ),
    )  # fmt: skip
    return ParameterSet(tuple(parameter for parameter in every if parameter.group in groups))


def driven_joints(robot: RobotDescription) -> list[tuple[int, str]]:
    """Return index and name of the motor joints that have a motor: all but locked lateral axes."""
    return [(i, joint) for i, joint in enumerate(MOTOR_JOINTS) if robot.motors[i] != LOCKED]


def ratio(
    name: str, quantity: str, places: Sequence[int], unit: str, nominal: float, prior: float, group: str
) -> Parameter:
    """Return a positive parameter whose ratio to the nominal value has a log-normal prior.

    prior: std [1] of ln(value / nominal); bounds: 5 std, at most tenfold.
    """
    wide = math.exp(min(5.0 * prior, math.log(10.0)))
    return Parameter(name, quantity, tuple(places), unit, nominal, prior, (nominal / wide, nominal * wide), group=group)


def relative(
    name: str, quantity: str, places: Sequence[int], unit: str, nominal: float, prior: float, group: str
) -> Parameter:
    """Return a positive parameter whose ratio to the nominal value has a normal prior.

    prior: std [1] of value / nominal; bounds: 5 std, at least a tenth. Equations of motion are linear in masses, gains
    and armature: combinations that the motions do not determine lie along straight lines of z, which steps of the
    optimiser follow.
    """
    low = nominal * max(1.0 - 5.0 * prior, 0.1)
    high = nominal * (1.0 + 5.0 * prior)
    return Parameter(name, quantity, tuple(places), unit, nominal, prior * nominal, (low, high), "absolute", group)


def motor_parameters(robot: RobotDescription) -> tuple[Parameter, ...]:
    """Return the parameters of motors: kp, kd, armature of each; torque limit, cutoff, no-load speed of each type."""
    parameters = []
    nominal = RobotValues.nominal(1, robot)
    for quantity, prior in (("kp", 0.2), ("kd", 0.2)):
        values = getattr(nominal, quantity)[0]
        parameters += [
            relative(f"{quantity}/{j}", quantity, (i,), "1", float(values[i]), prior, "motors")
            for i, j in driven_joints(robot)
        ]
    for i, joint in driven_joints(robot):
        parameters.append(
            relative(f"armature/{joint}", "armature", (i,), "kg m^2", robot.motors[i].armature, 0.25, "motors")
        )
    for kind, members in (("lateral", LATERAL), ("transversal", TRANSVERSAL)):
        types = dict.fromkeys(robot.motors[i] for i in members if robot.motors[i] != LOCKED)
        for motor in types:  # front and back legs may have different ones
            name = kind if len(types) == 1 else f"{kind} {motor.type}"
            places = [i for i in members if robot.motors[i] == motor]
            limit = float(nominal.saturation[0, places[0]])
            parameters += [
                relative(f"saturation/{name}", "saturation", places, "1", limit, 0.1, "motors"),
                relative(f"cutoff_speed/{name}", "cutoff_speed", places, "rad/s", motor.cutoff_speed, 0.1, "motors"),
                relative(f"no_load_speed/{name}", "no_load_speed", places, "rad/s", motor.no_load_speed, 0.1, "motors"),
            ]
    return tuple(parameters)


def mass_parameters(robot: RobotDescription) -> tuple[Parameter, ...]:
    """Return the mass parameters: mass, com and inertia of the base, and mass ratios by kind of link."""
    base = robot.links[0]
    parameters = [relative("base_mass", "base_mass", (0,), "kg", base.mass, 0.15, "masses")]
    for i, axis in enumerate("xyz"):
        c = float(base.com[i])
        parameters.append(
            Parameter(f"base_com/{axis}", "base_com", (i,), "m", c, 0.02, (c - 0.1, c + 0.1), "absolute", "masses")
        )
    parameters.append(relative("base_inertia", "base_inertia", (0,), "1", 1.0, 0.2, "masses"))
    parameters += [
        relative(f"link_mass/{kind}", "link_mass", (i,), "1", 1.0, 0.15, "masses") for i, kind in enumerate(LINK_KINDS)
    ]
    return tuple(parameters)


def friction_parameters(robot: RobotDescription) -> tuple[Parameter, ...]:
    """Return the friction parameters: Coulomb friction of each motor, knee damping, friction of the paws.

    They are positive and known by their order of magnitude only: their priors are log-normal, with estimated widths.
    """
    parameters = [
        ratio(
            f"motor_friction/{joint}", "motor_friction", (i,), "N m", robot.motors[i].coulomb_friction, 0.6, "friction"
        )
        for i, joint in driven_joints(robot)
    ]
    parameters.append(ratio("knee_damping", "knee_damping", (0,), "N m s/rad", robot.knee_damping, 0.4, "friction"))
    parameters.append(ratio("paw_friction", "paw_friction", (0,), "1", PAW_FRICTION, 0.2, "friction"))
    return tuple(parameters)


@dataclass(frozen=True)
class PriorMeasurement:
    """Measurement of the robot other than its motions, such as its weighed mass; counts as one more residual."""

    name: str
    measure: Callable[[RobotValues], np.ndarray]  # returns the modelled quantity of N robots, (N,)
    value: float  # measured value, in the quantity's unit
    std: float  # standard deviation of the measurement, in the same unit


def total_mass(robots: RobotValues, description: RobotDescription | None = None) -> np.ndarray:
    """Return the total mass of each of N robots [kg], (N,); description: by default the Jumper's."""
    robot = load_description() if description is None else description
    legs = [sum(robot.link(f"{leg}_{kind}").mass for leg in LEGS) for kind in LINK_KINDS]
    return robots.base_mass[:, 0] + robots.link_mass @ np.array(legs)


def weighed_mass(mass: float, std: float = 0.02, description: RobotDescription | None = None) -> PriorMeasurement:
    """Return the weighed mass of the whole robot [kg] as a prior measurement; std [kg]: of the scale.

    description: as in `total_mass`.

    Raises InputError: std is not positive, or the mass is not within 0.5 to 2 times the described one.
    """
    described = float(total_mass(RobotValues.nominal(1, description), description)[0])
    if not 0.5 * described <= mass <= 2.0 * described:
        raise InputError(
            f"weighed mass must be in {0.5 * described:.4g} to {2.0 * described:.4g} kg (the robot is described with "
            f"{described:.4g} kg), got {mass:.6g} kg"
        )
    check_within("deviation of the weighed mass", np.array([std]), (1.0e-6, 10.0))
    return PriorMeasurement("total mass", partial(total_mass, description=description), mass, std)
