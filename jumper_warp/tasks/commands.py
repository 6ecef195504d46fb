"""Layouts of the tasks' commands (such as goals and velocities), and checks of commands that users pass."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from jumper_warp.kernels.attitude.commands import set_turn
from jumper_warp.kernels.jump.reset import set_jump
from jumper_warp.kernels.velocity.commands import set_velocity
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.kernels import Function


@dataclass(frozen=True)
class CommandValue:
    """One number of a task's command: its name with unit, lower bound, and whether it may be omitted."""

    name: str  # With its unit, as `x [m]`
    least: float = -math.inf  # Smallest allowed number, in its unit
    optional: bool = False  # Whether it may be omitted, which means 0; only trailing numbers may be
    steps: bool = False  # Whether it is a whole number of policy steps, where 2^31 or more, as infinity, means never


@dataclass(frozen=True)
class CommandLayout:
    """Layout of a task's command, such as a goal position: the one to four numbers of which it consists, in order."""

    values: tuple[CommandValue, ...]
    nonzero: bool = False  # Whether at least one number must differ from 0

    @property
    def counts(self) -> tuple[int, ...]:
        """Allowed lengths of a command: with all, some or none of its optional components."""
        required = sum(not value.optional for value in self.values)
        return tuple(range(required, len(self.values) + 1))

    def __str__(self) -> str:
        """Return the names of the command's components with units, for messages."""
        return ", ".join(f"{value.name}{' (optional)' if value.optional else ''}" for value in self.values)


LAYOUTS: dict[Function, CommandLayout] = {
    set_jump: CommandLayout(
        (
            CommandValue("x [m]"),
            CommandValue("y [m]"),
            CommandValue("height [m]", least=0.0),
            CommandValue("policy step of the command [1]", least=0.0, optional=True, steps=True),
        )
    ),
    set_velocity: CommandLayout(
        (
            CommandValue("forward [m/s]"),
            CommandValue("left [m/s]"),
            CommandValue("turning [rad/s]"),
            CommandValue("gait [Hz]", least=0.0, optional=True),
        )
    ),
    set_turn: CommandLayout(tuple(CommandValue(f"quaternion {axis} [1]") for axis in "xyzw"), nonzero=True),
}
"""Layouts of commands by the function `Command.set` of a task; any other function has `ANY_NUMBERS`."""
ANY_NUMBERS = CommandLayout((CommandValue("a number"), *(CommandValue("a number", optional=True) for _ in range(3))))


def layout_of(task: TaskCfg) -> CommandLayout:
    """Return the layout of a task's command: names, bounds and order of its components."""
    return LAYOUTS.get(task.command.set, ANY_NUMBERS)


def check_commands(commands: np.ndarray, task: TaskCfg, num_envs: int, worlds: np.ndarray) -> None:
    """Raise InputError unless commands fit the layout of the task's command.

    commands: (num_envs, n), or (n,) for all worlds. worlds: (num_envs,) bool, worlds where bounds are checked.
    """
    layout = layout_of(task)
    subject = f"commands of {task.name} are {layout}"
    if commands.shape[:-1] not in ((num_envs,), ()) or commands.shape[-1:] not in [(n,) for n in layout.counts]:
        raise InputError(f"{subject}, {num_envs} rows or one for all, got shape {commands.shape}")
    durations = np.array([value.steps for value in layout.values[: commands.shape[-1]]])
    if not (np.isfinite(commands) | (durations & np.isinf(commands))).all():
        raise InputError("commands must be finite")
    rows = np.broadcast_to(commands, (num_envs, commands.shape[-1]))[worlds]
    for value, column in zip(layout.values, rows.T, strict=False):
        if (column < value.least).any():
            raise InputError(f"{subject}: {value.name} must be at least {value.least:g}, got {column.min():g}")
        if value.steps and (fraction := column[np.trunc(column) != column]).size:
            raise InputError(f"{subject}: {value.name} must be a whole number, got {fraction[0]:g}")
    if layout.nonzero and (rows == 0.0).all(axis=1).any():
        raise InputError(f"{subject}: not all may be 0")
