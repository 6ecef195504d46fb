"""Buffer on the device that keeps all policy steps of an iteration for a few watched worlds of an environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp

from jumper_warp.kernels.mdp.watched import WatchedSource, watched_kernel
from jumper_warp.live.clips import LONGEST, ROLES, Layout
from jumper_warp.utils.kernels import load_kernels, records
from jumper_warp.utils.threads import locked

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env

BLOCK = 256  # Threads of a block of the kernel


class WorldBuffer:
    """Buffer of the policy steps of one watched world for each of ROLES, and the last returns of all worlds.

    `record` only reads the environment: its results are bitwise those without a buffer. After each iteration `fetch`
    copies the buffer once, on a GPU without waiting. A world is watched until it has made a whole episode; then another
    one takes its place.
    layout: half-open range of columns by name (world, done, termination, level, joint_q, rewards, state). state_type:
    NumPy's type of the state.
    """

    def __init__(self, env: Env, steps: int) -> None:
        """Allocate a buffer of `steps` policy steps, and load its kernel; the first worlds are evenly spaced."""
        self.env = env
        self.steps = steps
        device = env.wp_device
        sources = self._sources()
        self.layout: Layout = {}
        first = 0
        for name, array in sources.items():
            self.layout[name] = (first, first + array.shape[1])
            first += array.shape[1]
        widths = [array.shape[1] for array in sources.values()]
        structs = []
        for array in sources.values():
            struct: Any = WatchedSource()
            struct.words = array
            structs.append(struct)
        source_of = np.repeat(np.arange(len(widths), dtype=np.int32), widths)
        word_of = np.concatenate([np.arange(width, dtype=np.int32) for width in widths])
        worlds = np.linspace(0, env.num_envs - 1, len(ROLES)).round().astype(np.int32)
        size = steps * len(ROLES) * first
        self._flat = torch.zeros(size + env.num_envs, dtype=torch.int32, device=env.device)
        returns = self._flat[size:].view(torch.float32).fill_(torch.nan)
        self._worlds = torch.from_numpy(worlds).to(env.device)
        self._running = wp.zeros(env.num_envs, dtype=float, device=device)
        self._kept = (sources, structs)  # the kernel reads their memory
        self._inputs = [
            wp.from_torch(self._worlds, dtype=wp.int32), wp.array(structs, dtype=WatchedSource, device=device),
            wp.array(source_of, dtype=wp.int32, device=device), wp.array(word_of, dtype=wp.int32, device=device),
            env.episodes.reward, env.episodes.done, self._running, wp.from_torch(returns),
            wp.from_torch(self._flat[:size].view(steps, len(ROLES), first), dtype=wp.int32),
        ]  # fmt: skip
        self._step = 0
        self.number = 0  # Iterations that `fetch` has returned
        self._host = self._flat
        if env.device.type == "cuda":
            self._host = torch.empty_like(self._flat, device="cpu", pin_memory=True)
        self._copied: torch.cuda.Event | None = None
        self._choice = np.random.default_rng(0)
        self._following = [int(world) for world in worlds]
        self._ends = np.zeros(len(ROLES), dtype=int)  # Episodes that ended in each watched world since it was chosen
        self._age = np.zeros(len(ROLES), dtype=int)  # [policy steps] since then
        load_kernels([(watched_kernel, BLOCK)], device)
        self._launch: Any = wp.launch(
            watched_kernel, max(env.num_envs, len(ROLES) * first), inputs=[0, *self._inputs], device=device,
            block_dim=BLOCK, record_cmd=True,
        )  # fmt: skip

    def _sources(self) -> dict[str, wp.array]:
        """Return the recorded values of all worlds as words by name, (num_envs, width) views of the environment."""
        env = self.env
        n = env.num_envs
        first = env.skills[0]
        terms = first.term_value.shape[0]
        self.state_type = records(first.states).dtype
        index = wp.array(np.arange(n), dtype=wp.int32, device=env.wp_device)
        strides = {"rewards": (4, 4 * n)}
        arrays = {
            "world": (index, 1), "done": (env.episodes.done, 1), "termination": (env.episodes.termination, 1),
            "level": (env.episodes.level, 1), "joint_q": (env.robot.joint_q, len(env.robot.joint_q) // n),
            "rewards": (first.term_value, terms), "state": (first.states, self.state_type.itemsize // 4),
        }  # fmt: skip
        self._index = index
        return {
            name: wp.array(
                ptr=array.ptr, dtype=wp.int32, shape=(n, width), strides=strides.get(name), device=env.wp_device
            )
            for name, (array, width) in arrays.items()
        }

    @locked
    def record(self) -> None:
        """Record the environment's last policy step; a captured graph of an iteration may contain the call."""
        self._launch.set_param_at_index(0, self._step)
        self._launch.launch()
        self._step = (self._step + 1) % self.steps

    def fetch(self) -> np.ndarray | None:
        """Return the words of an iteration, (steps, slots, columns) int32, and choose worlds for the next one.

        On a GPU they are those of an earlier iteration, whose copy has ended; None: it has not yet.
        """
        if self._host is self._flat:
            return self._read()
        if self._copied is not None and not self._copied.query():
            return None
        words = None if self._copied is None else self._read()
        self._host.copy_(self._flat, non_blocking=True)
        self._copied = torch.cuda.Event()
        self._copied.record()
        return words

    def _read(self) -> np.ndarray:
        """Return a copy of the words on the host, and replace worlds that have made a whole episode."""
        self.number += 1
        host = self._host.numpy()
        words = host[: -self.env.num_envs].reshape(self.steps, len(ROLES), -1).copy()
        current = words[..., 0] == self._following
        self._ends += (current & (words[..., 1] != 0)).sum(axis=0)
        self._age += current.sum(axis=0)
        ended = (self._ends > 1) | (self._age > 2 * LONGEST)
        if ended.any():
            returns = host[-self.env.num_envs :].view(np.float32)
            order = np.argsort(returns)[: np.isfinite(returns).sum()]
            for slot in np.flatnonzero(ended):
                self._following[slot] = self._choose(ROLES[slot], order)
            self._ends[ended] = 0
            self._age[ended] = 0
            worlds = torch.tensor(self._following, dtype=torch.int32)
            self._worlds.copy_(worlds, non_blocking=True)
        return words

    def _choose(self, role: str, order: np.ndarray) -> int:
        """Return the world for a role that is not watched yet; order: worlds by their last return, ascending."""
        middle = len(order) // 2
        by_role = {"best": order[::-1], "worst": order, "median": np.roll(order, -middle)}
        candidates = [*by_role.get(role, ()), *self._choice.permutation(self.env.num_envs)]
        return next((int(world) for world in candidates if world not in self._following), int(candidates[0]))
