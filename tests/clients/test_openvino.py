"""OpenVINO: a policy's ONNX file in single precision."""

import numpy as np
import openvino
import torch

from jumper_warp.policies.catalog import find_policy
from jumper_warp.policies.policy import Policy


def test_policy_acts_as_in_torch_with_single_precision():
    policy = Policy.load("vertical_jump")
    obs = np.random.default_rng(0).normal(0.0, 3.0, (64, len(policy.mean))).astype(np.float32)
    network = openvino.Core().compile_model(
        find_policy("vertical_jump") / "policy.onnx", "CPU", {"INFERENCE_PRECISION_HINT": "f32"}
    )
    actions = np.array([network(row[None])[0][0] for row in obs])
    np.testing.assert_allclose(actions, policy.act(torch.from_numpy(obs)), atol=1.0e-5)
    assert actions.std() > 0.1
