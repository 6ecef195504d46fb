"""Weight averaging of two policies."""

import pytest
import torch

from jumper_warp.cli.main import main
from jumper_warp.policies.policy import Policy, blend, save_policy
from jumper_warp.policies.spec import PolicyError

HORIZONTAL = Policy.load("horizontal_jump")


@pytest.fixture(scope="module")
def other():
    """Horizontal-jump policy with perturbed layers and another normaliser."""
    torch.manual_seed(3)
    layers = [(weight + 0.05 * torch.randn_like(weight), bias + 0.1) for weight, bias in HORIZONTAL.layers]
    mean, std = HORIZONTAL.mean + 0.2 * HORIZONTAL.std, 1.5 * HORIZONTAL.std
    return Policy(layers, mean, std, HORIZONTAL.interface, HORIZONTAL.config)


@pytest.fixture(scope="module")
def obs():
    """(200, 147) observations within 5 standard deviations of HORIZONTAL."""
    return HORIZONTAL.mean + HORIZONTAL.std * torch.randn(200, 147, generator=torch.manual_seed(1)).clamp(-5.0, 5.0)


def test_blend_equals_each_policy_at_fractions_0_and_1(other, obs):
    assert (HORIZONTAL.act(obs) - other.act(obs)).abs().mean() > 0.1
    torch.testing.assert_close(blend(HORIZONTAL, other, 0.0).act(obs), HORIZONTAL.act(obs), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(blend(HORIZONTAL, other, 1.0).act(obs), other.act(obs), atol=1e-4, rtol=0.0)


def test_blend_interpolates_the_weights(other):
    same = Policy(other.layers, HORIZONTAL.mean, HORIZONTAL.std, other.interface)
    blended = blend(HORIZONTAL, same, 0.3).layers
    for blended_layer, layer, other_layer in zip(blended, HORIZONTAL.layers, same.layers, strict=True):
        for result, tensor, other_tensor in zip(blended_layer, layer, other_layer, strict=True):
            torch.testing.assert_close(result, 0.7 * tensor + 0.3 * other_tensor)


def test_blend_records_fraction_and_origin_in_its_configuration(other):
    origin = blend(HORIZONTAL, other, 0.3).config["blended"]
    assert origin == {"share": 0.3, "commit": other.config["commit"], "iteration": other.config["iteration"]}


def test_blend_refuses_invalid_fractions_and_other_interfaces():
    with pytest.raises(PolicyError, match=r"fraction of a blend must be from 0 to 1, got 1\.1"):
        blend(HORIZONTAL, HORIZONTAL, 1.1)
    with pytest.raises(PolicyError, match="must have the same interface"):
        blend(HORIZONTAL, Policy.load("vertical_jump"), 0.5)


def test_export_command_writes_a_blend(other, obs, tmp_path):
    save_policy(tmp_path / "other", other)
    main(["export", "horizontal_jump", "--blend", str(tmp_path / "other"), "0.25", "--out", str(tmp_path / "blend")])
    expected = blend(HORIZONTAL, other, 0.25).act(obs)
    torch.testing.assert_close(Policy.load(tmp_path / "blend").act(obs), expected, atol=1e-6, rtol=0.0)
