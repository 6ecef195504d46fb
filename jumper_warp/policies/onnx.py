"""Policies as ONNX: one file with the weights, the normaliser, all clipping, and the policy's interface as metadata.

The file is the one place that keeps the weights of a policy. A layer of a mirror-symmetric actor has the same block
twice on its diagonal and zeros elsewhere: the file keeps one block, and the graph pads it to the whole weight, which
runtimes do once, when they load the file.
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
from jumper_warp.policies.spec import PolicyError, PolicyInterface
from jumper_warp.utils.files import write_atomically

OPSET = 18
IR_VERSION = 9
INPUT, OUTPUT = "obs", "actions"
OPERATORS = {"elu": "Elu", "relu": "Relu", "tanh": "Tanh"}
METADATA_VERSION = 2
ORIGIN = ("commit", "dirty")
"""Entries of a policy's configuration that its metadata repeats."""
STORED = {"mean": "normaliser.mean", "std": "normaliser.std"}
"""Initialisers: the tensors of the normaliser that they hold."""
LAYER = re.compile(r"actor_(\d+)_(weight|bias|block)")
"""Initialisers that hold a layer."""


class _Graph:
    """Collects nodes in a chain, and the constants that they read."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: Any, dtype: type = np.float32) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def add(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def weight(self, layer: int, value: np.ndarray) -> str:
        """Add the weight of a layer, (out, in), by its block where it has the same one twice on its diagonal."""
        name, block = f"actor_{layer}_weight", _block(value)
        if block is None:
            return self.constant(name, value)
        stored, columns = self.constant(f"actor_{layer}_block", block), block.shape[1]
        halves = []
        for half, pads in (("upper", (0, 0, 0, columns)), ("lower", (0, columns, 0, 0))):
            place = self.constant(f"{name}_{half}_pads", pads, np.int64)
            halves.append(self.add("Pad", [stored, place], f"{name}_{half}"))
        return self.add("Concat", halves, name, axis=0)


def _block(weight: np.ndarray) -> np.ndarray | None:
    """Return the block (out / 2, in / 2) that a weight has twice on its diagonal, bit by bit, or None."""
    rows, columns = (size // 2 for size in weight.shape)
    bits = weight.view(np.int32)
    if weight.shape != (2 * rows, 2 * columns) or bits[:rows, columns:].any() or bits[rows:, :columns].any():
        return None
    same = np.array_equal(bits[:rows, :columns], bits[rows:, columns:])
    return np.ascontiguousarray(weight[:rows, :columns]) if same else None


def onnx_model(policy: Policy, config: Mapping[str, Any] | None = None) -> onnx.ModelProto:
    """Return the model of a policy: `obs` (batch, num_obs) to `actions` (batch, num_actions), clipped to ±1.

    config: Names the commit (default: the policy's own configuration).
    """
    face = policy.interface
    tensors = {name: tensor.numpy() for name, tensor in policy.tensors().items()}
    graph = _Graph()
    zero = graph.constant("zero", 0.0)

    def clip(name: str, limit: float, output: str) -> str:
        bounds = [graph.constant(f"{output}_lower", -limit), graph.constant(f"{output}_upper", limit)]
        return graph.add("Clip", [name, *bounds], output)

    bad = graph.add("Or", [graph.add("IsNaN", [INPUT], "nan"), graph.add("IsInf", [INPUT], "infinite")], "bad")
    value = graph.add("Where", [bad, zero, INPUT], "finite")
    value = clip(value, face.observation_limit, "limited")
    value = graph.add("Sub", [value, graph.constant("mean", tensors["normaliser.mean"])], "centred")
    value = graph.add("Div", [value, graph.constant("std", tensors["normaliser.std"])], "normalised")
    value = clip(value, face.normalised_limit, "features")
    last = len(face.sizes) - 2
    for i in range(last + 1):
        weight = graph.weight(i, tensors[f"actor.{i}.weight"])
        bias = graph.constant(f"actor_{i}_bias", tensors[f"actor.{i}.bias"])
        value = graph.add("Gemm", [value, weight, bias], f"linear_{i}", transB=1)
        if i < last:
            value = graph.add(OPERATORS[face.activation], [value], f"activation_{i}")
    clip(value, 1.0, OUTPUT)

    ends = ((INPUT, face.sizes[0]), (OUTPUT, face.sizes[-1]))
    infos = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size]) for name, size in ends]
    network = helper.make_graph(graph.nodes, "policy", [infos[0]], [infos[1]], initializer=graph.constants)
    model = helper.make_model(
        network, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="jumper-warp"
    )
    helper.set_model_props(model, metadata(policy, policy.config if config is None else config))
    return model


def metadata(policy: Policy, config: Mapping[str, Any]) -> dict[str, str]:
    """Return the entries of the model's metadata.

    `jumper_warp` is JSON with the whole `PolicyInterface`; the others repeat parts of it, comma-separated and
    unrounded, under the names that common deployment tools read. What the observation holds of the past is told by its
    `observation_layout`: the network itself remembers nothing.
    """
    face = policy.interface
    joints = ("joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "action_scale")
    lists = {name: getattr(face, name) for name in (*joints, "observation_names")}
    origin = {key: config.get(key) for key in ORIGIN}
    full = {**origin, "schema_version": METADATA_VERSION, **face.to_json()}
    entries = {name: ",".join(map(str, values)) for name, values in lists.items()}
    return entries | {"jumper_warp": json.dumps(full, ensure_ascii=False, allow_nan=False)}


def onnx_bytes(policy: Policy, config: Mapping[str, Any] | None = None) -> bytes:
    """Return the file's content, checked, the same for the same policy; see `onnx_model`."""
    model = onnx_model(policy, config)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def policy_from_onnx(data: bytes, interface: PolicyInterface, config: Mapping[str, Any]) -> Policy:
    """Return the policy that `onnx_bytes` wrote, bitwise.

    interface, config: those of the policy, from elsewhere; the graph and the metadata of the file must be of these.

    Raises PolicyError: the file is damaged, its weights are not those of a usable policy of the interface, or its
    graph, its opset or its metadata differ from what `onnx_model` makes of them.
    """
    model = onnx.ModelProto()
    try:
        model.ParseFromString(data)
    except DecodeError as error:
        raise PolicyError(f"the ONNX file cannot be read ({error!s:.100})") from error
    tensors = _tensors(model.graph.initializer)
    check_tensors(tensors, interface)
    layers = [(tensors[f"actor.{i}.weight"], tensors[f"actor.{i}.bias"]) for i in range(len(interface.sizes) - 1)]
    policy = Policy(layers, tensors["normaliser.mean"], tensors["normaliser.std"], interface, config)
    if onnx_model(policy).SerializeToString(deterministic=True) != model.SerializeToString(deterministic=True):
        raise PolicyError("the graph or the metadata of the ONNX file is not what these weights and config.json make")
    return policy


def _tensors(initialisers: Iterable[TensorProto]) -> dict[str, torch.Tensor]:
    """Return the normaliser and the layers that initialisers hold, by their names in a policy."""
    found = {}
    for stored in initialisers:
        layer = LAYER.fullmatch(str(stored.name))  # protobuf gives bytes where a name is no UTF-8
        if layer is None and stored.name not in STORED:
            continue
        name = STORED[stored.name] if layer is None else f"actor.{layer[1]}.{layer[2]}"
        if stored.data_type != TensorProto.FLOAT:
            raise PolicyError(f"{name} must hold floating-point numbers of 32 bits")
        try:
            tensor = torch.from_numpy(np.frombuffer(stored.raw_data, "<f4").reshape(tuple(stored.dims)).copy())
        except (ValueError, OverflowError) as error:
            raise PolicyError(f"{name} does not hold as many numbers as its shape needs") from error
        if name.endswith(".block"):
            if tensor.dim() != 2:
                raise PolicyError(f"{name} must be a matrix, it has shape {tuple(tensor.shape)!s:.60}")
            name, tensor = name.replace("block", "weight"), torch.block_diag(tensor, tensor)
        found[name] = tensor
    return found


def export_onnx(policy: Policy, path: Path) -> Path:
    """Write a policy as one ONNX file, whole or not at all; return its path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, onnx_bytes(policy))
    return path
