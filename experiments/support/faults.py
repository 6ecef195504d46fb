"""Trainings in forked processes in which a fault happens at a chosen file operation or processor time."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib
import json
import os
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch.distributed.launcher.api import LaunchConfig, elastic_launch

from jumper_warp.cli.main import main
from jumper_warp.envs.skill import kernels_of
from jumper_warp.registry import make_task
from jumper_warp.utils.runtime import init_warp

ITERATIONS, SAVE_INTERVAL = 12, 2  # Iterations of a training, and between its checkpoints
TRAIN = (
    "train vertical-jump --device cpu --threads 1 --num-envs 8 --no-tensorboard --log-interval 1 --ppo.num-steps 8 "
    f"--ppo.minibatches 2 --ppo.epochs 2 --ppo.hidden 32 32 --max-iterations {ITERATIONS} "
    f"--save-interval {SAVE_INTERVAL}"
).split()
"""A small training that saves often."""
TIMEOUT = 600.0  # [s] Time after which a training counts as hanging
OPERATIONS = ("open", "os.rename", "os.remove", "os.mkdir")  # Audit events of file operations
Action = Callable[[], object]


def warm_up() -> None:
    """Import all that a training imports, and build its kernels' code, before processes are forked.

    It starts no threads, as a forked process would lack them.
    """
    os.environ["CUDA_VISIBLE_DEVICES"] = ""  # a forked process could not use a GPU
    for module in ("cli.train", "training", "envs.env"):
        importlib.import_module(f"jumper_warp.{module}")
    wp.config.log_level = wp.LOG_WARNING
    init_warp()
    kernels_of(make_task(TRAIN[1]))


def fork(job: Action, log: Path) -> int:
    """Run a job in a forked process, with its output in a log file; return the process id.

    The process exits as a Python program does: with code 1 and a traceback after an exception.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    if pid := os.fork():
        return pid
    code: Any = 1
    try:
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(output, 1)
        os.dup2(output, 2)
        job()
        code = 0
    except SystemExit as end:
        code = end.code
    except BaseException:
        traceback.print_exc()
    if isinstance(code, str):
        print(code, file=sys.stderr)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else int(code is not None))


def wait(pid: int) -> int:
    """Return the exit code of a forked process, minus the signal's number if one ended it.

    Raises TimeoutError: it does not end; it is killed.
    """
    end = time.monotonic() + TIMEOUT
    while time.monotonic() < end:
        if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        time.sleep(0.01)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    raise TimeoutError(f"a training has not ended after {TIMEOUT:g} s")


def on_file_operations(root: Path, actions: Mapping[int, Action]) -> Callable[[], int]:
    """Call `actions[n]` before the n-th file operation below a folder; return a function that returns their number.

    The first operation has n = 1. Operations are counted until the process ends.
    """
    count, prefix = 0, f"{root}{os.sep}"

    def hook(event: str, args: tuple) -> None:
        nonlocal count
        if event in OPERATIONS and str(args[0]).startswith(prefix):
            count += 1
            actions.get(count, lambda: None)()

    sys.addaudithook(hook)
    return lambda: count


def after_processor_time(seconds: float, action: Action) -> None:
    """Call an action in a thread once this process has used more processor time [s]."""
    end = time.process_time() + seconds

    def work() -> None:
        while time.process_time() < end:
            time.sleep(0.002)
        action()

    threading.Thread(target=work, daemon=True).start()


def launch_ranks(job: Callable[[], None], ranks: int, restarts: int) -> None:
    """Run a job in several processes as torchrun does; restarts: how often all are restarted after one has died.

    Raises torch.distributed.elastic's ChildFailedError: a process died, and no restart is left.
    """
    os.environ.update(GLOO_SOCKET_IFNAME="lo", OMP_NUM_THREADS="1")
    # else restarted processes read the addresses of those that died
    os.environ["TORCH_DISABLE_SHARE_RDZV_TCP_STORE"] = "1"
    settings = LaunchConfig(
        min_nodes=1, max_nodes=1, nproc_per_node=ranks, run_id="faults", rdzv_backend="c10d", max_restarts=restarts,
        rdzv_endpoint="127.0.0.1:0", local_addr="127.0.0.1", monitor_interval=0.1, start_method="fork",
    )  # fmt: skip
    elastic_launch(settings, job)()


def train(args: Sequence[str]) -> None:
    """Run `jumper train` in this process with the small training `TRAIN` and more arguments."""
    main([*TRAIN, *args])


def shift_clock(seconds: float) -> None:
    """Let `time.time` and `time.time_ns` of this process return a time later by `seconds`."""
    now, now_ns, nanoseconds = time.time, time.time_ns, int(seconds * 1e9)
    time.time = lambda: now() + seconds
    time.time_ns = lambda: now_ns() + nanoseconds


def drop_privileges() -> None:
    """Drop this process's capabilities, so that permissions of files also hold for root."""
    if os.geteuid() == 0:
        header, none = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
        if ctypes.CDLL(None, use_errno=True).capset(header, none):
            raise OSError(ctypes.get_errno(), "capset")


def fill_disk(folder: Path, left: int) -> None:
    """Fill the disk of a folder with the file `filler`, but for about `left` bytes."""
    with contextlib.suppress(OSError), (folder / "filler").open("wb", buffering=0) as file:
        free = shutil.disk_usage(folder).free
        os.posix_fallocate(file.fileno(), 0, max(free - left, 1))


def digest(state: dict[str, Any]) -> dict[str, str]:
    """Return checksums of a checkpoint by part: iteration, algorithm, environment, random generators, other ranks."""
    return {part: _checksum(state[part]) for part in ("iteration", "ppo", "env", "rng", "others")}


def _checksum(value: Any) -> str:
    """Return the SHA-256 of tensors, numbers and text in nested dicts and lists."""
    sha = hashlib.sha256()

    def add(part: Any) -> None:
        if isinstance(part, dict):
            part = [item for pair in sorted(part.items(), key=lambda pair: str(pair[0])) for item in pair]
        if isinstance(part, (list, tuple)):
            for item in part:
                add(item)
        elif isinstance(part, torch.Tensor):
            sha.update(f"{part.dtype}{tuple(part.shape)}".encode() + part.contiguous().view(-1).numpy().tobytes())
        else:
            sha.update(repr(part).encode())

    add(value)
    return sha.hexdigest()


def logged(folder: Path) -> list[dict[str, Any]]:
    """Return the metrics of each logged iteration of a run, without times."""
    path = folder / "metrics.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    return [{name: value for name, value in line.items() if not name.startswith("Perf/")} for line in lines]
