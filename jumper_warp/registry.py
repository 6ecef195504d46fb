"""The tasks by name: how each is made, how its policies are trained, and where those of users come from.

Importing this module imports no task. A task of a user comes from a file or module that the user names, or from an
installed package with an entry point of group `jumper_warp.tasks`; nothing else is ever imported for its sake.
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
"""Of entry points: name of a task, and `module:function` that returns its `TaskCfg` or `TaskEntry`."""


@dataclass(frozen=True)
class TaskEntry:
    """How a task is made and trained."""

    make: Callable[[], TaskCfg] | str
    """Returns the task; or where that function is, `module:function`, imported when the task is made."""
    ppo: PpoCfg = field(default_factory=PpoCfg)
    """Settings of the algorithm unless told otherwise."""
    aliases: tuple[str, ...] = ()
    best_metric: str = "Metrics/success"
    """The logged figure that makes a checkpoint the best, unless told otherwise."""

    @property
    def origin(self) -> str:
        """Name of the module that makes the task."""
        return self.make.split(":")[0] if isinstance(self.make, str) else self.make.__module__

    def task(self, name: str) -> TaskCfg:
        """Return the task; raises InputError: it is none, or not of this name."""
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
"""How velocity tracking is trained."""
HEIGHTS = PpoCfg(gamma=0.99)
"""How jumps to heights are trained."""
ON_MARS = replace(HEIGHTS, symmetry="actor")
"""The same on Mars, where a little spin turns the robot far."""
PLACES = PpoCfg(gamma=0.99, entropy_coef=0.0003, symmetry="actor")
"""How jumps to places are trained."""
TURNS = PpoCfg(gamma=0.99, entropy_coef=0.001, init_std=0.5, symmetry="actor")
"""How turning in flight is trained."""

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
"""The project's tasks, and those that were registered or asked for."""


def make_task(name: str) -> TaskCfg:
    """Return a task by name or alias. Raises InputError: an unknown one, or one whose maker gives no such task."""
    name, entry = find_task(name)
    return entry.task(name)


def trainer_settings(name: str) -> PpoCfg:
    """Return how policies of a task, by name or alias, are trained unless told otherwise; raises as `make_task`."""
    return find_task(name)[1].ppo


def task_names() -> tuple[str, ...]:
    """Return the names of all tasks; those of installed packages are not loaded for it."""
    return tuple(dict.fromkeys([*TASKS, *sorted({point.name for point in installed_tasks()})]))


def register_task(
    name: str, make: Callable[[], TaskCfg], *, ppo: PpoCfg | None = None, aliases: tuple[str, ...] = ()
) -> None:
    """Let `make` be found by the name of its task, and by aliases; ppo: settings of the algorithm.

    Raises InputError: a name is taken.
    """
    _register(name, TaskEntry(make, PpoCfg() if ppo is None else ppo, tuple(aliases)))


def _register(name: str, entry: TaskEntry) -> None:
    taken = {alias: other for other, known in TASKS.items() for alias in (other, *known.aliases)}
    for each in (name, *entry.aliases):
        if each in taken:
            raise InputError(f"there is a task {each!r:.60} already, of {TASKS[taken[each]].origin}")
    TASKS[name] = entry


def find_task(name: str) -> tuple[str, TaskEntry]:
    """Return a task's name and entry by name or alias; raises InputError for an unknown one."""
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
    """Return the tasks that installed packages offer, without loading them."""
    return tuple(entry_points(group=GROUP))


def package_of(point: EntryPoint) -> str:
    """Return the name of the package that offers a task."""
    return point.dist.name if point.dist is not None else point.module


def load_installed(point: EntryPoint) -> None:
    """Load a task of an installed package, and register it.

    Raises InputError: it cannot be imported, or a name is taken.
    """
    where = f"task {point.name!r:.60} of package {package_of(point)}"
    try:
        make: Callable[..., Any] = point.load()
    except (ImportError, AttributeError) as error:
        raise InputError(f"{where} cannot be loaded: {type(error).__name__}: {error}") from error
    if not callable(make):
        raise InputError(f"{where}: {point.value} is no function")
    made = make()
    _register(point.name, made if isinstance(made, TaskEntry) else TaskEntry(make))


def load_task_module(name: str) -> ModuleType:
    """Import a FILE.py, or a module by name, so that the tasks that it registers are known.

    Raises InputError: there is none, its name belongs to another module, or what it registers or defines is refused.
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
    """Import a file under its stem; one that was imported before is returned as it is."""
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
    """Return whether importing a name would give another file than this."""
    spec = importlib.util.find_spec(name)
    return spec is not None and spec.origin != str(path)
