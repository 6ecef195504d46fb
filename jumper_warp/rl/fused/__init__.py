"""PPO's rollout and update in a few Triton kernels, on GPUs of compute capability 8.0 or higher."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.learner import Learner
from jumper_warp.rl.torch.ppo import Ppo


def make_ppo(env: VecEnv, cfg: PpoCfg) -> Learner:
    """Return the PPO learner of an environment: `FusedPpo` if `use_fused` returns True, else `Ppo`.

    Raises InputError as `Learner`.
    """
    if not use_fused(cfg, env.device):
        return Ppo(env, cfg)
    from jumper_warp.rl.fused.ppo import FusedPpo  # imports Triton

    return FusedPpo(env, cfg)


def use_fused(cfg: PpoCfg, device: torch.device) -> bool:
    """Return whether to train with the fused kernels; if GPU, settings or installation rule them out, print the reason.

    A CPU uses them only in tests, in Triton's interpreter (environment variable TRITON_INTERPRET=1).
    """
    if not cfg.fused or (device.type == "cpu" and os.environ.get("TRITON_INTERPRET") != "1"):
        return False
    if reason := _obstacle(cfg, device):
        print(f"PPO trains with PyTorch, more slowly than with fused kernels: {reason}", file=sys.stderr)
    return not reason


def _obstacle(cfg: PpoCfg, device: torch.device) -> str:
    """Return why the fused kernels cannot train with the settings on the device; empty if they can."""
    if device.type == "cuda" and (capability := torch.cuda.get_device_capability(device)) < (8, 0):
        return f"they need compute capability 8.0, the GPU has {'.'.join(map(str, capability))}"
    if cfg.activation != "elu":
        return f"they need the activation elu, got {cfg.activation}"
    if any(width % 16 for width in cfg.hidden):
        return f"they need hidden widths that are multiples of 16, got {', '.join(map(str, cfg.hidden))}"
    if not importlib.util.find_spec("triton"):
        return "Triton is not installed"
    compilers = filter(None, (os.environ.get("CC"), "gcc", "clang"))
    return "" if any(map(shutil.which, compilers)) else "Triton needs a C compiler, such as gcc"
