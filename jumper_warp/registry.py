"""Registry of tasks by name, with their factory functions and training settings.

Importing this module imports no task. A user's task comes from a file or module that the user names, or from an
installed package with an entry point of group `jumper_warp.tasks`; no other module is imported to find tasks.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import keyword
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.utils.assets import dashed, policy_tasks
from jumper_warp.utils.checks import NAME, check_flags, check_type
from jumper_warp.utils.errors import InputError, suggestion
from jumper_warp.utils.files import existing_file
from jumper_warp.utils.sources import PROJECT_PREFIX, module_from_file, own_fault

if TYPE_CHECKING:
    from jumper_warp.robot.overlay import RobotOverlay
    from jumper_warp.tasks.cfg import TaskCfg

MAX_SOURCE_BYTES = 2**20  # Size of the largest file of tasks that is imported
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
    about: str = ""  # What the robot does, in a few words, for `jumper list`; default: the factory's first sentence
    presets: dict[str, str] = field(default_factory=dict)  # Groups of flags of `jumper train` by name, such as `laptop`
    num_envs: int = TrainCfg.num_envs  # Default number of worlds for training
    max_iterations: int = TrainCfg.max_iterations  # Default number of iterations of a training

    @property
    def origin(self) -> str:
        """Name of the module with the factory function."""
        return self.make.split(":")[0] if isinstance(self.make, str) else self.make.__module__

    @property
    def of_project(self) -> bool:
        """Whether the task is one of the project's own, not of a user."""
        return self.origin.startswith(PROJECT_PREFIX)

    @property
    def description(self) -> str:
        """Short description of the task: `about`, or the first sentence of the factory's docstring.

        The factory is not imported for it.
        """
        doc = "" if isinstance(self.make, str) else getattr(self.make, "__doc__", None) or ""
        return self.about or first_sentence(doc)

    def training(self, name: str) -> TrainCfg:
        """Return the default settings with which the task is trained; name: of the task."""
        return TrainCfg(
            task=name, num_envs=self.num_envs, max_iterations=self.max_iterations, best_metric=self.best_metric,
            ppo=self.ppo,
        )  # fmt: skip

    def factory(self) -> Callable[[], TaskCfg]:
        """Import the factory function if it is given by name, and return it."""
        if not isinstance(self.make, str):
            return self.make
        module, _, function = self.make.partition(":")
        return getattr(importlib.import_module(module), function)

    def task(self, name: str, robot: RobotOverlay | None = None) -> TaskCfg:
        """Return the task that the factory makes, a task of the project with its numbers for a robot.

        Raises InputError: it is invalid, no TaskCfg, or has another name.
        """
        from jumper_warp.robot.overlay import RobotOverlay
        from jumper_warp.tasks.cfg import TaskCfg

        make = self.factory()
        try:
            task = make()
        except (InputError, TypeError) as error:
            if self.of_project:
                raise
            code = getattr(inspect.unwrap(make), "__code__", None)
            raise own_fault(error, code.co_filename if code else "") from error
        if not isinstance(task, TaskCfg):
            raise InputError(f"task {name!r} of {self.origin}: expected a TaskCfg, got {type(task).__name__}")
        if task.name != name:
            raise InputError(f"task {name!r} of {self.origin} calls itself {task.name!r:.60}; give both the same name")
        check_type("robot", robot, RobotOverlay | None)
        if robot is None or robot.is_jumper or not self.of_project:
            return task
        from jumper_warp.sim.apex import jumper_measures, measure
        from jumper_warp.tasks.scaling import scaled

        return scaled(task, robot.description, measure(robot), jumper_measures())


def first_sentence(doc: str) -> str:
    """Return the first sentence of a factory's docstring on one line, without "Return" before it and the full stop."""
    sentence = " ".join(doc.split("\n\n")[0].split()).split(". ")[0].removeprefix("Return ").rstrip(".")
    return sentence[:1].upper() + sentence[1:]


