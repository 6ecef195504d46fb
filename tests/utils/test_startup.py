"""Start of a command's process: modules that are executed at their first use."""

import importlib
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


def test_commands_import_newton_without_its_viewer():
    code = (
        "import sys; from jumper_warp.utils.startup import prepare_imports; prepare_imports(); import newton;"
        "print('rerun' in sys.modules); print(newton.viewer.ViewerNull.__name__, 'rerun' in sys.modules)"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.split() == ["False", "ViewerNull", "True"]
