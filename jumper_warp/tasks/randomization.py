"""Domain randomisation (paper, Table V): ranges of physical parameters, and the events that sample them.

A policy that is trained on many similar robots also works on the real one, whose parameters are not known exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

from jumper_warp.kernels.mdp import parameters
from jumper_warp.tasks.bounds import check_range
from jumper_warp.tasks.terms import EventTerm
from jumper_warp.utils.checks import check_probabilities, check_types
from jumper_warp.utils.kernels import Function

Range = tuple[float, float] | None  # (lower, upper), or None: off
NOMINAL_FRICTION = 0.9  # [1] Friction coefficient of the paws where it is not randomised
MEAN_FRICTION = 0.85
"""[1] Friction coefficient of the paws in nominal evaluations of policies trained with randomised friction."""
LONGEST_LATENCY = 100.0
"""[ms] Longest latency that the ring buffers of targets and observations hold: 48 physics steps, six policy steps."""
PUSH_INTERVAL = (0.2, 0.5)  # [s] Time from one sample of the push to the next (authors' configuration)
PUSH_PROBABILITY = 0.25  # [1] Probability of a push in such an interval (authors' configuration)


@dataclass(frozen=True)
class RandomizationCfg:
    """Ranges (lower, upper) of uniformly sampled robot parameters; None: nominal. The defaults are for jumping.

    Masses and scales must be positive; friction and latency may be 0.
    """

    static_friction: Range = (0.9, 1.2)
    """[1] Static friction coefficient of the paws; raised to the world's dynamic coefficient if below it."""
    dynamic_friction: Range = (0.8, 0.9)
    """[1] Dynamic friction coefficient of the paws."""
    base_mass: Range = (-1.0, 2.0)
    """[kg] Mass added to the base."""
    link_mass: Range = (0.8, 1.2)
    """[1] Factor on mass and inertia of each link."""
    com_shift: Range = (-0.03, 0.03)
    """[m] Shift of the base's centre of mass along each body axis."""
    gains: Range = (0.6, 1.4)
    """[1] Factor on kp of each motor; kd has another sample of this range, unless `damping_gains` is set."""
    no_load_speed: Range = (0.8, 1.2)
    """[1] Factor on the no-load speed of each motor."""
    cutoff_speed: Range = (0.8, 1.4)
    """[1] Factor on the cutoff speed of each motor, which stays below its no-load speed."""
    motor_friction: Range = (0.005, 0.04)
    """[N m] Coulomb friction of each motor."""
    armature: Range = (0.6, 1.4)
    """[1] Factor on the armature (rotor inertia) of each motor."""
    joint_offset: Range = (-2.0, 2.0)
    """[deg] Constant error of each motor's position sensor."""
    latency: Range = (0.0, 16.0)
    """[ms] Delay from action to motor, rounded to the nearest physics step."""
    observation_latency: Range = None
    """[ms] Delay from sensor to policy, rounded to the nearest physics step."""
    zero_latency_probability: float = 0.0
    """[1] Probability of zero latency, for either latency unless its range is a single value; with a robot overlay, of
    its latency. At 0 training rarely samples the nominal case, where the policy may then chatter."""
    push_force: Range = (-5.0, 5.0)
    """[N] Push on the base along each world axis, while a paw is on the ground."""
    push_torque: Range = (-3.0, 3.0)
    """[N m] Torque of a push on the base about each world axis, while a paw is on the ground."""
    push_interval: Range = PUSH_INTERVAL
    """[s] Time from one sample of the push to the next; None: one push for the whole episode."""
    push_probability: float = PUSH_PROBABILITY
    """[1] Probability of a push in each interval of `push_interval`."""
    push_in_flight: bool = False
    """Whether pushes also act while no paw is on the ground."""
    damping_gains: Range = None
    """[1] Factor on kd of each motor; None: a sample of `gains`, independent of kp."""
    resample_at: Literal["startup", "reset"] = "reset"
    """When parameters other than pushes are sampled: once at startup, or at every reset of a world."""

    def __post_init__(self) -> None:
        """Raise InputError for a field of another type, a reversed range, or one out of bounds."""
        check_types("randomisation", self)
        for name, value in vars(self).items():
            if isinstance(value, tuple):
                check_range(name, value)
        check_probabilities("randomisation", self, "push_probability", "zero_latency_probability")

    @classmethod
    def off(cls) -> RandomizationCfg:
        """Return a configuration without randomisation: all ranges are None.

        push_probability is 1, for pushes that a caller adds.
        """
        ranges = [name for name, field in cls.__dataclass_fields__.items() if "Range" in str(field.type)]
        off: dict[str, Any] = dict.fromkeys(ranges)
        return cls(**off, push_probability=1.0)

    @classmethod
    def walking(cls) -> RandomizationCfg:
        """Return the paper's ranges for walking, with a probability of 0.2 of zero latency."""
        return cls(
            static_friction=(0.8, 0.95),
            dynamic_friction=(0.7, 0.8),
            no_load_speed=(0.6, 1.2),
            cutoff_speed=(0.6, 1.4),
            motor_friction=(0.0, 0.04),
            latency=(0.0, 32.0),
            observation_latency=(0.0, 32.0),
            zero_latency_probability=0.2,
            push_force=(-10.0, 10.0),
            push_in_flight=True,
        )

    @property
    def nominal_friction(self) -> float:
        """Return the paws' friction coefficient [1] for evaluations without randomisation.

        Where training samples it, the middle of the default range, else the default of the simulation.
        """
        return MEAN_FRICTION if self.dynamic_friction else NOMINAL_FRICTION

    def in_tests(self) -> RandomizationCfg:
        """Return a copy for evaluation: parameters are sampled at every reset, and pushes at intervals."""
        timing = {} if self.push_interval else {"push_interval": PUSH_INTERVAL, "push_probability": PUSH_PROBABILITY}
        return replace(self, resample_at="reset", **timing)

    def with_fixed(self, **values: Any) -> RandomizationCfg:
        """Return a copy with the ranges of `fixed_ranges(**values)`. Raises InputError: a value is out of range."""
        return replace(self, **fixed_ranges(**values))

    def events(self) -> tuple[EventTerm, ...]:
        """Return the events that sample robot parameters from the ranges that are not None; numbers are in SI units."""
        terms = []

        def add(func: Function, pair: Range, scale: float = 1.0, parallel: bool = False, **numbers: float) -> None:
            """Add an event that samples within a range, unless it is None; scale: from the range's unit to SI."""
            if pair is not None:
                ends = {"lower": scale * pair[0], "upper": scale * pair[1]}
                terms.append(EventTerm(func, mode=self.resample_at, parallel=parallel, **ends, **numbers))

        add(parameters.base_mass, self.base_mass)
        add(parameters.link_mass, self.link_mass, parallel=True)
        add(parameters.com_shift, self.com_shift)
        add(parameters.armature, self.armature, parallel=True)
        add(parameters.motor_friction, self.motor_friction, parallel=True)
        if self.gains or self.damping_gains:
            kp = self.gains or (1.0, 1.0)
            kd = self.damping_gains or kp
            terms.append(
                EventTerm(parameters.gains, mode=self.resample_at, parallel=True, kp_lower=kp[0], kp_upper=kp[1],
                          kd_lower=kd[0], kd_upper=kd[1])
            )  # fmt: skip
        if self.no_load_speed or self.cutoff_speed:
            no_load, cutoff = self.no_load_speed or (1.0, 1.0), self.cutoff_speed or (1.0, 1.0)
            terms.append(
                EventTerm(parameters.speed_limits, mode=self.resample_at, parallel=True, no_load_lower=no_load[0],
                          no_load_upper=no_load[1], cutoff_lower=cutoff[0], cutoff_upper=cutoff[1])
            )  # fmt: skip
        add(parameters.joint_offset, self.joint_offset, math.pi / 180.0, parallel=True)
        if self.dynamic_friction or self.static_friction:
            dynamic = self.dynamic_friction or (NOMINAL_FRICTION, NOMINAL_FRICTION)
            static = self.static_friction or (0.0, 0.0)  # the kernel raises it to the dynamic one
            terms.append(
                EventTerm(parameters.friction, mode=self.resample_at, dynamic_lower=dynamic[0],
                          dynamic_upper=dynamic[1], static_lower=static[0], static_upper=static[1])
            )  # fmt: skip
        zero = self.zero_latency_probability
        add(parameters.action_latency, self.latency, 1.0e-3, zero_probability=zero)
        add(parameters.observation_latency, self.observation_latency, 1.0e-3, zero_probability=zero)
        if self.push_force or self.push_torque:
            force, torque = self.push_force or (0.0, 0.0), self.push_torque or (0.0, 0.0)
            timing: dict[str, Any] = {"mode": "reset", "update_solver": False}
            if self.push_interval is not None:
                timing |= {"mode": "interval", "interval_range_s": self.push_interval}
            terms.append(
                EventTerm(parameters.push, **timing, probability=self.push_probability, force_lower=force[0],
                          force_upper=force[1], torque_lower=torque[0], torque_upper=torque[1])
            )  # fmt: skip
        return tuple(terms)