WALKING = PpoCfg(num_steps=24, gamma=0.985, entropy_coef=0.0025, init_std=0.4, symmetry="actor")
"""PPO settings for velocity tracking."""
HEIGHTS = PpoCfg(gamma=0.99)  # Training of vertical jumps
ON_MARS = replace(HEIGHTS, symmetry="actor")
"""PPO settings for vertical jumps on Mars, with symmetry: in long flights even a slow rotation turns the robot far."""
FROM_STANCE = replace(ON_MARS, final_entropy_coef=0.0003)  # Training of vertical jumps by a robot that stands
PLACES = PpoCfg(gamma=0.99, entropy_coef=0.0003, symmetry="actor")  # Training of jumps to goal positions
SCORE = "Metrics/score"  # Key of the log by which checkpoints of walks are selected
TURNS = PpoCfg(gamma=0.99, entropy_coef=0.001, init_std=0.5, symmetry="actor")  # Training of turning in flight
PAPER = PpoCfg(asymmetric_critic=False, final_desired_kl=0.01)
"""Settings of PPO that the paper's tasks share, from the authors' public code."""
PAPER_HEIGHTS = replace(PAPER, num_steps=45, minibatches=6, gamma=0.985, entropy_coef=0.00075)
PAPER_PLACES = replace(PAPER, num_steps=30, minibatches=4, gamma=0.99, entropy_coef=0.001)
PAPER_WALKING = replace(PAPER, num_steps=30, minibatches=4, gamma=0.985, entropy_coef=0.0025, hidden=(512, 256, 128))

NOMINAL = "--no-randomize --no-noise --history 1 --ppo.hidden 128 64 64"
"""Flags of trainings on two CPU cores: no randomisation, no noise, a short observation and a small network."""
LAPTOP_JUMP = f"{NOMINAL} --num-envs 1024 --env.curriculum.promote-after 1 --ppo.desired-kl 0.02"
LAPTOP_WALK = f"{NOMINAL} --num-envs 512 --ppo.desired-kl 0.02 --ppo.minibatches 4"
NEARER = "--env.command-filter.transversal.upper 140 --env.terminations.walked.margin 9" + "".join(
    f" --env.levels.{i}.goal-lower -0.9 -0.9 0 --env.levels.{i}.goal-upper 1.7 0.9 0" for i in (10, 11)
)
"""Flags of a jump from a stance: thighs up to 140°, steps to the goal, goals of at most 1.7 m in the last levels."""
# Numbers of iterations in presets are those of 330, 650, 1,310, 1,800 and 1,110 s at 20,000 steps per second.

UP, AHEAD, STANDING, MARS, PRINTED = (
    f"jumper_warp.tasks.jump.{name}:" for name in ("vertical", "horizontal", "standing", "mars", "paper")
)
WALK = "jumper_warp.tasks.velocity"

TASKS: dict[str, TaskEntry] = {
    "vertical-jump": TaskEntry(
        f"{UP}vertical_jump", HEIGHTS, ("Olympus-Vertical-Jump",), about="jump to a height",
        presets={
            "laptop": f"{LAPTOP_JUMP} --ppo.final-desired-kl 0.005 --ppo.entropy-coef 0.0003 --max-iterations 200"
        },
    ),
    "horizontal-jump": TaskEntry(
        f"{AHEAD}horizontal_jump", PLACES, ("Olympus-Horizontal-Jump",), about="jump to a place ahead",
        presets={"laptop": f"{LAPTOP_JUMP} --ppo.final-desired-kl 0.005 --max-iterations 400"},
    ),
    "horizontal-jump-sighted": TaskEntry(f"{AHEAD}horizontal_jump_sighted", PLACES, about="jump off and onto blocks"),
    "vertical-jump-standing": TaskEntry(
        f"{STANDING}vertical_jump_standing", FROM_STANCE, about="stand, and jump to a height", max_iterations=6000,
        presets={"laptop": f"{LAPTOP_JUMP} --ppo.final-desired-kl 0.005 --max-iterations 800"},
    ),
    "horizontal-jump-standing": TaskEntry(
        f"{STANDING}horizontal_jump_standing", PLACES, about="stand, and jump in any direction", max_iterations=8500,
        presets={"laptop": f"{LAPTOP_JUMP} --ppo.final-desired-kl 0.005 --max-iterations 1100 {NEARER}"},
    ),
    "vertical-jump-mars": TaskEntry(f"{MARS}vertical_jump_mars", ON_MARS, ("Olympus-Vertical-Jump-Mars",),
                                    about="jump to a height, Mars"),
    "vertical-jump-mars-loose": TaskEntry(f"{MARS}vertical_jump_mars_loose", ON_MARS, about="jump up to 3.6 m, Mars"),
    "horizontal-jump-mars": TaskEntry(f"{MARS}horizontal_jump_mars", PLACES, ("Olympus-Jump-Mars",),
                                      about="jump to a place, Mars"),
    "horizontal-jump-mars-loose": TaskEntry(f"{MARS}horizontal_jump_mars_loose", PLACES, about="jump farther, Mars"),
    "velocity-flat": TaskEntry(
        f"{WALK}.flat:velocity_flat", WALKING, ("Olympus-Walk",), SCORE, "walk on level ground",
        {"laptop": f"{LAPTOP_WALK} --ppo.final-desired-kl 0.001 --ppo.entropy-coef 0.006 --max-iterations 1800"},
    ),
    "velocity-rough": TaskEntry(f"{WALK}.rough:velocity_rough", replace(WALKING, final_entropy_coef=0.0003), (), SCORE,
                                "walk on level and rough ground", max_iterations=7500),
    "velocity-mars": TaskEntry(f"{WALK}.rough:velocity_mars", replace(WALKING, final_entropy_coef=0.0003), (), SCORE,
                               "walk on Mars", max_iterations=7500),
    "velocity-trot": TaskEntry(f"{WALK}.flat:velocity_trot", WALKING, (), SCORE, "trot on level ground"),
    "vertical-jump-paper": TaskEntry(f"{PRINTED}vertical_jump_paper", PAPER_HEIGHTS, num_envs=4096, max_iterations=4000,
                                     about="jump to a height, as in the paper"),
    "horizontal-jump-paper": TaskEntry(f"{PRINTED}horizontal_jump_paper", PAPER_PLACES, num_envs=4096,
                                       max_iterations=4000, about="jump to a place, as in the paper"),
    "velocity-paper": TaskEntry(f"{WALK}.paper:velocity_paper", PAPER_WALKING, (), SCORE, "walk as in the paper",
                                num_envs=4096, max_iterations=2000),
    "attitude": TaskEntry("jumper_warp.tasks.attitude.flight:attitude_in_flight", TURNS, (), "Metrics/settled",
                          "turn while floating"),
}  # fmt: skip
"""Registered tasks by name: those of the project, of the user, and of installed packages once loaded."""


