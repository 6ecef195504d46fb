"""What a task is: observation, reward table, terminations, resets, curriculum and randomisation, as data."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field, fields
from itertools import accumulate
from typing import Any

import warp as wp

from jumper_warp.checks import check_finite, check_not_negative, check_positive
from jumper_warp.motors import FilterCfg, MotorCfg
from jumper_warp.ppo import PpoCfg
from jumper_warp.randomization import RandomizationCfg
from kernels import terminations
from kernels.ground_draws import EVERY_SIDE, GroundRanges
from kernels.observe import SensorNoise
from kernels.reset_draws import ResetRanges

Pair = tuple[float, float]


@dataclass(frozen=True)
class Term:
    """One line of the reward table."""

    func: wp.Function
    """(view: RobotView, task: JumpTask, p: wp.vec4) -> float"""
    weight: float
    """Multiplies the term; carries the sign."""
    params: tuple[float, ...] = ()
    """Up to four numbers that the function reads as p."""
    once: bool = False
    """Whether the term is paid per event; otherwise it is multiplied by the policy step [s]."""

    def __post_init__(self) -> None:
        _check_params(self.func, self.params)
        check_finite(f"the weight of {self.name}", self.weight)

    @property
    def name(self) -> str:
        """The function's name."""
        return self.func.key.split(".")[-1]


@dataclass(frozen=True)
class Rule:
    """One reason for an episode to end. The first that holds counts; a success must be the table's first."""

    func: wp.Function
    """(view: RobotView, task: JumpTask, p: wp.vec4) -> bool"""
    params: tuple[float, ...] = ()
    """Up to four numbers that the function reads as p."""
    success: bool = False
    """Whether this is no failure: the value of what would follow is counted."""

    def __post_init__(self) -> None:
        _check_params(self.func, self.params)

    @property
    def name(self) -> str:
        """The function's name."""
        return self.func.key.split(".")[-1]


def _check_params(func: wp.Function, params: tuple[float, ...]) -> None:
    check_finite(f"parameters of {func.key}", *params)
    if len(params) > 4:
        raise ValueError(f"{func.key} takes up to four parameters, got {params}")


@dataclass(frozen=True)
class ResetCfg:
    """Reference state initialisation: shares of the schemes and ranges of their states; angles in degrees."""

    standing: float = 0.60
    default: float = 0.15
    in_flight: float = 0.20
    touchdown: float = 0.0
    """Shares; what is left begins just landed."""
    base_xy: float = 0.05
    """[m]"""
    tilt: float = 5.0
    """[deg] Roll, pitch and yaw."""
    forward_pitch: float = 0.0
    """[deg] Largest mean pitch of standing states."""
    heading: float = 0.0
    """[deg] Half width of the heading."""
    front_x: Pair = (0.20, 0.22)
    """[m] Paw positions relative to the base."""
    front_y: Pair = (0.15, 0.17)
    """[m]"""
    back_x: Pair = (0.20, 0.22)
    """[m]"""
    back_y: Pair = (0.20, 0.22)
    """[m]"""
    takeoff_height: Pair = (0.40, 0.45)
    """[m]"""
    takeoff_ahead: Pair = (0.0, 0.0)
    """[m] Base ahead of its start, towards the goal."""
    takeoff_angle: Pair = (50.0, 75.0)
    """[deg] Above the horizon, where the goal names no apex."""
    highest_apex: float = 1.0
    """[m] Of jumps with a drawn takeoff angle."""
    landing_height: float = 0.42
    """[m] Of the base, where the projectile ends."""
    flight_time: Pair = (0.01, 0.95)
    """[1] Share of the time in the air."""
    flight_lateral: float = 10.0
    """[deg]"""
    flight_transversal: Pair = (0.0, 90.0)
    """[deg]"""
    touchdown_time: Pair = (0.03, 0.15)
    """[s] Before landing."""
    touchdown_behind: Pair = (0.0, 0.0)
    """[m] Base behind the projectile before touchdown, so that the paws are ahead of it."""
    paw_depth: Pair = (0.30, 0.45)
    """[m] Paws below the base before touchdown."""
    landed_height: Pair = (0.30, 0.42)
    """[m]"""
    landed_ahead: Pair = (0.0, 0.0)
    """[m] Base ahead of the goal just after landing."""
    landed_speed: Pair = (0.0, 1.0)
    """[m/s] Downward."""
    jump_again: float = 0.0
    """[1] Share of episodes past the first level in which a landed robot gets another goal."""
    command_delay: float = 0.5
    """[s] Longest time until the jump is commanded."""
    again_delay: Pair = (0.2, 0.7)
    """[s] From touchdown to the other goal."""

    def __post_init__(self) -> None:
        """Raises ValueError: shares do not add up, a pair is reversed, a number not finite or out of range."""
        shares = self._shares()
        if not min(shares) >= 0.0 or sum(shares) > 1.0 + 1e-9:
            raise ValueError(f"reset shares must be >= 0 and add up to at most 1, got {shares}")
        for name, value in vars(self).items():
            check_finite(f"reset {name}", *(value if isinstance(value, tuple) else (value,)))
            if isinstance(value, tuple) and not value[0] <= value[1]:
                raise ValueError(f"reset {name} must be (lower, upper), got {value}")
        for name, least in (("command_delay", self.command_delay), ("again_delay", self.again_delay[0])):
            if not least >= 0.0:
                raise ValueError(f"reset {name} must not be negative, got {least}")
        if not 0.0 <= self.jump_again <= 1.0:
            raise ValueError(f"reset jump_again must be in [0, 1], got {self.jump_again}")

    def _shares(self) -> tuple[float, ...]:
        return (self.standing, self.default, self.in_flight, self.touchdown)

    def ranges(self, step_dt: float) -> Any:
        """Return the kernels' `ResetRanges`: angles in radians, delays in policy steps of step_dt [s]."""
        ranges = ResetRanges()
        ranges.shares = wp.vec4(*accumulate(self._shares()))
        degrees = ("tilt", "forward_pitch", "heading", "takeoff_angle", "flight_lateral", "flight_transversal")
        apart = ("standing", "default", "in_flight", "touchdown", "command_delay", "again_delay")
        for name, value in vars(self).items():
            if name in apart:
                continue
            scale = math.pi / 180.0 if name in degrees else 1.0
            if isinstance(value, tuple):
                setattr(ranges, name, wp.vec2(scale * value[0], scale * value[1]))
            else:
                setattr(ranges, name, scale * value)
        ranges.command_delay = round(self.command_delay / step_dt)
        ranges.again_delay = wp.vec2(*(delay / step_dt for delay in self.again_delay))
        return ranges


