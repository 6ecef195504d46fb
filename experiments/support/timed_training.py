"""The time that a training takes to a success, in a process of its own."""

from __future__ import annotations

from typing import Any

import torch

from jumper_warp.envs.env import Env
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.ppo import Ppo
from jumper_warp.tasks.cfg import TaskCfg
from support.learning import Curve, learning_curve, make_judge, success, warm_up
from support.timing import process_age


def timed_training(task: TaskCfg, cfg: PpoCfg, args: Any, seed: int) -> Curve:
    """Train, and return the curve with the time from the start of this process until the training was ready.

    args: envs, device, randomize, jumps, seconds, every and heights, as `experiments/learning_curves.py` has them.
    """
    torch.manual_seed(seed)
    env = Env(task, args.envs, seed=seed, device=args.device, randomize=args.randomize, noise=args.randomize)
    ppo = Ppo(env, cfg)
    warm_up(env, ppo)
    ready, judge = process_age(), make_judge(task, args.jumps, args.device)
    success(ppo, judge)
    curve = learning_curve(env, ppo, judge, args.seconds, args.every, args.heights)
    curve.ready = ready
    return curve
