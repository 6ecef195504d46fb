"""Parameters of a task's terms in one array, by name: `rewards.jump_height.weight`, `observations.actor.lin_vel.noise`.

Flags change them before an environment is made; `Env.set` changes them while it runs. Kernels index them by `TermSlot`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from jumper_warp.tasks.terms import Term
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.threads import locked


class TermSlot(SimpleNamespace):
    """Indices of a term's parameters (such as a reward's weight) in the task's parameter array, and the term's options.

    Kernels use it; the array p is that of `TaskParams.values`. Each name in the term's `settings` is an attribute, the
    index of its value (of a pair: the first): `p[slot.weight]`. Each name in its `options` is an attribute with the
    option's value.
    """

    def __init__(self, term: Any, offset: int) -> None:
        """Store the term's indices and options; offset: index of the term's first number in the array."""
        numbers = list(term.flat_numbers)
        settings = numbers[: len(numbers) - term.num_params]
        super().__init__(**term.options, **{name.removesuffix(".lower"): offset + i for i, name in enumerate(settings)})
        self.term = term
        self.func = term.func
        self.first = offset
        self.start = offset + len(settings)
        self.stop = offset + len(numbers)
        """Half-open range of the function's parameters: `*p[slot.start : slot.stop]`."""
        self.compiled = (term.func, offset, self.start, self.stop, *term.options.items())
        """Parts of the term that are compiled into a kernel; tasks with equal tuples share the kernel."""


class TaskParams:
    """Parameters of all terms of a task, such as weights of rewards, in one list, and the index of each by name."""

    def __init__(self, task: str, sections: Mapping[str, Sequence[Term]]) -> None:
        """Collect the parameters of all terms; task: name, for messages; sections: terms by name of their section."""
        self.task = task
        self.slots: dict[str, list[TermSlot]] = {section: [] for section in sections}
        """Slots by section, one per term, in the order of the terms."""
        self.values: list[float] = []
        self.names: dict[str, int] = {}
        """Index of each number in `values` by dotted name; the first if a randomisation and an event share a name."""
        for section, terms in sections.items():
            for term in terms:
                self.slots[section].append(TermSlot(term, len(self.values)))
                for key, value in term.flat_numbers.items():
                    self.names.setdefault(f"{section}.{term.name}.{key}", len(self.values))
                    self.values.append(float(value))

    def checked(self, numbers: Sequence[float], i: int) -> float:
        """Return number `i` of a list like `values` as its term stores it. Raises InputError: it is out of bounds."""
        slot = next(slot for slots in self.slots.values() for slot in slots if slot.first <= i < slot.stop)
        term = slot.term.with_flat_numbers(numbers[slot.first : slot.stop])
        return list(term.flat_numbers.values())[i - slot.first]

    def index(self, name: str) -> int:
        """Return the index of a term's parameter by its dotted name. Raises InputError: there is none."""
        if not isinstance(name, str):
            raise InputError(f"the name of a number must be text like rewards.jump_height.weight, got {name!r:.60}")
        if name not in self.names:
            section, _, rest = name.partition(".")
            term, _, key = rest.rpartition(".")
            missing = f"has no number {key!r} of a {section} term {term!r}"
            raise InputError(f"{self.task} {missing}; names are like rewards.jump_height.weight")
        return self.names[name]


class ParamArrays:
    """Device array of the parameters of all terms of a task; values can change while captured CUDA graphs read them."""

    def __init__(self, params: TaskParams, device: wp.DeviceLike) -> None:
        """Copy a task's initial parameters to the device; params: names and values; device: Warp device."""
        self.params = params
        self._numbers = list(params.values)  # `values` before their conversion to float32
        self.values = wp.array(params.values, dtype=float, device=device)
        self.changed = wp.full(len(params.values), math.inf, dtype=float, device=device)
        """Numbers changed by `set`, (len(values),); infinity elsewhere."""

    @locked
    def set(self, name: str, value: float) -> None:
        """Change a term's parameter, given by its dotted name, on the device: in `values`, which the kernels read.

        `changed` holds the same numbers, and is saved with the environment's state.
        Raises InputError: there is none, or the term refuses the value in a configuration too.
        """
        i = self.params.index(name)
        value = self._numbers[i] = self.params.checked([*self._numbers[:i], value, *self._numbers[i + 1 :]], i)
        for array in (self.values, self.changed):
            array[i : i + 1].fill_(value)

    def restore(self) -> None:
        """Reset all parameters to `params.values` except those that `set` changed. Waits for the device."""
        self._numbers = self.restored(self.changed.numpy())
        self.values.assign(np.array(self._numbers, dtype=np.float32))

    def restored(self, changed: np.ndarray) -> list[float]:
        """Return all parameters, with those of `changed` that are finite. Raises InputError: a term refuses one."""
        decimals = [float(str(value)) for value in changed]  # such as 0.1 for the float32 0.100000001
        pairs = zip(self.params.values, decimals, strict=True)
        numbers = [value if math.isinf(change) else change for value, change in pairs]
        for slot in (slot for slots in self.params.slots.values() for slot in slots):
            slot.term.with_flat_numbers(numbers[slot.first : slot.stop])
        return numbers
