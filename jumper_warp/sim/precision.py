"""Kernel modules of the robot's dynamics, in single precision or in double, a reference for rounding and gradients."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import sys
from types import ModuleType
from typing import TYPE_CHECKING

from jumper_warp import kernels

PACKAGES = (
    "", ".actuation", ".dynamics", ".dynamics.adjoint", ".dynamics.legs", ".dynamics.world", ".jump", ".kinematics",
    ".terrain",
)  # fmt: skip
"""Packages within `jumper_warp.kernels` that `KernelModules` searches."""


def float64_kernels() -> ModuleType:
    """Return a copy of the package `jumper_warp.kernels` whose kernels compute in double precision.

    It consists of the same files, loaded again with a float64 `real`, and is registered, so that
    `importlib.import_module("jumper_warp.kernels_float64.layout")` works afterwards.
    """
    name = "jumper_warp.kernels_float64"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(
            name, kernels.__file__, submodule_search_locations=list(kernels.__path__)
        )
        assert spec is not None and spec.loader is not None
        package = importlib.util.module_from_spec(spec)
        sys.modules[name] = package
        spec.loader.exec_module(package)
    return sys.modules[name]


class KernelModules:
    """Warp kernel modules of the robot's dynamics, in single or double precision.

    Each is an attribute, named after the module, and is imported at its first use. For a type checker both precisions
    are the modules of single precision.
    """

    if TYPE_CHECKING:
        from jumper_warp.kernels import layout, scalar
        from jumper_warp.kernels.actuation import command_filter, motors
        from jumper_warp.kernels.dynamics import contact, drive, momentum, parameters, step, trajectory
        from jumper_warp.kernels.dynamics.adjoint import (
            constants_adjoint,
            gradients,
            leg_record,
            multipliers,
            rollout_adjoint,
            rollout_legs_adjoint,
            rollout_targets,
        )
        from jumper_warp.kernels.dynamics.legs import advance_legs, rollout_legs
        from jumper_warp.kernels.dynamics.world import advance, rollout
        from jumper_warp.kernels.jump import plan_cost
        from jumper_warp.kernels.kinematics import full_state, geometry
        from jumper_warp.kernels.terrain import ground

    def __init__(self, double: bool = False) -> None:
        """Import no module yet; double: whether the kernels compute in float64."""
        self._package = (float64_kernels() if double else kernels).__name__

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> ModuleType:
            """Import a kernel module by name, and cache it. Raises AttributeError: there is no such module."""
            for package in PACKAGES:
                path = f"{self._package}{package}.{name}"
                if importlib.util.find_spec(path) is not None:
                    module = importlib.import_module(path)
                    setattr(self, name, module)
                    return module
            raise AttributeError(f"no kernel module {name!r}")


@functools.cache
def kernel_modules(double: bool = False) -> KernelModules:
    """Return the kernel modules of the robot's dynamics; double: whether in float64."""
    return KernelModules(double)
