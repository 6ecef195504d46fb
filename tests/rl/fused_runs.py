"""Short trainings with the fused kernels in Triton's interpreter, in a new process of a CPU."""

import dataclasses
import math
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.checkpoint import load_checkpoint
from jumper_warp.rl.distributed import init_distributed
from jumper_warp.rl.fused import make_ppo
from jumper_warp.rl.runner import CHECKPOINTS, train
from toy_task import PushTask, join, push_cfg

FUSED = PpoCfg(
    num_steps=4, epochs=1, minibatches=2, hidden=(48, 16), max_grad_norm=0.3, lr=3e-3, desired_kl=1e-4, fused=True
)


class NoiseTask(PushTask):
    """Random observations and rewards; observations are a part of wider rows, and some are not finite."""

    num_obs, num_critic_obs, num_actions = 5, 7, 3

    def __init__(self, num_envs, seed=0, device="cpu"):
        super().__init__(num_envs, seed, device)
        self.obs = torch.zeros(num_envs, 9, device=device)[:, 2:7]
        self.critic_obs = torch.zeros(num_envs, 7, device=device)
        self.final_obs, self.final_critic_obs = self.obs, self.critic_obs
        self.reset()

    def reset(self):
        for each in (self.obs, self.critic_obs):
            each.normal_().mul_(3.0).add_(1.0)
        self.obs[0, 1], self.critic_obs[1, 0], self.obs[2, 3] = 100.0, -100.0, 100.0

    def step(self, action):
        self.reset()
        self.reward.normal_()
        self.reward[3] = math.nan
        self.done.copy_((torch.rand_like(self.done) < 0.3).float())
        self.timeout.copy_(self.done * (torch.rand_like(self.done) < 0.5).float())

    def mirror(self, what, plane):
        if plane == "front-back":
            return ([0, 1, 2, 3, 4], [-1.0, -1.0, 1.0, 1.0, 1.0]) if what == "observation" else ([2, 1, 0], [1.0] * 3)
        if what == "observation":
            return [1, 0, 2, 4, 3], [1.0, 1.0, -1.0, -1.0, -1.0]
        return [2, 1, 0], [1.0, -1.0, 1.0]


def interpreted(function, *args):
    """Return the result of a function of this module, in a new process in which Triton interprets its kernels."""
    with ProcessPoolExecutor(1, get_context("spawn"), initializer=_interpret) as pool:
        return pool.submit(function, *args).result()


def _interpret():
    """Run Triton's kernels in its interpreter, on the CPU."""
    os.environ["TRITON_INTERPRET"] = "1"
    from jumper_warp.rl.fused import networks

    networks.SPLIT_ROWS = 8  # several splits of small minibatches


def minibatch_gradients(cfgs):
    """Return for each settings state of the model, samples, old log_std, gradients by name, and losses."""
    results = []
    for cfg in cfgs:
        torch.manual_seed(0)
        ppo = make_ppo(NoiseTask(12), cfg)
        ppo.collect()
        batch = ppo.batch()
        for segment in ppo.flat.segments:  # other weights than those that acted, and large actions
            segment.view(ppo.flat.value).add_(0.3 * torch.randn(segment.shape))
        ppo.networks.copy_weights()
        samples = torch.randperm(ppo.batch_size)[:21]
        ppo.fused.compute_gradient(samples)
        names = {id(param): name for name, param in ppo.model.named_parameters()}
        gradients = {names[id(param)]: param.grad.clone() for param in ppo.flat.params}
        part = {name: value[samples] for name, value in batch._asdict().items()}
        losses = ppo.flat.all_reduced[ppo.flat.size :].clone()
        results.append((ppo.state_dict()["model"], part, ppo.rollout.log_std.clone(), gradients, losses))
    return results


def iterations(cfgs):
    """Return for each settings parameters, batch, statistics and optimiser after an iteration and another rollout."""
    from jumper_warp.rl.fused.ppo import FusedPpo

    results = []
    for cfg in cfgs:
        torch.manual_seed(0)
        ppo = make_ppo(NoiseTask(8), cfg)
        ppo.compile()
        ppo.iterate()
        statistics = ppo.statistics()
        ppo.collect()
        batch = [part.float().clone() for part in ppo.batch()]
        state = ppo.state_dict()
        results.append((isinstance(ppo, FusedPpo), state, batch, statistics))
    return results


def whole_and_resumed(folder: Path):
    """Train for four iterations, then again from the second; return both last checkpoints."""
    cfg = push_cfg(folder, num_envs=8, ppo=dataclasses.replace(FUSED, symmetry="actor"))
    train(cfg, PushTask)
    (checkpoints,) = folder.glob(f"push/*/{CHECKPOINTS}")
    last = checkpoints / "iteration_000004.pt"
    whole = load_checkpoint(last)
    train(dataclasses.replace(cfg, resume=str(checkpoints / "iteration_000002.pt")), PushTask)
    return whole, load_checkpoint(last)


def update_rank(rank, port, path):
    """Iterate in one of two processes with different worlds, and save the state to path + rank."""
    _interpret()
    join(rank, port)
    init_distributed("cpu")
    torch.manual_seed(0)
    ppo = make_ppo(NoiseTask(4), FUSED)
    torch.manual_seed(1 + rank)
    ppo.compile()
    ppo.iterate()
    torch.save(ppo.state_dict() | {"action": ppo.rollout.action}, path + str(rank))
    torch.distributed.destroy_process_group()
