"""Mutated policy folders: each is refused with a one-line error, or loads as a policy that acts and can be saved."""

import hashlib
import itertools
import json
import math

import numpy as np
import onnx
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_policy import make_interface

from json_helpers import places
from jumper_warp.policies.folder import load_policy, save_policy
from jumper_warp.policies.onnx import onnx_bytes
from jumper_warp.policies.policy import Policy
from jumper_warp.policies.spec import PolicyError, PolicyInterface

SIZES = (5, 6, 4, 2)  # observation, hidden layers, action
FILES = ("config.json", "policy.onnx", "manifest.json", "README.md")
VALUES = [
    None, True, 0, -1, 1, 2, 10**30, 1e-30, 1e30, 1e300, -1e300, math.nan, math.inf, -math.inf, 0.5, -0.5, "", "x",
    "a\nb", "\ud800", "../x", "1", [], [1], [1.0, 2.0], ["a", "b"], [[1.0]], {}, {"a": 1}, {"a\nb": [math.nan]},
]  # fmt: skip
OBSERVATIONS = torch.cat(
    [torch.zeros(1, 5), 1e3 * torch.eye(5), -1e30 * torch.ones(1, 5), torch.full((1, 5), math.nan)]
)
COMMON = settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def small_policy():
    """Return a policy with random weights of SIZES."""
    torch.manual_seed(2)
    interface = make_interface(SIZES[0], SIZES[-1], SIZES[1:-1])
    layers = [(torch.randn(o, i), torch.randn(o)) for i, o in itertools.pairwise(SIZES)]
    return Policy(layers, torch.randn(5), torch.rand(5) + 0.1, interface, {"env": {"seed": 5, "list": [1, 2.0, None]}})


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """Folder of `small_policy`, which no test changes."""
    return save_policy(tmp_path_factory.mktemp("policies") / "original", small_policy())


@pytest.fixture(scope="module")
def folder(original):
    """Folder for mutated policies."""
    (original.parent / "changed").mkdir()
    return original.parent / "changed"


def write(folder, content):
    """Replace all files of a folder by `content` (file name to bytes)."""
    for path in folder.iterdir():
        path.unlink()
    for name, data in content.items():
        (folder / name).write_bytes(data)


def content_of(folder):
    """Return the bytes of FILES by name."""
    return {name: (folder / name).read_bytes() for name in FILES}


def update_checksums(content):
    """Update the checksums in `content["manifest.json"]` to the other files in `content` (name to bytes)."""
    manifest = json.loads(content["manifest.json"])
    for name in manifest["sha256"]:
        manifest["sha256"][name] = hashlib.sha256(content[name]).hexdigest()
    content["manifest.json"] = json.dumps(manifest).encode()


def check(folder, saved):
    """Return whether a folder loads; assert that the error is one line, or that the policy acts and saves bitwise.

    saved: folder to save the policy to.
    """
    try:
        policy = load_policy(folder)
    except PolicyError as error:
        assert len(str(error).splitlines()) == 1 and len(str(error)) < 1000
        return False
    with torch.no_grad():
        actions = policy.act(torch.cat([OBSERVATIONS, torch.randn(8, 5)]))
    assert actions.shape == (len(OBSERVATIONS) + 8, 2)
    assert actions.isfinite().all() and actions.abs().max() <= 1.0
    interface = policy.interface
    assert 0.0 < interface.physics_dt <= interface.policy_dt <= 1.0
    assert min(interface.torque_limit) > 0.0 and min(*interface.joint_stiffness, *interface.joint_damping) >= 0.0
    assert onnx_bytes(policy)
    again = load_policy(save_policy(saved, policy, overwrite=True))
    assert torch.equal(again.act(OBSERVATIONS), policy.act(OBSERVATIONS)) and again.interface == interface
    return True


def change_one(tree, data):
    """Change, scale, delete or add one entry of nested dicts and lists, in place; data: Hypothesis chooses which."""
    table, key = data.draw(st.sampled_from(list(places(tree))))
    kind = data.draw(st.sampled_from(["value", "value", "value", "scale", "delete", "add"]))
    if kind == "delete":
        del table[key]
    elif kind == "add" and isinstance(table, dict):
        table[data.draw(st.sampled_from(["", "extra", "a\nb", "\ud800"]))] = data.draw(st.sampled_from(VALUES))
    elif kind == "add":
        table.insert(key, data.draw(st.sampled_from([table[key], *VALUES])))
    elif kind == "scale" and isinstance(table[key], int | float):
        table[key] *= data.draw(st.sampled_from([-1, 1e-6, 1e6, 1e30, 1e-300]))
    else:
        table[key] = data.draw(st.sampled_from(VALUES))


