"""Settings of the motors and of the motor command filter, and the kernel structures made of them.

The command filter keeps joints off their stops and links apart: it changes a target only if its joint would soon
violate a limit. Angles are lateral (positive outward) and transversal, i.e. outer and inner (positive away from the
leg's other thigh); their sum is the angle between the thighs. Torques and speeds are at the joint, behind the gear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Literal

import numpy as np
import warp as wp

from jumper_warp.kernels.actuation import command_filter
from jumper_warp.kernels.actuation import motors as actuator
from jumper_warp.robot.description import RobotDescription, load_description
from jumper_warp.robot.parts import Motor
from jumper_warp.robot.values import RobotValues
from jumper_warp.utils.checks import check_angle_limits, check_bounds, check_filter_speed, check_type, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import KernelStruct

OVERSPEED_START, OVERSPEED_END = math.radians(2000.0), math.radians(2500.0)
"""[rad/s] Speeds at which over-speed protection starts to reduce the torque, and at which the torque is 0."""
MAX_FADE = 1.0e4  # [rad/s] Highest speed at which over-speed protection may end
MOTOR_BOUNDS = {
    "kp": (0.0, 1.0e4, "N m/rad"), "kd": (0.0, 1.0e3, "N m s/rad"), "saturation": (1.0e-3, 1.0e3, "N m"),
    "peak": (1.0e-3, 1.0e3, "N m"), "cutoff_speed": (0.0, 1.0e3, "rad/s"), "no_load_speed": (0.0, 1.0e3, "rad/s"),
}  # fmt: skip
"""Smallest and largest value of the fields of `MotorKindCfg`, and unit."""
MOTOR_CONSTANTS = ("kp", "kd", "saturation", "peak", "cutoff_speed", "no_load_speed", "offset")
"""Constants of a motor in `MotorArrays`; units as in `jumper_warp.kernels.actuation.motors`."""
LIMITS = ("lower", "upper", "lower_zone", "upper_zone")
FILTER_NAMES = (*(f"{angle}.{limit}" for angle in ("lateral", "transversal", "sum") for limit in LIMITS), "horizon",
                "speed_floor")  # fmt: skip
"""Names of the 14 entries of `filter_constants`: angles [rad], horizon [s], speed [rad/s]; zones have no gradient."""


@dataclass(frozen=True)
class MotorKindCfg:
    """Gains, torque limits and speeds of one kind of motor, lateral or transversal, at the joint."""

    kp: float
    """[N m/rad]"""
    kd: float
    """[N m s/rad]"""
    saturation: float
    """[N m] Limit of the commanded torque."""
    peak: float
    """[N m] Largest torque of the motor, up to the cutoff speed."""
    cutoff_speed: float
    """[rad/s] Speed up to which full driving torque is available."""
    no_load_speed: float
    """[rad/s] Speed from which no driving torque is available."""

    def __post_init__(self) -> None:
        """Raise InputError if a value is outside its range in MOTOR_BOUNDS, or no_load_speed is too low."""
        check_types("motor", self)
        check_bounds("motor", self, MOTOR_BOUNDS)
        if self.no_load_speed <= self.cutoff_speed:
            raise InputError(f"no_load_speed must be > cutoff_speed = {self.cutoff_speed}, got {self.no_load_speed}")


@dataclass(frozen=True)
class MotorCfg:
    """Settings of the robot's motors: gains and limits of lateral and transversal motors, and over-speed protection."""

    lateral: MotorKindCfg
    transversal: MotorKindCfg
    fade_start: float = OVERSPEED_START
    """[rad/s] Speed at which over-speed protection starts to reduce the torque."""
    fade_end: float = OVERSPEED_END
    """[rad/s] Speed from which the torque is 0."""

    def __post_init__(self) -> None:
        """Raise InputError unless the over-speed protection has speeds 0 <= fade_start < fade_end <= MAX_FADE."""
        check_types("motors", self)
        if not 0.0 <= self.fade_start < self.fade_end <= MAX_FADE:
            speeds = f"{self.fade_start}, {self.fade_end}"
            raise InputError(f"need 0 <= fade_start < fade_end <= {MAX_FADE:g} rad/s, got {speeds}")

    @classmethod
    def from_description(
        cls,
        description: RobotDescription,
        gains: Literal["jumping", "walking"],
        lateral_torque: float,
        transversal_torque: float,
    ) -> MotorCfg:
        """Return the left front leg's motors with its jumping or walking gains and the given torque limits [N m].

        A limit is cut to the motor's peak torque. `RobotValues` has the ratios of other motors to these.
        """
        motors = description.motors
        return cls(motor_kind(motors[0], gains, lateral_torque), motor_kind(motors[1], gains, transversal_torque))


