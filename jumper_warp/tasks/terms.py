"""Terms of a task: a Warp function and its numbers by name, checked when they are written down.

The first arguments of a function come from the kernel; its other parameters, all float, are numbers of the term. All
numbers of a task lie in one array on the device, so that each can change while a captured graph replays.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, get_type_hints

import warp as wp

from jumper_warp.kernels.mdp.events import AT_RESET, AT_STEP, MODES
from jumper_warp.kernels.mdp.parameters import RobotParameters
from jumper_warp.kernels.mdp.view import RobotArrays, RobotView
from jumper_warp.utils.checks import FLOAT32_MAX
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Function

REQUIRED = inspect.Parameter.empty
AXES = {2: ("x", "y"), 3: ("x", "y", "z")}
LEGS = ("FL", "FR", "BL", "BR")
MOTORS = tuple(f"{leg}_{motor}" for leg in LEGS for motor in ("lateral", "outer", "inner"))


class Term:
    """A Warp function with its numbers. Equal terms have the same function, name, numbers and options."""

    context: int = 2
    """How many arguments of the function come from the kernel."""
    takes: ClassVar[tuple[Any, ...]] = (RobotView,)
    """What the first of them may be."""
    returns: ClassVar[tuple[Any, ...]] = ()
    """What the function may return; anything if empty."""
    settings: ClassVar[dict[str, Any]] = {}
    """Numbers that the kernel itself reads, with their defaults; they come before those of the function."""
    options: Mapping[str, Any] = {}
    """What is compiled in, with its defaults."""

    def __init__(self, func: Function, *, name: str = "", **given: Any) -> None:
        """func: with the signature that the class names. name: for logs and flags (default: the function's).

        given: numbers and options by name.
        Raises InputError: a number is missing, unknown or not finite, or the function is not one for such a term.
        """
        kind = type(self).__name__
        if not isinstance(func, wp.Function):
            raise InputError(f"{kind}: {func!r:.60} is not a @wp.func")
        self.func, self.name = func, name or func.key.split(".")[-1]
        where = f"{kind} {self.name}"
        self._check_types(where)
        python: Any = func.func
        params = list(inspect.signature(python).parameters.values())[self.context :]
        known = self.settings | {p.name: p.default for p in params}
        if len(known) < len(self.settings) + len(params) or set(known) & {"func", "name", *self.options}:
            raise InputError(
                f"{where}: a parameter has the name of a setting, one of {[*self.settings, *self.options]}"
            )
        for p in params:
            if func.input_types.get(p.name) not in (float, wp.float32):
                raise InputError(f"{where}: parameter {p.name!r} must be annotated float")
        for key in given:
            if key not in known and key not in self.options:
                raise InputError(f"{where}: unknown parameter {key!r}; it has {[*known, *self.options]}")
        self.numbers = {key: given.get(key, default) for key, default in known.items()}
        for key, value in self.numbers.items():
            if value is REQUIRED:
                raise InputError(f"{where}: parameter {key!r} is missing")
            parts = value if isinstance(known[key], tuple) and isinstance(value, tuple) else (value,)
            wrong = any(isinstance(part, bool) or not isinstance(part, int | float) for part in parts)
            if wrong or not all(abs(part) <= FLOAT32_MAX for part in parts):
                raise InputError(f"{where}: parameter {key!r} must be a finite number, got {value!r:.60}")
        self.options = {key: given.get(key, default) for key, default in type(self).options.items()}
        self.num_params = len(params)

    def _check_types(self, where: str) -> None:
        """Raise InputError unless the function takes and returns what such a term's does."""
        first = next(iter(self.func.input_types.values()), None)
        if first is not Any and first not in self.takes:
            takes = " or ".join(kind.key for kind in self.takes)
            raise InputError(f"{where}: the first argument of the function must be annotated {takes}")
        returned = get_type_hints(self.func.func).get("return")
        if self.returns and returned is not None and returned not in self.returns:
            raise InputError(f"{where}: the function must return {self.returns[0].__name__}, it returns {returned}")

    def replace(self, **changes: Any) -> Any:
        """Return the term with other numbers or options; raises ValueError as the constructor."""
        return type(self)(**{"func": self.func, "name": self.name, **self.numbers, **self.options, **changes})

    @property
    def flat_numbers(self) -> dict[str, float]:
        """Numbers by name in the order of the device's array; a pair as `name.lower` and `name.upper`."""
        flat: dict[str, float] = {}
        for key, value in self.numbers.items():
            pair = isinstance(value, tuple)
            flat |= {f"{key}.lower": value[0], f"{key}.upper": value[1]} if pair else {key: value}
        return flat

    @property
    def of_state(self) -> Any:
        """The struct of the task's state that the function reads, or Any."""
        return self.func.input_types.get("state", Any)

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and all(
            getattr(self, name) == getattr(other, name) for name in ("func", "name", "numbers", "options")
        )

    def __hash__(self) -> int:
        return hash((type(self), self.name))

    def __repr__(self) -> str:
        numbers = "".join(f", {key}={value!r}" for key, value in {**self.numbers, **self.options}.items())
        return f"{type(self).__name__}({self.name}{numbers})"


class RewardTerm(Term):
    """(robot: RobotView, state, ...) -> float; times the weight, and with `scale_by_dt` times the policy step [s]."""

    settings: ClassVar = {"weight": REQUIRED}
    options: Mapping[str, Any] = {"scale_by_dt": True}
    returns: ClassVar = (float, wp.float32)

    def __init__(self, func: Function, weight: float, **given: Any) -> None:
        super().__init__(func, weight=weight, **given)

    @property
    def weight(self) -> float:
        """Multiplies the term; carries the sign."""
        return self.numbers["weight"]


class TerminationTerm(Term):
    """(robot: RobotView, state, ...) -> bool.

    time_out: an end that says nothing against the state, so that what would follow counts. success: what the success
    rate and the curriculum count.
    """

    options: Mapping[str, Any] = {"time_out": False, "success": False}
    returns: ClassVar = (bool, wp.bool)


class ObservationTerm(Term):
    """(robot: RobotView, state, ...) -> float or vector; or likewise (parameters: RobotParameters, world: int), or of
    the ground around the robot (arrays: RobotArrays, ground: Ground, world: int).

    noise: standard deviation, cut at one. Then clipped to plus and minus `clip`, and scaled. history: frames, the
    oldest first. delayed: whether it comes as late as the world's sensors do.
    """

    settings: ClassVar = {"noise": 0.0, "scale": 1.0, "clip": 100.0}
    options: Mapping[str, Any] = {"history": 1, "delayed": False}
    takes: ClassVar = (RobotView, RobotParameters, RobotArrays)

    def __init__(self, func: Function, **given: Any) -> None:
        if isinstance(func, wp.Function) and RobotArrays in func.input_types.values():
            self.context = 3
        super().__init__(func, **given)
        history = self.options["history"]
        if not isinstance(history, int) or history < 1:
            raise InputError(f"ObservationTerm {self.name}: history must be at least 1, got {history!r:.40}")
        if self.numbers["noise"] < 0.0 or self.numbers["clip"] <= 0.0:
            raise InputError(f"ObservationTerm {self.name}: noise must not be negative and clip must be positive")

    @property
    def width(self) -> int:
        """Number of columns of one frame."""
        returned = get_type_hints(self.func.func)["return"]
        return 1 if returned in (float, wp.float32) else returned._length_

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of all frames."""
        width = self.width
        if width == 1:
            frame = (self.name,)
        else:
            ends = AXES.get(width) or {4: LEGS, 12: MOTORS}.get(width) or tuple(map(str, range(width)))
            frame = tuple(f"{self.name}_{end}" for end in ends)
        ages = range(self.options["history"] - 1, -1, -1)
        return tuple(f"{column}_{age}_ago" if age else column for age in ages for column in frame)


class EventTerm(Term):
    """(parameters: RobotParameters, rng: RngStream, ...), writes the parameters of `rng.world`.

    mode: once at the start ("startup"), at every "reset", or also at "interval"s sampled from
    `interval_range_s`.
    update_solver: whether the solver must read the model again, as after any but pushes and latencies.
    parallel: whether its loop is one over range(rng.lane, end, rng.lanes), which threads share; not at intervals.
    """

    settings: ClassVar = {"interval_range_s": (0.0, 0.0)}
    options: Mapping[str, Any] = {"mode": "reset", "update_solver": True, "parallel": False}
    takes: ClassVar = (RobotParameters,)

    def __init__(self, func: Function, **given: Any) -> None:
        super().__init__(func, **given)
        mode, interval = self.options["mode"], self.numbers["interval_range_s"]
        if mode not in ("startup", "reset", "interval"):
            raise InputError(f"EventTerm {self.name}: mode must be startup, reset or interval, got {mode!r:.40}")
        if mode == "interval" and self.options["parallel"]:
            raise InputError(f"EventTerm {self.name}: an event at intervals cannot be parallel")
        rises = isinstance(interval, tuple) and len(interval) == 2 and 0.0 <= interval[0] <= interval[1]
        if not rises or (mode == "interval" and interval[0] == 0.0):
            raise InputError(f"EventTerm {self.name}: interval_range_s must be (lower, upper) above 0, got {interval}")

    def due_at(self, stage: int) -> bool:
        """Return whether it may be due at a stage of `jumper_warp.kernels.mdp.events`."""
        mode = MODES[self.options["mode"]]
        return stage == mode or (mode == AT_STEP and stage == AT_RESET)


class Advance(Term):
    """(robot: RobotView, state, ...) -> state, one policy step later: the task's phase machine."""


class Curriculum(Term):
    """(robot: RobotView, state) -> error of an ended episode.

    An episode that ends with success and an error up to `tolerance` is one; `promote_after` of them in a row raise the
    world's level. counts: (state) -> bool, whether an episode counts at all. unit: of the error, as it is logged.
    """

    settings: ClassVar = {"tolerance": REQUIRED, "promote_after": 5}
    options: Mapping[str, Any] = {"counts": REQUIRED, "unit": "m"}
    returns: ClassVar = (float, wp.float32)

    def __init__(self, func: Function, **given: Any) -> None:
        super().__init__(func, **given)
        if not isinstance(self.options["counts"], wp.Function):
            raise InputError(f"Curriculum {self.name}: counts must be a @wp.func (state) -> bool")
        if self.numbers["tolerance"] < 0.0 or self.numbers["promote_after"] < 1:
            raise InputError(f"Curriculum {self.name}: tolerance must not be negative, promote_after at least 1")


@dataclass(frozen=True)
class StateMetric:
    """A figure of the training log: what worlds have counted in a field of their state since it was read last."""

    name: str
    """Under which it is logged, with its unit."""
    field: str
    """Field of the task's state, float; all that are read are set to 0."""
    per: str | None = None
    """Field by whose sum over all worlds that of `field` is divided; None: its mean over all worlds, which stays."""
