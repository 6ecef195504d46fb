"""Soak tests: random actions for a long time, on a simulation or on a whole environment."""

from __future__ import annotations

import gc
import json
import mmap
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task, task_names
from jumper_warp.rl.graphs import CapturedProcedure
from jumper_warp.sim.simulation import Simulation
from jumper_warp.sim.solver import SolverJumper
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.checks import check_not_negative
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import write_atomically
from support.scripts import ThreadArgs, tracked

PARTS = "parts.jsonl"  # File in the output folder with the metrics of each part of a soak test


@dataclass(frozen=True)
class SoakArgs(ThreadArgs):
    """Flags of a soak test."""

    num_envs: int = 1024  # Number of environments
    steps: int = 10_000  # Number of policy steps of each environment; with 1024 environments 10 million in all
    hold_steps: int = 10  # Number of policy steps for which an action is held
    episode_steps: int = 300
    """Number of policy steps after which all worlds restart or, with --task, after which the host checks them."""
    lateral: float = 15.0  # [deg] Largest lateral target
    transversal: tuple[float, float] = (-30.0, 140.0)  # [deg] Least and largest transversal target
    command_filter: bool = False  # Pass the targets through the motor command filter
    task: str | None = None
    """Name of a task whose environment is tested, with its limits and filter, or `all` for all tasks in turn (default:
    the simulation alone)."""
    max_seconds: float = 0.0
    """[s] With --task: further parts of --steps policy steps, each with another seed and with `all` another task, run
    until this time. Results add up over all starts with the same --out. 0: one part."""
    rebuilds: int = 0  # With --task: number of environments that are made and dropped after the steps
    resets: int = 0  # With --task: number of evaluation resets after the steps
    seed: int = 0  # Seed of actions, masses and friction

    def __post_init__(self) -> None:
        for name in ("num_envs", "steps", "hold_steps", "episode_steps"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("max_seconds", "rebuilds", "resets"):
            check_not_negative(name, getattr(self, name))


def randomize(sim: Simulation, rng: np.random.Generator) -> None:
    """Scale masses and inertias of every world by a random 0.8 to 1.25, and set its friction to a random 0.2 to 1.2."""
    model, n = sim.model, sim.num_worlds
    scale = rng.uniform(0.8, 1.25, n).astype(np.float32)
    model.body_mass.assign(model.body_mass.numpy() * np.repeat(scale, 21))
    model.body_inertia.assign(model.body_inertia.numpy() * np.repeat(scale, 21)[:, None, None])
    worlds, friction = np.asarray(model.shape_world.numpy(), dtype=int), rng.uniform(0.2, 1.2, n).astype(np.float32)
    mu = model.shape_material_mu.numpy()
    mu[worlds >= 0] = friction[worlds[worlds >= 0]]
    model.shape_material_mu.assign(mu)
    sim.physics.parameters_changed()


def simulation_steps(sim: Simulation, args: SoakArgs) -> Iterator[torch.Tensor]:
    """Step a simulation under random motor targets; yield after each step which worlds diverged, (n,) bool.

    Flags stay set until the reset after `args.episode_steps` and are yielded once, before it.
    """
    if sim.device.is_cuda:
        torch.cuda.set_stream(wp.stream_to_torch(wp.get_stream(sim.device)))
    randomize(sim, np.random.default_rng(args.seed))
    target, diverged = wp.to_torch(sim.target), wp.to_torch(sim.physics.diverged)
    lateral, low, high = (np.radians(value) for value in (args.lateral, *args.transversal))
    lower, upper = (
        target.new_tensor([row] * 4).reshape(12, 1) for row in ([-lateral, low, low], [lateral, high, high])
    )
    for step in tracked(range(args.steps), "policy steps"):
        if step % args.hold_steps == 0:
            target.copy_(lower + (upper - lower) * torch.rand_like(target))
        sim.step()
        last = (step + 1) % args.episode_steps == 0 or step + 1 == args.steps
        yield (diverged != 0) & last
        if last:
            sim.reset()


def hardest(task: TaskCfg) -> TaskCfg:
    """Return a copy of the task with only the hardest row of its terrain map; tasks without a map are unchanged."""
    settings = task.reset.settings
    terrain = getattr(settings, "terrain", None)
    if terrain is None or terrain.rows == 0:
        return task
    return replace(task, reset=replace(task.reset, settings=replace(settings, terrain=replace(terrain, rows=1))))


class SoakTotals(NamedTuple):
    """Totals of a soak test over all worlds and steps."""

    flagged: int  # worlds flagged as non-finite, once per episode
    unsolved: int  # world steps whose contacts did not converge
    rows: int  # world steps with a value that is not finite
    speed: float  # [m/s] largest speed of a base
    joint_speed: float  # [rad/s] largest speed of a joint


class SoakCounters:
    """Counts of non-finite worlds and unsolved contacts so far, and largest speeds, on the device."""

    def __init__(self, sim: Simulation) -> None:
        """Start all counters at 0; sim: simulation whose state is read."""
        self._rates = wp.to_torch(sim.state.joint_qd).view(sim.num_worlds, -1)
        self._state = wp.to_torch(sim.state.joint_q).view(sim.num_worlds, -1)
        assert isinstance(sim.solver, SolverJumper)
        self._residual, self._tolerance = wp.to_torch(sim.solver.residual), sim.solver.tolerance
        self._speeds = self._rates.new_zeros(2)  # [m/s] of a base, [rad/s] of a joint
        self._counts = torch.zeros(3, dtype=torch.int64, device=self._rates.device)
        self._step_speeds = self._rates.new_zeros(2)  # the same of one step

    def update(self, flagged: torch.Tensor, *rows: torch.Tensor) -> None:
        """Count the invalid worlds and unsolved contacts after a policy step, and update the largest speeds.

        flagged: (num_worlds,) bool; rows: (num_worlds, ...) values that should be finite.
        """
        self._step_speeds[0] = self._rates[:, :3].square().sum(dim=1).max().sqrt()
        self._step_speeds[1] = self._rates[:, 6:26].abs().max()
        torch.maximum(self._speeds, self._step_speeds, out=self._speeds)
        finite = self._rates.isfinite().all(dim=1) & self._state.isfinite().all(dim=1)
        for values in rows:
            finite &= values.view(len(finite), -1).isfinite().all(dim=1)
        self._counts += torch.stack([flagged.sum(), (self._residual > self._tolerance).sum(), (~finite).sum()])

    def read(self) -> SoakTotals:
        """Return the counts and largest speeds so far; waits for the device."""
        return SoakTotals(*self._counts.tolist(), *self._speeds.tolist())


def soak_simulation(sim: Simulation, args: SoakArgs) -> dict:
    """Soak-test a simulation under random motor targets, and return the metrics.

    Raises RuntimeError: NaN or infinity in a world without a flag.
    """
    counters, start = SoakCounters(sim), time.perf_counter()
    for step, flagged in enumerate(simulation_steps(sim, args)):
        counters.update(flagged)
        if (step + 1) % args.episode_steps == 0 and counters.read().rows:
            raise RuntimeError(f"a world holds values that are not finite but was not flagged, step {step}")
    return soak_metrics(counters, args.steps * sim.num_worlds, time.perf_counter() - start)


def soak_env(env: Env, args: SoakArgs) -> dict:
    """Soak-test an environment under random actions, and return the metrics.

    On a GPU, `args.hold_steps` steps are one graph. Worlds that diverged are flagged. Raises RuntimeError: a
    coordinate, rate, reward or observation after the step (and reset) is NaN or infinite.
    """
    env.reset()
    diverged = [term.name for term in env.task.terminations].index("diverged")
    counters, action = SoakCounters(env.sim), torch.zeros_like(env.action)
    termination = wp.to_torch(env.episodes.termination)

    def step_held() -> None:
        """Take `args.hold_steps` steps with one random action, and update the counters after each."""
        action.uniform_(-1.0, 1.0)
        for _ in range(args.hold_steps):
            env.step(action)
            counters.update(termination == diverged, env.obs, env.critic_obs, env.reward)

    run, rounds = CapturedProcedure(step_held, env.device.type == "cuda"), -(-args.steps // args.hold_steps)
    check_interval = max(args.episode_steps // args.hold_steps, 1)

    def round_of_steps(i: int) -> None:
        """Run `step_held`; every `check_interval` rounds, raise RuntimeError if any values were not finite."""
        run()
        if (i + 1) % check_interval == 0 and (rows := counters.read().rows):
            raise RuntimeError(f"{rows} rows hold values that are not finite, by step {(i + 1) * args.hold_steps}")

    start = time.perf_counter()
    growth = resident_growth(round_of_steps, rounds, "rounds of random actions")
    wall = time.perf_counter() - start
    return soak_metrics(counters, rounds * args.hold_steps * env.num_envs, wall) | {"resident_growth_kib": growth}


def resident_growth(job: Callable[[int], object], count: int, title: str) -> int:
    """Call a job `count` times with its index; return the growth of resident memory [KiB] in the second half.

    In the first half the allocator's pools grow. 0 where the operating system has no /proc.
    """
    before = 0
    for i in tracked(range(count), title):
        if i == count // 2:
            before = resident_memory()
        job(i)
    return resident_memory() - before


def resident_memory() -> int:
    """Return the resident memory of this process [KiB] after garbage collection; 0 where there is no /proc."""
    gc.collect()
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * mmap.PAGESIZE // 1024 if statm.exists() else 0


def rebuild_growth(make: Callable[[], Env], args: SoakArgs) -> dict[str, int]:
    """Return the growth of resident memory [KiB] over repeated builds, and over evaluation resets, of an environment.

    After a reset and in a new environment, random actions are held for `args.hold_steps` policy steps.
    """

    def steps(env: Env) -> None:
        """Take steps with random actions."""
        action = torch.empty_like(env.action).uniform_(-1.0, 1.0)
        for _ in range(args.hold_steps):
            env.step(action)

    def rebuild(i: int) -> None:
        """Make an environment, and drop it after some steps."""
        env = make()
        env.reset()
        steps(env)

    env = make()

    def reset(i: int) -> None:
        """Begin an evaluation's episode; all components of its command are 1."""
        env.evaluation_reset(np.ones(env.task.command.counts[0]))
        steps(env)

    return {
        "resident_growth_rebuilds_kib": resident_growth(rebuild, args.rebuilds, "environments"),
        "resident_growth_resets_kib": resident_growth(reset, args.resets, "evaluation resets"),
    }


def soak_metrics(counters: SoakCounters, count: int, wall: float) -> dict:
    """Return the totals and the speed of a soak test as metrics by name.

    count: policy steps of all worlds together; wall: time for them [s].
    """
    totals = counters.read()
    return {
        "steps": count, "non_finite_worlds": totals.flagged, "non_finite_rows": totals.rows,
        "largest_speed_m_s": totals.speed, "largest_joint_speed_rad_s": totals.joint_speed,
        "unsolved_contacts": totals.unsolved, "share_of_steps_contact_unsolved": totals.unsolved / count,
        "wall_s": wall, "steps_per_s": count / wall,
    }  # fmt: skip


def soak_tasks(args: SoakArgs, folder: Path) -> dict:
    """Soak-test one environment after another, of one task or of all in turn, and return the metrics of all together.

    Each test is a part in a file in the folder. With `args.max_seconds` earlier parts count too, and parts run while
    there is time for another one.
    """
    start, longest, path = time.perf_counter(), 0.0, folder / PARTS
    parts = [json.loads(line) for line in path.read_text().splitlines()] if args.max_seconds and path.is_file() else []
    names = task_names() if args.task == "all" else (str(args.task),)
    while True:
        begin, seed = time.perf_counter(), args.seed + len(parts)
        task = hardest(make_task(names[len(parts) % len(names)]))
        torch.manual_seed(seed)
        make = partial(Env, task, args.num_envs, seed=seed, device=args.device, threads=args.threads)
        parts.append(soak_env(make(), args) | {"task": task.name, "seed": seed, "envs": args.num_envs})
        write_atomically(path, "".join(json.dumps(part) + "\n" for part in parts).encode())
        longest = max(longest, time.perf_counter() - begin)
        if time.perf_counter() - start + longest > args.max_seconds:
            break
    metrics = total_metrics(parts)
    if args.rebuilds or args.resets:
        metrics |= rebuild_growth(make, args)
    growth = sum(metrics[name] for name in metrics if name.startswith("resident_growth"))
    metrics["resident_growth_kib_per_1000_steps"] = 1000.0 * growth / (0.5 * args.steps * len(parts))
    return metrics | {"task": args.task}


def total_metrics(parts: list[dict]) -> dict:
    """Return the sums or largest values of metrics over soak tests (parts), and the steps of each task."""
    metrics = {name: max(part[name] for part in parts) for name in parts[0] if name.startswith("largest")}
    names = ("steps", "non_finite_worlds", "non_finite_rows", "unsolved_contacts", "wall_s", "resident_growth_kib")
    metrics |= {name: sum(part[name] for part in parts) for name in names}
    metrics["share_of_steps_contact_unsolved"] = metrics["unsolved_contacts"] / metrics["steps"]
    metrics["steps_per_s"] = metrics["steps"] / metrics["wall_s"]
    for part in parts:
        name = f"steps_{part['task'].replace('-', '_')}"
        metrics[name] = metrics.get(name, 0) + part["steps"]
    return metrics
