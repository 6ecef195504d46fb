"""Inference of a policy on a real robot: sensor readings to observation, action and motor targets.

It uses NumPy and ONNX Runtime, and neither PyTorch, Warp nor Newton. `docs/tutorials/on_a_robot.md` defines each
reading, and lists the files of the package that this module needs.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.ma import is_masked

from jumper_warp.policies.spec import METADATA_VERSION, SOURCE_KEYS, PolicyInterface, checksum_entry
from jumper_warp.utils.checks import check_number
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import parse_json, read_file, read_json

COMMAND_BOUND = 4.0 * math.pi  # [rad] Motor targets are clipped to ± this before the filter
JOINTS = tuple(f"{leg}_{motor}" for leg in ("FL", "FR", "BL", "BR") for motor in ("lateral", "outer", "inner"))
"""Names of the motors, in the order of all arrays."""
PLAUSIBLE = {
    "angle": (math.pi, "rad"), "rate": (100.0, "rad/s"), "lin_vel": (20.0, "m/s"), "ang_vel": (100.0, "rad/s"),
    "height": (10.0, "m"), "wanted_height": (10.0, "m"), "goal": (100.0, "m"), "jump_command": (1.0, ""),
}  # fmt: skip
"""Largest absolute value and unit of readings by name; beyond, they are in another unit or of a faulty sensor."""
LARGEST = 1.0e6  # Largest absolute value of other readings
UNIT_LENGTH = (0.9, 1.1)  # Least and largest length of `gravity`, a unit vector
EXTERNAL = b"\x0a\x08location"
"""Bytes that name another file in ONNX's `TensorProto.external_data`: the key `location`, field 1 of an entry."""
LAST_ACTION = "last_action"  # Observation term that `DeployedPolicy` computes, so that readings must not contain it


