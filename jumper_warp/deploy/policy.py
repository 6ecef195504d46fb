"""A policy as a robot runs it, in NumPy and onnxruntime alone: from readings to an observation, an action and targets.

Of the package it needs `jumper_warp/utils/errors.py` alone. `docs/deployment.md` tells what each reading is.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from jumper_warp.utils.errors import InputError

COMMAND_BOUND = 4.0 * math.pi
"""[rad] Commands are bounded to this before the filter."""
OWN = "last_action"
"""The term of the observation that a policy remembers itself."""


class DeployedPolicy:
    """One policy on one robot. `targets` is a whole policy step; `observe`, `act` and `filtered` are its parts."""

    def __init__(self, file: str | Path) -> None:
        """Load `policy.onnx`, which tells all that is needed; `interface` is what it tells, as a dict.

        Raises ValueError: the file does not tell how its observation is laid out.
        """
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # small networks lose by more
        self._session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        entries = self._session.get_modelmeta().custom_metadata_map
        self.interface: dict[str, Any] = json.loads(entries.get("jumper_warp", "{}"))
        if not self.interface.get("observation_layout"):
            raise InputError(f"{file}: no observation_layout in its metadata: export the policy again")
        self.layout = self.interface["observation_layout"]
        self.scale = np.array(self.interface["action_scale"], dtype=np.float32)
        self.default = np.array(self.interface["default_joint_pos"], dtype=np.float32)
        self.reset()

    def reset(self) -> None:
        """Forget the past, as where the robot has been put down anew."""
        self.action = np.zeros(len(self.scale), dtype=np.float32)
        self._frames: dict[str, np.ndarray] = {}

    def targets(self, readings: Mapping[str, Any]) -> np.ndarray:
        """Return what the motors follow until the next policy step [rad], (12,); call every `policy_dt`.

        readings: of each term of the observation but last_action, by its name; angles as the sensors read them.
        Raises ValueError: readings are missing, unknown, or of another size.
        """
        action = self.act(self.observe(readings))
        return self.filtered(self.default + self.scale * action, readings["angle"], readings["rate"])

    def observe(self, readings: Mapping[str, Any]) -> np.ndarray:
        """Return the observation, (columns,); advances the history by a policy step. Arguments: as of `targets`."""
        different = sorted(set(readings) ^ (set(self.layout) - {OWN}))
        if different:
            raise InputError(f"readings missing or unknown: {', '.join(different)}")
        return np.concatenate([self._term(name, term, readings) for name, term in self.layout.items()])

    def _term(self, name: str, term: Mapping[str, Any], readings: Mapping[str, Any]) -> np.ndarray:
        """Return the columns of a term, its oldest frame first; at the start all frames are the first reading."""
        value = self.action if name == OWN else np.atleast_1d(np.asarray(readings[name], dtype=np.float32))
        width = (term["end"] - term["first"]) // term["history"]
        if value.shape != (width,):
            raise InputError(f"{name} takes {width} numbers, got an array of shape {value.shape}")
        if name == "angle":
            value = value - self.default
        value = np.float32(term["scale"]) * np.clip(value, -term["clip"], term["clip"])
        frames = self._frames.get(name)
        past = np.tile(value, (term["history"] - 1, 1)) if frames is None else frames[1:]
        self._frames[name] = np.concatenate([past, value[None]])
        return self._frames[name].ravel()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the action, (12,) within -1 to 1, and remember it for the next observation."""
        self.action = np.asarray(self._session.run(["actions"], {"obs": observation[None]})[0])[0]
        return self.action

    def filtered(self, target: np.ndarray, angle: Any, rate: Any) -> np.ndarray:
        """Return targets [rad] that give way to the limits of angles as these come near; all (12,), [rad], [rad/s].

        It is the filter of `kernels/actuation/command_filter.py`, which states its equations.
        """
        limits = self.interface["command_filter"]
        target = np.clip(target, -COMMAND_BOUND, COMMAND_BOUND).reshape(4, 3)
        angle, rate = (np.asarray(values, dtype=np.float32).reshape(4, 3) for values in (angle, rate))
        safe = np.empty_like(target)
        for motor, kind in enumerate(("lateral", "transversal", "transversal")):
            safe[:, motor] = limited(target[:, motor], angle[:, motor], rate[:, motor], limits[kind], limits)
        total = safe[:, 1] + safe[:, 2]
        both = limited(total, angle[:, 1] + angle[:, 2], rate[:, 1] + rate[:, 2], limits["sum"], limits)
        safe[:, 1:] += 0.5 * (both - total)[:, None]
        return safe.ravel()


def limited(
    command: np.ndarray, pos: np.ndarray, vel: np.ndarray, limits: Mapping[str, float], settings: Mapping[str, Any]
) -> np.ndarray:
    """Return commands [rad] of quantities at `pos` [rad], `vel` [rad/s], within limits [deg] as far as these bind.

    settings: horizon [s] and speed_floor [deg/s].
    """
    lower, upper, lower_zone, upper_zone = (
        np.float32(math.radians(limits[name])) for name in ("lower", "upper", "lower_zone", "upper_zone")
    )
    floor = np.float32(math.radians(settings["speed_floor"]))
    above, below = upper - pos, pos - lower
    left = np.minimum(above / np.maximum(vel, floor), below / np.maximum(-vel, floor))
    weight = np.clip(1.0 - left / np.float32(settings["horizon"]), 0.0, 1.0)
    near_upper, near_lower = above < upper_zone, below < lower_zone
    weight = np.where(near_upper | near_lower, 0.0, weight)
    toward = (near_upper & (command > pos)) | (near_lower & (command < pos))
    weight = np.where(toward | (above < 0.0) | (below < 0.0), 1.0, weight)
    return command + weight.astype(np.float32) * (np.clip(command, lower, upper) - command)


class JumpCommand:
    """`jump_command` of jumps to heights: 1 from `give` on until the robot has landed, else 0."""

    def __init__(self, takeoff_speed: float = 0.75) -> None:
        """Begin without a command; takeoff_speed [m/s]: upward, that a flight begins with."""
        self._takeoff_speed = takeoff_speed
        self.wanted, self.in_flight = False, False

    def give(self) -> None:
        """Ask for a jump."""
        self.wanted = True

    def update(self, up: float, paws_down: int) -> float:
        """Return the command of this policy step, before `targets`; up [m/s]: velocity of the base, world z."""
        if self.in_flight and paws_down > 0:
            self.wanted, self.in_flight = False, False
        elif paws_down == 0 and up > self._takeoff_speed:
            self.in_flight = True
        return float(self.wanted)
