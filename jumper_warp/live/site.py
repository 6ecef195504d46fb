"""Policies as files that JavaScript reads, and the static page on which a visitor drives the robot with them."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.evaluation.trained import trained_bounds
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.velocity.state import VelocityState
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError
from jumper_warp.tasks.jump.evaluation import HeightEvaluation
from jumper_warp.utils.assets import ASSETS
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json

FORMAT = "jumper-warp policy for browsers 1"
TERMS = frozenset({
    "command", "wanted_height", "jump_command", "goal", "height", "lin_vel", "ang_vel", "gravity", "angle", "rate",
    "last_action", "block_ahead", "way",
})  # fmt: skip
"""Observation terms that the page computes; `TERMS` in page/policy.js has the same names."""
EARTH = {"walk": "walking", "jump_up": "vertical_jump", "jump_to": "horizontal_jump"}
SCENES = {
    "plain": EARTH,
    "blocks": EARTH | {"jump_to": "sighted_jump"},
    "rough": EARTH,
    "mars": EARTH | {"jump_up": "mars_vertical_jump", "jump_to": "mars_horizontal_jump"},
}
"""Name of the policy of each skill by scene of the page."""


def skill_of(policy: Policy) -> str:
    """Return the skill of a policy: walk, jump_up or jump_to. Raises PolicyError: the page has none for its task."""
    task = policy.recipe().task
    if task.state is VelocityState:
        return "walk"
    if task.state is JumpState:
        return "jump_up" if isinstance(task.evaluation, HeightEvaluation) else "jump_to"
    raise PolicyError(f"{task.name}: the page runs policies that walk, jump up or jump to a place")


def browser_files(policy: Policy, name: str) -> dict[str, bytes]:
    """Return `policy.json` and `policy.bin` of a policy, content by file name.

    The binary file has little-endian float32 values: mean and standard deviation of the normaliser, then each layer's
    weight, (out, in), and bias. name: shown on the page. Raises PolicyError: the task is neither walking nor jumping,
    or an observation term is none of `TERMS`.
    """
    interface = policy.interface
    if unknown := sorted(set(interface.observation_layout) - TERMS):
        raise PolicyError(f"{name}: the page cannot compute the observation {', '.join(unknown)}")
    task = policy.recipe().task
    kinds = [asdict(task.motors.lateral), asdict(task.motors.transversal), asdict(task.motors.transversal)]
    limits = ("peak", "cutoff_speed", "no_load_speed")
    tensors = policy.tensors()
    values = np.concatenate([tensor.numpy().astype("<f4").ravel() for tensor in tensors.values()])
    fields = {key: value for key, value in interface.to_json().items() if key != "observation_names"}
    description: Json = {
        "format": FORMAT,
        "name": name,
        "skill": skill_of(policy),
        "range": {bound.name: [bound.low, bound.high] for bound in trained_bounds(task)},
        "gravity": task.gravity,
        "friction": task.randomization.nominal_friction,
        "takeoff_speed": task.advance.numbers.get("takeoff_speed", 0.0),
        "motors": {key: [kind[key] for kind in kinds] * 4 for key in limits},
        "fade": [task.motors.fade_start, task.motors.fade_end],
        "sizes": list(interface.sizes),
        "sha256": hashlib.sha256(values.tobytes()).hexdigest(),
        "interface": fields,
    }
    return {"policy.json": json.dumps(description).encode(), "policy.bin": values.tobytes()}


def write_page(folder: Path, policies: Sequence[Policy] = ()) -> Path:
    """Write the static page with its policies to a folder, and return the path of its index.html.

    policies: take the place of the project's policies of their skills, in all scenes. Raises InputError: the bundle is
    missing, or two policies have the same skill; PolicyError: see `browser_files`.
    """
    own = {skill_of(policy): policy for policy in policies}
    if len(own) < len(policies):
        raise InputError("the page takes one policy for each skill")
    scenes = {scene: names | {skill: f"my_{skill}" for skill in own} for scene, names in SCENES.items()}
    used: Mapping[str, Any] = {f"my_{skill}": policy for skill, policy in own.items()}
    with as_file(files("jumper_warp.live").joinpath("page", "dist")) as bundle:
        if not (bundle / "index.html").is_file():
            raise InputError("the page is not built: run `make page`")
        shutil.copytree(bundle, folder, dirs_exist_ok=True)
    shutil.copytree(ASSETS / "jumper" / "meshes", folder / "meshes", dirs_exist_ok=True)
    shutil.copy(ASSETS / "jumper" / "jumper.xml", folder)
    for name in sorted({name for names in scenes.values() for name in names.values()}):
        target = folder / "policies" / name
        target.mkdir(parents=True, exist_ok=True)
        for file, content in browser_files(used.get(name) or Policy.load(name), name).items():
            (target / file).write_bytes(content)
    (folder / "scenes.json").write_text(json.dumps(scenes) + "\n")
    return folder / "index.html"
