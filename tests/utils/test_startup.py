"""Start of a command's process: modules that are executed at their first use."""

import importlib
import inspect
import subprocess
import sys

import pytest

from jumper_warp.utils import startup


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A deferred submodule of a package, imported but not executed."""
    (tmp_path / "slow_package").mkdir()
    (tmp_path / "slow_package" / "__init__.py").write_text("from . import slow\n")
    (tmp_path / "slow_package" / "slow.py").write_text("from slow_package import slow\nVALUE = 3\nRUNS = [slow]\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(startup, "DEFERRED", frozenset({"slow_package.slow"}))
    monkeypatch.setattr(sys, "meta_path", [startup.DeferredFinder(), *sys.meta_path])
    yield importlib.import_module("slow_package").slow
    for name in ("slow_package", "slow_package.slow"):
        sys.modules.pop(name)


def executed(module):
    """Return whether the module's code has run, without running it."""
    return "VALUE" in vars(module)


def test_module_is_executed_at_the_first_use_of_a_name(module):
    assert not executed(module)
    assert module.VALUE == 3
    assert module.RUNS == [module] and type(module) is type(sys)


def test_names_of_the_import_system_do_not_execute_it(module):
    importlib.import_module("slow_package.slow")
    assert module.__file__ == module.__spec__.origin and inspect.getmodule(executed) is sys.modules[__name__]
    assert not executed(module)


def test_import_of_a_name_executes_it(module):
    from slow_package.slow import VALUE

    assert VALUE == 3


def test_missing_name_raises(module):
    with pytest.raises(AttributeError, match="NONE"):
        _ = module.NONE


def test_commands_import_newton_without_its_viewer():
    code = (
        "import sys; from jumper_warp.utils.startup import prepare_imports; prepare_imports(); import newton;"
        "print('rerun' in sys.modules); print(newton.viewer.ViewerNull.__name__, 'rerun' in sys.modules)"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.split() == ["False", "ViewerNull", "True"]


def test_first_garbage_collection_is_late_and_there_is_none_at_the_end():
    code = (
        "import gc; from jumper_warp.utils.startup import prepare_imports; prepare_imports()\n"
        "print(gc.get_threshold()[0]); gc.collect(); print(gc.get_threshold()[0])\n"
        "class Cycle:\n"
        "    def __init__(self): self.me = self\n"
        "    def __del__(self): print('collected')\n"
        "Cycle(); print('end')"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.split() == [str(startup.FIRST_COLLECTION_THRESHOLD), str(startup.COLLECTION_THRESHOLD), "end"]


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_files_and_progress_of_a_process_with_closed_standard_streams(tmp_path, closed):
    code = (
        "import sys; from jumper_warp.utils.progress import phase\n"
        "with phase('waiting'), open(sys.argv[1], 'w') as file: print(file.fileno() > 2, file=file)\n"
        "from jumper_warp.utils.runtime import init_warp; init_warp(); print('out'); print('err', file=sys.stderr)"
    )
    command = ["sh", "-c", f'exec "$@" {closed}', "sh", sys.executable, "-c", code, str(tmp_path / "file")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and (tmp_path / "file").read_text() == "True\n"
    assert ("out" in done.stdout, "err" in done.stderr) == (">&-" not in closed.split(), "2>&-" not in closed)
