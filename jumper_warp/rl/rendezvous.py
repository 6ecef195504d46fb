"""How the processes of torchrun find each other, after a restart too."""

from __future__ import annotations

import os
import time
import uuid

import torch

PAUSE = 0.01
"""[s] Between two looks into the store."""


def elastic_store() -> torch.distributed.Store | None:
    """Return the store of torchrun's agent under names of this start alone; None if no agent has one.

    The agent's store outlives a restart. Under the same names, processes would find the addresses of those that are
    gone. All processes must call this.
    """
    if os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True":
        return None
    store, rank, size = next(torch.distributed.rendezvous("env://"))
    return torch.distributed.PrefixStore(f"start/{agreed_name(store, rank, size)}", store)


def agreed_name(store: torch.distributed.Store, rank: int, size: int) -> str:
    """Return the name that process 0 has drawn, in every process, whatever earlier ones have left in the store.

    Each of the others asks under a name that it has drawn itself, so that no answer can be an old one.
    """
    own = uuid.uuid4().hex
    if rank > 0:
        store.set(f"asks/{rank}", own)
        found = store.get(f"answer/{own}").decode()
        store.set(f"heard/{found}/{rank}", "")
        return found
    left = set(range(1, size))
    while left:
        for other in sorted(left):
            if store.check([f"heard/{own}/{other}"]):
                left.remove(other)
            elif store.check([f"asks/{other}"]):
                store.set(f"answer/{store.get(f'asks/{other}').decode()}", own)
        time.sleep(PAUSE)
    return own
