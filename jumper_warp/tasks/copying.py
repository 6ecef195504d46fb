"""Copying and pickling of tasks and their parts; pickles refer to Warp functions and structs by name."""

from __future__ import annotations

import copy
import dataclasses
import importlib
import os
import pickle
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple, Self, TypeVar

import warp as wp
from warp._src.codegen import Struct  # the type of a `@wp.struct`

from jumper_warp.utils.sources import module_from_file

T = TypeVar("T")


class Copyable:
    """Base class of objects that are copied and pickled by the arguments of their constructor.

    All other attributes are made again. Copies share Warp functions and structs; pickles have their names.
    """

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments that make an equal object; by default the dataclass's fields."""
        fields = dataclasses.fields(self)  # pyright: ignore[reportArgumentType]
        return {spec.name: getattr(self, spec.name) for spec in fields}

    def __copy__(self) -> Self:
        """Return a copy made by the constructor, which checks its arguments again."""
        return type(self)(**self.arguments())

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        """Return a deep copy; Warp functions and structs are shared, as a copy of them would be another kernel."""
        arguments = self.arguments().items()
        return type(self)(**{name: value if _is_named(value) else copy.deepcopy(value, memo)
                             for name, value in arguments})  # fmt: skip

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        """Return the constructor call that `pickle` stores. Raises pickle.PicklingError: see `Reference.to`."""
        arguments = self.arguments().items()
        return _make, (type(self), {k: Reference.to(value) if _is_named(value) else value for k, value in arguments})


class Reference(NamedTuple):
    """Module and name by which a pickle refers to a Warp function or struct."""

    module: str
    name: str
    path: str | None  # file of the module, for one that cannot be imported

    @classmethod
    def to(cls, definition: object) -> Reference:
        """Return the reference to a function or struct. Raises PicklingError: not at the top level of its module."""
        module, module_name, name = top_level(definition)
        if module is None:
            raise pickle.PicklingError(
                f"{module_name}:{name} cannot be pickled: define it under this name at the top level of a module"
            )
        return cls(module_name, name, getattr(module, "__file__", None))

    def definition(self) -> Any:
        """Import and return the referenced function or struct. Raises ImportError or AttributeError: not found."""
        try:
            module = sys.modules.get(self.module) or importlib.import_module(self.module)
        except ModuleNotFoundError:
            if self.path is None or not os.path.isfile(self.path):
                raise
            module = module_from_file(self.module, self.path)
        return getattr(module, self.name)


def top_level(definition: Any) -> tuple[ModuleType | None, str, str]:
    """Return module, module's name and qualified name of a Warp function, a struct or a class.

    The module is None unless the definition is found under its name at the top level of its module.
    """
    python: Any = definition.func if isinstance(definition, wp.Function) else getattr(definition, "cls", definition)
    module = sys.modules.get(python.__module__)
    found = module is not None and vars(module).get(python.__qualname__) is definition
    return module if found else None, python.__module__, python.__qualname__


def _is_named(value: object) -> bool:
    """Return whether a value is a Warp function or struct, which copies share and pickles refer to by name."""
    return isinstance(value, wp.Function | Struct)


def _make(kind: type[T], arguments: dict[str, object]) -> T:
    """Return a new object of class `kind`; arguments: of its constructor, with references to functions and structs."""
    values = arguments.items()
    return kind(**{name: value.definition() if isinstance(value, Reference) else value for name, value in values})
