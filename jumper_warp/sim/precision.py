"""Double-precision build of the kernels, a reference for rounding errors and gradients."""

import importlib.util
import sys
from types import ModuleType

from jumper_warp import kernels


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
