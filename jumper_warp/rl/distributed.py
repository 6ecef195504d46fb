"""Distributed training: one process (rank) per device."""

import hashlib
import importlib
import io
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import torch

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.threads import available_threads, torchrun_variable

NCCL = {"NCCL_NVLS_ENABLE": "0", "NCCL_GRAPH_REGISTER": "0"}
"""Defaults of NCCL's environment variables: no NVLink multicast, which some machines forbid, and no registration of
buffers during graph capture, which would synchronise the ranks."""


def world_size() -> int:
    """Return the number of training processes."""
    return torch.distributed.get_world_size() if torch.distributed.is_initialized() else 1


def wait_for_ranks() -> None:
    """Block until every process has reached this call."""
    if world_size() > 1:
        torch.distributed.barrier()


def all_reduce_max(values: list[int]) -> list[int]:
    """Return the elementwise maximum of a list over all processes (blocking); all lists have equal length."""
    if world_size() == 1:
        return values
    vector = torch.tensor(values, device="cuda" if torch.distributed.get_backend() == "nccl" else "cpu")
    torch.distributed.all_reduce(vector, op=torch.distributed.ReduceOp.MAX)
    return vector.tolist()


def all_ranks_agree(agreed: bool) -> bool:
    """Return whether every process passes True; blocks until all processes have called."""
    return all_reduce_max([int(not agreed)]) == [0]


def same_on_all_ranks(text: str) -> bool:
    """Return whether all processes pass the same text (blocking).

    The maxima of a hash d and of -d over all processes are d and -d only if all are equal. Seven bytes fit an int64.
    """
    digest = int.from_bytes(hashlib.sha256(text.encode()).digest()[:7], "big")
    return all_reduce_max([digest, -digest]) == [digest, -digest]


def local_rank_zero_first(procedure: Callable[[], None]) -> None:
    """Run a procedure on local rank 0 of each machine, then on the others, where it can use cached files."""
    if world_size() == 1:
        procedure()
        return
    local_rank_zero = os.environ.get("LOCAL_RANK", "0") == "0"
    for turn in (True, False):
        if local_rank_zero == turn:
            procedure()
        wait_for_ranks()


def all_reduce_mean(x: torch.Tensor) -> torch.Tensor:
    """Average a tensor in place over all training processes, and return it."""
    if world_size() > 1:
        torch.distributed.all_reduce(x)
        x.div_(world_size())
    return x


class Rank(NamedTuple):
    """Identity of this training process: its rank (index), the number of processes, and its device."""

    index: int  # 0 for the process that logs and saves
    size: int  # number of processes
    device: torch.device


def init_distributed(device: str | None = None, threads: int | None = None) -> Rank:
    """Select the device, join the process group under torchrun (RANK, LOCAL_RANK, WORLD_SIZE), and return the rank.

    device: torch device (default: a GPU if there is one); several ranks use cuda:LOCAL_RANK.
    threads: torch's CPU threads, unless OMP_NUM_THREADS is set. Raises InputError: there is no such device, or a
    variable is missing or invalid.
    """
    try:
        selected = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    except RuntimeError as error:
        raise InputError(f"no device {device!r:.60} ({error!s:.100})") from error
    if selected.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device {device} requested, but torch finds no GPU")
    size = torchrun_variable("WORLD_SIZE")
    index = torchrun_variable("RANK", 0, 0, size - 1) if size > 1 else 0
    if size > 1 and selected.type == "cuda":
        selected = torch.device("cuda", torchrun_variable("LOCAL_RANK", index, 0))
    elif selected.type == "cuda" and selected.index is None:
        selected = torch.device("cuda", 0)
    if selected.type == "cuda":
        torch.cuda.set_device(selected)
    elif "OMP_NUM_THREADS" not in os.environ:
        # small networks gain little from many threads, and lose on a busy machine
        cores = available_threads()
        torch.set_num_threads(threads or min(cores, max(2, cores // 2)))
    if size > 1 and not torch.distributed.is_initialized():
        for name, value in NCCL.items():
            os.environ.setdefault(name, value)
        # default arguments of this module keep the group that exists at its import: with a group, its threads would
        # outlive Python, and then abort the process
        importlib.import_module("torch.distributed.nn.functional")
        try:
            torch.distributed.init_process_group("nccl" if selected.type == "cuda" else "gloo")
        except ValueError as error:  # a variable is missing
            raise InputError(f"{error}; start several processes with torchrun") from error
    return Rank(index, size, selected)


def gather_states(state: dict[str, Any], rank: Rank) -> list[dict[str, Any]]:
    """Return, on rank 0, the states (nested dicts of tensors) of all ranks in order; on other ranks, an empty list."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    data = torch.frombuffer(bytearray(buffer.getvalue()), dtype=torch.uint8).to(rank.device)
    sizes = [torch.zeros(1, dtype=torch.int64, device=rank.device) for _ in range(rank.size)]
    torch.distributed.all_gather(sizes, torch.tensor([len(data)], device=rank.device))
    longest = max(int(size) for size in sizes)
    parts = [torch.zeros(longest, dtype=torch.uint8, device=rank.device) for _ in range(rank.size)]
    torch.distributed.all_gather(parts, torch.nn.functional.pad(data, (0, longest - len(data))))
    if rank.index != 0:
        return []
    sent = [part[: int(size)].cpu().numpy().tobytes() for part, size in zip(parts, sizes, strict=True)]
    return [torch.load(io.BytesIO(part), weights_only=True) for part in sent]


def other_states(local: dict[str, Any], rank: Rank) -> list[dict[str, Any]]:
    """Gather the other ranks' states of environment, generators and episodes on rank 0; return [] elsewhere.

    local: the state of this rank, with `ppo`, of which only `episode` differs between ranks.
    """
    if world_size() == 1:
        return []
    return gather_states({**local, "ppo": {"episode": local["ppo"]["episode"].cpu()}}, rank)[1:]