def motor_kind(motor: Motor, gains: Literal["jumping", "walking"], torque: float) -> MotorKindCfg:
    """Return a motor type's gains, speeds and torques; commands are limited to `torque` [N m], at most the peak."""
    check_type("torque", torque, float)
    pd = getattr(motor, gains)
    saturation = min(torque, motor.peak_torque)
    peak = motor.peak_torque
    return MotorKindCfg(pd.kp, pd.kd, saturation, peak, motor.cutoff_speed, motor.no_load_speed)


def jumping_motors(torque: float = 18.0, lateral_torque: float | None = None) -> MotorCfg:
    """Return the project's motors with jumping gains, limited to torques [N m]; lateral_torque defaults to `torque`."""
    lateral_torque = torque if lateral_torque is None else lateral_torque
    return MotorCfg.from_description(load_description(), "jumping", lateral_torque, torque)


def walking_motors(torque: float = 10.0) -> MotorCfg:
    """Return the project's motors with walking gains, limited to a torque [N m]."""
    return MotorCfg.from_description(load_description(), "walking", torque, torque)


def motor_arrays(
    cfg: MotorCfg,
    num_worlds: int,
    *,
    module: ModuleType = actuator,
    device: wp.DeviceLike = None,
    requires_grad: bool = False,
    robot: RobotValues | None = None,
) -> KernelStruct:
    """Return the motor constants of `num_worlds` worlds as a struct of arrays for the kernels.

    Arrays are (12, num_worlds), without sensor offsets. module: `jumper_warp.kernels.actuation.motors` in either
    precision. robot: factors on gains and torque limits, speeds and sensor offsets of one robot (N = 1) or of every
    world (N = num_worlds). Raises InputError: cfg is no MotorCfg.
    """
    if not isinstance(cfg, MotorCfg):
        raise InputError(f"motors must be a MotorCfg, got {cfg!r:.60}")

    def per_motor(lateral: float, transversal: float) -> wp.array:
        """Return a constant of the two kinds of motors for every motor and world, (12, num_worlds)."""
        column = np.tile([lateral, transversal, transversal], 4)[:, None]
        values = np.repeat(column, num_worlds, axis=1)
        return wp.array(values, dtype=module.real, device=device, requires_grad=requires_grad)

    motors = module.MotorArrays()
    for name in vars(cfg.lateral):
        setattr(motors, name, per_motor(getattr(cfg.lateral, name), getattr(cfg.transversal, name)))
    motors.offset = per_motor(0.0, 0.0)
    motors.fade_start = cfg.fade_start
    motors.fade_end = cfg.fade_end
    if robot is not None:
        for name in ("kp", "kd", "saturation", "peak"):
            array = getattr(motors, name)
            array.assign((array.numpy() * getattr(robot, name).T).astype(np.float32))
        for name in ("no_load_speed", "cutoff_speed", "offset"):
            getattr(motors, name).assign((np.zeros((12, num_worlds)) + getattr(robot, name).T).astype(np.float32))
    return motors


@dataclass(frozen=True)
class LimitsCfg:
    """Limits of one motor angle, or sum of angles, that the motor command filter enforces."""

    lower: float
    """[deg]"""
    upper: float
    """[deg]"""
    lower_zone: float = 0.0
    """[deg] Width of the hard zone inside the lower limit."""
    upper_zone: float = 0.0
    """[deg] Width of the hard zone inside the upper limit."""

    def __post_init__(self) -> None:
        """Raise InputError unless the limits are finite, lower < upper, and their hard zones do not overlap."""
        check_types("angle", self)
        check_angle_limits("angle", **vars(self))