class DeployedPolicy:
    """Policy that runs on a real robot: `targets` turns sensor readings into motor targets.

    It is a policy step: `observe`, `act` and `filter_targets`. Arrays with one value per motor, (12,), have the legs
    FL, FR, BL, BR in this order; each lateral, outer, inner.

    `targets` and `observe` raise InputError for a reading that is missing, of another size, not finite or implausible,
    such as degrees for radians, and change nothing: hold the last target, and call `targets` again with the next
    readings. The history then has a gap of one policy step. If faults last longer than 0.1 s, switch the motors to
    damping and call `reset` before a restart.
    """

    def __init__(self, file: str | Path) -> None:
        """Load an ONNX policy; its metadata becomes `interface`, a dict of the fields of `PolicyInterface`.

        Raises InputError, a ValueError: the file is missing, damaged or no policy of this robot, or ONNX Runtime is not
        installed.
        """
        try:
            import onnxruntime
        except ImportError:
            raise InputError('DeployedPolicy needs ONNX Runtime: pip install "jumper-warp[export]"') from None
        data = _verified(Path(file))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # more threads slow down small networks
        options.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
            metadata = self._session.get_modelmeta().custom_metadata_map
        except Exception as error:  # ONNX Runtime's errors have no common class
            raise InputError(f"{file}: not an ONNX file that ONNX Runtime can load ({error!s:.200})") from None
        self.interface = _interface(file, metadata)
        self.layout: dict[str, Any] = self.interface["observation_layout"]
        self.scale = np.array(self.interface["action_scale"], dtype=np.float32)  # (12,) [rad] for an action of 1
        self.default = np.array(self.interface["default_joint_pos"], dtype=np.float32)  # (12,) [rad]
        self.reset()
        try:
            action = self.act(np.zeros(len(self.interface["observation_names"]), dtype=np.float32))
        except Exception as error:
            raise InputError(f"{file}: the network does not fit its metadata ({error!s:.200})") from None
        if action.shape != (len(JOINTS),) or not np.isfinite(action).all():
            raise InputError(f"{file}: the network must return {len(JOINTS)} finite numbers, got {action!s:.60}")
        self.reset()

    def reset(self) -> None:
        """Clear the policy's last action and its history of observations; call it whenever the robot restarts."""
        self.action = np.zeros(len(self.scale), dtype=np.float32)
        self._observation = np.zeros(0, np.float32)  # the last one, empty after a reset

    def targets(self, readings: Mapping[str, Any]) -> np.ndarray:
        """Return the motor targets until the next policy step [rad], (12,); call it every `policy_dt`.

        readings: sensor values of each observation term but last_action, by name; `angle`: (12,) [rad], the default
        pose not subtracted; `rate`: (12,) [rad/s]. Raises InputError, and changes nothing: one is missing, unknown, of
        another size, not finite, or beyond `PLAUSIBLE`.
        """
        action = self.act(self.observe(readings))
        return self.filter_targets(self.default + self.scale * action, readings["angle"], readings["rate"])

    def observe(self, readings: Mapping[str, Any]) -> np.ndarray:
        """Return the policy's observation, (num_obs,), and append the readings to the history.

        Arguments and errors: see `targets`.
        """
        if not isinstance(readings, Mapping):
            raise InputError(f"readings must be a mapping from term to value, got {readings!r:.60}")
        different = sorted(map(str, set(readings) ^ (set(self.layout) - {LAST_ACTION})))
        if different:
            raise InputError(f"readings missing or unknown: {', '.join(different)}")
        values = {name: self._reading(name, reading) for name, reading in readings.items()}
        values[LAST_ACTION] = self.action
        return self._scaled(values)

    def _reading(self, name: str, reading: Any) -> np.ndarray:
        """Return a sensor reading as (width,) float32.

        Raises InputError: it is of another size, not finite, or implausible.
        """
        value = _numbers(name, reading, _width(self.layout[name]))
        bound, unit = PLAUSIBLE.get(name, (LARGEST, ""))
        if np.count_nonzero(np.abs(value) > bound):
            largest = value[np.argmax(np.abs(value))]
            limit = f"±{bound:.4g} {unit}".strip()
            raise InputError(f"{name} must be within {limit}, got {largest:.4g}; hold the last target")
        if name == "gravity" and not UNIT_LENGTH[0] <= (length := float(np.linalg.norm(value))) <= UNIT_LENGTH[1]:
            raise InputError(f"gravity must be a unit vector, got length {length:.4g}; hold the last target")
        return value

    def _scaled(self, values: dict[str, np.ndarray]) -> np.ndarray:
        """Append readings by term, clipped and scaled, to the history, and return the observation, (num_obs,).

        The oldest frame of a term is first; the first reading after `reset` fills all frames.
        """
        terms = self.layout.values()
        widths = [_width(term) for term in terms]
        clip, scale = np.repeat(np.array([(term["clip"], term["scale"]) for term in terms], np.float32), widths, 0).T
        values = values | {"angle": values["angle"] - self.default}
        value = np.concatenate([values[name] for name in self.layout])
        value = scale * np.minimum(np.maximum(value, -clip), clip)
        ends = np.cumsum(widths)
        if not len(self._observation):
            parts = zip(np.split(value, ends[:-1]), terms, strict=True)
            self._observation = np.concatenate([np.tile(part, term["history"]) for part, term in parts])
        for term, width, end in zip(terms, widths, ends, strict=True):
            frames = self._observation[term["first"] : term["end"]]
            frames[:-width] = frames[width:]
            frames[-width:] = value[end - width : end]
        return self._observation.copy()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Run the policy's network and return the action, (12,), in [-1, 1].

        observation: (num_obs,). Raises InputError: it has another size, or is not finite.
        """
        obs = _numbers("observation", observation, len(self.interface["observation_names"]))
        self.action = np.asarray(self._session.run(["actions"], {"obs": obs[None]})[0])[0]
        return self.action

    def filter_targets(self, target: np.ndarray, angle: Any, rate: Any) -> np.ndarray:
        """Return motor targets [rad], (12,), from which `limit_command` removes part of the excess over joint limits.

        It is applied to each angle, then to each leg's sum of outer and inner angle, as in
        `kernels/actuation/command_filter.py`. target, angle: (12,) [rad]; rate: [rad/s]. Raises InputError: one has
        another size, or is not finite.
        """
        settings = self.interface["command_filter"]
        joints = (("target", target), ("angle", angle), ("rate", rate))
        target, angle, rate = (_numbers(name, values, len(JOINTS)).reshape(4, 3) for name, values in joints)
        target = np.minimum(np.maximum(target, -COMMAND_BOUND), COMMAND_BOUND)
        lateral, transversal = settings["lateral"], settings["transversal"]
        limits = {name: [lateral[name], transversal[name], transversal[name]] for name in lateral}
        filtered = limit_command(target, angle, rate, limits, settings)
        total = filtered[:, 1] + filtered[:, 2]
        sums = (total, angle[:, 1] + angle[:, 2], rate[:, 1] + rate[:, 2])
        filtered[:, 1:] += 0.5 * (limit_command(*sums, settings["sum"], settings) - total)[:, None]
        return filtered.ravel()


def _verified(file: Path) -> bytes:
    """Return the content of a policy's ONNX file, after comparing it with its checksum.

    Raises InputError: it cannot be read, takes weights from another file, or differs from its checksum: in its
    metadata, or in the manifest of its policy folder.
    """
    data = read_file(file, "ONNX file of a policy")
    if EXTERNAL in data:
        raise InputError(f"{file}: takes weights from another file, which its checksum does not cover")
    size = len(checksum_entry(b""))
    if data[-size:] == checksum_entry(data[:-size]):
        return data
    manifest = file.with_name("manifest.json")
    checksums = None
    if manifest.is_file():
        content = read_json(manifest, "manifest of a policy")
        checksums = content.get("sha256") if isinstance(content, dict) else None
    if isinstance(checksums, dict) and checksums.get(file.name) == hashlib.sha256(data).hexdigest():
        return data
    raise InputError(
        f"{file}: damaged, or copied without its manifest.json, which has its checksum; a file that needs no "
        "manifest: jumper export POLICY --out FILE.onnx"
    )


def _interface(file: str | Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """Return the fields of `PolicyInterface` in the metadata of an ONNX file. Raises InputError, with the file."""
    content = parse_json(metadata.get("jumper_warp", "{}"), f"{file}: metadata")
    if not isinstance(content, dict) or content.get("schema_version") != METADATA_VERSION:
        raise InputError(f"{file}: the metadata lacks version {METADATA_VERSION}: export the policy again")
    fields = {key: value for key, value in content.items() if key not in (*SOURCE_KEYS, "schema_version")}
    try:
        interface = PolicyInterface.from_json(fields).to_json()
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    layout = interface["observation_layout"]
    wide = ("angle", "rate", LAST_ACTION)
    if interface["joint_names"] != JOINTS:
        raise InputError(f"{file}: expected the joints {', '.join(JOINTS)}")
    if wrong := [name for name in wide if name in layout and _width(layout[name]) != len(JOINTS)]:
        raise InputError(f"{file}: {wrong[0]} in the observation must have {len(JOINTS)} values a frame")
    if missing := [name for name in ("angle", "rate") if name not in layout]:
        raise InputError(f"{file}: the observation lacks {' and '.join(missing)}, which the command filter needs")
    return interface


def _numbers(name: str, values: Any, width: int) -> np.ndarray:
    """Return a number or an array as (width,) float32. Raises InputError: it is of another size, or not finite."""
    array = values
    if type(values) is not np.ndarray or values.dtype != np.float32 or values.ndim != 1:  # else as in each policy step
        try:
            with np.errstate(over="ignore"):
                if is_masked(values):
                    raise TypeError("some values are masked")
                array = np.atleast_1d(np.asarray(values))
                if array.dtype.kind not in "fiu":
                    raise TypeError(f"values of type {array.dtype}")
                array = array.astype(np.float32)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"{name} must be numbers, got {values!r:.60}") from None
    if array.shape != (width,):
        raise InputError(f"{name} must have {width} values, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} is not finite: {array!s:.100}; hold the last target")
    return array


def _width(term: Mapping[str, Any]) -> int:
    """Return the number of values in one frame of an observation term, an entry of `DeployedPolicy.layout`."""
    return (term["end"] - term["first"]) // term["history"]


def limit_command(
    command: np.ndarray, pos: np.ndarray, vel: np.ndarray, limits: Mapping[str, Any], settings: Mapping[str, Any]
) -> np.ndarray:
    """Return commands [rad] from which a fraction `weight` of the part beyond the joint limits is removed.

    The motor command filter of the simulation: it slows joints before their stops, and the policy was trained with it.
    weight: 1 - (time until the joint reaches a limit) / horizon, in [0, 1]. Within the zone of a limit it is 1 for
    commands toward the limit, else 0; beyond a limit it is 1.
    command, pos [rad], vel [rad/s]: arrays of one shape. limits: lower, upper, and the widths lower_zone, upper_zone
    [deg], numbers or one for each column. settings: horizon [s] and speed_floor, the least speed for the time to a
    limit [deg/s].
    """
    lower, upper, lower_zone, upper_zone = (
        np.radians(limits[name]).astype(np.float32) for name in ("lower", "upper", "lower_zone", "upper_zone")
    )
    floor = np.float32(math.radians(settings["speed_floor"]))
    to_upper = upper - pos
    to_lower = pos - lower
    time_to_limit = np.minimum(to_upper / np.maximum(vel, floor), to_lower / np.maximum(-vel, floor))
    weight = np.minimum(np.maximum(1.0 - time_to_limit / np.float32(settings["horizon"]), 0.0), 1.0)
    near_upper = to_upper < upper_zone
    near_lower = to_lower < lower_zone
    weight = np.where(near_upper | near_lower, 0.0, weight)
    toward_limit = (near_upper & (command > pos)) | (near_lower & (command < pos))
    weight = np.where(toward_limit | (to_upper < 0.0) | (to_lower < 0.0), 1.0, weight)
    return command + weight.astype(np.float32) * (np.minimum(np.maximum(command, lower), upper) - command)


class JumpCommand:
    """Jump command observed by vertical-jump policies (term `jump_command`): 1 from `request` to landing, else 0.

    requested: whether a jump is commanded; in_flight: whether the robot has taken off and not landed.
    """

    def __init__(self, takeoff_speed: float = 0.75) -> None:
        """Start with no jump commanded; takeoff_speed: upward speed [m/s] that counts as takeoff, above 0 to 20.

        Raises InputError: it is out of range.
        """
        check_number("takeoff_speed", takeoff_speed, 1.0e-6, 20.0, "m/s")
        self._takeoff_speed = takeoff_speed
        self.requested = False
        self.in_flight = False

    def request(self) -> None:
        """Command a jump from the next `update` on."""
        self.requested = True

    def update(self, vertical_velocity: float, paws_down: int) -> float:
        """Detect takeoff and landing, clear the command at landing, and return `jump_command`, 0 or 1.

        Call it once per policy step. vertical_velocity: of the base, world frame, upward positive [m/s]; paws_down:
        number of paws on the ground. Raises InputError, and changes nothing: one is not finite or implausible.
        """
        fastest = PLAUSIBLE["lin_vel"][0]
        check_number("vertical_velocity", vertical_velocity, -fastest, fastest, "m/s")
        if paws_down not in range(5):
            raise InputError(f"paws_down must be 0, 1, 2, 3 or 4, got {paws_down!r:.40}")
        rises = vertical_velocity > self._takeoff_speed
        if self.in_flight and paws_down > 0 and not rises:
            self.requested = False
            self.in_flight = False
        elif paws_down == 0 and rises:
            self.in_flight = True
        return float(self.requested)
