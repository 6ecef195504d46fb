"""Range checks of settings; each raises InputError with a one-line message that begins with `name`."""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from numbers import Integral, Real
from types import UnionType
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin, get_type_hints

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import ErrorType, Json

if TYPE_CHECKING:
    import numpy as np

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. -]{0,99}")
"""Valid names of tasks, terms, observation columns and joints, for comma-separated lists and file names."""
ACTIVATIONS = ("elu", "relu", "tanh")  # Names of the activations of hidden layers
MAX_HIDDEN, MAX_WIDTH = 64, 65536  # Largest number of hidden layers, and of units in one
FILTER_ANGLE = 1440.0  # [deg] Bound of limits in a command filter: twice the bound of motor targets
FLOAT32_MAX = 3.4028234e38  # Largest finite float32; settings are converted to float32 on a device
MOST_WORLDS = 2**20  # Largest number of simulated worlds
MOST_SETTING = 1.0e6  # Largest absolute value of a setting of a task, in its unit
FLOAT32_MIN = 1.1754944e-38  # Smallest positive normal float32; a GPU may round smaller values to 0
MOST_SEED = 2**31 - 1  # Largest valid seed; the kernels' random streams take an int32
LAST_OF_PREVIOUS_VERSION = "05fa856"  # Last commit that reads policies and runs of the previous version


def in_float32(value: float) -> str:
    """Return a number as text for an error message, with a note if float32 cannot hold it."""
    if FLOAT32_MAX < abs(value) < math.inf:
        return f"{value}, too large for float32"
    return f"{value}, too small for float32" if 0.0 < value < FLOAT32_MIN else f"{value}"


def check_finite(name: str, *values: float) -> None:
    """Raise InputError if a value is NaN or infinite in float32."""
    _check_range(name, values, -FLOAT32_MAX, "finite")


def check_positive(name: str, *values: float) -> None:
    """Raise InputError unless all values are positive and finite in float32."""
    _check_range(name, values, FLOAT32_MIN, "positive and finite")


def check_not_negative(name: str, *values: float) -> None:
    """Raise InputError unless all values are non-negative and finite in float32."""
    _check_range(name, values, 0.0, "finite and not negative")


def _check_range(name: str, values: Iterable[float], low: float, expected: str) -> None:
    """Raise InputError, which names the `expected` property, unless all values are from `low` to FLOAT32_MAX."""
    for value in values:
        check_type(name, value, float)
        if not low <= value <= FLOAT32_MAX:
            raise InputError(f"{name} must be {expected}, got {in_float32(value)}")


def check_within(name: str, values: np.ndarray, bounds: tuple[float, float]) -> None:
    """Raise InputError if an entry of an array is NaN or outside [lower, upper]; bounds: (lower, upper)."""
    outside = ~((values >= bounds[0]) & (values <= bounds[1]))
    if outside.any():
        raise InputError(f"{name} must be in [{bounds[0]:g}, {bounds[1]:g}], got {values[outside][0]:g}")


def check_probabilities(section: str, cfg: Any, *names: str) -> None:
    """Raise InputError unless the fields `names` of `cfg` are in [0, 1]; section: name of `cfg` in the message."""
    for name in names:
        if not 0.0 <= (value := getattr(cfg, name)) <= 1.0:
            raise InputError(f"{section} {name} must be in [0, 1], got {value}")


def check_count(name: str, value: Any, most: int = MOST_WORLDS) -> int:
    """Return an integer, such as `np.int64(4)`, as int.

    Raises InputError: it is a bool, no integer, or not in 1 to `most`.
    """
    if (number := _integer(value)) is None or not 1 <= number <= most:
        raise InputError(f"{name} must be a whole number of 1 to {most}, got {value!r:.40}")
    return number


def _integer(value: Any) -> int | None:
    """Return an integer of any type as int; None: it is a bool or no integer."""
    try:
        return None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        return None


def check_flags(**flags: Any) -> None:
    """Raise InputError unless all values are bools of Python or NumPy; flags: values by name.

    Another type would count silently: to Python the text "no" is true.
    """
    for name, value in flags.items():
        if not isinstance(value, bool) and getattr(getattr(value, "dtype", None), "kind", "") != "b":
            raise InputError(f"{name} must be True or False, got {value!r:.40}")


def check_types(section: str, cfg: Any) -> None:
    """Raise InputError for a field of a dataclass, or of one that it contains, whose type is not the annotated one.

    section: name of `cfg`, for messages. Annotations that Python cannot evaluate, or of other kinds, accept anything.
    """
    hints = _hints(type(cfg))
    for spec in dataclasses.fields(cfg):
        value = getattr(cfg, spec.name)
        check_type(f"{section} {spec.name}", value, hints.get(spec.name, Any))
        for part in value if isinstance(value, tuple) else (value,):
            if dataclasses.is_dataclass(part) and not isinstance(part, type):
                check_types(f"{section} {spec.name}", part)


def check_type(name: str, value: Any, hint: Any) -> None:
    """Raise InputError unless a value is of a type as in annotations, such as `Sequence[int] | None`.

    bools are neither int nor float; numbers of NumPy are.
    """
    if not _fits(value, hint):
        raise InputError(f"{name} must be {_shown(hint)}, got {value!r:.60}")


