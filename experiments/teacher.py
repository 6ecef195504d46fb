"""Teach a policy of Earth to jump from a stance on Mars: it imitates plans of whole-jump predictive control.

    python experiments/teacher.py --out outputs/teacher
    jumper train vertical-jump-mars-standing --task-module experiments/teacher.py \
      --init-policy outputs/teacher/policy --ppo.init-std 0.3

The controller plans jumps of robots on Mars, which begin with jumps of the policy of Earth. Actions are disturbed
while they are executed, and the controller corrects the motion. The script records observations with noise and the
planned actions of jumps that succeed. The policy imitates them by supervised learning. The script writes the resulting
policy, in the folder `policy`, and the success of all three in `metrics.json`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np
import torch

from jumper_warp.envs.env import Env
from jumper_warp.envs.vec_env import RAW_LIMIT
from jumper_warp.evaluation.conditions import Conditions, env_of_recipe
from jumper_warp.evaluation.jumps import JumpLog
from jumper_warp.evaluation.log import run_evaluation
from jumper_warp.evaluation.predictive_control import PredictiveController
from jumper_warp.kernels.jump import rewards, terminations
from jumper_warp.policies.policy import Policy, save_policy
from jumper_warp.policies.spec import make_interface
from jumper_warp.policies.warm_start import actor_init_from_policy, task_symmetries
from jumper_warp.recipe import Recipe
from jumper_warp.registry import FROM_STANCE, register_task
from jumper_warp.rl.actor_init import apply_actor_init
from jumper_warp.rl.mirror import expand_layers
from jumper_warp.rl.networks import NORMALISED_LIMIT, ActorCritic, linear_layers
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.interface import interface
from jumper_warp.tasks.jump.cfg import StartProbability
from jumper_warp.tasks.jump.mars import vertical_jump_mars_loose
from jumper_warp.tasks.jump.standing import FRICTION, SQUAT, STANCE, standing
from jumper_warp.tasks.jump.vertical import heights
from jumper_warp.tasks.terms import RewardTerm, TerminationTerm
from jumper_warp.tasks.units import DEG, SECOND
from support.scripts import ThreadArgs, prepare, report, run_script

NAME = "vertical-jump-mars-standing"
DEEP_SQUAT: dict[str, Any] = SQUAT | {"acceleration": 75.0}  # Motors of 24.8 N m
SCALES = (0.6, 0.53, 0.47, 0.42, 0.37, 0.33)  # [1] Of goals: a takeoff of Earth reaches 2.6 times the height on Mars
LONGEST = 200  # Policy steps of the longest plan
SECONDS = 5.0  # [s] Longest time of a jump with the stance before it and the rest after it
BATCH = 4096  # Samples of a step of supervised learning


def mars_standing_jump() -> TaskCfg:
    """Return the task of a vertical jump on Mars from a stance, with a squat as deep as the height needs."""
    starts = StartProbability(0.45, default=0.15, in_flight=0.20, after_landing=0.10, pushing=0.10)
    task = standing(vertical_jump_mars_loose(), 0.3 * SECOND, 0.2, starts)
    task = replace(
        task,
        name=NAME,
        rewards=(
            *task.rewards,
            RewardTerm(rewards.squat, 100.0, std=0.03, scale_by_dt=False, **DEEP_SQUAT),
            RewardTerm(rewards.tracking, 40.0, std_wide=0.4, std_fine=0.08, fine_weight=0.6),
            RewardTerm(rewards.touchdown_tracking, 120.0, std=0.13, scale_by_dt=False),
        ),
        terminations=(*task.terminations, TerminationTerm(terminations.shallow_squat, tolerance=0.04, **DEEP_SQUAT)),
        levels=heights((0.6, 1.2), (0.7, 1.8), (0.7, 2.5), (0.7, 3.4)),
        randomization=replace(FRICTION, latency=(0.0, 18.0), zero_latency_probability=0.2),
    )
    task = task.with_terms("terminations", moved_away={"distance": 0.66})
    return task.with_terms(
        "rewards", jump_height={"weight": 80.0}, horizontal_velocity={"weight": 25.0},
        ground_posture={"weight": 40.0, "std": 20.0 * DEG, "shift": STANCE},
    )  # fmt: skip


register_task(NAME, mars_standing_jump, ppo=FROM_STANCE, replace=True)


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the teacher."""

    policy: str = "vertical_jump"  # Policy that plans begin with, and that imitates them
    robots: int = 4096  # Number of robots
    processes: int = 1  # Number of processes that share the robots
    goals: tuple[float, float] = (0.6, 2.2)  # [m] Range of the commanded heights
    first_iterations: int = 20  # Iterations before a jump
    disturbance: float = 0.02  # [1] Standard deviation of the disturbance of actions
    epochs: int = 20  # Passes over the recorded samples
    seed: int = 1  # Seed of goals, noise, disturbances and the order of samples


