"""Numbers of a task's terms in one array, by dotted name: `rewards.jump_height.weight`, `policy.lin_vel.noise`.

Flags change a task's numbers before its environment is made, `Env.set` while it runs; kernels read them by `TermSlot`.
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


class TermSlot(SimpleNamespace):
    """A term as kernels read it.

    Each of its `settings` is an attribute, the index of its value: `p[slot.weight]`. So are its options, as values.
    """

    def __init__(self, term: Any, offset: int) -> None:
        """offset: index of the term's first number."""
        super().__init__(**term.options, **{name: offset + i for i, name in enumerate(term.settings)})
        self.term, self.func, self.parameterless = term, term.func, not term.num_params
        """parameterless: Warp refuses an empty `*p[start:start]`."""
        self.start, self.stop = offset + len(term.settings), offset + len(term.numbers)
        """Range of the function's parameters."""
        self.compiled = (term.func, offset, self.start, self.stop, *term.options.items())
        """What a kernel holds of the term; tasks with the same share the kernel, whatever their numbers."""


class TaskParams:
    """Numbers of all terms of a task, and the index of each."""

    def __init__(self, task: str, sections: Mapping[str, Sequence[Term]]) -> None:
        """task: its name, for messages."""
        self.task = task
        self.slots: dict[str, list[TermSlot]] = {section: [] for section in sections}
        """By section, in the order of its terms."""
        self.values: list[float] = []
        self.names: dict[str, int] = {}
        """Index in `values` by dotted name; the first one where a randomisation and an event have the same name."""
        for section, terms in sections.items():
            for term in terms:
                self.slots[section].append(TermSlot(term, len(self.values)))
                for key, value in term.numbers.items():
                    self.names.setdefault(f"{section}.{term.name}.{key}", len(self.values))
                    self.values.append(float(value))

    def index(self, name: str) -> int:
        """Return the index of a number by its dotted name. Raises InputError: there is none."""
        if name not in self.names:
            section, _, rest = name.partition(".")
            term, _, key = rest.rpartition(".")
            missing = f"has no {key!r} of a {section} term {term!r}"
            raise InputError(f"{self.task} {missing}; names are like rewards.jump_height.weight")
        return self.names[name]


class ParamArrays:
    """Numbers of a task on a device, where captured graphs read changes."""

    def __init__(self, params: TaskParams, device: Any) -> None:
        self.params = params
        self.values = wp.array(params.values, dtype=float, device=device)
        self.changed = wp.full(len(params.values), math.inf, dtype=float, device=device)
        """Of `values`, those that `set` has changed; infinite where it has not."""

    def set(self, name: str, value: float) -> None:
        """Change a number by its dotted name. Raises InputError: there is none, or the value is not finite."""
        if not math.isfinite(value):
            raise InputError(f"{name} must be finite, got {value}")
        i = self.params.index(name)
        for array in (self.values, self.changed):
            array[i : i + 1].fill_(value)

    def restore(self) -> None:
        """Take the task's numbers except those in `changed` (waits for the device)."""
        changed = self.changed.numpy()
        self.values.assign(np.where(np.isinf(changed), np.array(self.params.values, dtype=np.float32), changed))
