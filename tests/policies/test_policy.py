import dataclasses
import hashlib
import json
import math

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from jumper_warp.envs.vec_env import RAW_LIMIT
from jumper_warp.policies import catalog
from jumper_warp.policies.catalog import find_policy
from jumper_warp.policies.policy import Policy, export_onnx, load_policy, save_policy
from jumper_warp.policies.spec import PolicyError, PolicyInterface, checksum_entry
from jumper_warp.rl.networks import ActorCritic, linear_layers
from jumper_warp.robot.motors import vertical_jump_filter
from jumper_warp.utils import assets
from jumper_warp.utils.assets import policy_tasks

FILTER = dataclasses.asdict(vertical_jump_filter())
TERM = {"first": 0, "end": 1, "scale": 1.0, "clip": 1.0, "history": 1}


def make_interface(num_obs=1, num_actions=1, hidden=(1,), **changes):
    """Return an interface of these sizes with made-up values; changes: of its fields."""
    values = {
        "task": "vertical-jump",
        "observation_names": tuple(f"obs_{i}" for i in range(num_obs)),
        "joint_names": tuple(f"motor_{i}" for i in range(num_actions)),
        "command_filter": FILTER,
        "policy_dt": 1.0 / 60.0,
        "physics_dt": 1.0 / 480.0,
        "hidden": hidden,
    }
    per_joint = ("action_scale", "default_joint_pos", "joint_stiffness", "joint_damping", "torque_limit")
    values |= {name: tuple(0.1 * (i + 1) for i in range(num_actions)) for name in per_joint}
    return PolicyInterface(**(values | changes))


def scalar_policy(out_weight=1.0):
    """Return the policy obs -> (obs - 1) / 2 -> elu(x - 2) -> out_weight * x."""
    one = torch.ones(1, 1)
    layers = [(one, torch.tensor([-2.0])), (out_weight * one, torch.zeros(1))]
    return Policy(layers, torch.tensor([1.0]), torch.tensor([2.0]), make_interface())


@pytest.fixture(scope="module")
def model():
    """`ActorCritic` with statistics of 48 observations with various means and scales."""
    torch.manual_seed(3)
    model = ActorCritic(48, 12, (64, 32))
    model.obs_moments.update(torch.randn(1000, 48) * torch.linspace(0.1, 5.0, 48) + torch.linspace(-3.0, 3.0, 48))
    with torch.no_grad():
        model.actor[-1].weight.mul_(100.0)  # from the tiny initial weights to actions that reach the limits
    return model


@pytest.fixture(scope="module")
def trained(model):
    """Policy of `model`."""
    mean, std = model.obs_moments.mean, model.obs_moments.scaling().std
    config = {"env": {"seed": 5}, "commit": "abc"}
    return Policy(linear_layers(model.actor), mean, std, make_interface(48, 12, (64, 32)), config)


@pytest.fixture(scope="module")
def observations():
    """(9, 48) observations: ordinary, very large and not finite."""
    torch.manual_seed(4)
    obs = 4.0 * torch.randn(9, 48)
    obs[1, 3], obs[2, 4], obs[3, 5], obs[4, 6] = math.nan, math.inf, -math.inf, 1.0e13
    return obs


@pytest.fixture
def folder(trained, tmp_path):
    """Saved folder of `trained`."""
    return save_policy(tmp_path / "jump", trained)


def replace_file(folder, name, data):
    """Write `data` to a file of a policy's folder, and its checksum to the manifest."""
    (folder / name).write_bytes(data)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["sha256"][name] = hashlib.sha256(data).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(manifest))


def edit_json(folder, name, change):
    """Apply `change` in place to the object in a JSON file of a policy's folder, with a valid checksum."""
    content = json.loads((folder / name).read_text())
    change(content)
    data = json.dumps(content).encode()
    if name == "manifest.json":
        (folder / name).write_bytes(data)
    else:
        replace_file(folder, name, data)


def edit_manifest(change):
    """Return a function that applies `change` to the manifest of a policy's folder."""
    return lambda folder: edit_json(folder, "manifest.json", change)


def edit_config(change):
    """Return a function that applies `change` to the configuration in a policy's folder."""
    return lambda folder: edit_json(folder, "config.json", change)


# ---------------------------------------------------------------------- acting


def test_action_agrees_with_hand_calculation():  # elu((3 - 1) / 2 - 2) = exp(-1) - 1
    assert scalar_policy().act(torch.tensor([[3.0]])).item() == pytest.approx(math.exp(-1.0) - 1.0, abs=1e-6)


