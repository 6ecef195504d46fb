"""Check that no world becomes non-finite under random actions for a long time, and write metrics.

    python experiments/soak_test.py --num-envs 4096 --steps 2500 --out outputs/soak
    python experiments/soak_test.py --num-envs 16384 --steps 61036 --tasks velocity-rough   # a billion steps

Randomised environments of all tasks take random actions, each for `--hold-steps` policy steps; episodes end and begin
as in training. On a GPU these steps are one graph. A world that diverges is flagged, reset and counted; a value that is
not finite after that is an error.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task, task_names
from jumper_warp.rl.graphs import CapturedProcedure
from jumper_warp.sim.solver import SolverJumper
from jumper_warp.utils.errors import InputError
from support.scripts import ThreadArgs, prepare, report, run_script, tracked


@dataclass(frozen=True)
class Args(ThreadArgs):
    """Flags of the soak test."""

    num_envs: int = 1024  # Number of environments
    steps: int = 1000  # Number of policy steps of each environment, for each task
    hold_steps: int = 10  # Number of policy steps for which an action is held
    tasks: tuple[str, ...] = ()  # Names of the tasks (default: all)
    seed: int = 0  # Seed of actions and environments

    def __post_init__(self) -> None:
        if min(self.num_envs, self.steps, self.hold_steps) < 1:
            raise InputError("num_envs, steps and hold_steps must be at least 1")


def soak(env: Env, args: Args) -> dict[str, float]:
    """Step an environment under random actions, and return counts and largest speeds by name.

    Raises RuntimeError: a coordinate, rate, reward or observation is NaN or infinite after a step (and its resets).
    """
    env.reset()
    assert isinstance(env.sim.solver, SolverJumper)
    residual = wp.to_torch(env.sim.solver.residual)
    tolerance = env.sim.solver.tolerance
    q, qd = (wp.to_torch(x).view(env.num_envs, -1) for x in (env.sim.state.joint_q, env.sim.state.joint_qd))
    termination = wp.to_torch(env.episodes.termination)
    diverged = env.task.termination_names.index("diverged")
    action = torch.zeros_like(env.action)
    counts = torch.zeros_like(qd[0, :3]).double()
    speeds = qd.new_zeros(2)

    def step_held() -> None:
        """Take `args.hold_steps` steps with one random action; after each, count worlds and update largest speeds."""
        action.uniform_(-1.0, 1.0)
        for _ in range(args.hold_steps):
            env.step(action)
            finite = torch.cat([q, qd, env.obs, env.critic_obs, env.reward.view(-1, 1)], dim=1).isfinite().all(dim=1)
            counts.add_(torch.stack([(termination == diverged).sum(), (residual > tolerance).sum(), (~finite).sum()]))
            step_speeds = torch.stack([qd[:, :3].square().sum(dim=1).max().sqrt(), qd[:, 6:26].abs().max()])
            torch.maximum(speeds, step_speeds, out=speeds)

    run = CapturedProcedure(step_held, env.device.type == "cuda")
    rounds = -(-args.steps // args.hold_steps)
    for i in tracked(range(rounds), f"rounds of random actions, {env.task.name}"):
        run()
        if (i % 30 == 29 or i + 1 == rounds) and (rows := int(counts[2])):
            raise RuntimeError(f"{rows} rows hold values that are not finite, by step {(i + 1) * args.hold_steps}")
    return {
        "steps": rounds * args.hold_steps * env.num_envs, "non_finite_worlds": int(counts[0]),
        "unsolved_contacts": int(counts[1]), "largest_speed_m_s": float(speeds[0]),
        "largest_joint_speed_rad_s": float(speeds[1]),
    }  # fmt: skip


def main(args: Args) -> dict[str, Any]:
    """Soak-test the environments of all tasks in turn, and return the sums and largest values of their metrics."""
    folder = prepare("soak_test", args, args.threads)
    start = time.perf_counter()
    total: dict[str, Any] = {}
    for name in args.tasks or task_names():
        torch.manual_seed(args.seed)
        env = Env(make_task(name), args.num_envs, seed=args.seed, device=args.device, threads=args.threads)
        for key, value in soak(env, args).items():
            total[key] = max(total.get(key, 0), value) if key.startswith("largest") else total.get(key, 0) + value
    total["steps_per_s"] = total["steps"] / (time.perf_counter() - start)
    total |= {"tasks": list(args.tasks or task_names()), "envs": args.num_envs, "seed": args.seed}
    keys = ("steps", "non_finite_worlds", "unsolved_contacts", "largest_speed_m_s", "steps_per_s")
    return report(args, folder, total, f"{total['steps']:,} policy steps with random actions", keys)


if __name__ == "__main__":
    run_script(main, Args)
