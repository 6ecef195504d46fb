"""Interface of a policy: observation, action, motors and time steps, i.e. all data of a policy but its weights."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from dataclasses import dataclass, field
from typing import Any, get_type_hints

from jumper_warp.utils.checks import ACTIVATIONS, MAX_HIDDEN, MAX_WIDTH, NAME, check_angle_limits, check_filter_speed
from jumper_warp.utils.errors import InputError

FULL_TURN = 2.0 * math.pi
JOINT_BOUNDS = {
    "action_scale": (1.0e-4, FULL_TURN),  # [rad]
    "default_joint_pos": (-FULL_TURN, FULL_TURN),  # [rad]
    "joint_stiffness": (0.0, 1.0e4),  # [N m/rad]
    "joint_damping": (0.0, 1.0e3),  # [N m s/rad]
    "torque_limit": (1.0e-3, 1.0e4),  # [N m]
}
"""Lower and upper bounds of the interface's fields with one value per joint."""
SCALAR_BOUNDS = {
    "policy_dt": (1.0e-4, 1.0),  # [s]
    "physics_dt": (1.0e-6, 1.0),  # [s]
    "observation_limit": (1.0e-3, 1.0e6),
    "normalised_limit": (1.0e-3, 1.0e6),
}
"""Lower and upper bounds of the interface's scalar fields."""
LAYOUT_FIELDS = ("first", "end", "scale", "clip", "history")  # Fields of each term in an observation layout
FILTERED = ("lateral", "transversal", "sum")  # Angles with limits in a command filter: two motors, and outer + inner
LIMITS = ("lower", "upper", "lower_zone", "upper_zone")  # Limits of an angle in a command filter [deg]
MAX_COLUMNS = 100_000  # Largest number of columns of an observation
MAX_HISTORY = 1000  # Largest number of frames of an observation term
METADATA_VERSION = 2  # Version of an ONNX file's metadata
SOURCE_KEYS = ("commit", "dirty")  # Entries of a policy's configuration that are copied to the metadata


class PolicyError(InputError):
    """Error: a policy is missing, damaged, or does not fit its configuration. The message is one line."""


@dataclass(frozen=True)
class PolicyInterface:
    """Observation layout, network sizes, and motor settings of a policy.

    Observations are in SI units and rad; velocities and gravity in body axes, angles relative to `default_joint_pos`.
    `observation_layout` specifies the clipping, scaling and history of each term; clipping precedes scaling. An action
    a in [-1, 1] commands the motor angle a · action_scale + default_joint_pos.
    """

    task: str  # name of the task
    observation_names: tuple[str, ...]  # name of each entry of the observation, in order
    joint_names: tuple[str, ...]  # motors in the order of the action and of the tuples below
    action_scale: tuple[float, ...]  # [rad]
    default_joint_pos: tuple[float, ...]  # [rad]
    joint_stiffness: tuple[float, ...]  # [N m/rad]
    joint_damping: tuple[float, ...]  # [N m s/rad]
    torque_limit: tuple[float, ...]  # [N m]
    command_filter: dict[str, Any]  # fields of `jumper_warp.robot.motors.FilterCfg`: angles [deg], horizon [s]
    policy_dt: float  # [s] Time between actions
    physics_dt: float  # [s] Physics step of the training
    hidden: tuple[int, ...]  # widths of the hidden layers
    activation: str = "elu"
    observation_layout: dict[str, Any] = field(default_factory=dict)
    """Observation terms by name, each with first and end column, scale, clip and history; empty if unknown."""
    observation_limit: float = 100.0  # raw observations are clamped to ± this; entries that are not finite count as 0
    normalised_limit: float = 10.0  # normalised observations are clamped to ± this many standard deviations
    quaternion_order: str = "xyzw"

    def __post_init__(self) -> None:
        """Raise PolicyError if a field is out of range, or fields contradict each other."""
        for name in ("observation_names", "joint_names"):
            names = getattr(self, name)
            if not names or len(set(names)) < len(names) or len(names) > MAX_COLUMNS:
                raise PolicyError(f"{name} must be distinct, 1 to {MAX_COLUMNS}")
        for name in (self.task, *self.observation_names, *self.joint_names):
            if not NAME.fullmatch(name):
                raise PolicyError(f"names may contain letters, digits, _ . - and spaces, got {name!r:.60}")
        for name, (low, high) in (JOINT_BOUNDS | SCALAR_BOUNDS).items():
            values = getattr(self, name)
            if name in JOINT_BOUNDS and len(values) != len(self.joint_names):
                raise PolicyError(f"{name} needs {len(self.joint_names)} numbers, one per joint, got {len(values)}")
            for value in values if name in JOINT_BOUNDS else (values,):
                if not low <= value <= high:
                    raise PolicyError(f"{name} must lie in {low:.4g} to {high:.4g}, got {value:.4g}")
        if self.physics_dt > self.policy_dt:
            raise PolicyError(f"physics_dt must be at most policy_dt = {self.policy_dt}, got {self.physics_dt}")
        if not 1 <= len(self.hidden) <= MAX_HIDDEN or not all(1 <= width <= MAX_WIDTH for width in self.hidden):
            raise PolicyError(
                f"hidden must name 1 to {MAX_HIDDEN} widths from 1 to {MAX_WIDTH}, got {self.hidden!s:.100}"
            )
        _check_filter(self.command_filter)
        _check_layout(self.observation_layout, len(self.observation_names))
        if self.activation not in ACTIVATIONS:
            raise PolicyError(f"activation must be one of {', '.join(ACTIVATIONS)}, got {self.activation!r:.40}")
        if self.quaternion_order != "xyzw":
            raise PolicyError(f"quaternion_order must be xyzw, got {self.quaternion_order!r:.40}")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sizes of observation, hidden layers and action, in this order."""
        return (len(self.observation_names), *self.hidden, len(self.joint_names))

    def to_json(self) -> dict[str, Any]:
        """Return the interface's fields as a JSON object."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, data: Any) -> PolicyInterface:
        """Restore a policy's interface from the JSON object that `to_json` returns.

        Raises PolicyError: fields are missing or invalid.
        """
        if not isinstance(data, dict):
            raise PolicyError("the interface must be a JSON object")
        hints = get_type_hints(cls)
        different = sorted(set(data) ^ set(hints))
        if different:
            raise PolicyError(f"interface fields missing or unknown: {', '.join(different):.200}")
        return cls(**{name: _parse_field(name, data[name], str(hint)) for name, hint in hints.items()})