def make_task(name: str, robot: RobotOverlay | None = None) -> TaskCfg:
    """Return a task by name or alias, where - counts as _.

    robot: of other lengths than the Jumper's (`load_overlay`), in whose measures the project's tasks state their
    numbers. Raises InputError: the task is unknown, or its factory returns no such task.
    """
    name, entry = find_task(name)
    return entry.task(name, robot)


def trainer_settings(name: str) -> PpoCfg:
    """Return the default PPO settings of a task by name or alias. Raises InputError: unknown task."""
    return find_task(name)[1].ppo


def task_names() -> tuple[str, ...]:
    """Return the names of all tasks, including those of installed packages, which stay unloaded."""
    return tuple(dict.fromkeys([*TASKS, *sorted({point.name for point in installed_tasks()})]))


def register_task(
    name: str, make: Callable[[], TaskCfg], *, ppo: PpoCfg | None = None, aliases: tuple[str, ...] = (),
    about: str = "", presets: dict[str, str] | None = None, replace: bool = False,
) -> None:  # fmt: skip
    """Register the task that `make` returns under its name and aliases.

    ppo: default training settings; about: text for `jumper list` (default: the first sentence of make's docstring);
    presets: groups of flags of `jumper train` by name, as {"laptop": LAPTOP_JUMP}; replace: whether to replace a task
    of this name. A function of the same name in the same module, as of a file or a notebook's cell that runs again,
    always replaces its task. Raises InputError: a name or alias is taken or invalid, or make is no function.
    """
    check_flags(replace=replace)
    check_type("ppo", ppo, PpoCfg | None)
    check_type("about", about, str)
    check_type("aliases", aliases, tuple[str, ...])
    check_type("presets", presets, dict[str, str] | None)
    for preset, flags in (presets or {}).items():
        check_type(f"preset {preset!r:.40}", flags, str)
        try:
            shlex.split(flags)
        except ValueError as error:
            raise InputError(f"preset {preset!r:.40} of task {name!r:.40}: {error}") from error
    if not callable(make) or not all(isinstance(each, str) and NAME.fullmatch(each) for each in (name, *aliases)):
        given = f"{name!r:.40}, {make!r:.60}, aliases {aliases!r:.60}"
        raise InputError(f"register_task needs names as for files, and a function that makes the task, got {given}")
    entry = TaskEntry(make, PpoCfg() if ppo is None else ppo, tuple(aliases), about=about, presets=presets or {})
    _register(name, entry, replace or (name in TASKS and _is_same_function(make, TASKS[name].make)))


def _is_same_function(make: Any, other: Any) -> bool:
    """Return whether two factory functions have the same module and name, as after a notebook's cell runs again."""
    names = [(getattr(f, "__module__", None), getattr(f, "__qualname__", None)) for f in (make, other)]
    return names[0] == names[1] and None not in names[0]