def check_number(name: str, value: Any, low: float, high: float, unit: str = "") -> None:
    """Raise InputError unless a value is a number from `low` to `high`, and no bool; unit: of the limits."""
    if not _fits(value, float) or not low <= value <= high:
        limits = f"{low:g} to {high:g}{unit and ' '}{unit}"
        raise InputError(f"{name} must be in {limits}, got {value!s:.40}")


@functools.cache
def _hints(kind: type) -> Json:
    """Return the types of a dataclass's fields by name; empty if one of them cannot be evaluated."""
    try:
        return get_type_hints(kind)
    except (NameError, TypeError):
        return {}


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value is of an annotated type."""
    origin = get_origin(hint)
    parts = get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str | int) and value in parts
    if origin is tuple:
        if isinstance(value, tuple) and parts[-1:] == (Ellipsis,):
            return all(_fits(part, parts[0]) for part in value)
        return isinstance(value, tuple) and len(value) == len(parts) and all(map(_fits, value, parts))
    if origin is Sequence:
        return isinstance(value, Collection) and not isinstance(value, str) and all(_fits(x, parts[0]) for x in value)
    if hint in (float, int):
        return isinstance(value, Real if hint is float else Integral) and not isinstance(value, bool)
    kind = origin or hint
    return hint is Any or not isinstance(kind, type) or isinstance(value, kind)


def _shown(hint: Any) -> str:
    """Return an annotated type as text for error messages, such as `(float, float)` or `(RewardTerm, ...)`."""
    origin = get_origin(hint)
    parts = get_args(hint)
    if origin in (Union, UnionType, Literal):
        return " or ".join(part if isinstance(part, str) else _shown(part) for part in parts)
    if origin is tuple:
        return f"({', '.join(map(_shown, parts))})"
    if origin is Sequence:
        return f"a sequence of {_shown(parts[0])}"
    name = "..." if hint is Ellipsis else "None" if hint is type(None) else getattr(hint, "__name__", str(hint))
    return "a @wp.func" if name == "Function" else name


def check_bounds(section: str, cfg: Any, bounds: Mapping[str, tuple[float, float, str]]) -> None:
    """Raise InputError if a number, or one of a pair of numbers, is outside its range; None, an unset option, passes.

    cfg: object with the fields that `bounds` names; bounds: (lower, upper, unit) by field. section: name of `cfg`, for
    messages.
    """
    for name, (low, high, unit) in bounds.items():
        value = getattr(cfg, name)
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None:
                check_number(f"{section} {name}", number, low, high, unit)


def check_seed(value: Any) -> int:
    """Return an integer, such as `np.int64(4)`, as int.

    Raises InputError: it is a bool, no integer, or not in 0 to MOST_SEED.
    """
    if (number := _integer(value)) is None or not 0 <= number <= MOST_SEED:
        raise InputError(f"seed must be in 0 .. {MOST_SEED}, got {value!r:.40}")
    return number


def check_angle_limits(name: str, lower: float, upper: float, lower_zone: float, upper_zone: float) -> None:
    """Raise InputError unless limits of an angle [deg] are finite and in order, and zones inside do not overlap.

    lower_zone, upper_zone: widths of hard zones inside the limits [deg], >= 0, in which a command filter clamps
    commands toward the limit at any speed.
    """
    if not -FILTER_ANGLE <= lower < upper <= FILTER_ANGLE:
        raise InputError(
            f"{name}: lower limit must be below upper limit, within {FILTER_ANGLE:g} deg, got {lower}, {upper}"
        )
    if not (lower_zone >= 0.0 and upper_zone >= 0.0 and lower_zone + upper_zone <= upper - lower):
        raise InputError(f"{name}: hard zones must be >= 0 without overlap, got {lower_zone}, {upper_zone}")


def check_network(hidden: Sequence[int], activation: str, error: ErrorType = InputError) -> None:
    """Raise `error` if the widths of the hidden layers are out of range, or their activation is unknown."""
    if not 1 <= len(hidden) <= MAX_HIDDEN or not 1 <= min(hidden) <= max(hidden) <= MAX_WIDTH:
        raise error(f"hidden must name 1 to {MAX_HIDDEN} widths from 1 to {MAX_WIDTH}, got {hidden!s:.100}")
    if activation not in ACTIVATIONS:
        raise error(f"activation must be one of {', '.join(ACTIVATIONS)}, got {activation!r:.40}")


def check_filter_speed(horizon: float, speed_floor: float) -> None:
    """Raise InputError for a command filter's horizon outside 1 ms to 10 s, or a speed floor outside 1e-3 to 1e4 deg/s.

    horizon: [s]; speed_floor: [deg/s].
    """
    for name, value, low, high in (("horizon", horizon, 1.0e-3, 10.0), ("speed_floor", speed_floor, 1.0e-3, 1.0e4)):
        if not low <= value <= high:
            raise InputError(f"filter {name} must be in {low:g} to {high:g}, got {value}")


def version_error(version: str, known: int, last: str = LAST_OF_PREVIOUS_VERSION) -> str:
    """Return the error message for a file of unsupported `version`; last: commit that reads version `known - 1`."""
    previous = f"commit {last} reads version {known - 1}"
    return f"has version {version}, expected version {known}; {previous}"