def test_action_is_clipped_to_1():  # from 10 (exp(-1) - 1) = -6.3
    assert scalar_policy(10.0).act(torch.tensor([3.0])).item() == -1.0


def test_normalised_observation_is_limited_to_ten_standard_deviations():
    policy = scalar_policy(0.1)  # (90 - 1) / 2 = 44.5, limited to 10, minus 2, times 0.1
    assert policy.act(torch.tensor([90.0])).item() == pytest.approx(0.8, abs=1e-6)


def test_policy_agrees_with_the_trained_network_bitwise(model, trained, observations):
    bounded = observations.nan_to_num(0.0, 0.0, 0.0).clamp(-RAW_LIMIT, RAW_LIMIT)  # as `Env` returns them
    assert torch.equal(trained.act(observations), model.act(bounded))
    actions = trained.act(observations).abs()
    assert (actions == 1.0).any() and (actions < 1.0).any()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_observation_counts_as_zero(bad):
    assert scalar_policy().act(torch.tensor([bad])) == scalar_policy().act(torch.tensor([0.0]))


def test_float64_observations_are_clamped_before_conversion():
    policy = scalar_policy(0.1)
    assert policy.act(torch.tensor([1.0e300], dtype=torch.float64)) == policy.act(torch.tensor([100.0]))


# ---------------------------------------------------------------------- saving and loading


def test_saved_policy_loads_bitwise(trained, folder, observations):
    loaded = load_policy(folder)
    assert loaded.interface == trained.interface
    assert loaded.config["env"] == {"seed": 5} and loaded.config["commit"] == "abc"
    assert torch.equal(loaded.act(observations), trained.act(observations))
    assert {path.name for path in folder.iterdir()} == {"config.json", "policy.onnx", "manifest.json", "README.md"}


def test_existing_policy_is_replaced_only_with_overwrite(folder, trained):
    (folder / "old.txt").write_text("old")
    with pytest.raises(PolicyError, match="exists"):
        save_policy(folder, trained)
    save_policy(folder, trained, overwrite=True)
    assert load_policy(folder) and not (folder / "old.txt").exists()
    assert [path.name for path in folder.parent.iterdir()] == ["jump"]


def test_folder_without_a_policy_is_never_replaced(tmp_path, trained):
    (tmp_path / "mine.txt").touch()
    with pytest.raises(PolicyError, match="not a policy's"):
        save_policy(tmp_path, trained, overwrite=True)
    assert (tmp_path / "mine.txt").exists()


def test_project_policies_are_found_by_name(tmp_path, trained, monkeypatch):
    for module in (assets, catalog):
        monkeypatch.setattr(module, "POLICIES", tmp_path)
    save_policy(tmp_path / "vertical_jump", trained)
    assert policy_tasks() == {"vertical_jump": trained.interface.task}
    assert load_policy("vertical-jump").interface == trained.interface
    with pytest.raises(PolicyError, match=r"no policy 'walk'; there are vertical_jump$"):
        load_policy("walk")


def change_model(change):
    """Return a function that applies `change` to the ONNX model in a policy's folder, with a valid checksum."""

    def changed(folder):
        model = onnx.load(folder / "policy.onnx")
        change(model)
        replace_file(folder, "policy.onnx", model.SerializeToString())

    return changed


def set_nan(model):
    """Write NaN into the first bias."""
    bias = next(tensor for tensor in model.graph.initializer if tensor.name == "actor_0_bias")
    bias.CopyFrom(onnx.numpy_helper.from_array(np.full(64, np.nan, np.float32), bias.name))


NOT_REPRODUCIBLE = "the graph or metadata of the ONNX file differs from that of its weights and config.json"
REFUSALS = {
    "manifest missing": (lambda f: (f / "manifest.json").unlink(), "manifest.json: no such file"),
    "older version": (
        edit_manifest(lambda m: m.update(schema_version=2)),
        "has version 2, expected version 3; commit 05fa856 reads version 2",
    ),
    "file of another folder": (edit_manifest(lambda m: m["sha256"].update({"../x": "0"})), "names a file '../x'"),
    "weights in another file": (
        change_model(lambda m: [setattr(weight, "data_location", 1) for weight in m.graph.initializer]),
        "is in another file",
    ),
    "truncated": (
        lambda f: (f / "policy.onnx").write_bytes((f / "policy.onnx").read_bytes()[:-4]),
        "policy.onnx: truncated or altered",
    ),
    "NaN": (change_model(set_nan), "actor.0.bias is not finite"),
    "another operator": (change_model(lambda m: setattr(m.graph.node[8], "op_type", "Relu")), NOT_REPRODUCIBLE),
    "config of another interface": (edit_config(lambda c: c["interface"].update(policy_dt=0.02)), NOT_REPRODUCIBLE),
}  # fmt: skip
"""A function that damages a policy's folder (of `trained`), and the error message, by name."""


