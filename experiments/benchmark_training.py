"""How fast training is, and where its time goes: solver, environment and PPO in one run on one machine.

    python experiments/benchmark_training.py --envs 4096 8192 16384 --out outputs/benchmark_training

Steps are policy steps of 1/60 s, 8 physics steps each, of all environments together. The solver stands; environment
and training see random or learned actions, with randomisation and noise. rsl-rl-lib trains on the same environment
through the package's adapter. Before anything is timed, its outcome is checked.
"""

from __future__ import annotations

import contextlib
import io
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
import tyro
import warp as wp
from rich.console import Console
from rich.table import Table

from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task
from jumper_warp.rl.logger import Stopwatch
from jumper_warp.rl.ppo import Ppo, PpoCfg
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.output import output_dir, write_figures
from jumper_warp.utils.runtime import report_device

PARTS = {
    "action_kernel": "action",
    "push_kernel": "action",
    "episode_kernel": "episode",
    "observe_kernel": "observe",
    "reset_kernel": "reset",
    "clear_world_kernel": "reset",
}
"""Parts of a policy step by kernel; every other kernel is physics."""


@dataclass(frozen=True)
class Args:
    """Flags."""

    envs: tuple[int, ...] | None = None
    """Numbers of environments for solver and environment (default: 4096 8192 16384 on a GPU, 64 on a CPU)."""
    train_envs: int | None = None
    """Number of environments for training and profile (default: 8192 on a GPU, 64 on a CPU)."""
    steps: int = 200
    """Policy steps in a repetition."""
    repeats: int = 5
    """Repetitions of a timing; the median counts."""
    iterations: int = 10
    """Training iterations that are timed, of either trainer."""
    rsl_rl: bool = True
    """Train with rsl-rl-lib too."""
    num_steps: int = 32
    """Policy steps of each environment in an iteration."""
    out: Path | None = None
    """Folder for figures.json (default: outputs/benchmark_training/<time>)."""
    device: str | None = None
    """Warp device."""

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("steps", "repeats", "iterations", "num_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


def seconds(body: Callable[[], Any], calls: int, args: Args) -> float:
    """Return the seconds of a call, the median of all repetitions; waits for the device."""
    times = []
    for _ in range(args.repeats):
        wp.synchronize_device(args.device)
        start = time.perf_counter()
        for _ in range(calls):
            body()
        wp.synchronize_device(args.device)
        times.append((time.perf_counter() - start) / calls)
    return float(np.median(times))


def time_solver(envs: int, args: Args) -> float:
    """Return seconds a policy step of motors and physics alone; every robot must stand."""
    task = make_task("vertical-jump")
    sim = Simulation(envs, motors=task.motors, visuals=False, device=args.device)
    for _ in range(60):
        sim.step()
    standing = sim.joint_q()[:, 2]
    if not (np.all(standing > 0.33) and np.all(standing < 0.40)):
        raise RuntimeError(f"the robots do not stand: heights {standing.min():.3f} to {standing.max():.3f} m")
    with wp.ScopedCapture(device=sim.device) as capture:
        sim.physics(sim.substeps, sim.target, bodies=False)
    return seconds(lambda: wp.capture_launch(capture.graph), args.steps, args)


def make_env(envs: int, args: Args) -> tuple[Env, Callable[[], None]]:
    """Return an environment in the middle of its episodes, and what steps it with random actions."""
    env = Env(make_task("vertical-jump"), envs, device=args.device)
    actions = torch.rand(16, envs, env.num_actions, device=env.device) * 2.0 - 1.0
    count = 0

    def step() -> None:
        nonlocal count
        env.step(actions[count % len(actions)])
        count += 1

    env.reset()
    for _ in range(100):
        step()
    figures = env.metrics()
    if not bool(env.obs.isfinite().all()) or figures["Episode_Termination/came_apart"] > 0.01:
        raise RuntimeError(f"{100 * figures['Episode_Termination/came_apart']:.1f} % of the episodes came apart")
    return env, step


def profile_step(envs: int, args: Args) -> dict[str, float]:
    """Return seconds of each part of a policy step: every kernel launched again and again on the same state."""
    env, _ = make_env(envs, args)
    launches: list[tuple[tuple, dict]] = []
    launch = wp.launch

    def remember(*positional: Any, **named: Any) -> None:
        launches.append((positional, named))
        launch(*positional, **named)

    with mock.patch.object(wp, "launch", remember):
        env._launch_step()
    state = (env.sim.state.joint_q, env.sim.state.joint_qd, env.tasks)
    saved = [wp.clone(array) for array in state]
    parts = dict.fromkeys(("action", "physics", "episode", "observe", "reset"), 0.0)
    for positional, named in launches:
        name = (named.get("kernel") or positional[0]).key
        part = next((part for kernel, part in PARTS.items() if kernel in name), "physics")
        calls = 1 if part == "physics" else 10
        with wp.ScopedCapture(device=env.wp_device) as capture:
            for _ in range(calls):
                launch(*positional, **named)
        parts[part] += seconds(lambda graph=capture.graph: wp.capture_launch(graph), 3, args) / calls
        for array, old in zip(state, saved, strict=True):
            wp.copy(array, old)
    return parts


def time_ppo(envs: int, args: Args) -> dict[str, float]:
    """Return figures of training with this package's PPO; the policy must have changed and stayed finite."""
    env, _ = make_env(envs, args)
    ppo = Ppo(env, PpoCfg(num_steps=args.num_steps))
    before = ppo.model.log_std.detach().clone()
    for _ in range(3):  # eager, capture, replay
        ppo.collect()
        ppo.update()
    watch = Stopwatch(env.device)
    wp.synchronize_device(args.device)
    start = time.perf_counter()
    for _ in range(args.iterations):
        watch.start()
        ppo.collect()
        watch.mark()
        ppo.update()
        watch.mark()
    collect, update = watch.read()
    wall = (time.perf_counter() - start) / args.iterations
    after = ppo.model.log_std.detach()
    if not bool(after.isfinite().all()) or torch.equal(after, before):
        raise RuntimeError("the policy did not learn")
    steps = args.num_steps * envs
    return {"ppo_steps_per_s": steps / wall, "ppo_iteration_s": wall, "ppo_collect_s": collect, "ppo_update_s": update}


def time_rsl_rl(envs: int, args: Args) -> dict[str, float]:
    """Return figures of training with rsl-rl-lib on the same environment, with the same settings."""
    from jumper_warp.envs.rsl_rl import train_rsl_rl

    env, _ = make_env(envs, args)
    with contextlib.redirect_stdout(io.StringIO()):
        cfg = replace(PpoCfg(), num_steps=args.num_steps)
        runner = train_rsl_rl(env, cfg, iterations=2, save_interval=10**6, seed=1, folder=None)
        wp.synchronize_device(args.device)
        start = time.perf_counter()
        runner.learn(args.iterations)
        wp.synchronize_device(args.device)
    wall = (time.perf_counter() - start) / args.iterations
    return {"rsl_rl_steps_per_s": args.num_steps * envs / wall, "rsl_rl_iteration_s": wall}


def main(args: Args) -> dict:
    """Run the benchmark and return its figures."""
    wp.config.log_level = wp.LOG_WARNING
    info = report_device(args.device)
    folder = output_dir("benchmark_training", args.out)
    gpu = wp.get_device(args.device).is_cuda
    envs = args.envs or ((4096, 8192, 16384) if gpu else (64,))
    train_envs = args.train_envs or (8192 if gpu else 64)
    values: dict = {"device": info.name, "envs": list(envs), "train_envs": train_envs, "num_steps": args.num_steps}
    step_time = {}
    for n in sorted({*envs, train_envs}):
        solver, step_time[n] = time_solver(n, args), seconds(make_env(n, args)[1], args.steps, args)
        values |= {f"solver_steps_per_s_{n}": n / solver, f"env_steps_per_s_{n}": n / step_time[n]}
    parts = profile_step(train_envs, args)
    values |= {f"{part}_us": 1e6 * wall for part, wall in parts.items()}
    values |= {f"{part}_share": wall / sum(parts.values()) for part, wall in parts.items()}
    values["env_step_us"] = 1e6 * step_time[train_envs]
    values |= time_ppo(train_envs, args)
    values["collect_env_share"] = args.num_steps * step_time[train_envs] / values["ppo_collect_s"]
    if args.rsl_rl:
        values |= time_rsl_rl(train_envs, args)
        values["ppo_over_rsl_rl"] = values["ppo_steps_per_s"] / values["rsl_rl_steps_per_s"]
    write_figures(folder, values)
    table = Table("figure", "value", title="Policy steps of 8 physics steps, motors included, graphs on")
    for name, value in values.items():
        large = isinstance(value, float) and value >= 1e3
        table.add_row(name, f"{value:,.0f}" if large else f"{value:.4g}" if isinstance(value, float) else str(value))
    Console().print(table)
    print(f"figures in {folder}")
    return values


if __name__ == "__main__":
    main(tyro.cli(Args))