@dataclass(frozen=True)
class Level:
    """One level of the curriculum."""

    goal_lower: tuple[float, float, float]
    """Smallest goal relative to start and heading [m]: landing x, y, and base height at the apex (0: any)."""
    goal_upper: tuple[float, float, float]
    """Largest goal."""
    base_height: Pair
    """[m] Of standing starts; low ones are deep squats."""

    def __post_init__(self) -> None:
        """Raises ValueError: goals are reversed or not finite, or heights are reversed or not positive."""
        check_finite("goals of a level", *self.goal_lower, *self.goal_upper)
        check_positive("base_height of a level", *self.base_height)
        pairs = (*zip(self.goal_lower, self.goal_upper, strict=True), self.base_height)
        if not all(lower <= upper for lower, upper in pairs):
            raise ValueError(f"goals and heights of a level must be lower, then upper, got {astuple(self)}")


@dataclass(frozen=True)
class NoiseCfg:
    """Observation noise (paper, Table VI); standard deviations, cut at one."""

    lin_vel: float = 0.1
    """[m/s]"""
    ang_vel: float = 0.1
    """[rad/s]"""
    gravity: float = 0.05
    """[1] 0.5 m/s^2 of 9.81."""
    angle: float = 3.0
    """[deg]"""
    rate: float = 10.0
    """[deg/s]"""
    position: float = 0.005
    """[m] Of the base's height and of the way to the goal."""

    def __post_init__(self) -> None:
        """Raises ValueError: a standard deviation is negative or not finite."""
        for name, value in vars(self).items():
            check_not_negative(f"noise {name}", value)

    def sensor_noise(self, enabled: bool = True) -> Any:
        """Return the kernels' `SensorNoise`; all zero unless enabled."""
        noise = SensorNoise()
        for spec in fields(self):
            scale = math.pi / 180.0 if spec.name in ("angle", "rate") else 1.0
            setattr(noise, spec.name, scale * getattr(self, spec.name) if enabled else 0.0)
        return noise


