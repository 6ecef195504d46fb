"""Several training processes, one a device."""

import hashlib
import io
import os
from collections.abc import Callable
from typing import Any, NamedTuple

import torch

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.threads import available_threads

NCCL = {"NCCL_NVLS_ENABLE": "0", "NCCL_GRAPH_REGISTER": "0"}
"""Settings of NCCL that are made unless the user did: no multicast over NVLink, which not every machine allows, and no
registration of buffers while a graph is captured, for which the ranks would have to wait for each other then."""


def world_size() -> int:
    """Return the number of training processes."""
    return torch.distributed.get_world_size() if torch.distributed.is_initialized() else 1


def wait_for_ranks() -> None:
    """Wait until every process got here, so that none leaves the group while another still uses it."""
    if world_size() > 1:
        torch.distributed.barrier()


def all_reduce_max(values: list[int]) -> list[int]:
    """Return the largest of each number over all processes; each waits for the others."""
    if world_size() == 1:
        return values
    vector = torch.tensor(values, device="cuda" if torch.distributed.get_backend() == "nccl" else "cpu")
    torch.distributed.all_reduce(vector, op=torch.distributed.ReduceOp.MAX)
    return vector.tolist()


def all_ranks_agree(agreed: bool) -> bool:
    """Return whether all processes agree; each waits for the others."""
    return all_reduce_max([int(not agreed)]) == [0]


def same_on_all_ranks(text: str) -> bool:
    """Return whether all processes call this with the same text; each waits for the others."""
    number = int.from_bytes(hashlib.sha256(text.encode()).digest()[:7], "big")
    return all_reduce_max([number, -number]) == [number, -number]


def local_rank_zero_first(procedure: Callable[[], None]) -> None:
    """Run a procedure on the first process of each machine, then on the others, which find its files."""
    if world_size() == 1:
        procedure()
        return
    first = os.environ.get("LOCAL_RANK", "0") == "0"
    for turn in (True, False):
        if first == turn:
            procedure()
        wait_for_ranks()


def all_reduce_mean(x: torch.Tensor) -> torch.Tensor:
    """Average a tensor in place over all training processes, and return it."""
    if world_size() > 1:
        torch.distributed.all_reduce(x)
        x.div_(world_size())
    return x


class Rank(NamedTuple):
    """This process among those that train together."""

    index: int
    """0 for the one that logs and saves."""
    size: int
    device: torch.device


def init_distributed(device: str | None = None, threads: int | None = None) -> Rank:
    """Return this process's place; under torchrun (RANK, LOCAL_RANK, WORLD_SIZE), join the other processes.

    threads: of torch on a CPU, unless OMP_NUM_THREADS is set.

    Raises ValueError: there is no such device.
    """
    kind = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    if kind.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device {device} asked for, but torch finds no GPU")
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size > 1 and kind.type == "cuda":
        kind = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
    elif kind.type == "cuda" and kind.index is None:
        kind = torch.device("cuda", 0)
    if kind.type == "cuda":
        torch.cuda.set_device(kind)
    elif "OMP_NUM_THREADS" not in os.environ:
        # small networks gain little from many threads, and lose where these wait on a busy machine
        cores = available_threads()
        torch.set_num_threads(threads or min(cores, max(2, cores // 2)))
    if size > 1 and not torch.distributed.is_initialized():
        for name, value in NCCL.items():
            os.environ.setdefault(name, value)
        torch.distributed.init_process_group("nccl" if kind.type == "cuda" else "gloo")
    return Rank(int(os.environ.get("RANK", "0")) if size > 1 else 0, size, kind)


def gather(state: dict[str, Any], rank: Rank) -> list[dict[str, Any]]:
    """Return the state of every process, in process 0; tensors travel as bytes and are read as weights only."""
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
