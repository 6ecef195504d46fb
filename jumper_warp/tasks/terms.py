"""Terms of a task, such as rewards: a Warp function and its parameters by name, checked when a term is created.

The first arguments of a function come from the kernel; its other parameters, all float, are numbers of the term. All
numbers of a task lie in one array on the device, so that each can change while a captured graph replays. Each has a
name, such as `rewards.jump_height.weight` or `observations.actor.lin_vel.noise`, and kernels index it by `TermSlot`.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, ClassVar, Self, get_type_hints

import warp as wp

from jumper_warp.kernels.mdp import mirror
from jumper_warp.kernels.mdp.events import AT_RESET, AT_STEP, MODES
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.kernels.mdp.random import RngStream
from jumper_warp.kernels.mdp.step import every_episode
from jumper_warp.kernels.mdp.view import RobotArrays, RobotView
from jumper_warp.kernels.terrain.ground import Ground
from jumper_warp.robot.description import LEGS, MOTOR_JOINTS
from jumper_warp.tasks.bounds import check_event_ranges, checked_number
from jumper_warp.tasks.copying import Copyable, Struct
from jumper_warp.tasks.functions import check_function, is_own, place_of, shown_type
from jumper_warp.utils.checks import check_count, check_flags, check_type, check_types
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Function

REQUIRED = inspect.Parameter.empty
OBSERVATION_BOUNDS = {
    "noise": (0.0, 1.0e3), "noise_limit": (1.0e-3, 10.0), "scale": (1.0e-6, 1.0e6), "clip": (1.0e-6, 1.0e6)
}  # fmt: skip
"""Smallest and largest settings of an observation term; noise and clip in the unit of the function."""
MAX_HISTORY = 1000  # Largest number of frames of an observation term


class Term(Copyable):
    """Part of a task, such as a reward or a termination: a Warp function and values of its parameters.

    Equal terms have the same function, name, numbers and options.
    """

    takes: ClassVar[tuple[tuple[Any, ...], ...]] = ((RobotView, Any),)
    """Allowed types of the leading arguments, which the kernel passes; Any: the task's state. The first argument
    decides. All other arguments are the term's numbers."""
    returns: ClassVar[tuple[type, ...]] = ()
    """Allowed return types; empty: any."""
    settings: ClassVar[dict[str, Any]] = {}
    """Defaults of the numbers that the kernel itself reads; they come before the function's numbers."""
    options: Mapping[str, Any] = {}
    """Defaults of values that are compiled into the kernel; on an instance, its values."""

    def __init__(self, func: Function, *, name: str = "", **values: Any) -> None:
        """Create a term from a function; values: its parameters (numbers and options) by name.

        func: @wp.func with the class's signature. name: for logs and flags (default: the function's name).
        Raises InputError: a number is missing, unknown or out of bounds (see `checked_number`), or the function does
        not fit the class.
        """
        kind = type(self).__name__
        if not isinstance(func, wp.Function):
            raise InputError(f"{kind}: {func!r:.60} is not a @wp.func")
        check_type(f"{kind}: name", name, str)
        self.func = func
        self.name = name or func.key.split(".")[-1]
        where = f"{kind} {self.name}"
        if reason := self._misfit():
            raise InputError(f"{place_of(func)}: {where}: {reason}")
        python: Any = func.func
        params = list(inspect.signature(python).parameters.values())[len(self._leading()) :]
        known = self.settings | {p.name: p.default for p in params}
        if len(known) < len(self.settings) + len(params) or set(known) & {"func", "name", *self.options}:
            raise InputError(
                f"{where}: a parameter has the name of a setting, one of {[*self.settings, *self.options]}"
            )
        for p in params:
            if func.input_types.get(p.name) not in (float, wp.float32):
                raise InputError(f"{where}: parameter {p.name!r} must be annotated float")
        for key in values:
            if key not in known and key not in self.options:
                raise InputError(f"{where}: unknown parameter {key!r}; it has {[*known, *self.options]}")
        self.numbers = {key: values.get(key, default) for key, default in known.items()}
        divides = isinstance(self, RewardTerm | TerminationTerm) and not is_own(func)
        for key, value in self.numbers.items():
            if value is REQUIRED:
                raise InputError(f"{where}: parameter {key!r} is missing")
            if isinstance(known[key], tuple) and isinstance(value, tuple):
                self.numbers[key] = tuple(checked_number(where, key, part) for part in value)
            else:
                self.numbers[key] = checked_number(where, key, value, divides)
        self.options = {key: values.get(key, default) for key, default in type(self).options.items()}
        for key in (key for key, default in type(self).options.items() if isinstance(default, bool)):
            check_flags(**{f"{where}: {key}": self.options[key]})
            self.options[key] = bool(self.options[key])
        self.num_params = len(params)

    def _misfit(self) -> str:
        """Return why the function has no allowed first argument (`takes`) or result (`returns`); empty: it has both."""
        if not self._leading():
            return f"the first argument of the function must be annotated {' or '.join(t[0].key for t in self.takes)}"
        try:
            returned = get_type_hints(self.func.func).get("return", REQUIRED)
        except NameError as error:
            return f"an annotation of the function has an {error}"
        if returned is REQUIRED or self._may_return(returned):
            return ""
        return f"the function must return {self.returned}, its annotation is {shown_type(returned)}"

    def _leading(self) -> tuple[object, ...]:
        """Return the types of the leading arguments, from `takes`, that fit the term's function; empty: none do."""
        first = next(iter(self.func.input_types.values()), None)
        return next((kinds for kinds in self.takes if first in (Any, kinds[0])), ())

    def _may_return(self, kind: object, state: object = Any) -> bool:
        """Return whether the term's function may return values of type `kind` in a task with this `state`."""
        return not self.returns or kind in self.returns

    @property
    def returned(self) -> str:
        """Description, for messages, of the type that the term's function must return."""
        return self.returns[0].__name__ if self.returns else "any type"

    def check(self, state: Struct) -> None:
        """Raise InputError unless the term's function fits the task's `state`, a `@wp.struct`, and can be compiled."""
        takes = [state if kind is Any else kind for kind in self._leading()] + [wp.float32] * self.num_params
        where = f"{type(self).__name__} {self.name}"
        check_function(where, self.func, takes, self.returned, lambda kind: self._may_return(kind, state))

    def replace(self, **changes: Any) -> Self:
        """Return a copy of the term with changed function, name, numbers or options.

        Raises InputError like the constructor.
        """
        return type(self)(**self.arguments() | changes)

    @property
    def flat_numbers(self) -> dict[str, float]:
        """Parameters of the term by name, in the order of the device array.

        Settings are first; a pair has the names `name.lower` and `name.upper`.
        """
        flat: dict[str, float] = {}
        for key, value in self.numbers.items():
            pair = isinstance(value, tuple)
            flat |= {f"{key}.lower": value[0], f"{key}.upper": value[1]} if pair else {key: value}
        return flat

    def with_flat_numbers(self, flat: Iterable[float]) -> Self:
        """Return a copy of the term with new numbers, in the order of `flat_numbers`; errors: as `replace`."""
        rest = iter(flat)
        parts = {key: tuple(next(rest) for _ in value) if isinstance(value, tuple) else next(rest)
                 for key, value in self.numbers.items()}  # fmt: skip
        return self.replace(**parts)

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments that make an equal term."""
        return {"func": self.func, "name": self.name, **self.numbers, **self.options}

    def __eq__(self, other: object) -> bool:
        """Return whether function, name and all values are equal."""
        return type(self) is type(other) and all(
            getattr(self, name) == getattr(other, name) for name in ("func", "name", "numbers", "options")
        )

    def __hash__(self) -> int:
        """Return a hash of type and name alone, since values may be unhashable; equal terms have equal hashes."""
        return hash((type(self), self.name))

    def __repr__(self) -> str:
        """Return the term's name and values, for messages."""
        numbers = "".join(f", {key}={value!r}" for key, value in {**self.numbers, **self.options}.items())
        return f"{type(self).__name__}({self.name}{numbers})"


