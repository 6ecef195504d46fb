"""Policies as ONNX: one file, normaliser and clipping baked in, and the policy's interface as metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from jumper_warp.policies.policy import Policy
from jumper_warp.utils.files import write_whole

OPSET = 18
IR_VERSION = 9
INPUT, OUTPUT = "obs", "actions"
OPERATORS = {"elu": "Elu", "relu": "Relu", "tanh": "Tanh"}
METADATA_VERSION = 2
"""2 lacks the entry observation_history, which was 1 even where terms hold frames of the past."""


class _Graph:
    """Collects nodes in a chain, and the constants that they read."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: Any) -> str:
        array = np.asarray(value, dtype=np.float32)
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def add(self, operator: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output


def onnx_model(policy: Policy, origin: Mapping[str, Any] | None = None) -> onnx.ModelProto:
    """Return the checked model of a policy: `obs` (batch, num_obs) to `actions` (batch, num_actions), clipped to ±1.

    origin: More entries of the metadata, as JSON holds them, such as the commit.
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
        names = [graph.constant(f"actor_{i}_{part}", tensors[f"actor.{i}.{part}"]) for part in ("weight", "bias")]
        value = graph.add("Gemm", [value, *names], f"linear_{i}", transB=1)
        if i < last:
            value = graph.add(OPERATORS[face.activation], [value], f"activation_{i}")
    clip(value, 1.0, OUTPUT)

    ends = ((INPUT, face.sizes[0]), (OUTPUT, face.sizes[-1]))
    infos = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size]) for name, size in ends]
    network = helper.make_graph(graph.nodes, "policy", [infos[0]], [infos[1]], initializer=graph.constants)
    model = helper.make_model(
        network, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="jumper-warp"
    )
    helper.set_model_props(model, metadata(policy, origin))
    onnx.checker.check_model(model, full_check=True)
    return model


def metadata(policy: Policy, origin: Mapping[str, Any] | None = None) -> dict[str, str]:
    """Return the entries of the model's metadata.

    `jumper_warp` is JSON with the whole `PolicyInterface`; the others repeat parts of it, comma-separated and
    unrounded, under the names that common deployment tools read. What the observation holds of the past is told by its
    `observation_layout`: the network itself remembers nothing.
    """
    face = policy.interface
    joints = ("joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "action_scale")
    lists = {name: getattr(face, name) for name in (*joints, "observation_names")}
    full = {**(origin or {}), "schema_version": METADATA_VERSION, **face.to_json()}
    entries = {name: ",".join(map(str, values)) for name, values in lists.items()}
    return entries | {"jumper_warp": json.dumps(full, ensure_ascii=False, allow_nan=False)}


def onnx_bytes(policy: Policy, origin: Mapping[str, Any] | None = None) -> bytes:
    """Return the file's content, the same for the same policy; see `onnx_model`."""
    return onnx_model(policy, origin).SerializeToString(deterministic=True)


def export_onnx(policy: Policy, path: Path) -> Path:
    """Write a policy as one ONNX file, whole or not at all; return its path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, onnx_bytes(policy, {key: policy.config.get(key) for key in ("commit", "dirty")}))
    return path
