"""Registry of tasks by name, with their factory functions and training settings.

Importing this module imports no task. A user's task comes from a file or module that the user names, or from an
installed package with an entry point of group `jumper_warp.tasks`; no other module is imported to find tasks.
"""

from __future__ import annotations

import importlib
import importlib.util
import keyword
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.utils.errors import InputError

if TYPE_CHECKING:
    from jumper_warp.tasks.cfg import TaskCfg

GROUP = "jumper_warp.tasks"
"""Group of entry points `TASK = module:function`, where the function returns a `TaskCfg` or `TaskEntry`."""


@dataclass(frozen=True)
class TaskEntry:
    """Registry entry of a task: its factory function and training settings."""

    make: Callable[[], TaskCfg] | str
    """Function that returns the task, or `module:function`, which is imported when the task is made."""
    ppo: PpoCfg = field(default_factory=PpoCfg)  # Default settings of PPO for training
    aliases: tuple[str, ...] = ()  # other names of the task
    best_metric: str = "Metrics/success"  # Default metric of the log whose largest value selects the best checkpoint

    @property
    def origin(self) -> str:
        """Name of the module with the factory function."""
        return self.make.split(":")[0] if isinstance(self.make, str) else self.make.__module__

    def task(self, name: str) -> TaskCfg:
        """Make and return the task. Raises InputError: the result is no TaskCfg, or has another name."""
        from jumper_warp.tasks.cfg import TaskCfg

        make = self.make
        if isinstance(make, str):
            module, _, function = make.partition(":")
            make = getattr(importlib.import_module(module), function)
        task = make()
        if not isinstance(task, TaskCfg):
            raise InputError(f"task {name!r} of {self.origin}: expected a TaskCfg, got {type(task).__name__}")
        if task.name != name:
            raise InputError(f"task {name!r} of {self.origin} calls itself {task.name!r:.60}; give both the same name")
        return task


WALKING = PpoCfg(num_steps=24, gamma=0.985, entropy_coef=0.0025, init_std=0.4, symmetry="actor")
"""PPO settings for velocity tracking."""
HEIGHTS = PpoCfg(gamma=0.99)  # Training of vertical jumps
ON_MARS = replace(HEIGHTS, symmetry="actor")
"""PPO settings for vertical jumps on Mars, with symmetry: in long flights even a slow rotation turns the robot far."""
PLACES = PpoCfg(gamma=0.99, entropy_coef=0.0003, symmetry="actor")  # Training of jumps to goal positions
TURNS = PpoCfg(gamma=0.99, entropy_coef=0.001, init_std=0.5, symmetry="actor")  # Training of turning in flight

TASKS: dict[str, TaskEntry] = {
    "vertical-jump": TaskEntry("jumper_warp.tasks.jump.vertical:vertical_jump", HEIGHTS, ("Olympus-Vertical-Jump",)),
    "horizontal-jump": TaskEntry(
        "jumper_warp.tasks.jump.horizontal:horizontal_jump", PLACES, ("Olympus-Horizontal-Jump",)
    ),
    "horizontal-jump-slippery": TaskEntry("jumper_warp.tasks.jump.horizontal:horizontal_jump_slippery", PLACES),
    "horizontal-jump-sighted": TaskEntry("jumper_warp.tasks.jump.horizontal:horizontal_jump_sighted", PLACES),
    "omnidirectional-jump": TaskEntry("jumper_warp.tasks.jump.horizontal:omnidirectional_jump", PLACES),
    "vertical-jump-mars": TaskEntry(
        "jumper_warp.tasks.jump.mars:vertical_jump_mars", ON_MARS, aliases=("Olympus-Vertical-Jump-Mars",)
    ),
    "vertical-jump-mars-loose": TaskEntry("jumper_warp.tasks.jump.mars:vertical_jump_mars_loose", ON_MARS),
    "horizontal-jump-mars": TaskEntry(
        "jumper_warp.tasks.jump.mars:horizontal_jump_mars", PLACES, aliases=("Olympus-Jump-Mars",)
    ),
    "horizontal-jump-mars-loose": TaskEntry("jumper_warp.tasks.jump.mars:horizontal_jump_mars_loose", PLACES),
    "velocity-flat": TaskEntry(
        "jumper_warp.tasks.velocity.flat:velocity_flat", WALKING, ("Olympus-Walk",), "Metrics/score"
    ),
    "velocity-rough": TaskEntry(
        "jumper_warp.tasks.velocity.rough:velocity_rough", WALKING, best_metric="Metrics/score"
    ),
    "velocity-trot": TaskEntry("jumper_warp.tasks.velocity.flat:velocity_trot", WALKING, best_metric="Metrics/score"),
    "attitude": TaskEntry("jumper_warp.tasks.attitude.flight:attitude_in_flight", TURNS, best_metric="Metrics/settled"),
}  # fmt: skip
"""Registered tasks by name: those of the project, of the user, and of installed packages once loaded."""


def make_task(name: str) -> TaskCfg:
    """Return a task by name or alias. Raises InputError: it is unknown, or its factory returns no such task."""
    name, entry = find_task(name)
    return entry.task(name)


def trainer_settings(name: str) -> PpoCfg:
    """Return the default PPO settings of a task by name or alias. Raises InputError: unknown task."""
    return find_task(name)[1].ppo