class RewardTerm(Term):
    """Term of the reward: a function's value times a weight and, with `scale_by_dt`, the policy step [s].

    Function: (robot: RobotView, state, ...) -> float.
    """

    settings: ClassVar = {"weight": REQUIRED}
    options: Mapping[str, Any] = {"scale_by_dt": True}
    returns: ClassVar = (float, wp.float32)

    def __init__(self, func: Function, weight: float, **values: Any) -> None:
        """Store a reward function with its parameters by name, and its weight."""
        super().__init__(func, weight=weight, **values)

    @property
    def weight(self) -> float:
        """Factor of the reward term; negative: a penalty."""
        return self.numbers["weight"]


class TerminationTerm(Term):
    """Condition that ends an episode.

    Function: (robot: RobotView, state, ...) -> bool. time_out: whether the end is no failure, so that the value of the
    last state is bootstrapped. success: whether the success rate and the curriculum count the end as a success.
    """

    options: Mapping[str, Any] = {"time_out": False, "success": False}
    returns: ClassVar = (bool, wp.bool)


class ObservationTerm(Term):
    """Part of an observation: a scalar or a vector, with noise, limits, scale, history and delay.

    Function: (robot: RobotView, state, ...) -> float or vector, one frame of columns. Other signatures: (parameters:
    RobotParameters, world: int, ...) and, to read the ground, (arrays: RobotArrays, ground: Ground, world: int, ...).
    noise: standard deviation of Gaussian noise, in the function's unit, cut at noise_limit standard deviations; then
    values are clipped to [-clip, clip] and multiplied by scale. history: number of frames, oldest first. delayed:
    whether the world's observation latency applies. mirror: mirror image of the value, as in
    `jumper_warp.kernels.mdp.mirror`, such as (1, -2, 3) for a vector (default: the stock function's).
    """

    settings: ClassVar = {"noise": 0.0, "noise_limit": 1.0, "scale": 1.0, "clip": 100.0}
    options: Mapping[str, Any] = {"history": 1, "delayed": False, "mirror": None}
    takes: ClassVar = ((RobotView, Any), (RobotParameters, wp.int32), (RobotArrays, Ground, wp.int32))

    def __init__(self, func: Function, **values: Any) -> None:
        """Store a function with its settings and options. Raises InputError as `Term`, or an option is out of range."""
        super().__init__(func, **values)
        if "return" not in get_type_hints(self.func.func):
            where = f"{place_of(self.func)}: ObservationTerm {self.name}"
            raise InputError(f"{where}: the function needs an annotation of its return type, {self.returned}")
        history = check_count(f"ObservationTerm {self.name}: history", self.options["history"], MAX_HISTORY)
        self.options = {**self.options, "history": history}
        for key, (low, high) in OBSERVATION_BOUNDS.items():
            if not low <= self.numbers[key] <= high:
                limits = f"{low:g} to {high:g}, got {self.numbers[key]:.6g}"
                raise InputError(f"ObservationTerm {self.name}: {key} must be in {limits}")
        check_type(f"ObservationTerm {self.name}: mirror", self.options["mirror"], tuple[int, ...] | None)
        image = dict(enumerate(self.mirror or range(1, self.width + 1), 1))
        if len(image) != self.width or {abs(k): i if k > 0 else -i for i, k in image.items()} != image:
            wanted = f"1 to {self.width}, each once with a sign, and be its own inverse"
            raise InputError(f"ObservationTerm {self.name}: mirror must have {wanted}, got {self.mirror}")

    def _may_return(self, kind: object, state: object = Any) -> bool:
        """Return whether the term's function may return values of type `kind`: a number or a vector."""
        vector = hasattr(kind, "_length_") and getattr(kind, "_wp_scalar_type_", None) is wp.float32
        return kind in (float, wp.float32) or vector

    @property
    def returned(self) -> str:
        """Description, for messages, of the type that the term's function must return."""
        return "float or a vector"

    @property
    def width(self) -> int:
        """Number of columns of one frame of the observation term."""
        returned = get_type_hints(self.func.func)["return"]
        return 1 if returned in (float, wp.float32) else returned._length_

    @property
    def mirror(self) -> tuple[int, ...] | None:
        """Mirror image of a frame's columns, as in `jumper_warp.kernels.mdp.mirror`; None: not known."""
        return self.options["mirror"] or getattr(self.func, "mirror", None)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of all frames, oldest first: `gravity_x_3_ago`, ..., `gravity_x`.

        Columns that are mirrored as legs or motors have their names; others of 2 to 4 are x, y, z, w, as in Warp.
        """
        names = {mirror.LEGS: LEGS, mirror.MOTORS: MOTOR_JOINTS}.get(self.mirror or (), "xyzw"[: self.width])
        if len(names) < self.width:
            names = map(str, range(self.width))
        frame = (self.name,) if self.width == 1 else tuple(f"{self.name}_{name}" for name in names)
        ages = range(self.options["history"] - 1, -1, -1)
        return tuple(f"{column}_{age}_ago" if age else column for age in ages for column in frame)


class EventTerm(Term):
    """Event that changes a world's robot parameters at startup, at resets or at intervals, as in domain randomisation.

    Function: (parameters: RobotParameters, rng: RngStream, ...), which writes parameters of world `rng.world`. mode:
    "startup": once; "reset": at every reset; "interval": at resets and then at intervals sampled from
    `interval_range_s` [s]. update_solver: whether the solver must read the model again; pushes and latencies need not.
    parallel: whether threads share its loop over range(rng.lane, end, rng.lanes); not with "interval".
    """

    settings: ClassVar = {"interval_range_s": (0.0, 0.0)}
    options: Mapping[str, Any] = {"mode": "reset", "update_solver": True, "parallel": False}
    takes: ClassVar = ((RobotParameters, RngStream),)

    def __init__(self, func: Function, **values: Any) -> None:
        """Store a function with its settings and options. Raises InputError as `Term`, or for an unknown mode."""
        super().__init__(func, **values)
        mode = self.options["mode"]
        interval = self.numbers["interval_range_s"]
        if mode not in ("startup", "reset", "interval"):
            raise InputError(f"EventTerm {self.name}: mode must be startup, reset or interval, got {mode!r:.40}")
        if mode == "interval" and self.options["parallel"]:
            raise InputError(f"EventTerm {self.name}: an event at intervals cannot be parallel")
        rises = isinstance(interval, tuple) and len(interval) == 2 and 0.0 <= interval[0] <= interval[1]
        if not rises or (mode == "interval" and interval[0] == 0.0):
            raise InputError(f"EventTerm {self.name}: interval_range_s must be (lower, upper) above 0, got {interval}")
        check_event_ranges(self.func, self.numbers)

    def due_at(self, stage: int) -> bool:
        """Return whether the event may run at a stage of `kernels.mdp.events`: STARTUP, AT_RESET or AT_STEP."""
        mode = MODES[self.options["mode"]]
        return stage == mode or (mode == AT_STEP and stage == AT_RESET)


class Advance(Term):
    """Term that updates a task's state in each policy step, such as the phase of a jump.

    Function: (robot: RobotView, state, ...) -> state.
    """

    def _may_return(self, kind: object, state: object = Any) -> bool:
        """Return whether the function may return type `kind`: the state or, if that is unknown, a `@wp.struct`."""
        return kind in (Any, state) or (state is Any and hasattr(kind, "vars"))

    @property
    def returned(self) -> str:
        """Description, for messages, of the type that the term's function must return."""
        return "the state"


