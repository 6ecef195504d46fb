"""Simulation and reinforcement learning for the quadruped Jumper; the names in `__all__` are imported on first use."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from jumper_warp.utils.threads import limit_spinning
from jumper_warp.utils.version import __version__ as __version__

if TYPE_CHECKING:
    from jumper_warp.envs.env import Env as Env
    from jumper_warp.policies.policy import load_policy as load_policy
    from jumper_warp.recipe import Recipe as Recipe
    from jumper_warp.registry import make_task as make_task
    from jumper_warp.robot.model import build_model as build_model
    from jumper_warp.sim.simulation import Simulation as Simulation
    from jumper_warp.sim.solver import SolverJumper as SolverJumper
    from jumper_warp.training import train as train

_MODULES = {
    "Env": "jumper_warp.envs.env",
    "Recipe": "jumper_warp.recipe",
    "Simulation": "jumper_warp.sim.simulation",
    "SolverJumper": "jumper_warp.sim.solver",
    "build_model": "jumper_warp.robot.model",
    "load_policy": "jumper_warp.policies.policy",
    "make_task": "jumper_warp.registry",
    "train": "jumper_warp.training",
}
"""Module of each public name, imported at the name's first use."""
__all__ = ["Env", "Recipe", "Simulation", "SolverJumper", "build_model", "load_policy", "make_task", "train"]

limit_spinning()


def __getattr__(name: str) -> Any:
    """Import and return a public name. Raises AttributeError for any other name."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    """Return the names of this module and all public names, imported or not."""
    return sorted({*globals(), *_MODULES})