def _register(name: str, entry: TaskEntry, replace: bool = False) -> None:
    """Add an entry to `TASKS`, or replace that of the same name. Raises InputError: its name or an alias is taken."""
    owners = {alias: task for alias, task in _tasks_by_name().items() if not (replace and task == name)}
    for alias in (name, *entry.aliases):
        if owner := owners.get(dashed(alias)):
            raise InputError(f"there is a task {alias!r:.60} already, of {TASKS[owner].origin}")
    TASKS[name] = entry


def _tasks_by_name() -> dict[str, str]:
    """Return a map from the names and aliases of the tasks in `TASKS`, in dashed spelling, to their names."""
    return {dashed(name): task for task, entry in TASKS.items() for name in (task, *entry.aliases)}


def task_name(name: str) -> str | None:
    """Return the registered name of a task by name or alias, where - counts as _; None if there is no such task.

    Tasks of installed packages stay unloaded.
    """
    installed = {dashed(point.name): point.name for point in installed_tasks()}
    return (installed | _tasks_by_name()).get(dashed(name))


def find_task(name: str) -> tuple[str, TaskEntry]:
    """Return (name, entry) of a task by name or alias, where - counts as _; an installed task is loaded.

    Raises InputError: the task is unknown, or in several packages.
    """
    if not isinstance(name, str):
        raise InputError(f"a task's name must be a text, got {name!r:.60}")
    known = task_name(name)
    if known is None:
        raise InputError(_unknown_task(name))
    if known not in TASKS:
        points = [point for point in installed_tasks() if point.name == known]
        if len(points) > 1:
            raise InputError(f"task {name!r:.60} is in several packages: {', '.join(package_of(p) for p in points)}")
        load_installed(points[0])
    return known, TASKS[known]


def _unknown_task(name: str) -> str:
    """Return the error message for a name that is no task.

    It says whether the name is a policy, and mentions similar names and --task-module.
    """
    for policy, task in policy_tasks().items():
        if dashed(name) == dashed(policy):
            return f"{name!r} is a policy, not a task; its task is {task}"
    own = "; a task of your own needs --task-module FILE.py"
    if similar := suggestion(name, [*task_names(), *(alias for entry in TASKS.values() for alias in entry.aliases)]):
        return f"unknown task {name!r:.60}{own}{similar}"
    return f"unknown task {name!r:.60}; there are {', '.join(task_names())}{own}"


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


LOADED: list[str] = []  # Names of the user's files and modules, in whose files an exception is the user's mistake


def load_task_module(name: str) -> ModuleType:
    """Import a user's FILE.py or module, which registers tasks; after an exception `TASKS` is unchanged.

    Raises InputError: it does not exist, its name is another module's, or it registers or defines an invalid task.
    OSError: the file cannot be read.
    """
    path, before = Path(name), dict(TASKS)
    LOADED.append(name)
    try:
        if path.suffix == ".py" or len(path.parts) > 1:
            return _load_file(path)
        if not all(part.isidentifier() for part in name.split(".")):
            raise ModuleNotFoundError(name=name)
        return importlib.import_module(name)
    except BaseException as error:
        TASKS.clear()
        TASKS.update(before)
        if isinstance(error, SystemExit):
            raise InputError(f"{name}: a file of tasks must not exit when it is imported") from error
        if isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}."):
            raise InputError(f"no module {name!r:.80}; give a FILE.py or the name of an installed module") from error
        raise


def _load_file(path: Path) -> ModuleType:
    """Import a file as a module named by its stem, and return it; a loaded file is not run again. Raises InputError."""
    existing_file(path, "tasks of your own", MAX_SOURCE_BYTES)
    path, name = path.resolve(), path.stem
    if not name.isidentifier() or keyword.iskeyword(name):
        raise InputError(f"{path.name}: the name of a task's file must be one that Python can import")
    known = sys.modules.get(name)
    if known is not None and getattr(known, "__file__", None) == str(path):
        return known
    if known is not None or name in sys.stdlib_module_names or _is_elsewhere(name, path):
        raise InputError(f"{path.name}: {name!r} is the name of another module; give the file another name")
    if path.suffix != ".py":
        raise InputError(f"{path.name}: the name of a task's file must end in .py")
    try:
        return module_from_file(name, path)
    except BaseException as error:
        if isinstance(error, SyntaxError):  # of the file, or of one that it imports; without a name for a null byte
            raise InputError(f"{Path(error.filename or path).name}:{error.lineno or 1}: {error.msg}") from error
        if isinstance(error, InputError):
            raise own_fault(error, str(path)) from error
        raise


def _is_elsewhere(name: str, path: Path) -> bool:
    """Return whether `import name` would import a file other than `path`.

    Then a saved task, which names its functions as `module:function`, would find the wrong ones.
    """
    spec = importlib.util.find_spec(name)
    return spec is not None and spec.origin != str(path)
