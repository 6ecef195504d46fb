"""Interface of a policy: observation, action, motors and time steps, i.e. all data of a policy but its weights."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from dataclasses import dataclass, field
from typing import Any

from jumper_warp.utils.checks import NAME, check_angle_limits, check_filter_speed, check_network, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json

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
    command_filter: Json  # fields of `jumper_warp.robot.motors.FilterCfg`: angles [deg], horizon [s]
    policy_dt: float  # [s] Time between actions
    physics_dt: float  # [s] Physics step of the training
    hidden: tuple[int, ...]  # widths of the hidden layers
    activation: str = "elu"
    observation_layout: Json = field(default_factory=dict)
    """Observation terms by name, each with first and end column, scale, clip and history; empty if unknown."""
    observation_limit: float = 100.0  # raw observations are clamped to ± this; entries that are not finite count as 0
    normalised_limit: float = 10.0  # normalised observations are clamped to ± this many standard deviations
    quaternion_order: str = "xyzw"

    def __post_init__(self) -> None:
        """Raise PolicyError if a field is out of range, or fields contradict each other."""
        for name in ("observation_names", "joint_names"):
            names = getattr(self, name)
            if not names or len(set(names)) < len(names):
                raise PolicyError(f"{name} must be distinct, at least one")
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
        check_network(self.hidden, self.activation, PolicyError)
        _check_filter(self.command_filter)
        _check_layout(self.observation_layout, len(self.observation_names))
        if self.quaternion_order != "xyzw":
            raise PolicyError(f"quaternion_order must be xyzw, got {self.quaternion_order!r:.40}")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Sizes of observation, hidden layers and action, in this order."""
        return (len(self.observation_names), *self.hidden, len(self.joint_names))

    def to_json(self) -> Json:
        """Return the interface's fields as a JSON object."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, data: Any) -> PolicyInterface:
        """Restore a policy's interface from the JSON object that `to_json` returns.

        Raises PolicyError: fields are missing or invalid.
        """
        if not isinstance(data, dict):
            raise PolicyError("the interface must be a JSON object")
        different = sorted(set(data) ^ {spec.name for spec in dataclasses.fields(cls)})
        if different:
            raise PolicyError(f"interface fields missing or unknown: {', '.join(different):.200}")
        values: Json = {name: tuple(value) if isinstance(value, list) else value for name, value in data.items()}
        try:
            interface = cls(**values)
            check_types("interface field", interface)
        except PolicyError:
            raise
        except (InputError, TypeError, AttributeError) as error:
            raise PolicyError(f"the interface has a field of another type: {error}") from error
        return interface


def _check_filter(fields: Json) -> None:
    """Raise PolicyError unless a command filter has exactly the fields of `FilterCfg`, with valid values."""
    if set(fields) != {*FILTERED, "horizon", "speed_floor"}:
        raise PolicyError(f"command_filter must have the fields {', '.join(FILTERED)}, horizon, speed_floor")
    numbers = [fields["horizon"], fields["speed_floor"], *(each for name in FILTERED for each in fields[name].values())]
    if any(isinstance(number, bool) for number in numbers):
        raise PolicyError("command_filter must hold numbers")
    try:
        check_filter_speed(fields["horizon"], fields["speed_floor"])
        for name in FILTERED:
            check_angle_limits(name, **fields[name])
    except (InputError, TypeError) as error:
        raise PolicyError(f"command_filter: {error}") from error


def _check_layout(layout: Json, width: int) -> None:
    """Raise PolicyError unless an observation layout is empty, or its terms fill `width` columns without gaps.

    A term's columns are `history` frames of equal width.
    """
    first = 0
    for name, term in layout.items():
        where = f"observation_layout {name!r:.60}"
        if set(term) != set(LAYOUT_FIELDS) or any(type(term[key]) is not int for key in ("first", "end", "history")):
            raise PolicyError(f"{where} must have {', '.join(LAYOUT_FIELDS)}; first, end and history whole numbers")
        if term["first"] != first or term["end"] <= first or not 1 <= term["history"] <= MAX_HISTORY:
            raise PolicyError(f"{where} must begin at column {first}, with 1 to {MAX_HISTORY} frames")
        if (term["end"] - first) % term["history"]:
            raise PolicyError(f"{where} must hold whole frames")
        for key in ("scale", "clip"):
            if isinstance(term[key], bool) or not 1.0e-6 <= term[key] <= 1.0e6:
                raise PolicyError(f"{where}: {key} must lie in 1e-6 to 1e6, got {term[key]!r:.60}")
        first = term["end"]
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
    description: Json, *, policy_dt: float, physics_dt: float, hidden: tuple[int, ...], activation: str = "elu"
) -> PolicyInterface:
    """Return the interface (observation, action, motors, time steps) of policies for a task.

    description: result of `jumper_warp.tasks.interface.interface`. policy_dt, physics_dt: [s]. hidden: widths of the
    hidden layers. activation: elu, relu or tanh. Raises PolicyError: a field is missing, unknown or invalid.
    """
    shape = {"policy_dt": policy_dt, "physics_dt": physics_dt, "hidden": list(hidden), "activation": activation}
    fields = dataclasses.fields(PolicyInterface)
    optional = {spec.name: spec.default for spec in fields if spec.default is not dataclasses.MISSING}
    return PolicyInterface.from_json({"observation_layout": {}} | optional | description | shape)
