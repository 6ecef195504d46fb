"""The tasks by name."""

from collections.abc import Callable

from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.tasks.jump.horizontal import horizontal_jump, omnidirectional_jump
from jumper_warp.tasks.jump.vertical import vertical_jump

TASKS: dict[str, Callable[[], TaskCfg]] = {
    "vertical-jump": vertical_jump,
    "horizontal-jump": horizontal_jump,
    "omnidirectional-jump": omnidirectional_jump,
}
ALIASES = {"Olympus-Vertical-Jump": "vertical-jump", "Olympus-Horizontal-Jump": "horizontal-jump"}


def make_task(name: str) -> TaskCfg:
    """Return a task by name or alias. Raises ValueError for an unknown one."""
    name = ALIASES.get(name, name)
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; there are {', '.join(TASKS)}")
    return TASKS[name]()
