"""Bundles: conformance vectors, ONNX metadata for other readers, and the runtime in a bare environment."""

import math
import os
import shutil
import subprocess
import sys

import numpy as np
import onnxruntime
import pytest

from jumper_warp.bench.bundle import export_bundle
from jumper_warp.bench.vectors import record_vectors
from jumper_warp.deploy.bundle import FILE, Bundle
from jumper_warp.deploy.check import check_bundle
from jumper_warp.policies.policy import load_policy
from jumper_warp.utils.assets import ASSETS
from jumper_warp.utils.errors import InputError


def test_shipped_bundle_conforms(bundle):
    assert check_bundle(bundle) == []
    assert not bundle.edited


def test_shipped_vectors_are_those_of_the_policy():
    vectors = record_vectors(load_policy("vertical_jump"), episodes=1, steps=30)
    with np.load(ASSETS / "conformance" / "vertical_jump.npz") as shipped:
        assert np.abs(shipped["reading_angle"][:30] - vectors["reading_angle"]).max() < 1e-4
        assert np.abs(shipped["action"][:30] - vectors["action"]).max() < 1e-3


def swap(fields, first, second):
    """Swap two entries of a list."""
    fields[first], fields[second] = fields[second], fields[first]


def action_of(policy):
    """Return the settings of a policy's action."""
    return policy["actions"]["JointPositionAction"]


MISTAKES = {  # by name: the policy that is checked, and a function that changes its settings and those of the bundle
    "swapped pair": ("vertical_jump", lambda policy, bundle: swap(bundle["joint_ids_map"], 1, 2)),
    "swapped defaults": ("vertical_jump", lambda policy, bundle: swap(action_of(policy)["offset"], 0, 1)),
    "wrong sign": ("vertical_jump", lambda policy, bundle: bundle["joint_signs"].__setitem__(4, -1)),
    "degrees": (
        "walking",
        lambda policy, bundle: action_of(policy).update(scale=np.degrees(action_of(policy)["scale"]).tolist()),
    ),
    "wrong gain": ("walking", lambda policy, bundle: policy["stiffness"].__setitem__(3, 34.0)),
    "wrong scale": ("horizontal_jump", lambda policy, bundle: policy["observations"]["rate"].update(scale=0.05)),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_in_the_settings_fails_the_check(mistake, edited):
    name, change = MISTAKES[mistake]

    def make(settings):
        settings["policies"] = {name: settings["policies"][name]}
        change(settings["policies"][name], settings)

    bundle = Bundle(edited(make))
    assert check_bundle(bundle)
    assert bundle.edited


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("safety max_rate", math.nan, "safety max_rate must be finite"),
        ("safety max_tilt", math.inf, "safety max_tilt must be finite"),
        ("safety upper", [*11 * [100.0], math.nan], "safety upper 11 must be finite"),
        ("hold torque_limit", 12 * [math.nan], "hold torque_limit 0 must be finite"),
        ("safety lower", 11 * [-50.0], "need 12 angles"),
        ("policies", {}, "no policies"),
        ("policies vertical_jump observations angle history_length", 1, "history of 4"),
        ("joint_ids_map", [0, 1, 2], FILE),
        ("joint_offsets", 12 * [math.nan], FILE),
        ("safety max_late", None, FILE),
        ("policies vertical_jump stiffness", [1.0, 2.0], FILE),
        ("policies vertical_jump skill", "fly", FILE),
        ("policies vertical_jump command_filter", {}, FILE),
        ("stand_up folded", [0.0] * 4, FILE),
    ],
)
def test_setting_that_is_missing_or_of_another_size_or_not_finite_is_refused(place, value, message, edited):
    def change(settings):
        *sections, name = place.split()
        for section in sections:
            settings = settings[section]
        settings[name] = value

    folder = edited(change)
    with pytest.raises(InputError, match=message):
        check_bundle(Bundle(folder))


def test_stale_history_fails_the_check(bundle_folder, monkeypatch):
    bundle = Bundle(bundle_folder)
    policy = bundle.policies["vertical_jump"]
    observe, readings = policy.observe, []

    def stale(reading):
        """Observe the readings of the step before."""
        readings.append(reading)
        return observe(readings[max(0, len(readings) - 2)])

    monkeypatch.setattr(policy, "observe", stale)
    assert any("observation" in line for line in check_bundle(bundle))


def test_swapped_onnx_file_is_refused(bundle_folder, tmp_path):
    folder = shutil.copytree(bundle_folder, tmp_path / "bundle")
    shutil.copy(folder / "walking.onnx", folder / "vertical_jump.onnx")
    with pytest.raises(InputError, match="differs from its hash"):
        Bundle(folder)


def test_policy_with_an_observation_that_the_runtime_lacks_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot compute the observation block_ahead"):
        export_bundle([("sighted_jump", load_policy("sighted_jump"))], tmp_path)


def test_metadata_gives_other_readers_the_observation(bundle_folder):
    """Their rule: names are terms; a term's history is stacked with the oldest frame first, flattened, and scaled."""
    session = onnxruntime.InferenceSession(bundle_folder / "horizontal_jump.onnx")
    columns = {key: value.split(",") for key, value in session.get_modelmeta().custom_metadata_map.items()}
    terms = columns["observation_names"]
    widths = {"goal": 2, "lin_vel": 3, "ang_vel": 3, "gravity": 3, "angle": 12, "rate": 12, "last_action": 12}
    frames = map(int, columns["observation_terms_history_length"])
    width = sum(widths.get(term, 1) * count for term, count in zip(terms, frames, strict=True))
    assert width == session.get_inputs()[0].shape[1] and set(columns["command_names"]) <= set(terms)
    for key in ("scale", "clip", "flatten_history_dim"):
        assert len(list(map(float, columns[f"observation_terms_{key}"]))) == len(terms)
    for key in ("joint_stiffness", "joint_damping", "default_joint_pos", "action_scale"):
        assert len(list(map(float, columns[key]))) == 12


CHECK = """
import runpy, sys
sys.modules.update(dict.fromkeys(("torch", "warp", "newton", "onnx", "scipy", "rerun", "tyro")))  # cannot be imported
sys.path[:] = [path for path in sys.path if path != sys.argv[1]]
sys.argv = ["deploy.pyz", ".", "--check"]
runpy.run_path("deploy.pyz", run_name="__main__")
"""


def test_archive_checks_the_bundle_without_the_packages_of_the_simulator(bundle_folder):
    command = [sys.executable, "-c", CHECK, str(ASSETS.parent)]
    done = subprocess.run(command, cwd=bundle_folder, env={"PATH": os.environ["PATH"]}, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "3 policies conform\n"), done.stderr
