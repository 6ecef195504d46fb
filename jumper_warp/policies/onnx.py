"""ONNX files of policies: weights, normaliser and clipping as a graph, and the interface as metadata.

A policy's weights are saved only in this file. A weight of a mirror-symmetric actor is block diagonal with two equal
blocks. The file stores one block, and the graph pads it to the whole weight, which runtimes evaluate once, on loading.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError
from onnx import TensorProto, helper, numpy_helper

from jumper_warp.policies.policy import Policy, check_tensors
from jumper_warp.policies.spec import METADATA_VERSION, SOURCE_KEYS, PolicyError, PolicyInterface, checksum_entry
from jumper_warp.utils.files import write_atomically

OPSET = 18
IR_VERSION = 9
INPUT, OUTPUT = "obs", "actions"
OPERATORS = {"elu": "Elu", "relu": "Relu", "tanh": "Tanh"}
NORMALISER_TENSORS = {"mean": "normaliser.mean", "std": "normaliser.std"}
"""Names of the normaliser's tensors in `Policy.tensors`, by ONNX initialiser."""
LAYER_INITIALISER = re.compile(r"actor_(\d+)_(weight|bias|block)")
"""Pattern of the names of initialisers that hold a layer's weight, bias or repeated block."""


class _GraphBuilder:
    """Builder of an ONNX graph: collects nodes and constants; every method returns the name of its output."""

    def __init__(self) -> None:
        """Create an empty graph."""
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: Any, dtype: type = np.float32) -> str:
        """Add a constant (initialiser); value: a number or an array."""
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def add(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Add a node; inputs: names of its inputs; output: name of its output and of the node."""
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def weight(self, layer: int, value: np.ndarray) -> str:
        """Add a layer's weight, (out, in), to the graph; two equal blocks on its diagonal are stored once."""
        name, block = f"actor_{layer}_weight", _repeated_block(value)
        if block is None:
            return self.constant(name, value)
        stored, columns = self.constant(f"actor_{layer}_block", block), block.shape[1]
        halves = []
        for half, pads in (("upper", (0, 0, 0, columns)), ("lower", (0, columns, 0, 0))):
            pads_name = self.constant(f"{name}_{half}_pads", pads, np.int64)
            halves.append(self.add("Pad", [stored, pads_name], f"{name}_{half}"))
        return self.add("Concat", halves, name, axis=0)


def _repeated_block(weight: np.ndarray) -> np.ndarray | None:
    """Return the block that a mirror-symmetric layer's weight has twice on its diagonal, else None.

    The comparison is bitwise; the block is (out / 2, in / 2), and the rest of the weight zero.
    """
    rows, columns = (size // 2 for size in weight.shape)
    bits = weight.view(np.int32)
    if weight.shape != (2 * rows, 2 * columns) or bits[:rows, columns:].any() or bits[rows:, :columns].any():
        return None
    same = np.array_equal(bits[:rows, :columns], bits[rows:, columns:])
    return np.ascontiguousarray(weight[:rows, :columns]) if same else None


def onnx_model(policy: Policy, config: Mapping[str, Any] | None = None) -> onnx.ModelProto:
    """Return the ONNX model of a policy: `obs` (batch, num_obs) to `actions` (batch, num_actions), clipped to ±1.

    config: configuration with the commit for the metadata (default: the policy's own).
    """
    interface = policy.interface
    tensors = {name: tensor.numpy() for name, tensor in policy.tensors().items()}
    graph = _GraphBuilder()
    zero = graph.constant("zero", 0.0)

    def clip(name: str, limit: float, output: str) -> str:
        """Add a node that clips the tensor `name` to ± limit, with the name `output`."""
        bounds = [graph.constant(f"{output}_lower", -limit), graph.constant(f"{output}_upper", limit)]
        return graph.add("Clip", [name, *bounds], output)

    non_finite = graph.add("Or", [graph.add("IsNaN", [INPUT], "nan"), graph.add("IsInf", [INPUT], "infinite")], "bad")
    value = graph.add("Where", [non_finite, zero, INPUT], "finite")
    value = clip(value, interface.observation_limit, "limited")
    value = graph.add("Sub", [value, graph.constant("mean", tensors["normaliser.mean"])], "centred")
    value = graph.add("Div", [value, graph.constant("std", tensors["normaliser.std"])], "normalised")
    value = clip(value, interface.normalised_limit, "features")
    last = len(interface.sizes) - 2
    for i in range(last + 1):
        weight = graph.weight(i, tensors[f"actor.{i}.weight"])
        bias = graph.constant(f"actor_{i}_bias", tensors[f"actor.{i}.bias"])
        value = graph.add("Gemm", [value, weight, bias], f"linear_{i}", transB=1)
        if i < last:
            value = graph.add(OPERATORS[interface.activation], [value], f"activation_{i}")
    clip(value, 1.0, OUTPUT)

    sizes = ((INPUT, interface.sizes[0]), (OUTPUT, interface.sizes[-1]))
    infos = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size]) for name, size in sizes]
    network = helper.make_graph(graph.nodes, "policy", [infos[0]], [infos[1]], initializer=graph.constants)
    model = helper.make_model(
        network, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="jumper-warp"
    )
    helper.set_model_props(model, metadata(policy, policy.config if config is None else config))
    return model


