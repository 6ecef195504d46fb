"""Export of a bundle: deploy.yaml, ONNX files of policies, their conformance vectors and the runtime as deploy.pyz."""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import onnx
import yaml

from jumper_warp.bench.vectors import vectors_bytes
from jumper_warp.deploy.bundle import FILE, VERSION, settings_hash
from jumper_warp.deploy.codec import dbc
from jumper_warp.deploy.policy import JOINTS, LAST_ACTION
from jumper_warp.policies.onnx import onnx_bytes
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyInterface, checksum_entry
from jumper_warp.robot.description import load_description
from jumper_warp.robot.motors import OVERSPEED_END, OVERSPEED_START
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_atomically

SKILL_OF_COMMAND = {"wanted_height": "jump_up", "goal": "jump_to", "command": "walk"}
"""Skill of a policy by the observation term that holds its command."""
READ_TERMS = {"height", "lin_vel", "ang_vel", "gravity", "angle", "rate", LAST_ACTION}
"""Observation terms beside those of the command that the runtime computes."""
COMMAND_RANGES = {
    "walk": {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [-0.5, 0.5], "ang_vel_z": [-1.0, 1.0]},
    "jump_up": {"wanted_height": [0.5, 1.0]},
    "jump_to": {"ahead": [-0.5, 1.5], "left": [-0.5, 0.5]},
}
"""Ranges of commands by skill, [m/s], [rad/s], [m]; the runtime clips requests to them."""


def skill_of(interface: PolicyInterface) -> str:
    """Return the skill of a policy: walk, jump_up or jump_to. Raises InputError: the runtime cannot run it."""
    for term, skill in SKILL_OF_COMMAND.items():
        if term in interface.observation_layout:
            commands = {term} if skill == "walk" else {"wanted_height", "jump_command", "goal"}
            if unread := interface.observation_layout.keys() - READ_TERMS - commands:
                raise InputError(f"{interface.task}: the runtime cannot compute the observation {min(unread)}")
            return skill
    raise InputError(f"{interface.task}: a bundle takes policies that walk, jump up or jump to a place")


def policy_settings(interface: PolicyInterface, file: str) -> dict[str, Any]:
    """Return a policy's section of deploy.yaml, with the keys of unitree's files."""
    skill = skill_of(interface)
    default = list(interface.default_joint_pos)
    action = {
        "clip": [-1.0, 1.0], "joint_names": list(interface.joint_names), "scale": list(interface.action_scale),
        "offset": default, "joint_ids": None,
    }  # fmt: skip
    observations = {
        name: {
            "params": {}, "clip": [-term["clip"], term["clip"]], "scale": term["scale"],
            "history_length": term["history"],
        } for name, term in interface.observation_layout.items()
    }  # fmt: skip
    return {
        "file": file, "task": interface.task, "skill": skill, "step_dt": interface.policy_dt,
        "stiffness": list(interface.joint_stiffness), "damping": list(interface.joint_damping),
        "torque_limit": list(interface.torque_limit), "default_joint_pos": default,
        "actions": {"JointPositionAction": action}, "observations": observations, "commands": COMMAND_RANGES[skill],
        "command_filter": interface.command_filter,
    }  # fmt: skip


def robot_settings() -> dict[str, Any]:
    """Return the sections of deploy.yaml that all policies share."""
    description = load_description()
    motors = description.motors
    lateral = ["lateral" in name for name in JOINTS]
    curve = {name: [getattr(motor, name) for motor in motors] for name in ("cutoff_speed", "no_load_speed")}
    curve |= {"peak": [motor.peak_torque for motor in motors]}
    return {
        "version": VERSION, "step_dt": 1.0 / 60.0, "rate": 480, "joint_names": list(JOINTS),
        "joint_ids_map": list(range(12)), "joint_signs": [1] * 12, "joint_offsets": [0.0] * 12,
        "motors": [motor.type for motor in motors], "can": {"reply_id": 0},
        "default_joint_pos": [float(angle) for angle in description.pose("default")],
        "hold": {
            "stiffness": [motor.jumping.kp for motor in motors], "damping": [motor.jumping.kd for motor in motors],
            "torque_limit": [10.0 if each else 18.0 for each in lateral],
        },
        "stand_up": {"folded": [0.0 if each else math.radians(100.0) for each in lateral], "seconds": 2.0},
        "torque_curve": curve | {"fade_start": [OVERSPEED_START] * 12, "fade_end": [OVERSPEED_END] * 12},
        "closed_chain": {"transversal_sum": [math.degrees(limit) for limit in description.transversal_sum]},
        "safety": {
            "lower": [-50.0 if each else -30.0 for each in lateral],
            "upper": [110.0 if each else 140.0 for each in lateral],
            "position_margin": 12.0, "max_rate": 45.0, "max_temperature": 80.0, "max_tilt": 60.0, "torque_factor": 1.2,
            "torque_margin": 2.0, "max_late": 1.0e-3, "damping": [2.0] * 12,
        },
        "switch": {"rest_speed": 0.10, "rest_spin": 0.30, "rest_tilt": 0.14, "max_offset": 0.44},
        "estimator": {},
    }  # fmt: skip


