"""Restarts by torchrun: when a process has died, all begin again, and go on with their own run."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from jumper_warp.rl.checkpoint import newest_checksum
from jumper_warp.rl.resume import CHECKPOINTS
from jumper_warp.utils.files import write_whole

if TYPE_CHECKING:
    from jumper_warp.rl.cfg import TrainCfg
    from jumper_warp.rl.distributed import Rank

MARK = "elastic.json"
"""File of a run: the agents of torchrun that it runs under, and the newest checkpoint from before."""
LONGEST = 4096
"""Bytes of a text that processes tell each other."""


def own_run(cfg: TrainCfg, rank: Rank) -> tuple[TrainCfg, Path | None]:
    """Return the settings with which a process begins, and the folder of its run; None: there is none yet.

    After a restart it is the folder that the run had before. The settings resume its newest checkpoint, whatever the
    run began with, and are left alone where none was saved since. All processes must call this, and see the same
    folders.
    """
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return cfg, None
    told = [json.loads(text) for text in tell(json.dumps([_agent(), _restarts()]), rank)]
    if max(restarts for _, restarts in told) == 0:  # an agent counts the failures of its own processes only
        return cfg, None
    found = _marked(cfg, {agent for agent, _ in told}) if rank.index == 0 else None
    name = tell(str(found or ""), rank)[0]
    if not name:
        return cfg, None
    folder = Path(name)
    if newest_checksum(folder / CHECKPOINTS) != json.loads((folder / MARK).read_text())["newest"]:
        cfg = dataclasses.replace(cfg, resume=name, start_from=None)
    return cfg, folder


def mark_run(folder: Path, rank: Rank) -> None:
    """Note in a run's folder under which agents it begins; all processes must call this."""
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return
    agents = sorted(set(tell(_agent(), rank)))
    if rank.index == 0:
        mark = {"agents": agents, "newest": newest_checksum(folder / CHECKPOINTS)}
        write_whole(folder / MARK, json.dumps(mark, indent=1).encode())


def tell(text: str, rank: Rank) -> list[str]:
    """Return a text of every process, in every process."""
    if rank.size == 1:
        return [text]
    data = text.encode()
    own = torch.zeros(LONGEST, dtype=torch.uint8)
    own[: len(data)] = torch.frombuffer(bytearray(data), dtype=torch.uint8) if data else own[:0]
    parts = [torch.zeros(LONGEST, dtype=torch.uint8, device=rank.device) for _ in range(rank.size)]
    torch.distributed.all_gather(parts, own.to(rank.device))
    return [bytes(part.cpu().numpy()).rstrip(b"\0").decode() for part in parts]


def _agent() -> str:
    """Return the name of the agent that started this process and would start it again."""
    return f"{os.environ['TORCHELASTIC_RUN_ID']} {platform.node()} {os.getppid()}"


def _restarts() -> int:
    return int(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"))


def _marked(cfg: TrainCfg, agents: set[str]) -> Path | None:
    """Return the run that one of the agents has begun, or resumed, last."""
    given = Path(cfg.resume or "")  # a run, its checkpoints, or one of these
    marks = {*(cfg.log_root / cfg.task).glob(f"*/{MARK}"), *(path / MARK for path in (given, *list(given.parents)[:2]))}
    for mark in sorted(filter(Path.is_file, marks), key=lambda path: path.stat().st_mtime, reverse=True):
        try:
            if agents & set(json.loads(mark.read_text())["agents"]):
                return mark.parent
        except (ValueError, LookupError, TypeError):
            continue  # no mark of ours
    return None
