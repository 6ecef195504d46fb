"""Random actions for a long time, on a simulation or on a whole environment."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.rl.graphs import Captured
from jumper_warp.sim.simulation import Simulation
from jumper_warp.sim.solver import SolverJumper
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError
from support.scripts import ThreadArgs


@dataclass(frozen=True)
class SoakArgs(ThreadArgs):
    """Flags of a soak test."""

    num_envs: int = 1024
    """Number of environments."""
    steps: int = 10_000
    """Number of policy steps of each environment; with 1024 environments 10 million in all."""
    hold_steps: int = 10
    """Number of policy steps for which an action is held."""
    episode_steps: int = 300
    """Number of policy steps after which all worlds restart or, with --task, after which the host checks them."""
    lateral: float = 15.0
    """[deg] Largest lateral target."""
    transversal: tuple[float, float] = (-30.0, 140.0)
    """[deg] Least and largest transversal target."""
    command_filter: bool = False
    """Pass the targets through the motor command filter."""
    task: str | None = None
    """Name of a task whose environment is tested, with its limits and filter (default: the simulation alone)."""
    seed: int = 0
    """Seed of actions, masses and friction."""

    def __post_init__(self) -> None:
        for name in ("num_envs", "steps", "hold_steps", "episode_steps"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")


def randomize(sim: Simulation, rng: np.random.Generator) -> None:
    """Give every world its own masses (0.8 to 1.25 times) and paw friction (0.2 to 1.2)."""
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
    """Make all steps of a simulation under random targets; after each, give which worlds are flagged as non-finite."""
    if sim.device.is_cuda:
        torch.cuda.set_stream(wp.stream_to_torch(wp.get_stream(sim.device)))
    randomize(sim, np.random.default_rng(args.seed))
    target, invalid = wp.to_torch(sim.target), wp.to_torch(sim.physics.invalid)
    lateral, low, high = (np.radians(value) for value in (args.lateral, *args.transversal))
    lower, upper = (
        target.new_tensor([row] * 4).reshape(12, 1) for row in ([-lateral, low, low], [lateral, high, high])
    )
    for step in range(args.steps):
        if step % args.hold_steps == 0:
            target.copy_(lower + (upper - lower) * torch.rand_like(target))
        sim.step()
        last = (step + 1) % args.episode_steps == 0 or step + 1 == args.steps
        yield (invalid != 0) & last
        if last:  # flagged worlds are counted once
            sim.reset()


def hardest(task: TaskCfg) -> TaskCfg:
    """Return a task whose map, if it has one, has the last row alone, since robots that fall go back to the first."""
    settings = task.reset.settings
    terrain = getattr(settings, "terrain", None)
    if terrain is None or terrain.rows == 0:
        return task
    return replace(task, reset=replace(task.reset, settings=replace(settings, terrain=replace(terrain, rows=1))))


class Totals:
    """What is counted of worlds while they are soaked, on the device."""

    def __init__(self, sim: Simulation) -> None:
        self._rates = wp.to_torch(sim.state.joint_qd).view(sim.num_worlds, -1)
        self._state = wp.to_torch(sim.state.joint_q).view(sim.num_worlds, -1)
        assert isinstance(sim.solver, SolverJumper)
        self._residual, self._tolerance = wp.to_torch(sim.solver.residual), sim.solver.tolerance
        self._speeds = self._rates.new_zeros(2)  # [m/s] of a base, [rad/s] of a joint
        self._counts = torch.zeros(3, dtype=torch.int64, device=self._rates.device)
        self._fast = self._rates.new_zeros(2)

    def take(self, bad: torch.Tensor, *rows: torch.Tensor) -> None:
        """Take in a policy step. bad: (num_worlds,) bool, flagged; rows: (num_worlds, ...) that should be finite."""
        self._fast[0] = self._rates[:, :3].square().sum(dim=1).max().sqrt()
        self._fast[1] = self._rates[:, 6:26].abs().max()
        torch.maximum(self._speeds, self._fast, out=self._speeds)
        finite = self._rates.isfinite().all(dim=1) & self._state.isfinite().all(dim=1)
        for each in rows:
            finite &= each.view(len(finite), -1).isfinite().all(dim=1)
        self._counts += torch.stack([bad.sum(), (self._residual > self._tolerance).sum(), (~finite).sum()])

    def read(self) -> tuple[int, int, int, float, float]:
        """Return flagged worlds, steps with a contact unsolved, rows not finite, and the largest speeds."""
        flagged, unsolved, rows = self._counts.tolist()
        return flagged, unsolved, rows, *self._speeds.tolist()


def soak_simulation(sim: Simulation, args: SoakArgs) -> dict:
    """Make all steps of a simulation under random targets, and return the figures."""
    totals, start = Totals(sim), time.perf_counter()
    for step, bad in enumerate(simulation_steps(sim, args)):
        totals.take(bad)
        if (step + 1) % args.episode_steps == 0 and totals.read()[2]:
            raise RuntimeError(f"a world holds values that are not finite but was not flagged, step {step}")
    return figures_of(totals, args.steps * sim.num_worlds, time.perf_counter() - start)


def soak_env(env: Env, args: SoakArgs) -> dict:
    """Make all steps of an environment under random actions, `hold` of them as one graph, and return the figures.

    Flagged are worlds that came apart. Not finite may be no row of the coordinates, rates, rewards and observations,
    those of the next episode where one has ended.
    """
    env.reset()
    apart = [term.name for term in env.task.terminations].index("came_apart")
    ending, totals, action = wp.to_torch(env.worlds.ending), Totals(env.sim), torch.zeros_like(env.action)

    def some() -> None:
        action.uniform_(-1.0, 1.0)
        for _ in range(args.hold_steps):
            env.step(action)
            totals.take(ending == apart, env.obs, env.critic_obs, env.reward)

    run, rounds = Captured(some, env.device.type == "cuda"), -(-args.steps // args.hold_steps)
    looks = max(args.episode_steps // args.hold_steps, 1)
    start = time.perf_counter()
    for i in range(rounds):
        run()
        if (i + 1) % looks == 0 and (rows := totals.read()[2]):
            raise RuntimeError(f"{rows} rows hold values that are not finite, by step {(i + 1) * args.hold_steps}")
    return figures_of(totals, rounds * args.hold_steps * env.num_envs, time.perf_counter() - start)


def figures_of(totals: Totals, count: int, wall: float) -> dict:
    """Return the figures of so many steps of worlds, made in a time [s]; waits for the device."""
    flagged, unsolved, rows, speed, joint_speed = totals.read()
    return {
        "steps": count,
        "non_finite_worlds": flagged,
        "non_finite_rows": rows,
        "largest_speed_m_s": speed,
        "largest_joint_speed_rad_s": joint_speed,
        "share_of_steps_contact_unsolved": unsolved / count,
        "wall_s": wall,
        "steps_per_s": count / wall,
    }