def reader_metadata(interface: PolicyInterface) -> dict[str, str]:
    """Return the entries of ONNX metadata that readers of mjlab's and BeyondMimic's policies take.

    `observation_names` are terms there. The entries `observation_terms_*` have a value for each term, in this order.
    A reader stacks `observation_terms_history_length` frames of a term, the oldest first, and flattens them.
    """
    layout = interface.observation_layout
    entries: dict[str, list] = {
        "command_names": [name for name in layout if name in SKILL_OF_COMMAND], "observation_names": list(layout),
        "observation_terms_history_length": [term["history"] for term in layout.values()],
        "observation_terms_flatten_history_dim": [1] * len(layout),
    }  # fmt: skip
    entries |= {f"observation_terms_{key}": [term[key] for term in layout.values()] for key in ("scale", "clip")}
    return {name: ",".join(map(str, values)) for name, values in entries.items()}


def bundle_onnx(policy: Policy) -> bytes:
    """Return a policy as an ONNX file with its checksum, and metadata that other readers take."""
    model = onnx.load_from_string(onnx_bytes(policy.tensors(), policy.interface, policy.config))
    entries = {entry.key: entry.value for entry in model.metadata_props}
    onnx.helper.set_model_props(model, entries | reader_metadata(policy.interface))
    data = model.SerializeToString(deterministic=True)
    return data + checksum_entry(data)


def runtime_archive() -> bytes:
    """Return the runtime as a zip archive that Python runs: `jumper_warp.deploy` and the modules that it imports."""
    package = Path(__file__).parents[1]
    modules = [*sorted((package / "deploy").glob("*.py")), package / "policies/spec.py"]
    modules += [package / "utils" / f"{name}.py" for name in ("checks", "errors", "files")]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("jumper_warp", "jumper_warp/policies", "jumper_warp/utils"):
            archive.writestr(zipfile.ZipInfo(f"{name}/__init__.py"), "")
        for path in modules:
            info = zipfile.ZipInfo(f"jumper_warp/{path.relative_to(package)}")
            archive.writestr(info, path.read_bytes(), zipfile.ZIP_DEFLATED)
        archive.writestr(zipfile.ZipInfo("__main__.py"), "from jumper_warp.deploy.main import main\n\nmain()\n")
    return file.getvalue()


def export_bundle(policies: Sequence[tuple[str, Policy]], folder: Path) -> Path:
    """Write a bundle of named policies to a folder, and return it.

    Raises InputError: two policies have the same skill, or the runtime cannot run one.
    """
    settings = robot_settings()
    files: dict[str, bytes] = {}
    sections: dict[str, Any] = {}
    for name, policy in policies:
        section = policy_settings(policy.interface, f"{name}.onnx")
        if section["skill"] in {each["skill"] for each in sections.values()}:
            raise InputError(f"{name}: the bundle already has a policy for {section['skill']}")
        sections[name] = section
        files[f"{name}.onnx"] = bundle_onnx(policy)
        files[f"{name}.npz"] = vectors_bytes(name, policy)
    files["jumper.dbc"] = dbc(settings["motors"][:3]).encode()
    files["deploy.pyz"] = runtime_archive()
    settings["policies"] = sections
    settings["files"] = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    settings["sha256"] = settings_hash(settings)
    folder.mkdir(parents=True, exist_ok=True)
    files[FILE] = yaml.safe_dump(settings, sort_keys=False).encode()
    for name, data in files.items():
        write_atomically(folder / name, data)
    return folder
