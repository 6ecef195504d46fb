"""What a policy reads and drives: all that is needed to run it on a robot, apart from its weights."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any, get_type_hints

from jumper_warp.rl.cfg import ACTIVATIONS
from jumper_warp.utils.checks import NAME
from jumper_warp.utils.errors import InputError

MAX_HIDDEN = 64
"""Most hidden layers."""
TURN = 2.0 * math.pi
PER_JOINT = {
    "action_scale": (-TURN, TURN),  # [rad]
    "default_joint_pos": (-TURN, TURN),  # [rad]
    "joint_stiffness": (0.0, 1.0e4),  # [N m/rad]
    "joint_damping": (0.0, 1.0e3),  # [N m s/rad]
    "torque_limit": (1.0e-3, 1.0e4),  # [N m]
}
"""Least and largest value of what an interface holds for every joint."""
SINGLE = {
    "policy_dt": (1.0e-4, 1.0),  # [s]
    "physics_dt": (1.0e-6, 1.0),  # [s]
    "observation_limit": (1.0e-3, 1.0e6),
    "normalised_limit": (1.0e-3, 1.0e6),
}
"""The same of single numbers; the limits are far within single precision."""
LAYOUT = ("first", "end", "scale", "clip", "history")
"""What is told of every term of an observation."""


class PolicyError(InputError):
    """A policy that is missing, damaged, or does not fit its configuration. The message is one line."""


@dataclass(frozen=True)
class PolicyInterface:
    """Observation, network sizes, and the way from an action to motor torques.

    Observations are SI units and rad; velocities and gravity in body axes, angles relative to `default_joint_pos`.
    Where `observation_layout` tells it, a term is clipped, then scaled, and keeps frames of the past. An action a in
    [-1, 1] commands a · action_scale + default_joint_pos.
    """

    task: str
    observation_names: tuple[str, ...]
    """Of every entry of the observation, in order."""
    joint_names: tuple[str, ...]
    """Motors in the order of the action; the tuples below follow it."""
    action_scale: tuple[float, ...]
    """[rad]"""
    default_joint_pos: tuple[float, ...]
    """[rad]"""
    joint_stiffness: tuple[float, ...]
    """[N m/rad]"""
    joint_damping: tuple[float, ...]
    """[N m s/rad]"""
    torque_limit: tuple[float, ...]
    """[N m]"""
    command_filter: dict[str, Any]
    """Fields of `jumper_warp.robot.motors.FilterCfg`: degrees, horizon in seconds."""
    policy_dt: float
    """[s] Time between actions."""
    physics_dt: float
    """[s] Step of the simulation that it was trained in."""
    hidden: tuple[int, ...]
    """Widths of the hidden layers."""
    activation: str = "elu"
    observation_layout: dict[str, Any] = field(default_factory=dict)
    """Terms by name: first and end column, scale, clip and history. Empty: not known."""
    observation_limit: float = 100.0
    """Raw observations are clamped to plus and minus this; what is not finite counts as 0."""
    normalised_limit: float = 10.0
    """Observations in standard deviations are clamped to plus and minus this."""
    quaternion_order: str = "xyzw"

    def __post_init__(self) -> None:
        """Check that the parts fit each other. Raises PolicyError."""
        for name in ("observation_names", "joint_names"):
            names = getattr(self, name)
            if not names or len(set(names)) < len(names):
                raise PolicyError(f"{name} must be distinct and not empty")
        for name in (self.task, *self.observation_names, *self.joint_names):
            if not NAME.fullmatch(name):
                raise PolicyError(f"names must be of letters, digits, and _ . - or spaces, got {name!r:.60}")
        for name, (low, high) in (PER_JOINT | SINGLE).items():
            values = getattr(self, name)
            if name in PER_JOINT and len(values) != len(self.joint_names):
                raise PolicyError(f"{name} needs {len(self.joint_names)} numbers, one a joint, got {len(values)}")
            for value in values if name in PER_JOINT else (values,):
                if not low <= value <= high:
                    raise PolicyError(f"{name} must lie in {low:.4g} to {high:.4g}, got {value:.4g}")
        if self.physics_dt > self.policy_dt:
            raise PolicyError(f"physics_dt must be at most policy_dt = {self.policy_dt}, got {self.physics_dt}")
        if not 1 <= len(self.hidden) <= MAX_HIDDEN or not all(1 <= width <= 65536 for width in self.hidden):
            raise PolicyError(f"hidden must name 1 to {MAX_HIDDEN} widths from 1 to 65536, got {self.hidden!s:.100}")
        _check_filter(self.command_filter)
        _check_layout(self.observation_layout, len(self.observation_names))
        if self.activation not in ACTIVATIONS:
            raise PolicyError(f"activation must be one of {', '.join(ACTIVATIONS)}, got {self.activation!r:.40}")
        if self.quaternion_order != "xyzw":
            raise PolicyError(f"quaternion_order must be xyzw, got {self.quaternion_order!r:.40}")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Widths of all layers, observation and action included."""
        return (len(self.observation_names), *self.hidden, len(self.joint_names))

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON holds them."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, data: Any) -> PolicyInterface:
        """Return what `to_json` described. Raises PolicyError: a field is missing, unknown or of another type."""
        if not isinstance(data, dict):
            raise PolicyError("the interface must be a JSON object")
        hints = get_type_hints(cls)
        different = sorted(set(data) ^ set(hints))
        if different:
            raise PolicyError(f"interface fields missing or unknown: {', '.join(different):.200}")
        return cls(**{name: _checked(name, data[name], str(hint)) for name, hint in hints.items()})


