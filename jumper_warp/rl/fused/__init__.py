"""PPO's rollout and update in a few Triton kernels, on GPUs of compute capability 9.0 or higher; opt-in."""

from __future__ import annotations

import importlib.util
import os
import sys

import torch

from jumper_warp.envs.vec_env import VecEnv
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.ppo import Ppo


def make_ppo(env: VecEnv, cfg: PpoCfg) -> Ppo:
    """Return PPO on an environment, with the fused kernels if `PpoCfg.fused` is set and the device can use them.

    Raises InputError as `Ppo`.
    """
    if not use_fused(cfg, env.device):
        return Ppo(env, cfg)
    from jumper_warp.rl.fused.ppo import FusedPpo  # imports Triton

    return FusedPpo(env, cfg)


def use_fused(cfg: PpoCfg, device: torch.device) -> bool:
    """Return whether to train with the fused kernels; prints the reason if a GPU cannot use them.

    A CPU uses them only in tests, in Triton's interpreter (environment variable TRITON_INTERPRET=1).
    """
    if not cfg.fused or (device.type == "cpu" and os.environ.get("TRITON_INTERPRET") != "1"):
        return False
    if reason := _obstacle(cfg, device):
        print(f"--ppo.fused has no effect: {reason}", file=sys.stderr)
    return not reason


def _obstacle(cfg: PpoCfg, device: torch.device) -> str:
    """Return why the fused kernels cannot train with the settings on the device; empty if they can."""
    if device.type == "cuda" and (capability := torch.cuda.get_device_capability(device)) < (9, 0):
        return f"compute capability 9.0 needed, the GPU has {'.'.join(map(str, capability))}"
    if cfg.activation != "elu":
        return f"activation elu needed, got {cfg.activation}"
    if any(width % 16 for width in cfg.hidden):
        return f"hidden widths must be multiples of 16, got {', '.join(map(str, cfg.hidden))}"
    return "" if importlib.util.find_spec("triton") else "Triton is not installed"
