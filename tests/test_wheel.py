"""The wheel: built from a copy of the tree, unpacked, and used from another folder."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from jumper_warp.utils.assets import policy_tasks

ROOT = Path(__file__).parents[1]
SOURCES = ("jumper_warp", "kernels", "assets", "setup.py", "pyproject.toml", "README.md", "LICENSE")
BUILD = "from setuptools.build_meta import build_wheel; print(build_wheel('.'))"
USE_PACKAGE = """
import jumper_warp
from jumper_warp.cli.main import main
from jumper_warp.policies.policy import load_policy
from jumper_warp.utils.assets import policy_tasks
from jumper_warp.robot.description import load_description

print(jumper_warp.__file__)
main(["list", "--json"])
load_description()
for name in policy_tasks():
    load_policy(name)  # checks every file
"""


def python(code, folder, *paths):
    """Run Python code in a folder with `paths` as PYTHONPATH; return its lines of stdout, or of stderr if it fails."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    return (done.stderr if done.returncode else done.stdout).splitlines()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Path of the wheel that is built from a copy of the source tree."""
    tree = tmp_path_factory.mktemp("tree")
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tree / name, **({"symlinks": True} if copy is shutil.copytree else {}))
    return tree / python(BUILD, tree)[-1]


def test_wheel_holds_one_package_and_all_assets(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder, inside in (("jumper_warp", ""), ("kernels", "jumper_warp/"), ("assets", "jumper_warp/")):
        kinds = "*" if folder == "assets" else "*.py"
        files = {f"{inside}{path.relative_to(ROOT)}" for path in (ROOT / folder).rglob(kinds) if path.is_file()}
        assert files and files <= names, sorted(files - names)[:5]
    assert "jumper_warp/viz/jumper.mplstyle" in names
    others = {name.split("/")[0] for name in names} - {"jumper_warp"}
    assert len(others) == 1 and others.pop().endswith(".dist-info")
    assert wheel.stat().st_size < 16e6  # bytes


def test_installed_package_finds_assets_and_policies_from_another_folder(wheel, tmp_path):
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    zipfile.ZipFile(wheel).extractall(site)
    elsewhere.mkdir()
    package, *listed = python(USE_PACKAGE, elsewhere, site)  # its path, and the JSON of `jumper list`
    assert Path(package).is_relative_to(site)
    assert [policy["name"] for policy in json.loads("\n".join(listed))["policies"]] == list(policy_tasks())


def test_kernels_folder_of_the_source_tree_refuses_import():
    error = python("import kernels", ROOT)[-1]
    assert error.startswith("ImportError: import jumper_warp.kernels: the folder kernels/ is not")
