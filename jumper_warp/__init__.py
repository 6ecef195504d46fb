"""Simulation and reinforcement learning for the quadruped Jumper; the names that are typed every day, on demand."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env as Env
    from jumper_warp.policies.folder import load_policy as load_policy
    from jumper_warp.registry import make_task as make_task
    from jumper_warp.robot.model import build_model as build_model
    from jumper_warp.sim.simulation import Simulation as Simulation
    from jumper_warp.sim.solver import SolverJumper as SolverJumper

_PLACES = {
    "Env": "jumper_warp.envs.env",
    "Simulation": "jumper_warp.sim.simulation",
    "SolverJumper": "jumper_warp.sim.solver",
    "build_model": "jumper_warp.robot.model",
    "load_policy": "jumper_warp.policies.folder",
    "make_task": "jumper_warp.registry",
}
"""Modules of the names below; each is imported when a name of it is first used."""
__all__ = ["Env", "Simulation", "SolverJumper", "build_model", "load_policy", "make_task"]


# On a CPU torch's threads stay awake for milliseconds after each operation, on cores that the simulation's need next.
# libgomp reads this when torch is loaded; its own count of rounds is 300,000.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "20000")


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PLACES})