def metadata(policy: Policy, config: Mapping[str, Any]) -> dict[str, str]:
    """Return the entries of the ONNX model's metadata, strings by key.

    `jumper_warp` is JSON with the whole `PolicyInterface`. The other entries repeat parts of it, comma-separated and
    unrounded, under the names that common deployment tools read. The network has no internal state: past frames are
    part of the observation, see `observation_layout`.
    """
    interface = policy.interface
    joints = ("joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "action_scale")
    lists = {name: getattr(interface, name) for name in (*joints, "observation_names")}
    commit = {key: config.get(key) for key in SOURCE_KEYS}
    full = {**commit, "schema_version": METADATA_VERSION, **interface.to_json()}
    entries = {name: ",".join(map(str, values)) for name, values in lists.items()}
    return entries | {"jumper_warp": json.dumps(full, ensure_ascii=False, allow_nan=False)}


def onnx_bytes(policy: Policy, config: Mapping[str, Any] | None = None) -> bytes:
    """Return a policy as the bytes of an ONNX file, validated and deterministic; arguments: see `onnx_model`."""
    model = onnx_model(policy, config)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def policy_from_onnx(data: bytes, interface: PolicyInterface, config: Mapping[str, Any]) -> Policy:
    """Load the policy in an ONNX file; inverts `onnx_bytes` bitwise.

    data: content of the file. interface, config: from config.json; graph and metadata must agree with them.
    Raises PolicyError: the file is damaged, its weights are not valid for the interface, or its graph, opset or
    metadata differ from the result of `onnx_model`.
    """
    model = onnx.ModelProto()
    try:
        model.ParseFromString(data)
    except DecodeError as error:
        raise PolicyError(f"the ONNX file cannot be read ({error!s:.100})") from error
    tensors = _read_tensors(model.graph.initializer)
    check_tensors(tensors, interface)
    layers = [(tensors[f"actor.{i}.weight"], tensors[f"actor.{i}.bias"]) for i in range(len(interface.sizes) - 1)]
    policy = Policy(layers, tensors["normaliser.mean"], tensors["normaliser.std"], interface, config)
    if onnx_model(policy).SerializeToString(deterministic=True) != model.SerializeToString(deterministic=True):
        raise PolicyError("the graph or metadata of the ONNX file differs from that of its weights and config.json")
    return policy


def _read_tensors(initialisers: Iterable[TensorProto]) -> dict[str, torch.Tensor]:
    """Return the tensors of normaliser and layers in initialisers, float32, by the names of `Policy.tensors`.

    Raises PolicyError: an initialiser is malformed.
    """
    tensors = {}
    for stored in initialisers:
        layer = LAYER_INITIALISER.fullmatch(str(stored.name))  # protobuf returns bytes if a name is not UTF-8
        if layer is None and stored.name not in NORMALISER_TENSORS:
            continue
        name = NORMALISER_TENSORS[stored.name] if layer is None else f"actor.{layer[1]}.{layer[2]}"
        if stored.data_type != TensorProto.FLOAT:
            raise PolicyError(f"{name} must hold floating-point numbers of 32 bits")
        try:
            tensor = torch.from_numpy(np.frombuffer(stored.raw_data, "<f4").reshape(tuple(stored.dims)).copy())
        except (ValueError, OverflowError) as error:
            raise PolicyError(f"{name}: number of values does not match its shape") from error
        if name.endswith(".block"):
            if tensor.dim() != 2:
                raise PolicyError(f"{name} must be a matrix, got shape {tuple(tensor.shape)!s:.60}")
            name, tensor = name.replace("block", "weight"), torch.block_diag(tensor, tensor)
        tensors[name] = tensor
    return tensors


def export_onnx(policy: Policy, path: Path) -> Path:
    """Write a policy as one ONNX file with its checksum, atomically, and return its path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    data = onnx_bytes(policy)
    write_atomically(path, data + checksum_entry(data))
    return path