@pytest.mark.parametrize("case", REFUSALS)
def test_refuses_an_invalid_policy_folder_in_one_line(folder, case):
    damage, message = REFUSALS[case]
    damage(folder)
    with pytest.raises(PolicyError, match=message) as refusal:
        load_policy(folder)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"physics_dt": 0.1}, "physics_dt must be at most policy_dt"),
        ({"command_filter": FILTER | {"sum": FILTER["lateral"] | {"lower": 20.0}}}, "sum: lower limit must be below"),
        ({"action_scale": (-0.1,)}, "action_scale must lie in 0.0001 to 6.283, got -0.1"),
        ({"torque_limit": (1.0, 2.0)}, "torque_limit needs 1 numbers"),
        ({"observation_layout": {"a": TERM | {"end": 2}}}, "observation_layout has 2 columns, the observation 1"),
        ({"observation_layout": {"a": TERM | {"scale": math.nan}}}, "scale must lie in 1e-6 to 1e6, got nan"),
        ({"quaternion_order": "wxyz"}, "quaternion_order must be xyzw"),
        ({"command_filter": FILTER | {"horizon": True}}, "command_filter must hold numbers"),
    ],
)
def test_refuses_an_invalid_interface(change, message):
    with pytest.raises(PolicyError, match=message):
        make_interface(**change)


@pytest.mark.parametrize("activation", ["elu", "relu", "tanh"])
def test_refuses_weights_that_could_overflow_unless_the_activation_is_bounded(activation):
    layers = [(torch.full((4, 1), 1e20), torch.zeros(4)), (torch.full((1, 4), 1e20), torch.zeros(1))]
    interface, std = make_interface(hidden=(4,), activation=activation), torch.ones(1)
    if activation == "tanh":  # its output is bounded
        assert Policy(layers, 0.0 * std, std, interface).act(torch.tensor([1e30])).isfinite().all()
        return
    with pytest.raises(PolicyError, match="overflow"):
        Policy(layers, 0.0 * std, std, interface)


# ---------------------------------------------------------------------- ONNX


@pytest.mark.parametrize("batch", [1, 9])
def test_onnx_runtime_agrees_with_torch(folder, trained, observations, batch):
    session = onnxruntime.InferenceSession(str(folder / "policy.onnx"), providers=["CPUExecutionProvider"])
    obs = observations[:batch]
    actions = session.run(["actions"], {"obs": obs.numpy()})[0]
    assert actions.shape == (batch, 12)
    np.testing.assert_allclose(actions, trained.act(obs).numpy(), rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_onnx_runtime_agrees_with_other_activations(tmp_path, activation):
    torch.manual_seed(0)
    interface = make_interface(4, 2, (8, 8), activation=activation)
    layers = [(torch.randn(o, i), torch.randn(o)) for i, o in ((4, 8), (8, 8), (8, 2))]
    policy = Policy(layers, torch.randn(4), torch.rand(4) + 0.1, interface)
    session = onnxruntime.InferenceSession(str(export_onnx(policy, tmp_path / "p.onnx")))
    obs = torch.randn(5, 4)
    np.testing.assert_allclose(session.run(None, {"obs": obs.numpy()})[0], policy.act(obs).numpy(), atol=1e-5)


@pytest.mark.parametrize("name", policy_tasks())
def test_shipped_onnx_metadata_equals_the_interface(name):
    entries = {entry.key: entry.value for entry in onnx.load(find_policy(name) / "policy.onnx").metadata_props}
    full = json.loads(entries["jumper_warp"])
    interface = json.loads(json.dumps(load_policy(name).interface.to_json()))
    assert {key: full[key] for key in interface} == interface and interface["observation_layout"]
    assert set(full) - set(interface) == {"commit", "dirty", "schema_version"}


def test_onnx_is_one_file_and_reproducible(folder):
    model = onnx.load(folder / "policy.onnx", load_external_data=False)
    assert all(tensor.data_location == onnx.TensorProto.DEFAULT for tensor in model.graph.initializer)
    export_onnx(load_policy(folder), folder / "again.onnx")
    data = (folder / "policy.onnx").read_bytes()
    assert (folder / "again.onnx").read_bytes() == data + checksum_entry(data)
