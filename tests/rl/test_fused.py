"""The fused kernels in Triton's interpreter, where Triton is installed, against autograd in float64 and PyTorch."""

import dataclasses
import importlib.util

import pytest
import torch

from fused_runs import FUSED, NoiseTask, interpreted, iterations, minibatch_gradients, update_rank, whole_and_resumed
from jumper_warp.rl.fused import make_ppo
from jumper_warp.rl.mirror import symmetries_of
from jumper_warp.rl.networks import ActorCritic
from jumper_warp.rl.torch.ppo import Ppo
from ppo_oracle import reference_losses
from toy_task import PushTask, equal, free_port

needs_triton = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")
CASES = [
    {},
    {"symmetry": "actor"},
    {"clip_value": False, "hidden": (16,)},
    {"clip": 0.02, "hidden": (144, 16, 32)},
    {"hidden": (272, 16)},
    {"symmetry": "actor", "hidden": (32, 16)},
    {"symmetry": "both"},
    {"symmetry": "both", "hidden": (32, 16)},
]
CFGS = [dataclasses.replace(FUSED, **change) for change in CASES]


@pytest.fixture(scope="module")
def minibatches():
    """Results of `minibatch_gradients` for CFGS."""
    return interpreted(minibatch_gradients, CFGS)


@needs_triton
@pytest.mark.parametrize("case", range(len(CASES)), ids=str)
def test_gradients_agree_with_autograd_in_float64(case, minibatches):
    cfg, (state, part, old_log_std, gradients, losses) = CFGS[case], minibatches[case]
    model = ActorCritic(5, 3, cfg.hidden, num_critic_obs=7, symmetries=symmetries_of(NoiseTask(4), cfg.symmetry))
    model.load_state_dict(state)
    part = {name: value.double() for name, value in part.items()}
    *expected, kl = reference_losses(model.double(), part, old_log_std.double(), cfg)
    surrogate, value, entropy = expected
    (surrogate + cfg.value_coef * value - cfg.entropy_coef * entropy).backward()
    torch.testing.assert_close(losses[[0, 1, 2, 31]].double(), torch.stack([*expected, kl]), atol=1e-5, rtol=1e-5)
    for name, param in model.named_parameters():
        tolerance = 1e-6 * float(param.grad.abs().max()) + 1e-6  # sums of float32 products
        torch.testing.assert_close(gradients[name].double(), param.grad, atol=tolerance, rtol=1e-4, msg=name)
        assert param.grad.abs().max() > 1e-5, name


@needs_triton
def test_iteration_agrees_with_pytorch():
    cfgs = [dataclasses.replace(cfg, fused=fused) for cfg in (*CFGS[:2], CFGS[-1]) for fused in (True, False)]
    results = interpreted(iterations, cfgs)
    for fused, eager in zip(results[::2], results[1::2], strict=True):
        assert fused[0] and not eager[0]
        assert fused[3] == pytest.approx(eager[3], rel=1e-3, abs=1e-5)
        for ours, theirs in zip(fused[2], eager[2], strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
        for name, theirs in eager[1]["model"].items():
            if name != "actor.4.bias":  # the part of it that cancels in a symmetric policy follows rounding errors
                torch.testing.assert_close(fused[1]["model"][name], theirs, atol=1e-4, rtol=1e-4, msg=name)
        torch.testing.assert_close(fused[1]["lr"], eager[1]["lr"])
        assert fused[1]["optimiser"][0]["step"] == 2.0


@needs_triton
def test_resumed_training_is_bitwise_equal(tmp_path):
    whole, resumed = interpreted(whole_and_resumed, tmp_path)
    for part in ("ppo", "env", "rng"):
        assert equal(whole[part], resumed[part]), part


@needs_triton
def test_two_ranks_with_different_worlds_have_the_same_parameters(tmp_path):
    torch.multiprocessing.spawn(update_rank, (free_port(), str(tmp_path / "rank")), nprocs=2)
    states = [torch.load(tmp_path / f"rank{rank}", weights_only=True) for rank in range(2)]
    for part in ("model", "optimiser", "lr"):
        assert equal(states[0][part], states[1][part]), part
    assert not torch.equal(states[0]["action"], states[1]["action"])


# ---------------------------------------------------------------- without Triton


def test_cpu_and_no_fused_use_pytorch_silently(capsys, monkeypatch):
    assert type(make_ppo(PushTask(4), FUSED)) is Ppo
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert type(make_ppo(PushTask(4), dataclasses.replace(FUSED, fused=False))) is Ppo
    assert capsys.readouterr().err == ""