def task_names() -> tuple[str, ...]:
    """Return the names of all tasks, including those of installed packages, which stay unloaded."""
    return tuple(dict.fromkeys([*TASKS, *sorted({point.name for point in installed_tasks()})]))


def register_task(
    name: str, make: Callable[[], TaskCfg], *, ppo: PpoCfg | None = None, aliases: tuple[str, ...] = (),
    replace: bool = False,
) -> None:  # fmt: skip
    """Register the task that `make` returns under its name and aliases; ppo: default training settings.

    replace: whether to replace a task of this name; a function of the same name in the same module, as of a file or a
    notebook's cell that runs again, always replaces its task.
    Raises InputError: a name or alias is taken.
    """
    entry = TaskEntry(make, PpoCfg() if ppo is None else ppo, tuple(aliases))
    _register(name, entry, replace or (name in TASKS and _is_same_function(make, TASKS[name].make)))


def _is_same_function(make: Any, other: Any) -> bool:
    """Return whether two factory functions have the same module and name."""
    names = [(getattr(f, "__module__", None), getattr(f, "__qualname__", None)) for f in (make, other)]
    return names[0] == names[1] and None not in names[0]


def _register(name: str, entry: TaskEntry, replace: bool = False) -> None:
    """Add an entry to `TASKS`, or replace that of the same name. Raises InputError: its name or an alias is taken."""
    others = {task: known for task, known in TASKS.items() if not (replace and task == name)}
    owners = {alias: task for task, known in others.items() for alias in (task, *known.aliases)}
    for alias in (name, *entry.aliases):
        if alias in owners:
            raise InputError(f"there is a task {alias!r:.60} already, of {TASKS[owners[alias]].origin}")
    TASKS[name] = entry


def find_task(name: str) -> tuple[str, TaskEntry]:
    """Return (name, entry) of a task by name or alias; loads installed tasks. Raises InputError: unknown task."""
    for known, entry in TASKS.items():
        if name == known or name in entry.aliases:
            return known, entry
    points = [point for point in installed_tasks() if point.name == name]
    if len(points) > 1:
        raise InputError(f"task {name!r:.60} is in several packages: {', '.join(package_of(p) for p in points)}")
    if not points:
        raise InputError(f"unknown task {name!r:.60}; there are {', '.join(task_names())}")
    load_installed(points[0])
    return name, TASKS[name]


def installed_tasks() -> tuple[EntryPoint, ...]:
    """Return the entry points of installed packages' tasks, without loading them."""
    return tuple(entry_points(group=GROUP))


def package_of(point: EntryPoint) -> str:
    """Return the name of the package that has an entry point."""
    return point.dist.name if point.dist is not None else point.module


def load_installed(point: EntryPoint) -> None:
    """Load an installed package's task from its entry point, and register it.

    Raises InputError: it cannot be imported, or a name is taken.
    """
    subject = f"task {point.name!r:.60} of package {package_of(point)}"
    try:
        make: Callable[..., Any] = point.load()
    except (ImportError, AttributeError) as error:
        raise InputError(f"{subject} cannot be loaded: {type(error).__name__}: {error}") from error
    if not callable(make):
        raise InputError(f"{subject}: {point.value} is no function")
    result = make()
    _register(point.name, result if isinstance(result, TaskEntry) else TaskEntry(make))


def load_task_module(name: str) -> ModuleType:
    """Import a user's FILE.py or module, which registers tasks; after an exception `TASKS` is unchanged.

    Raises InputError: it does not exist, its name is another module's, or it registers or defines an invalid task.
    OSError: the file cannot be read.
    """
    path, before = Path(name), dict(TASKS)
    try:
        if path.suffix == ".py" or len(path.parts) > 1:
            return _load_file(path)
        if not all(part.isidentifier() for part in name.split(".")):
            raise ModuleNotFoundError(name=name)
        return importlib.import_module(name)
    except BaseException as error:
        TASKS.clear()
        TASKS.update(before)
        if isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}."):
            raise InputError(f"no module {name!r:.80}, give a FILE.py or the name of an installed module") from error
        raise


def _load_file(path: Path) -> ModuleType:
    """Import a file as a module named by its stem, and return it; a loaded file is not run again. Raises InputError."""
    if not path.is_file():
        raise InputError(f"no file {str(path)!r:.200}")
    path, name = path.resolve(), path.stem
    if not name.isidentifier() or keyword.iskeyword(name):
        raise InputError(f"{path.name}: the name of a task's file must be one that Python can import")
    known = sys.modules.get(name)
    if known is not None and getattr(known, "__file__", None) == str(path):
        return known
    if known is not None or name in sys.stdlib_module_names or _is_elsewhere(name, path):
        raise InputError(f"{path.name}: {name!r} is the name of another module; give the file another name")
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path.name}: the name of a task's file must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        if isinstance(error, SyntaxError) and error.filename == str(path):
            raise InputError(f"{path.name}:{error.lineno}: {error.msg}") from error
        if isinstance(error, InputError):
            lines = [line for frame, line in traceback.walk_tb(error.__traceback__)
                     if frame.f_code.co_filename == str(path)]  # fmt: skip
            raise InputError(f"{path.name}:{lines[-1] if lines else 1}: {error}") from error
        raise
    return module


def _is_elsewhere(name: str, path: Path) -> bool:
    """Return whether `import name` would import a file other than `path`."""
    spec = importlib.util.find_spec(name)
    return spec is not None and spec.origin != str(path)
