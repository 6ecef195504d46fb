"""Check and time PPO's update by fused Triton kernels on random observations, and write metrics.

    python experiments/fused_update.py --out outputs/fused_update

It needs a GPU of compute capability 8.0 or higher. Gradients of a minibatch are compared with autograd in
float64 on the same samples, without and with the mirror-symmetric actor. Products of bfloat16 cause errors of 0.6 %
for the critic. For the actor they are 2 to 11 %, since rounding moves 0.4 % of the samples across the bounds of the
clipping, in a test with large actions; in CPU emulation with small actions they are 1 to 2 %. Two trainings with one
seed must be bitwise equal. Times are of the fused and of the eager update, as CUDA graphs; the environment's steps are
empty. `benchmark_training.py --only-ppo --variants eager` times whole trainings.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import torch
import warp as wp

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.fused import make_ppo, use_fused
from jumper_warp.rl.learner import Learner
from jumper_warp.rl.networks import gaussian_log_prob, linear_layers
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import output_dir, write_metrics
from jumper_warp.utils.runtime import configure_device
from support.scripts import DeviceArgs, report, run_script
from support.timing import median_time

if TYPE_CHECKING:
    from jumper_warp.rl.fused.ppo import FusedPpo

SIZES = {"obs": 147, "critic_obs": 208, "action": 12}  # of the vertical jump with four observation steps


@dataclass(frozen=True)
class Args(DeviceArgs):
    """Flags of the check of the fused update."""

    num_envs: int = 8192  # Number of environments
    num_steps: int = 32  # Policy steps of each environment in an iteration
    epochs: int = 5  # Passes over the samples in an update
    hidden: tuple[int, ...] = (256, 128, 128)  # Widths of the hidden layers
    calls: int = 20  # Number of calls in a repetition of a timing; the median of five repetitions is reported


class RandomEnv:
    """A `VecEnv` with random observations and rewards; with `still` they are constant, so that a step costs nothing."""

    num_obs, num_critic_obs, num_actions = SIZES.values()

    def __init__(self, num_envs: int, device: torch.device, still: bool = False) -> None:
        """Allocate observations, the critic's observations, rewards and ends of episodes."""
        self.num_envs = num_envs
        self.device = device
        self.still = still
        self.obs = self.final_obs = torch.randn(num_envs, self.num_obs, device=device)
        self.critic_obs = self.final_critic_obs = torch.randn(num_envs, self.num_critic_obs, device=device)
        self.reward, self.done, self.timeout = torch.zeros(3, num_envs, device=device)

    def step(self, action: torch.Tensor) -> None:
        """Draw new observations and rewards; observations depend on the action."""
        if not self.still:
            self.obs.normal_().add_(0.1 * action.mean())
            self.critic_obs.normal_()
            self.reward.normal_()

    def reset(self) -> None:
        """Do nothing, since random observations need no reset."""

    def mirror(self, what: str) -> tuple[list[int], list[float]]:
        """Return a mirror map (order, signs) that swaps entries 0 and 1, 2 and 3, …, and negates every other pair."""
        size = SIZES["obs" if what == "observation" else "action"]
        pairs = 2 * (size // 2)
        order = [i ^ 1 for i in range(pairs)] + list(range(pairs, size))
        return order, [-1.0 if i % 4 < 2 and i < pairs else 1.0 for i in range(size)]


def build(args: Args, device: torch.device, still: bool = False, **changes: object) -> Learner:
    """Return compiled PPO on a `RandomEnv`, with weights of seed 0; changes: other settings, such as `fused=False`."""
    torch.manual_seed(0)
    cfg = PpoCfg(num_steps=args.num_steps, epochs=args.epochs, hidden=args.hidden, fused=True)
    ppo = make_ppo(RandomEnv(args.num_envs, device, still), dataclasses.replace(cfg, **changes))  # pyright: ignore
    ppo.compile()
    return ppo


def gradient_errors(ppo: FusedPpo) -> dict[str, float]:
    """Return the relative errors of a minibatch's gradient, by parameter and of the losses, against float64 autograd.

    The weights differ from those that acted: with equal ones all probability ratios would be 1, and none clipped.
    Raises RuntimeError: the gradient does not repeat bitwise.
    """
    cfg, flat = ppo.cfg, ppo.flat
    with torch.no_grad():
        linear_layers(ppo.model.actor)[-1][0].mul_(30.0)  # the initial actions are too small to test the clipping
        ppo.collector.roll()
        ppo.batch()
        for segment in flat.segments:
            weights = segment.view(flat.value)
            weights.add_(0.02 * weights.std(correction=0).clamp(min=0.1) * torch.randn_like(weights))
    ppo.networks.copy_weights()
    samples = ppo.order()[: ppo.batch_size // cfg.minibatches]
    ppo.fused.compute_gradient(samples)
    found = flat.all_reduced.clone()
    ppo.fused.compute_gradient(samples)
    if not torch.equal(found, flat.all_reduced):
        raise RuntimeError("the gradient of a minibatch does not repeat bitwise")
    batch = type(part := ppo.fused.batch())(*(each[samples].double() for each in part))
    model = copy.deepcopy(ppo.model).double()
    for param in model.parameters():
        param.grad = None
    mean = model.mean(batch.features)
    value = model.critic(batch.critic_features)[:, 0]
    ratio = (gaussian_log_prob(batch.action, mean, model.log_std) - batch.log_prob).exp()
    clipped = ratio.clamp(1.0 - cfg.clip, 1.0 + cfg.clip)
    surrogate = -torch.minimum(batch.advantage * ratio, batch.advantage * clipped).mean()
    near = batch.value + (value - batch.value).clamp(-cfg.clip, cfg.clip)
    value_loss = torch.maximum((value - batch.target).square(), (near - batch.target).square()).mean()
    entropy = (model.log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
    (surrogate + cfg.value_coef * value_loss - cfg.entropy_coef * entropy).backward()
    errors = {
        "surrogate": found[flat.size].item() / surrogate.item() - 1.0,
        "value": found[flat.size + 1].item() / value_loss.item() - 1.0,
    }
    for (name, param), exact in zip(ppo.model.named_parameters(), model.parameters(), strict=True):
        errors[name] = float((param.grad - exact.grad).norm() / exact.grad.norm())  # pyright: ignore
    return {name: abs(error) for name, error in errors.items()}


def repeats(args: Args, device: torch.device) -> bool:
    """Return whether two trainings of four iterations with one seed have bitwise equal parameters and Adam state."""
    results = []
    for _ in range(2):
        ppo = build(args, device)
        for _ in range(4):  # eager, capture, replay
            ppo.iterate()
        results.append([each.clone() for each in ppo.optimiser.tensors])
        ppo.close()
    return all(map(torch.equal, *results))


def times(ppo: Learner, args: Args) -> dict[str, float]:
    """Return the times [us] of collecting a rollout, of an update and of an acting step, on a GPU as CUDA graphs.

    ppo: on a still `RandomEnv`, whose steps cost nothing.
    """
    for _ in range(3):  # eager, capture, replay
        ppo.iterate()
    collect, update = (1.0e6 * median_time(part, args.device, args.calls) for part in (ppo.collect, ppo.update))
    return {"collect_us": collect, "update_us": update, "act_us": collect / args.num_steps}


def main(args: Args) -> dict:
    """Check gradients and bitwise reproducibility, time fused and eager update, write and return the metrics.

    Raises InputError: the device cannot use the fused update.
    """
    info = configure_device(args.device, 1)
    device = torch.device(wp.device_to_torch(wp.get_device(args.device)))
    if not use_fused(PpoCfg(hidden=args.hidden, fused=True), device):
        raise InputError(f"the fused update cannot run on {info.name}")
    folder = output_dir("fused_update", args.out)
    values: dict = {"device": info.name, "num_envs": args.num_envs, "num_steps": args.num_steps, "epochs": args.epochs}
    for symmetry in ("off", "actor"):
        errors = gradient_errors(cast("FusedPpo", build(args, device, symmetry=symmetry)))
        values |= {f"error_{symmetry}_{name}": error for name, error in errors.items()}
        values[f"largest_error_{symmetry}"] = max(errors.values())
    values["repeats_bitwise"] = repeats(args, device)
    write_metrics(folder, values)
    for name, changes in (("fused", {}), ("symmetric", {"symmetry": "actor"}), ("eager", {"fused": False})):
        ppo = build(args, device, still=True, **changes)
        values |= {f"{name}_{key}": value for key, value in times(ppo, args).items()}
        ppo.close()
    values["update_speedup"] = values["eager_update_us"] / values["fused_update_us"]
    keys = [key for key in values if not key.startswith("error_")]
    return report(args, folder, values, f"Fused update with {args.num_envs:,} environments, {info.name}", keys)


if __name__ == "__main__":
    run_script(main, Args)
