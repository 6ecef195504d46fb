"""Estimate of the memory that a training needs, compared with the free memory before anything is built."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import torch
import warp as wp

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.distributed import world_size
from jumper_warp.sim.simulation import SolverName
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.threads import checked_threads, torchrun_variable

NUM_ACTIONS = 12  # motors
BUILD_BYTES: dict[SolverName, int] = {"jumper": 70_000, "mujoco": 112_000}
"""[byte] Main memory for each world while the environment is built (`experiments/measure_memory.py`)."""
ENV_BYTES: dict[SolverName, int] = {"jumper": 23_400, "mujoco": 71_400}
"""[byte] Device memory of the environment's arrays for each world, measured likewise."""
RECORD_BYTES = 73_000
"""[byte] Memory for the first non-finite values of a task's terms, for each thread of a CPU, or once on a GPU."""
FLOAT_BYTES = 4  # [byte] Size of a float32
INDEX_BYTES = 8  # [byte] Size of a sample's index in the order of an epoch
MAX_PADDING = 21  # Largest number of floats that pad a sample's row


class MemoryNeed(NamedTuple):
    """Memory that a process needs [byte]: a fixed part, and a part for each world."""

    fixed: int
    per_world: int


class MemoryPool(NamedTuple):
    """Main memory or the memory of a GPU: its name, free size [byte], and what a training needs of it."""

    name: str
    free: int
    need: MemoryNeed

    def max_worlds(self) -> int:
        """Return the number of worlds whose training fits into the free memory."""
        return (self.free - self.need.fixed) // self.need.per_world


def learning_need(cfg: PpoCfg, num_obs: int, num_critic_obs: int) -> MemoryNeed:
    """Return the device memory that PPO's networks and rollouts need [byte], fixed and for each world.

    num_obs, num_critic_obs: sizes of the observations of actor and critic.
    The peak is in the critic's pass over the whole rollout: the buffers, the samples as rows with their orders, the
    normalised observations and a copy of them, and two layers of the greatest width.
    """
    critic_obs = num_critic_obs if cfg.asymmetric_critic else num_obs
    sizes = ((num_obs, *cfg.hidden, NUM_ACTIONS), (critic_obs, *cfg.hidden, 1))
    weights = sum((a + 1) * b for each in sizes for a, b in pairwise(each))
    sample_bytes = FLOAT_BYTES * (num_obs + critic_obs + 2 * NUM_ACTIONS + 4 + MAX_PADDING)
    samples = cfg.num_steps * (sample_bytes * (1.0 + 1.0 / cfg.minibatches) + INDEX_BYTES * cfg.epochs)
    critic_pass = FLOAT_BYTES * cfg.num_steps * (2 * critic_obs + 2 * max(cfg.hidden))
    per_world = rollout_bytes(cfg.num_steps, num_obs, critic_obs) + int(samples) + critic_pass
    return MemoryNeed(4 * FLOAT_BYTES * weights, per_world)


def rollout_bytes(num_steps: int, num_obs: int, num_critic_obs: int) -> int:
    """Return the size of PPO's rollout buffers for each world [byte]."""
    per_step = num_obs + 2 * num_critic_obs + 2 * NUM_ACTIONS + 3  # reward, done, timeout
    return FLOAT_BYTES * (num_steps * per_step + num_obs + num_critic_obs)  # observations after the last step


def free_main_memory() -> int:
    """Return the available main memory [byte]; the total memory on systems without /proc/meminfo."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def memory_pools(
    task: TaskCfg, ppo: PpoCfg, solver: SolverName, device: torch.device, *, rebuilt: bool = False
) -> list[MemoryPool]:
    """Return main memory and GPU memory, each with its free size and what a training in this process needs of it.

    rebuilt: count memory that this process uses as free.
    """
    num_obs, num_critic_obs = (max(end for _, end in task.layout(group).values()) for group in ("actor", "critic"))
    threads = 1 if device.type == "cuda" else checked_threads(None)
    learning = learning_need(ppo, num_obs, num_critic_obs)
    learning = learning._replace(fixed=learning.fixed + threads * RECORD_BYTES)
    main_free = free_main_memory() // torchrun_variable("LOCAL_WORLD_SIZE")
    main_free += own_main_memory() if rebuilt else 0
    build_bytes = BUILD_BYTES[solver]
    if device.type != "cuda":
        return [MemoryPool("main memory", main_free, MemoryNeed(learning.fixed, build_bytes + learning.per_world))]
    on_device = MemoryNeed(learning.fixed, ENV_BYTES[solver] + learning.per_world)
    free = torch.cuda.mem_get_info(device)[0] + (own_device_memory(device) if rebuilt else 0)
    return [
        MemoryPool("main memory", main_free, MemoryNeed(0, build_bytes)),
        MemoryPool(f"memory of {device}", free, on_device),
    ]


def own_main_memory() -> int:
    """Return the main memory that this process uses [byte]; 0 on systems without /proc."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0


def own_device_memory(device: torch.device) -> int:
    """Return the memory of a GPU that torch's and Warp's allocators hold in this process [byte]."""
    pooled = wp.get_mempool_used_mem_current(str(device)) if wp.is_mempool_enabled(str(device)) else 0
    return torch.cuda.memory_reserved(device) + pooled


def check_memory(task: TaskCfg, ppo: PpoCfg, solver: SolverName, num_envs: int, device: torch.device) -> None:
    """Raise InputError unless the `num_envs` worlds of this process fit into free memory.

    The message has the estimate, the free memory [GB], and a number of worlds that fits.
    """
    pools = memory_pools(task, ppo, solver, device)
    if num_envs > min(map(MemoryPool.max_worlds, pools)):
        raise InputError(describe_need(pools, ppo, num_envs))


def describe_need(pools: Sequence[MemoryPool], ppo: PpoCfg, num_envs: int) -> str:
    """Return one line on the memory that limits the number of worlds: need and free size [GB], and worlds that fit.

    If `num_envs`, of this process, should fit, half of it is suggested.
    """
    tightest = min(pools, key=MemoryPool.max_worlds)
    max_worlds = tightest.max_worlds()
    advice = "would fit" if max_worlds < num_envs else "may fit"
    max_worlds = max_worlds if max_worlds < num_envs else num_envs // 2
    needed = (tightest.need.fixed + num_envs * tightest.need.per_world) / 1.0e9
    multiple = ppo.minibatches // math.gcd(ppo.minibatches, ppo.num_steps)  # num_envs is divisible by it
    largest = world_size() * (max_worlds // multiple * multiple)
    return (
        f"num_envs {world_size() * num_envs} needs about {needed:,.1f} GB of {tightest.name} in each process, "
        f"{tightest.free / 1.0e9:,.1f} GB are free: "
        + (f"num_envs {largest} {advice}" if largest > 0 else "none would fit")
    )
