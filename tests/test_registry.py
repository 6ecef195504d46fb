"""Registry of tasks: names, files and modules of users, entry points of packages, and lazy public names."""

import subprocess
import sys

import pytest

import jumper_warp
from jumper_warp import registry
from jumper_warp.recipe import Recipe
from jumper_warp.registry import TASKS, find_task, load_task_module, make_task, register_task, task_name
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.tasks.saving import TaskError, task_to_json
from jumper_warp.utils.errors import InputError

PROJECT_TASKS = tuple(TASKS)
TASK_FILE = """\
from dataclasses import replace

from jumper_warp.registry import TaskEntry, register_task
from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.tasks.jump.vertical import vertical_jump


def low_jump():
    return replace(vertical_jump(), name="low-jump")


def entry():
    return TaskEntry(low_jump, PpoCfg(gamma=0.9), ("Low-Jump",))
"""
REGISTER = 'register_task("low-jump", low_jump, ppo=PpoCfg(gamma=0.9), aliases=("Low-Jump",))\n'


@pytest.fixture(autouse=True)
def restored_registry():
    """Restore registered tasks and imported modules after each test."""
    tasks, modules = dict(TASKS), set(sys.modules)
    yield
    TASKS.clear()
    TASKS.update(tasks)
    for name in set(sys.modules) - modules:
        if name.startswith(("my_", "their_")):
            del sys.modules[name]


# ---------------------------------------------------------------------- names


def test_tasks_are_found_by_name_and_alias():
    assert make_task("Olympus-Vertical-Jump") == make_task("vertical-jump")
    assert find_task("Olympus-Horizontal-Jump")[0] == "horizontal-jump"
    assert [make_task(name).name for name in PROJECT_TASKS] == list(PROJECT_TASKS)


@pytest.mark.parametrize("name", ["vertical_jump_mars", "Olympus_Vertical-Jump_Mars", "vertical-jump_mars"])
def test_dash_and_underscore_are_the_same_in_names_of_tasks(name):
    assert find_task(name)[0] == task_name(name) == "vertical-jump-mars"


@pytest.mark.parametrize(
    ("name", "aliases", "taken"),
    [("vertical-jump", (), "vertical-jump"), ("my-jump", ("Olympus-Vertical-Jump",), "Olympus")],
)  # fmt: skip
def test_name_that_is_taken_is_refused(name, aliases, taken):
    with pytest.raises(InputError, match=f"there is a task '{taken}.* already, of jumper_warp.tasks.jump"):
        register_task(name, lambda: make_task("vertical-jump"), aliases=aliases)
    assert tuple(TASKS) == PROJECT_TASKS


CELL = """
from jumper_warp.registry import make_task, register_task
import dataclasses

def low_jump():
    return dataclasses.replace(make_task("vertical-jump"), name="low-jump", gravity=GRAVITY)

register_task("low-jump", low_jump, aliases=("Low",))
"""


def test_cell_that_runs_again_replaces_its_task():
    notebook = {"__name__": "__main__"}
    for gravity in (9.81, 3.71):  # [m/s^2]
        exec(CELL.replace("GRAVITY", str(gravity)), notebook)
        assert make_task("Low").gravity == gravity
    assert list(TASKS).count("low-jump") == 1


# ---------------------------------------------------------------------- files and modules


def test_file_is_loaded_once_and_registers_its_tasks(tmp_path):
    path = tmp_path / "my_tasks.py"
    path.write_text(TASK_FILE + REGISTER)
    module = load_task_module(str(path))
    assert module is sys.modules["my_tasks"] is load_task_module(str(path))
    assert make_task("Low-Jump").name == "low-jump" and TASKS["low-jump"].origin == "my_tasks"


def test_file_with_the_name_of_another_module_is_refused(tmp_path):
    (tmp_path / "json.py").write_text("raise SystemExit('run')")
    before = sys.modules.get("json")
    with pytest.raises(InputError, match="'json' is the name of another module; give the file another name"):
        load_task_module(str(tmp_path / "json.py"))
    assert sys.modules.get("json") is before


# ---------------------------------------------------------------------- installed packages


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Function (package, points, code) that installs a package with entry points {task: "module:function"}."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(package, points, code=TASK_FILE):
        info = tmp_path / f"{package}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        lines = [f"{name} = {value}\n" for name, value in points.items()]
        (info / "entry_points.txt").write_text("[jumper_warp.tasks]\n" + "".join(lines))
        (tmp_path / f"{package}.py").write_text(code)

    return install


@pytest.mark.parametrize("function", ["low_jump", "entry"])
def test_installed_task_is_listed_but_loaded_only_when_made(install, function):
    install("their_tasks", {"low-jump": f"their_tasks:{function}"})
    assert "low-jump" in registry.task_names() and make_task("vertical-jump")
    with pytest.raises(InputError, match=r"there are .*low-jump"):
        make_task("swim")
    assert "their_tasks" not in sys.modules
    assert make_task("low-jump").name == "low-jump" and TASKS["low-jump"].origin == "their_tasks"
    assert registry.trainer_settings("low-jump").gamma == (0.9 if function == "entry" else PpoCfg().gamma)


def test_saved_configuration_loads_no_installed_task(install):
    install("their_tasks", {"low-jump": "their_tasks:low_jump"})
    new = task_to_json(make_task("vertical-jump")) | {"name": "low-jump"}
    new["rewards"][0]["func"] = "their_tasks:reward"
    for saved in (new, {"name": "low-jump", "terms": [], "rules": []}):
        with pytest.raises(TaskError):
            Recipe.from_json({"env": {"task": saved}}, [])
    assert "their_tasks" not in sys.modules and "low-jump" not in TASKS


def test_package_cannot_replace_a_task_of_the_project(install):
    install("their_tasks", {"vertical-jump": "their_tasks:low_jump"})
    assert make_task("vertical-jump").name == "vertical-jump" and "their_tasks" not in sys.modules
    (point,) = registry.installed_tasks()
    entry = TASKS["vertical-jump"]
    with pytest.raises(InputError, match="there is a task 'vertical-jump' already"):
        registry.load_installed(point)
    assert TASKS["vertical-jump"] is entry and entry.make == "jumper_warp.tasks.jump.vertical:vertical_jump"


def test_public_names_are_imported_lazily():
    code = (
        "import sys, jumper_warp\nfrom jumper_warp import make_task\n"
        "assert not {'torch', 'warp', 'newton'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    for name in jumper_warp.__all__:
        assert getattr(jumper_warp, name).__name__ == name
