"""Random actions for a long time, on a simulation or on a whole environment."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import warp as wp

from jumper_warp.envs.env import Env
from jumper_warp.sim.simulation import Simulation
from jumper_warp.utils.errors import InputError


@dataclass(frozen=True)
class SoakArgs:
    """Flags of a soak test."""

    envs: int = 1024
    """Number of environments."""
    steps: int = 10_000
    """Policy steps of each; with 1024 environments 10 million in all."""
    hold: int = 10
    """Policy steps for which an action is held."""
    episode: int = 300
    """Policy steps after which all worlds start again; of whole environments, after which they are looked at."""
    lateral: float = 15.0
    """[deg] Largest lateral target."""
    transversal: tuple[float, float] = (-30.0, 140.0)
    """[deg] Least and largest transversal target."""
    filter: bool = False
    """Whether the motor command filter guards the targets."""
    task: str | None = None
    """Name of a task whose environment is tried, with limits and filter of its own, instead of the simulation alone."""
    seed: int = 0
    """Of actions, masses and friction."""
    out: Path | None = None
    """Folder for figures.json (default: outputs/soak_test/<time>)."""
    device: str | None = None
    """Warp device."""
    threads: int | None = None
    """CPU threads that share the worlds (default: all cores); they change no result."""

    def __post_init__(self) -> None:
        """Check the values."""
        for name in ("envs", "steps", "hold", "episode"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")


def randomize(sim: Simulation, rng: np.random.Generator) -> None:
    """Give every world its own masses (0.8 to 1.25 times) and paw friction (0.2 to 1.2)."""
    model, n = sim.model, sim.num_worlds
    scale = rng.uniform(0.8, 1.25, n).astype(np.float32)
    model.body_mass.assign(model.body_mass.numpy() * np.repeat(scale, 21))
    model.body_inertia.assign(model.body_inertia.numpy() * np.repeat(scale, 21)[:, None, None])
    worlds, friction = model.shape_world.numpy(), rng.uniform(0.2, 1.2, n).astype(np.float32)
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
        if step % args.hold == 0:
            target.copy_(lower + (upper - lower) * torch.rand_like(target))
        sim.step()
        last = (step + 1) % args.episode == 0 or step + 1 == args.steps
        yield (invalid != 0) & last
        if last:  # flagged worlds are counted once
            sim.reset()


def env_steps(env: Env, args: SoakArgs) -> Iterator[torch.Tensor]:
    """Make all steps of an environment under random actions; after each, give which worlds came apart in it."""
    env.reset()
    apart = [term.name for term in env.task.terminations].index("came_apart")
    ending = wp.to_torch(env.worlds.ending)
    for step in range(args.steps):
        if step % args.hold == 0:
            action = 2.0 * torch.rand_like(env.action) - 1.0
        env.step(action)
        yield ending == apart


def soak(sim: Simulation, steps: Iterator[torch.Tensor], args: SoakArgs) -> dict:
    """Make all steps and return the figures."""
    rates = wp.to_torch(sim.state.joint_qd).view(sim.num_worlds, -1)
    residual = wp.to_torch(sim.solver.residual)
    speed, joint_speed = (rates.new_zeros(()) for _ in range(2))
    unsolved, flagged = (torch.zeros((), dtype=torch.int64, device=rates.device) for _ in range(2))
    start = time.perf_counter()
    for step, bad in enumerate(steps):
        speed = torch.maximum(speed, rates[:, :3].norm(dim=1).max())
        joint_speed = torch.maximum(joint_speed, rates[:, 6:26].abs().max())
        unsolved += (residual > sim.solver.tolerance).sum()
        flagged += bad.sum()
        if (step + 1) % args.episode == 0 and not bool(rates.isfinite().all()):
            raise RuntimeError(f"a world holds values that are not finite but was not flagged, step {step}")
    wall, count = time.perf_counter() - start, args.steps * sim.num_worlds
    return {
        "steps": count,
        "non_finite_worlds": int(flagged),
        "largest_speed_m_s": float(speed),
        "largest_joint_speed_rad_s": float(joint_speed),
        "share_of_steps_contact_unsolved": float(unsolved) / count,
        "wall_s": wall,
        "steps_per_s": count / wall,
    }
