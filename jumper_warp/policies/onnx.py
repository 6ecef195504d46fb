"""ONNX files of policies: weights, normaliser and clipping as a graph, and the interface as metadata.

A policy's weights are saved only in this file. A weight of a mirror-symmetric actor is block diagonal with two equal
blocks. The file stores one block, and the graph pads it to the whole weight, which runtimes evaluate once, on loading.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import onnx
import torch
from google.protobuf.message import DecodeError
from onnx import TensorProto, helper, numpy_helper

from jumper_warp.policies.spec import METADATA_VERSION, SOURCE_KEYS, PolicyError, PolicyInterface
from jumper_warp.rl.checkpoint import DECODE_ERRORS

OPSET = 18
IR_VERSION = 9
INPUT, OUTPUT = "obs", "actions"  # Names of the graph's input and output
MAX_OUTPUT = 1.0e38  # Bound of layer outputs, below the largest float32
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
        name = f"actor_{layer}_weight"
        block = _repeated_block(value)
        if block is None:
            return self.constant(name, value)
        stored = self.constant(f"actor_{layer}_block", block)
        columns = block.shape[1]
        halves = []
        for half, pads in (("upper", (0, 0, 0, columns)), ("lower", (0, columns, 0, 0))):
            pads_name = self.constant(f"{name}_{half}_pads", pads, np.int64)
            halves.append(self.add("Pad", [stored, pads_name], f"{name}_{half}"))
        return self.add("Concat", halves, name, axis=0)


def _repeated_block(weight: np.ndarray) -> np.ndarray | None:
    """Return the block that a mirror-symmetric layer's weight has twice on its diagonal, else None.

    The comparison is bitwise, so that loading restores the same weight; the block is (out / 2, in / 2), and the rest of
    the weight zero.
    """
    rows, columns = (size // 2 for size in weight.shape)
    bits = weight.view(np.int32)
    if weight.shape != (2 * rows, 2 * columns) or bits[:rows, columns:].any() or bits[rows:, :columns].any():
        return None
    same = np.array_equal(bits[:rows, :columns], bits[rows:, columns:])
    return np.ascontiguousarray(weight[:rows, :columns]) if same else None


def onnx_model(
    tensors: Mapping[str, torch.Tensor], interface: PolicyInterface, config: Mapping[str, Any]
) -> onnx.ModelProto:
    """Return the ONNX model of a policy: `obs` (batch, num_obs) to `actions` (batch, num_actions), clipped to ±1.

    It computes the same as `Policy.act`. tensors: of normaliser and layers, see `Policy.tensors`. config: configuration
    with the commit for the metadata.
    """
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    graph = _GraphBuilder()
    zero = graph.constant("zero", 0.0)

    def clip(name: str, limit: float, output: str) -> str:
        """Add a node that clips the tensor `name` to ± limit, with the name `output`."""
        bounds = [graph.constant(f"{output}_lower", -limit), graph.constant(f"{output}_upper", limit)]
        return graph.add("Clip", [name, *bounds], output)

    non_finite = graph.add("Or", [graph.add("IsNaN", [INPUT], "nan"), graph.add("IsInf", [INPUT], "infinite")], "bad")
    value = graph.add("Where", [non_finite, zero, INPUT], "finite")
    value = clip(value, interface.observation_limit, "limited")
    value = graph.add("Sub", [value, graph.constant("mean", arrays["normaliser.mean"])], "centred")
    value = graph.add("Div", [value, graph.constant("std", arrays["normaliser.std"])], "normalised")
    value = clip(value, interface.normalised_limit, "features")
    last = len(interface.sizes) - 2
    for i in range(last + 1):
        weight = graph.weight(i, arrays[f"actor.{i}.weight"])
        bias = graph.constant(f"actor_{i}_bias", arrays[f"actor.{i}.bias"])
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
    helper.set_model_props(model, metadata(interface, config))
    return model


def metadata(interface: PolicyInterface, config: Mapping[str, Any]) -> dict[str, str]:
    """Return the entries of the ONNX model's metadata, strings by key.

    `jumper_warp` is JSON with the whole `PolicyInterface`. The other entries repeat parts of it, comma-separated and
    unrounded, under the names that common deployment tools read. The network has no internal state: past frames are
    part of the observation, see `observation_layout`.
    """
    joints = ("joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "action_scale")
    lists = {name: getattr(interface, name) for name in (*joints, "observation_names")}
    commit = {key: config.get(key) for key in SOURCE_KEYS}
    full = {**commit, "schema_version": METADATA_VERSION, **interface.to_json()}
    entries = {name: ",".join(map(str, values)) for name, values in lists.items()}
    return entries | {"jumper_warp": json.dumps(full, ensure_ascii=False, allow_nan=False)}


def onnx_bytes(tensors: Mapping[str, torch.Tensor], interface: PolicyInterface, config: Mapping[str, Any]) -> bytes:
    """Return a policy as the bytes of an ONNX file, validated and deterministic; arguments: see `onnx_model`."""
    model = onnx_model(tensors, interface, config)
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


def tensors_from_onnx(data: bytes, interface: PolicyInterface, config: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Return the tensors of a policy's ONNX file, float32, by the names of `Policy.tensors`; inverts `onnx_bytes`.

    The policy acts with its tensors, not with the graph: another graph than `onnx_model` makes of them is refused.
    data: content of the file. interface, config: from config.json; graph and metadata must agree with them.
    Raises PolicyError: the file is damaged, its tensors do not fit the interface (see `check_tensors`), or its graph,
    opset or metadata differ from the result of `onnx_model`.
    """
    model = onnx.ModelProto()
    try:
        model.ParseFromString(data)
        tensors = dict(map(_read_tensor, filter(_is_tensor, model.graph.initializer)))
    except (DecodeError, *DECODE_ERRORS) as error:
        raise PolicyError(f"the ONNX file cannot be read ({error!s:.100})") from error
    check_tensors(tensors, interface)
    rebuilt = onnx_model(tensors, interface, config)
    if rebuilt.SerializeToString(deterministic=True) != model.SerializeToString(deterministic=True):
        raise PolicyError("the graph or metadata of the ONNX file differs from that of its weights and config.json")
    return tensors


