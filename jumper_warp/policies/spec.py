"""Interface of a policy: observation, action, motors and time steps, i.e. all data of a policy but its weights."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass, field
from typing import Any

from jumper_warp.utils.checks import check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json

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

        Raises PolicyError: a field is missing, unknown or of another type.
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
        except InputError as error:
            raise PolicyError(f"the interface has a field of another type: {error}") from error
        return interface


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
    hidden layers. activation: elu, relu or tanh. Raises PolicyError: a field is missing, unknown or of another type.
    """
    shape = {"policy_dt": policy_dt, "physics_dt": physics_dt, "hidden": list(hidden), "activation": activation}
    fields = dataclasses.fields(PolicyInterface)
    optional = {spec.name: spec.default for spec in fields if spec.default is not dataclasses.MISSING}
    return PolicyInterface.from_json({"observation_layout": {}} | optional | description | shape)