@dataclass(frozen=True)
class GroundCfg:
    """What standing starts of a randomised training on SolverJumper stand on or jump to; elsewhere the ground is level.

    An environment that is given a ground or a block draws none.
    """

    platform: float = 0.0
    """[1] Share that begins on a platform, where the paws have room to land beside it."""
    block: float = 0.0
    """[1] Share with a block under the goal that slides, where there is room before it."""
    drop: Pair = (0.03, 0.20)
    """[m] Height of the platform."""
    rise: Pair = (0.02, 0.08)
    """[m] Height of the block."""
    room: float = 0.30
    """[m] Most between the paws and an edge, each way; the near side of a block may be farther from both."""
    clearance: float = 0.12
    """[m] Least between an edge that must be crossed and the paws at the goal."""
    mass: Pair = (5.0, 100.0)
    """[kg] Of the block."""
    friction: Pair = (0.3, 1.0)
    """[1] Of block and floor."""

    def __post_init__(self) -> None:
        """Raises ValueError: shares or lengths out of range, or a pair that is reversed, not positive or not finite."""
        if not (min(self.platform, self.block) >= 0.0 and self.platform + self.block <= 1.0):
            raise ValueError(f"ground shares must be >= 0 and add up to at most 1, got {self.platform}, {self.block}")
        for name, value in vars(self).items():
            if isinstance(value, tuple) and not 0.0 < value[0] <= value[1] < math.inf:
                raise ValueError(f"ground {name} must be (lower, upper), positive and finite, got {value}")
        for name, least in (("room", EVERY_SIDE), ("clearance", 0.0)):
            if not least <= getattr(self, name) < math.inf:
                raise ValueError(f"ground {name} must be finite and at least {least:g}, got {getattr(self, name)}")

    @property
    def drawn(self) -> bool:
        """Whether there is anything but level ground."""
        return self.platform + self.block > 0.0

    def ranges(self) -> Any:
        """Return the kernels' `GroundRanges`."""
        ranges = GroundRanges()
        for name, value in vars(self).items():
            setattr(ranges, name, wp.vec2(*value) if isinstance(value, tuple) else value)
        return ranges


@dataclass(frozen=True)
class TaskCfg:
    """A task on the robot."""

    name: str
    observe: wp.Function
    """Writes the task's own observation columns."""
    columns: tuple[str, ...]
    """Names of these columns."""
    error: wp.Function
    """(view, task) -> distance from the goal [m]."""
    terms: tuple[Term, ...]
    rules: tuple[Rule, ...]
    levels: tuple[Level, ...]
    motors: MotorCfg
    command_filter: FilterCfg
    action_scale: Pair
    """[deg] Lateral and transversal."""
    reset: ResetCfg = field(default_factory=ResetCfg)
    ground: GroundCfg = field(default_factory=GroundCfg)
    noise: NoiseCfg = field(default_factory=NoiseCfg)
    randomization: RandomizationCfg = field(default_factory=RandomizationCfg)
    ppo: PpoCfg = field(default_factory=PpoCfg)
    """What `jumper train` starts from."""
    takeoff_speed: float = 0.75
    """[m/s] Upward speed without contact that begins a flight."""
    contact_force: float = 0.1
    """[N] Above it a paw counts as in contact."""
    near: float = 0.10
    """[m] Error up to which a landed jump is a success."""
    games: int = 5
    """Successes in a row that raise the level."""

    def __post_init__(self) -> None:
        """Raises ValueError: a table is not one that can be trained on, or a number is out of range."""
        names = [term.name for term in self.terms]
        if len(set(names)) < len(names):
            raise ValueError(f"every term of {self.name} needs a name of its own, got {names}")
        if not self.rules or not self.rules[0].success:
            raise ValueError(f"the first rule of {self.name} must be its success")
        if terminations.came_apart not in [rule.func for rule in self.rules]:
            raise ValueError(f"{self.name} needs the rule came_apart, which ends worlds whose state is no longer one")
        if not self.levels:
            raise ValueError(f"{self.name} needs at least one level")
        check_positive("action_scale", *self.action_scale)
        check_positive("near", self.near)
        check_finite("takeoff_speed", self.takeoff_speed)
        check_not_negative("contact_force", self.contact_force)
        if self.games < 1:
            raise ValueError(f"games must be at least 1, got {self.games}")

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of all observation columns in order."""
        motors = [f"{leg}_{m}" for leg in ("FL", "FR", "BL", "BR") for m in ("lateral", "outer", "inner")]
        robot = [f"{what}_{axis}" for what in ("lin_vel", "ang_vel", "gravity") for axis in "xyz"]
        joints = [f"{what}_{m}" for what in ("angle", "rate", "last_action") for m in motors]
        return (*self.columns, *robot, *joints)