@dataclass(frozen=True)
class FilterCfg:
    """Settings of the motor command filter, which keeps motor targets [rad] away from limits of the angles."""

    lateral: LimitsCfg
    transversal: LimitsCfg
    sum: LimitsCfg
    """Limits of outer + inner angle of a leg."""
    horizon: float
    """[s] Time to violation below which the limits begin to bind."""
    speed_floor: float = 60.0
    """[deg/s] Least speed assumed toward a limit."""

    def __post_init__(self) -> None:
        """Raise InputError unless horizon is in 1 ms to 10 s, and speed_floor in 1e-3 to 1e4 deg/s."""
        check_types("filter", self)
        check_filter_speed(self.horizon, self.speed_floor)


JUMP_LATERAL = LimitsCfg(-15.0, 15.0, lower_zone=10.0, upper_zone=15.0)
JUMP_TRANSVERSAL = LimitsCfg(-30.0, 140.0, lower_zone=10.0, upper_zone=15.0)


def vertical_jump_filter() -> FilterCfg:
    """Return the motor command filter for vertical jumps: limits begin to bind 8 policy steps before a violation."""
    return FilterCfg(JUMP_LATERAL, JUMP_TRANSVERSAL, sum=LimitsCfg(0.0, 240.0, 35.0, 45.0), horizon=8.0 / 60.0)


def horizontal_jump_filter() -> FilterCfg:
    """Return the motor command filter for horizontal jumps."""
    return FilterCfg(JUMP_LATERAL, JUMP_TRANSVERSAL, sum=LimitsCfg(0.0, 220.0, 30.0, 30.0), horizon=8.0 / 60.0)


def walking_filter() -> FilterCfg:
    """Return the motor command filter for walking: lateral limits at the hard stops, no hard zones inside limits."""
    lateral = LimitsCfg(-50.0, 110.0)
    transversal = LimitsCfg(-30.0, 140.0)
    return FilterCfg(lateral, transversal, sum=LimitsCfg(0.0, 220.0), horizon=5.0 / 60.0)


def loose_filter() -> FilterCfg:
    """Return the motor command filter for the highest jumps: limits bind two policy steps ahead, no hard zones."""
    lateral = LimitsCfg(-15.0, 15.0)
    transversal = LimitsCfg(-30.0, 140.0)
    return FilterCfg(lateral, transversal, sum=LimitsCfg(0.0, 240.0), horizon=2.0 / 60.0)


def filter_params(cfg: FilterCfg, *, module: ModuleType = command_filter) -> KernelStruct:
    """Return the motor command filter's settings as the struct that the kernels read, angles in radians.

    module: `command_filter` in either precision. Raises InputError: cfg is no FilterCfg.
    """
    if not isinstance(cfg, FilterCfg):
        raise InputError(f"command_filter must be a FilterCfg or None, got {cfg!r:.60}")
    params = module.FilterParams()
    for name in ("lateral", "transversal", "sum"):
        limits = module.Limits()
        for field, degrees in vars(getattr(cfg, name)).items():
            setattr(limits, field, math.radians(degrees))
        setattr(params, name, limits)
    params.horizon = cfg.horizon
    params.speed_floor = math.radians(cfg.speed_floor)
    return params


def filter_constants(cfg: FilterCfg | None) -> np.ndarray:
    """Return the command filter's settings as an array (14,), in the order and units of `FILTER_NAMES`.

    Differentiable rollouts read them from an array of each world, w.r.t. which they have gradients. cfg: None for the
    filter of vertical jumps. Raises InputError: it is no FilterCfg.
    """
    cfg = vertical_jump_filter() if cfg is None else cfg
    if not isinstance(cfg, FilterCfg):
        raise InputError(f"command_filter must be a FilterCfg or None, got {cfg!r:.60}")
    angles = [getattr(getattr(cfg, angle), limit) for angle in ("lateral", "transversal", "sum") for limit in LIMITS]
    return np.array([*np.radians(angles), cfg.horizon, math.radians(cfg.speed_floor)])