def fixed_ranges(
    *, latency: float | None = None, gains: tuple[float, float] | None = None, friction: float | None = None,
    sensor_offset: float | None = None,
) -> dict[str, tuple[float, float]]:  # fmt: skip
    """Return ranges that fix latency [ms], gains (factors on kp and kd [1]) or friction of the paws [1], by field.

    sensor_offset [deg]: largest error of a position sensor, sampled uniformly within plus and minus this per motor.
    """
    kp, kd = gains or (None, None)
    fixed = {"latency": latency, "gains": kp, "damping_gains": kd, "dynamic_friction": friction,
             "static_friction": friction}  # fmt: skip
    ranges = {name: (value, value) for name, value in fixed.items() if value is not None}
    return ranges | ({} if sensor_offset is None else {"joint_offset": (-sensor_offset, sensor_offset)})


PAPER = RandomizationCfg(
    base_mass=(-1.0, 2.0),  # Table V
    link_mass=(0.8, 1.2),  # Table V
    com_shift=(-0.03, 0.03),  # Table V
    gains=(0.6, 1.4),  # Table V; kp and kd alike: R
    armature=(0.6, 1.4),  # Table V
    joint_offset=(-2.0, 2.0),  # Table V
    push_torque=(-3.0, 3.0),  # Table V
    push_interval=(0.2, 0.5),  # A
    push_probability=0.25,  # A
    resample_at="reset",  # A
)
"""Values that the paper's jumps and its walk share; sources: see `jumper_warp.tasks.jump.paper`."""