def _checked(name: str, value: Any, hint: str) -> Any:
    """Return a JSON value as the type that the hint names, or raise a PolicyError."""
    kind = next(k for k in ("dict", "str", "float", "int") if k in hint)
    types = {"str": str, "float": (float, int), "int": int, "dict": dict}[kind]
    many = hint.startswith("tuple")
    values = value if many and isinstance(value, list) else [value]
    if many != isinstance(value, list) or not all(isinstance(v, types) and not isinstance(v, bool) for v in values):
        raise PolicyError(f"interface field {name} must be {'a list of ' if many else 'a '}{kind}, got {value!r:.60}")
    if kind == "float":
        values = [float(v) if abs(v) < 1.0e300 else math.inf for v in values]
    return tuple(values) if many else values[0]


def _check_filter(fields: dict[str, Any]) -> None:
    """Raise PolicyError unless the values of a command filter, or of a part of it, are finite numbers by name."""
    for name, value in fields.items():
        if not NAME.fullmatch(name):
            raise PolicyError(f"command_filter cannot hold {name!r:.60}")
        if isinstance(value, dict):
            _check_filter(value)
        elif isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1.0e6:
            raise PolicyError(f"command_filter {name} must be a number within 1e6, got {value!r:.60}")


def _check_layout(layout: dict[str, Any], width: int) -> None:
    """Raise PolicyError unless the terms follow each other and fill a number of columns; an empty layout may do."""
    first = 0
    for name, term in layout.items():
        numbers = list(term.values()) if isinstance(term, dict) and set(term) == set(LAYOUT) else [None]
        if not NAME.fullmatch(name) or not all(
            isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1.0e9 for value in numbers
        ):
            raise PolicyError(f"observation_layout {name!r:.60} must have the numbers {', '.join(LAYOUT)}")
        if term["first"] != first or term["end"] <= first or (term["end"] - first) % max(term["history"], 1):
            raise PolicyError(f"observation_layout {name!r:.60} must begin at column {first} and hold whole frames")
        first = term["end"]
    if layout and first != width:
        raise PolicyError(f"observation_layout has {first} columns, the observation {width}")


def make_interface(
    described: dict[str, Any], *, policy_dt: float, physics_dt: float, hidden: tuple[int, ...], activation: str = "elu"
) -> PolicyInterface:
    """Return the interface of policies of a task.

    described: what `jumper_warp.tasks.interface` says of it. policy_dt, physics_dt [s]; hidden: widths of the layers.
    Raises PolicyError: it does not fit together.
    """
    shape = {"policy_dt": policy_dt, "physics_dt": physics_dt, "hidden": list(hidden), "activation": activation}
    fields = dataclasses.fields(PolicyInterface)
    optional = {spec.name: spec.default for spec in fields if spec.default is not dataclasses.MISSING}
    return PolicyInterface.from_json({"observation_layout": {}} | optional | described | shape)