def make_env(args: Args, count: int, *, noise: bool = False) -> Env:
    """Return an environment of `count` nominal robots on Mars; noise: whether observations have noise."""
    recipe = Recipe.of(NAME)
    conditions = Conditions(device=args.device, threads=args.threads, noise=noise, seed=args.seed)
    return env_of_recipe(recipe, count, conditions, change=recipe.task.evaluation.prepare_task)


def jump(args: Args, act: Callable, env: Env) -> np.ndarray:
    """Return the success (num_envs,) of jumps to random goals, with actions `act`."""
    goals = np.random.default_rng(args.seed).uniform(*args.goals, env.num_envs)
    log = JumpLog(goals, env.task.termination_names)
    run_evaluation(act, env, log, seconds=SECONDS)
    return log.success[:, 0]


def planned(args: Args) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return observations and planned actions of successful jumps, (policy steps, robots, ...), and all successes."""
    env = make_env(args, args.robots, noise=True)
    controller = PredictiveController(
        env, Policy.load(args.policy).to(env.device), make_env(args, args.robots), iterations=1,
        scales=SCALES, threads=args.threads, longest=LONGEST,
    )  # fmt: skip
    controller.first_iterations = args.first_iterations
    generator = torch.Generator(env.device).manual_seed(args.seed)
    rows = []

    def act(obs: torch.Tensor) -> torch.Tensor:
        """Return the disturbed action, and record the planned one."""
        action = controller.act(obs)
        rows.append((obs.cpu().numpy().copy(), action.cpu().numpy()))
        return action + args.disturbance * torch.randn(action.shape, generator=generator, device=env.device)

    success = jump(args, act, env)
    obs, actions = (np.stack(arrays)[:, success] for arrays in zip(*rows, strict=True))
    return obs, actions, success


def imitate(args: Args, obs: torch.Tensor, actions: torch.Tensor, device: torch.device) -> tuple[Policy, float]:
    """Return a policy that imitates samples (samples, ...), and the root mean squared error [1] of its actions."""
    torch.manual_seed(args.seed)
    recipe = Recipe.of(NAME)
    ppo = recipe.train.ppo
    symmetries = task_symmetries(recipe.task, "actor")
    init = actor_init_from_policy(args.policy, recipe.task, ppo)
    model = ActorCritic(obs.shape[1], 12, ppo.hidden, ppo.activation, symmetries=symmetries)
    apply_actor_init(init, model, 1)
    model.to(device)
    features, actions = model.features(obs.to(device)), actions.to(device)
    optimiser = torch.optim.Adam(model.actor.parameters())
    for epoch in range(args.epochs):
        optimiser.param_groups[0]["lr"] = 1.0e-3 * (1.0 - epoch / args.epochs)
        for batch in torch.randperm(len(features), device=device).split(BATCH):
            mean = model.mean(features[batch])
            error = (mean - actions[batch]) * (mean.clamp(-1.0, 1.0) != actions[batch])  # actions are clipped to ±1
            optimiser.zero_grad()
            error.square().mean().backward()
            optimiser.step()
    rms = (model.mean(features).clamp(-1.0, 1.0) - actions).square().mean().sqrt().item()
    earth = Policy.load(args.policy)
    layers = expand_layers([(w.detach().cpu(), b.detach().cpu()) for w, b in linear_layers(model.actor)], symmetries)
    spec = make_interface(
        interface(recipe.task) | {"observation_limit": RAW_LIMIT, "normalised_limit": NORMALISED_LIMIT},
        policy_dt=earth.interface.policy_dt, physics_dt=earth.interface.physics_dt,
        hidden=tuple(len(bias) for _, bias in layers[:-1]), activation=ppo.activation,
    )  # fmt: skip
    return Policy(layers, init.mean, init.std, spec, recipe.to_json()), rms


def main(args: Args) -> dict:
    """Plan jumps, imitate them, save the policy, and return the metrics."""
    folder = prepare("teacher", args, args.threads)
    share = -(-args.robots // args.processes)
    jobs = [replace(args, robots=share, seed=1000 * args.seed + i) for i in range(args.processes)]
    begin = time.perf_counter()
    with ProcessPoolExecutor(args.processes, get_context("spawn")) as pool:
        parts = list(pool.map(planned, jobs))
    values = {"plan_s": time.perf_counter() - begin}
    values["teacher_success_rate"] = float(np.mean([part[2] for part in parts]))
    obs, actions = (
        torch.from_numpy(np.concatenate([part[i].reshape(-1, part[i].shape[2]) for part in parts])) for i in (0, 1)
    )
    env = make_env(args, min(args.robots, 1024), noise=True)
    policy, rms = imitate(args, obs, actions, env.device)
    values |= {"imitate_s": time.perf_counter() - begin - values["plan_s"], "samples": float(len(obs))}
    values["imitation_rms"] = rms
    save_policy(folder / "policy", policy, overwrite=True)
    for name, each in (("policy_of_earth", Policy.load(args.policy)), ("imitation", policy)):
        values[f"{name}_success_rate"] = float(jump(args, each.to(env.device).act, env).mean())
    return report(args, folder, values, "Imitation of planned jumps", list(values))


if __name__ == "__main__":
    run_script(main, Args)