def test_unchanged_policy_loads(original, tmp_path):
    assert check(original, tmp_path / "saved")


@COMMON
@given(data=st.data())
def test_damaged_file_with_a_checksum_is_refused(original, folder, data):
    content = content_of(original)
    name = data.draw(st.sampled_from(FILES))
    kind = data.draw(st.sampled_from(["delete", "truncate", "flip", "insert"]))
    damaged = bytearray(content[name])
    at = data.draw(st.integers(0, len(damaged) - 1))
    if kind == "truncate":
        del damaged[at:]
    elif kind == "flip":
        damaged[at] ^= data.draw(st.integers(1, 255))
    else:
        damaged[at:at] = data.draw(st.binary(min_size=1, max_size=8))
    content[name] = bytes(damaged)
    if kind == "delete":
        del content[name]
    write(folder, content)
    loaded = check(folder, folder.parent / "saved")
    assert name in ("README.md", "manifest.json") or not loaded  # these two have no checksum


@COMMON
@given(data=st.data())
def test_damaged_weights_with_valid_checksum_load_or_are_refused(original, folder, data):
    content = content_of(original)
    weights = bytearray(content["policy.onnx"])
    at = data.draw(st.integers(0, len(weights) - 1))
    weights[at] = data.draw(st.integers(0, 255) | st.sampled_from(b'\x00\n"0189{}[],:F'))
    content["policy.onnx"] = bytes(weights[: data.draw(st.sampled_from([None, at + 1, -1]))])
    update_checksums(content)
    write(folder, content)
    check(folder, folder.parent / "saved")


@pytest.mark.parametrize("name", ["config.json", "manifest.json"])
@COMMON
@given(data=st.data())
def test_changed_json_with_valid_checksums_loads_or_is_refused(original, folder, name, data):
    content = content_of(original)
    tree = json.loads(content[name])
    change_one(tree, data)
    content[name] = json.dumps(tree).encode()
    if name == "config.json":
        update_checksums(content)
    write(folder, content)
    check(folder, folder.parent / "saved")


def change_tensors(content, change):
    """Replace the initialisers (name to array) of the ONNX file in `content` by `change` of them; update checksums."""
    model = onnx.load_model_from_string(content["policy.onnx"])
    arrays = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    del model.graph.initializer[:]
    model.graph.initializer.extend(onnx.numpy_helper.from_array(array, name) for name, array in change(arrays).items())
    content["policy.onnx"] = model.SerializeToString()
    update_checksums(content)


@pytest.mark.parametrize("dtype", ["float64", "float16", "int64", "uint8", "bool", "complex64"])
def test_refuses_weights_of_another_type(original, folder, dtype):
    content = content_of(original)
    change_tensors(content, lambda arrays: {name: abs(array).astype(dtype) for name, array in arrays.items()})
    write(folder, content)
    assert not check(folder, folder.parent / "saved")


@pytest.mark.parametrize("scale", [1e-45, 1e-30, 1e10, 1e20, 1e38])
@pytest.mark.parametrize("part", ["actor_0_weight", "actor_1_bias", "actor_2_weight", "mean", "std"])
def test_scaled_weights_load_or_are_refused(original, folder, part, scale):
    content = content_of(original)
    change_tensors(content, lambda arrays: arrays | {part: np.float32(scale) * np.maximum(abs(arrays[part]), 1.0)})
    write(folder, content)
    check(folder, folder.parent / "saved")


@pytest.mark.parametrize("activation", ["elu", "relu", "tanh"])
def test_refuses_weights_that_could_overflow_unless_the_activation_is_bounded(activation):
    policy = small_policy()
    layers = [(weight * 1e20, bias) for weight, bias in policy.layers]
    interface = PolicyInterface(**{**vars(policy.interface), "activation": activation})
    if activation == "tanh":  # its output is bounded
        assert Policy(layers, policy.mean, policy.std, interface).act(OBSERVATIONS).isfinite().all()
        return
    with pytest.raises(PolicyError, match="overflow"):
        Policy(layers, policy.mean, policy.std, interface)
