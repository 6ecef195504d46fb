"""A bundle: policies as ONNX files, conformance vectors, and deploy.yaml, which connects them with the robot.

`docs/reference/bundle.md` describes the fields of deploy.yaml. Its values are used, not those in the ONNX metadata.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from jumper_warp.deploy.codec import Codec
from jumper_warp.deploy.control import Gains, TorqueCurve
from jumper_warp.deploy.policy import DeployedPolicy
from jumper_warp.deploy.safety import Safety
from jumper_warp.utils.checks import check_finite
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import read_file

VERSION = 1  # of deploy.yaml
FILE = "deploy.yaml"


class Bundle:
    """Content of a bundle: its settings, the policies by name, and the map between joints and motors."""

    def __init__(self, folder: str | Path) -> None:
        """Read deploy.yaml and load the policies.

        Raises InputError: a file is missing, differs from its hash, or does not fit the others, or a setting is wrong.
        """
        self.folder = Path(folder)
        with self.reading():
            self.settings: dict[str, Any] = yaml.safe_load(read_file(self.folder / FILE, "settings of a bundle"))
            if self.settings.get("version") != VERSION:
                raise InputError(f"{self.folder / FILE}: expected version {VERSION} of a bundle: export it again")
            check_all_finite(f"{self.folder / FILE}:", self.settings)
            self.joints = JointMap(self.settings)
            Safety(self.settings["safety"], self.settings["closed_chain"]["transversal_sum"])
            self.curve = TorqueCurve(**{k: np.array(v, np.float32) for k, v in self.settings["torque_curve"].items()})
            self.hold = Gains.from_yaml(self.settings["hold"])
            self.default = np.array(self.settings["default_joint_pos"], dtype=np.float32)
            self.joints.frames(self.default, self.hold.kp, self.hold.kd)  # ValueError: of another size, or NaN
            self.joints.frames(self.default, self.hold.kp, np.array(self.settings["safety"]["damping"]))
            self.policies = {name: self._policy(fields) for name, fields in self.settings["policies"].items()}
            if not self.policies:
                raise InputError(f"{self.folder / FILE}: no policies")
            self.edited = settings_hash(self.settings) != self.settings.get("sha256")  # since the export

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Read settings in a block, whose errors about missing or wrong ones become InputError."""
        try:
            yield
        except InputError:
            raise
        except (yaml.YAMLError, LookupError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{self.folder / FILE}: {type(error).__name__}: {error!s:.200}") from error

    def file(self, name: str) -> Path:
        """Return the path of a file of the bundle. Raises InputError: it differs from its hash in deploy.yaml."""
        path = self.folder / Path(name).name
        if hashlib.sha256(read_file(path, "file of a bundle")).hexdigest() != self.settings["files"].get(path.name):
            raise InputError(f"{path}: differs from its hash in {FILE}: export the bundle again")
        return path

    def _policy(self, fields: Mapping[str, Any]) -> DeployedPolicy:
        """Load a policy with the settings of its section of deploy.yaml."""
        policy = DeployedPolicy(self.file(fields["file"]))
        action = fields["actions"]["JointPositionAction"]
        policy.scale[:] = action["scale"]
        policy.default[:] = action["offset"]
        policy.interface["command_filter"] = fields["command_filter"]
        terms = fields["observations"]
        if list(terms) != list(policy.layout):
            raise InputError(f"{self.folder / FILE}: {fields['file']} observes the terms {', '.join(policy.layout)}")
        for name, term in terms.items():
            if term["history_length"] != policy.layout[name]["history"]:
                raise InputError(f"{self.folder / FILE}: {name} needs a history of {policy.layout[name]['history']}")
            policy.layout[name] |= {"scale": float(term["scale"]), "clip": float(term["clip"][1])}
        target = policy.filter_targets(policy.default + policy.scale * policy.action, policy.default, policy.action)
        self.joints.frames(target, *Gains.from_yaml(fields)[:2])  # as for `hold`
        return policy


class JointMap:
    """Map between the joints of the policies and the motors on the buses: order, sign and zero."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        """Read joint_ids_map, joint_signs, joint_offsets and motors of deploy.yaml."""
        self.motor = np.array(settings["joint_ids_map"])  # (12,) motor of each joint
        self.sign = np.array(settings["joint_signs"], dtype=float)  # (12,) joint angle over motor angle
        self.offset = np.array(settings["joint_offsets"], dtype=float)  # (12,) [rad] joint angle at the motor's zero
        self.transversal = np.array(
            ["lateral" not in name for name in settings["joint_names"]]
        )  # (12,) whether it is one
        self.codec = Codec(settings["motors"])
        self._by_joint = Codec([settings["motors"][motor] for motor in self.motor])

    def read(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the joints' angles [rad], rates [rad/s], torques [N m], temperatures [°C] and error codes, (12,) each.

        frames: replies of the motors, (12, 8) uint8. The first three are float32.
        """
        position, velocity, torque, temperature, error = self._by_joint.decode_reply(frames[self.motor])
        angle = (self.sign * position + self.offset).astype(np.float32)
        rate = (self.sign * velocity).astype(np.float32)
        return angle, rate, (self.sign * torque).astype(np.float32), temperature, error

    def frames(self, target: np.ndarray, kp: np.ndarray, kd: np.ndarray) -> np.ndarray:
        """Return the motors' command frames (12, 8) uint8; target [rad], kp, kd: (12,), by joint."""
        command = np.zeros((5, 12))
        command[0], command[2], command[3] = self.sign * (target - self.offset), kp, kd
        frames = np.empty((12, 8), np.uint8)
        frames[self.motor] = self._by_joint.encode(command)
        return frames


def check_all_finite(name: str, value: Any) -> None:
    """Raise InputError, which begins with `name`, if a number in nested settings is not finite.

    A limit of NaN is never exceeded.
    """
    if isinstance(value, float):
        check_finite(name, value)
    entries = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    for key, entry in entries:
        check_all_finite(f"{name} {key}", entry)


def settings_hash(settings: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the settings of deploy.yaml but the entry sha256."""
    rest = {name: value for name, value in settings.items() if name != "sha256"}
    return hashlib.sha256(yaml.safe_dump(rest, sort_keys=True).encode()).hexdigest()