def _parse_field(name: str, value: Any, hint: str) -> Any:
    """Convert a JSON value to the type of a hint, such as `tuple[float, ...]`. Raises PolicyError: another type.

    Numbers beyond ±1e300 become infinite. name: the field's, for messages.
    """
    kind = next(k for k in ("dict", "str", "float", "int") if k in hint)
    types = {"str": str, "float": (float, int), "int": int, "dict": dict}[kind]
    is_tuple = hint.startswith("tuple")
    values = value if is_tuple and isinstance(value, list) else [value]
    if is_tuple != isinstance(value, list) or not all(isinstance(v, types) and not isinstance(v, bool) for v in values):
        expected = f"a list of {kind}" if is_tuple else f"a {kind}"
        raise PolicyError(f"interface field {name} must be {expected}, got {value!r:.60}")
    if kind == "float":
        values = [float(v) if abs(v) < 1.0e300 else math.inf for v in values]
    return tuple(values) if is_tuple else values[0]


def _is_number(value: Any) -> bool:
    """Return whether a value is a finite number, and not a bool."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1.0e300


def _check_filter(fields: dict[str, Any]) -> None:
    """Raise PolicyError unless a command filter has exactly the fields of `FilterCfg`, with valid values."""
    expected: dict[str, Any] = {name: dict.fromkeys(LIMITS, 0.0) for name in FILTERED} | {
        "horizon": 0.0,
        "speed_floor": 0.0,
    }
    for place, known in (("", expected), *((name, expected[name]) for name in FILTERED)):
        table = fields.get(place) if place else fields
        if not isinstance(table, dict) or set(table) != set(known):
            raise PolicyError(f"command_filter{place and ' '}{place} must have the fields {', '.join(known)}")
        for name, value in table.items():
            if not isinstance(known[name], dict) and not _is_number(value):
                raise PolicyError(f"command_filter {name} must be a finite number, got {value!r:.60}")
    try:
        check_filter_speed(fields["horizon"], fields["speed_floor"])
        for name in FILTERED:
            check_angle_limits(name, **fields[name])
    except InputError as error:
        raise PolicyError(f"command_filter: {error}") from error


def _check_layout(layout: dict[str, Any], width: int) -> None:
    """Raise PolicyError unless an observation layout is empty, or its terms fill `width` columns without gaps."""
    first = 0
    for name, term in layout.items():
        where = f"observation_layout {name!r:.60}"
        fields = term if isinstance(term, dict) else {}
        whole = all(type(fields.get(key)) is int for key in ("first", "end", "history"))
        if set(fields) != set(LAYOUT_FIELDS) or not whole or not NAME.fullmatch(name):
            raise PolicyError(f"{where} must have {', '.join(LAYOUT_FIELDS)}; first, end and history whole numbers")
        if fields["first"] != first or fields["end"] <= first or not 1 <= fields["history"] <= MAX_HISTORY:
            raise PolicyError(f"{where} must begin at column {first}, with 1 to {MAX_HISTORY} frames")
        if (fields["end"] - first) % fields["history"]:
            raise PolicyError(f"{where} must hold whole frames")
        for key in ("scale", "clip"):
            if not _is_number(fields[key]) or not 1.0e-6 <= fields[key] <= 1.0e6:
                raise PolicyError(f"{where}: {key} must lie in 1e-6 to 1e6, got {fields[key]!r:.60}")
        first = fields["end"]
    if layout and first != width:
        raise PolicyError(f"observation_layout has {first} columns, the observation {width}")


def checksum_entry(data: bytes) -> bytes:
    """Return the bytes that append the SHA-256 of an ONNX file's content to its metadata, under the key `sha256`.

    They are a `StringStringEntryProto` in field 14, `metadata_props`, of a `ModelProto`; its key and value are fields 1
    and 2. Protocol buffers may be concatenated: the entry is added to the list.
    """
    digest = hashlib.sha256(data).hexdigest().encode()
    entry = b"\x0a\x06sha256\x12" + bytes([len(digest)]) + digest
    return b"\x72" + bytes([len(entry)]) + entry


def make_interface(
    description: dict[str, Any],
    *,
    policy_dt: float,
    physics_dt: float,
    hidden: tuple[int, ...],
    activation: str = "elu",
) -> PolicyInterface:
    """Return the interface (observation, action, motors, time steps) of policies for a task.

    description: result of `jumper_warp.tasks.interface.interface`. policy_dt, physics_dt: [s]. hidden: widths of the
    hidden layers. activation: elu, relu or tanh. Raises PolicyError: a field is missing, unknown or invalid.
    """
    shape = {"policy_dt": policy_dt, "physics_dt": physics_dt, "hidden": list(hidden), "activation": activation}
    fields = dataclasses.fields(PolicyInterface)
    optional = {spec.name: spec.default for spec in fields if spec.default is not dataclasses.MISSING}
    return PolicyInterface.from_json({"observation_layout": {}} | optional | description | shape)
