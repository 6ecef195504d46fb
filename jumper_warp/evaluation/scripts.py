"""Scripts: sequences of commands to one robot, read from JSON files.

A script is a JSON list of commands: `{"walk": [vx, vy, yaw_rate], "seconds": s}` ([m/s], [rad/s], [s]),
`{"stand": seconds}`, `{"jump_up": height}` (of the base at the apex [m]), `{"jump_to": [ahead, left]}` ([m]), and
`{"jump_onto": [ahead, left]}` ([m], onto a block).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jumper_warp.evaluation.log import check
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, read_json

KINDS = {"walk": 3, "stand": 1, "jump_up": 1, "jump_to": 2, "jump_onto": 2}  # Number of values of each kind of command
LIMITS = {"walk": 10.0, "stand": 600.0, "jump_up": 2.0, "jump_to": 5.0, "jump_onto": 5.0}
"""Largest absolute value of each kind of command, in its unit: [m/s] and [rad/s], [s], [m], [m], [m]."""
MAX_SECONDS = 600.0  # [s] Maximum total time of walking and standing in one script
MAX_COMMANDS = 1000
MAX_BYTES = 2**20


@dataclass(frozen=True)
class ScriptStep:
    """One command of a script: to walk or stand for some time, or to jump."""

    kind: str  # One of `KINDS`
    values: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Arguments. walk: velocity ahead, left [m/s], about z [rad/s]; jump_up: height [m]; jump_to, _onto: x, y [m]."""
    seconds: float = 0.0  # [s] Time of walking or standing; 0 for jumps

    @property
    def jumps(self) -> bool:
        """Whether the command is a jump."""
        return self.kind.startswith("jump")

    @property
    def goal(self) -> tuple[float, float, float]:
        """Commanded velocity [m/s], [m/s], [rad/s], or landing position x, y and apex height z [m] of a jump."""
        if self.kind == "jump_up":
            return (0.0, 0.0, self.values[0])
        x, y, z = (*self.values, 0.0, 0.0, 0.0)[:3]
        return x, y, z


def read_script(path: Path) -> tuple[ScriptStep, ...]:
    """Read the commands of a script file. Raises InputError, with the path: unreadable, or a malformed command."""
    content = read_json(path, "script of commands", MAX_BYTES)
    try:
        return parse_script(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def parse_script(content: Any) -> tuple[ScriptStep, ...]:
    """Convert JSON data to the commands of a script. Raises InputError: malformed, too many or too long commands."""
    if not isinstance(content, list) or not 1 <= len(content) <= MAX_COMMANDS:
        raise InputError(f"a script is a list of 1 to {MAX_COMMANDS} commands, such as {{'walk': [0.5, 0, 0.3]}}")
    steps = []
    for number, item in enumerate(content, start=1):
        try:
            steps.append(_step(item))
        except (TypeError, ValueError) as error:
            raise InputError(f"command {number}, {item!s:.60}: {error}") from error
    total = sum(step.seconds for step in steps)
    check(total <= MAX_SECONDS, f"walking and standing take {total:g} s, at most {MAX_SECONDS:g} are allowed")
    return tuple(steps)


def _step(item: Json) -> ScriptStep:
    """Convert a JSON object to a command. Raises TypeError or ValueError: it is malformed."""
    kind = next((kind for kind in KINDS if kind in item), None)
    check(kind is not None, f"a command must have one of {', '.join(KINDS)}")
    assert kind is not None
    unknown = sorted(set(item) - {kind} - ({"seconds"} if kind == "walk" else set()))
    check(not unknown, f"{kind} has no {', '.join(unknown)}")
    given = item[kind] if isinstance(item[kind], list) else [item[kind]]
    fits = len(given) == KINDS[kind] and all(_is_number(value) and abs(value) <= LIMITS[kind] for value in given)
    check(fits, f"{kind} takes {KINDS[kind]} numbers within {LIMITS[kind]:g}")
    if kind.startswith("jump"):
        check(kind != "jump_up" or given[0] > 0.0, "jump_up needs a positive height [m]")
        return ScriptStep(kind, tuple(map(float, given)))
    seconds = given[0] if kind == "stand" else item.get("seconds", 2.0)
    check(_is_number(seconds) and 0.0 < seconds <= MAX_SECONDS, f"seconds must be positive and at most {MAX_SECONDS:g}")
    return ScriptStep(kind, tuple(map(float, given)) if kind == "walk" else (0.0, 0.0, 0.0), float(seconds))


def _is_number(value: Any) -> bool:
    """Return whether JSON data is a number; a bool is none."""
    return type(value) in (int, float)