class Curriculum(Term):
    """Rule that raises a world's curriculum level after several successful episodes in a row with small errors.

    Function: (robot: RobotView, state) -> float, error of an ended episode in `unit`. `promote_after` episodes in a row
    that end with success and an error up to `tolerance` raise the world's level. counts: @wp.func (state) -> bool,
    whether an episode is counted (default: every episode is). unit: suffix of the logged error's name.
    """

    settings: ClassVar = {"tolerance": REQUIRED, "promote_after": 5}
    options: Mapping[str, Any] = {"counts": every_episode, "unit": "m"}
    returns: ClassVar = (float, wp.float32)

    def __init__(self, func: Function, **values: Any) -> None:
        super().__init__(func, **values)
        if not isinstance(self.options["counts"], wp.Function):
            raise InputError(f"Curriculum {self.name}: counts must be a @wp.func (state) -> bool")
        promote_after = self.numbers["promote_after"]
        if self.numbers["tolerance"] < 0.0 or promote_after < 1 or promote_after % 1:
            limits = "tolerance must not be negative, promote_after at least 1 and a whole number"
            raise InputError(f"Curriculum {self.name}: {limits}")


@dataclass(frozen=True)
class StateMetric:
    """Metric of the training log that combines a float field of the task state over all worlds."""

    name: str  # Key in the log, with its unit; without a group, as in `Curriculum/level`, it becomes `Metrics/NAME`
    field: str  # Field of the task's state. With `per`, worlds accumulate in it, and logging sets both fields to 0.
    per: str | None = None
    """Field whose sum over all worlds divides the sum of `field`; None: log the mean of `field` and keep it."""

    def __post_init__(self) -> None:
        """Add the group Metrics/ to a name without a group, under which training logs show it."""
        check_types("metric", self)
        if "/" not in self.name:
            object.__setattr__(self, "name", f"Metrics/{self.name}")


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
