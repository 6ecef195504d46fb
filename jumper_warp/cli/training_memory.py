"""How much memory a training needs, and a refusal before anything is built if there is less."""

from __future__ import annotations

import math
import os
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import world_size
from jumper_warp.sim.simulation import SolverName
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError

NUM_ACTIONS = 12
BUILDING: dict[SolverName, int] = {"jumper": 70_000, "mujoco": 112_000}
"""[byte] Of main memory for each world while the environment is built (`experiments/measure_memory.py`)."""
STANDING: dict[SolverName, int] = {"jumper": 25_750, "mujoco": 71_400}
"""[byte] Of the environment's own arrays on the device for each world, measured likewise."""
FLOAT = 4
"""[byte]"""
ORDER = 8
"""[byte] Of a sample's place in the order of an epoch."""
ZEROS = 21
"""At most so many numbers fill up a sample's row."""


class MemoryNeed(NamedTuple):
    """Memory that a process needs [byte]."""

    fixed: int
    per_world: int


class MemoryPool(NamedTuple):
    """A kind of memory: what the training needs of it, and how much is free [byte]."""

    need: MemoryNeed
    free: int
    name: str


def learning_need(cfg: PpoCfg, num_obs: int, num_critic_obs: int) -> MemoryNeed:
    """Return what PPO takes on the device, for networks and rollouts; num_critic_obs: the environment's, of a world.

    The peak is in the critic's pass over the whole rollout: the buffers, the samples as rows with their orders, the
    normalised observations with a copy of them, and the two widest layers.
    """
    critic_obs = num_critic_obs if cfg.asymmetric_critic else num_obs
    sizes = ((num_obs, *cfg.hidden, NUM_ACTIONS), (critic_obs, *cfg.hidden, 1))
    weights = sum((a + 1) * b for each in sizes for a, b in pairwise(each))
    row = FLOAT * (num_obs + critic_obs + 2 * NUM_ACTIONS + 4 + ZEROS)
    rows = cfg.num_steps * (row * (1.0 + 1.0 / cfg.minibatches) + ORDER * cfg.epochs)
    passing = FLOAT * cfg.num_steps * (2 * critic_obs + 2 * max(cfg.hidden))
    return MemoryNeed(4 * FLOAT * weights, rollout_bytes(cfg.num_steps, num_obs, critic_obs) + int(rows) + passing)


def rollout_bytes(num_steps: int, num_obs: int, num_critic_obs: int) -> int:
    """Return the size of `RolloutBuffer` for each world [byte] but for log_std; `num_critic_obs` the critic sees."""
    each = num_obs + 2 * num_critic_obs + 2 * NUM_ACTIONS + 3  # and one more of what follows the last step
    return FLOAT * (num_steps * each + num_obs + num_critic_obs)


def free_main_memory() -> int:
    """Return what programs can still take of main memory [byte]; all of it where the system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def check_memory(task: TaskCfg, ppo: PpoCfg, solver: SolverName, num_envs: int, device: torch.device) -> None:
    """Refuse a training of so many worlds in this process that does not fit into memory.

    Raises ValueError: it does not; the line tells the estimate, what is free, and a number of worlds that fits.
    """
    widths = [max(end for _, end in task.layout(group).values()) for group in ("actor", "critic")]
    learning = learning_need(ppo, *widths)
    main = free_main_memory() // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    building = MemoryNeed(0, BUILDING[solver])
    if device.type == "cuda":
        standing = MemoryNeed(learning.fixed, STANDING[solver] + learning.per_world)
        card = torch.cuda.mem_get_info(device)[0]
        pools = [MemoryPool(building, main, "main memory"), MemoryPool(standing, card, f"memory of {device}")]
    else:
        both = MemoryNeed(learning.fixed, building.per_world + learning.per_world)
        pools = [MemoryPool(both, main, "main memory")]
    fits = [(pool.free - pool.need.fixed) // pool.need.per_world for pool in pools]
    fit = min(fits)
    if num_envs <= fit:
        return
    need, free, name = pools[fits.index(fit)]
    needed = (need.fixed + num_envs * need.per_world) / 1.0e9
    grain = ppo.minibatches // math.gcd(ppo.minibatches, ppo.num_steps)
    most = world_size() * (fit // grain * grain)
    raise InputError(
        f"num_envs {world_size() * num_envs} needs about {needed:,.1f} GB of {name} in each process, "
        f"{free / 1.0e9:,.1f} GB are free: " + (f"num_envs {most} would fit" if most > 0 else "none would fit")
    )