def _is_tensor(stored: TensorProto) -> bool:
    """Return whether an initialiser holds a tensor of the normaliser or of a layer."""
    return stored.name in NORMALISER_TENSORS or LAYER_INITIALISER.fullmatch(stored.name) is not None


def _read_tensor(stored: TensorProto) -> tuple[str, torch.Tensor]:
    """Return the name (see `Policy.tensors`) and the value of an initialiser; a repeated block becomes the weight."""
    if stored.data_location == TensorProto.EXTERNAL:
        raise ValueError(f"{stored.name} is in another file")
    tensor = torch.from_numpy(numpy_helper.to_array(stored).copy())
    name = NORMALISER_TENSORS.get(stored.name) or stored.name.replace("_", ".")
    if name.endswith(".block"):
        return name.replace("block", "weight"), torch.block_diag(tensor, tensor)
    return name, tensor


def check_tensors(tensors: Mapping[str, torch.Tensor], interface: PolicyInterface) -> None:
    """Raise PolicyError unless names (see `Policy.tensors`), shapes and values of tensors fit an interface."""
    sizes = interface.sizes
    expected = {"normaliser.mean": (sizes[0],), "normaliser.std": (sizes[0],)}
    for i in range(len(sizes) - 1):
        expected |= {f"actor.{i}.weight": (sizes[i + 1], sizes[i]), f"actor.{i}.bias": (sizes[i + 1],)}
    different = sorted(set(expected) ^ set(tensors))
    if different:
        raise PolicyError(f"configured layers are {sizes}; missing or unknown: {', '.join(different):.200}")
    for name, shape in expected.items():
        tensor = tensors[name]
        if tuple(tensor.shape) != shape or tensor.dtype != torch.float32:
            raise PolicyError(f"{name} must be float32 of shape {shape}, got {tensor.dtype} of {tuple(tensor.shape)}")
        if not tensor.isfinite().all():
            raise PolicyError(f"{name} is not finite")
    if not (tensors["normaliser.std"] > 0.0).all():
        raise PolicyError("normaliser.std must be positive")
    _check_overflow(tensors, interface)


def _check_overflow(tensors: Mapping[str, torch.Tensor], interface: PolicyInterface) -> None:
    """Raise PolicyError if a layer's output could overflow float32 for some observation, by interval bounds.

    So no observation can make an action NaN: the features are clipped, and each layer's bound follows from the last.
    """
    bound = torch.full((interface.sizes[0],), interface.normalised_limit, dtype=torch.float64)
    for i in range(len(interface.sizes) - 1):
        bound = tensors[f"actor.{i}.weight"].double().abs() @ bound + tensors[f"actor.{i}.bias"].double().abs()
        if not bound.max() < MAX_OUTPUT:
            raise PolicyError(f"the weights of layer {i} are so large that its outputs may overflow")
        # an activation's output is at most its input, or 1
        bound = torch.ones_like(bound) if interface.activation == "tanh" else bound.clamp(min=1.0)
