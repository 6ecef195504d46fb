"""The wheel: built from a copy of the tree, unpacked, and used from another folder."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from jumper_warp.policies.folder import list_policies

ROOT = Path(__file__).parents[1]
SOURCES = ("jumper_warp", "kernels", "assets", "setup.py", "pyproject.toml", "README.md", "LICENSE")
BUILD = "from setuptools.build_meta import build_wheel; print(build_wheel('.'))"
USE = """
import jumper_warp
from jumper_warp.cli.main import main
from jumper_warp.policies.folder import list_policies, load_policy
from jumper_warp.robot.description import load_description

print(jumper_warp.__file__)
main(["list"])
load_description()
for name in list_policies():
    load_policy(name)  # checks every file
"""


def run(code, folder, *paths):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Path of the built wheel."""
    tree = tmp_path_factory.mktemp("tree")
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tree / name, **({"symlinks": True} if copy is shutil.copytree else {}))
    return tree / run(BUILD, tree)[-1]


def test_wheel_holds_one_package_and_all_assets(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder, inside in (("jumper_warp", ""), ("kernels", "jumper_warp/"), ("assets", "jumper_warp/")):
        kinds = "*" if folder == "assets" else "*.py"
        files = {f"{inside}{path.relative_to(ROOT)}" for path in (ROOT / folder).rglob(kinds) if path.is_file()}
        assert files and files <= names, sorted(files - names)[:5]
    others = {name.split("/")[0] for name in names} - {"jumper_warp"}
    assert len(others) == 1 and others.pop().endswith(".dist-info")
    assert wheel.stat().st_size < 40e6  # 22.8 MB


def test_wheel_finds_its_assets_from_another_folder(wheel, tmp_path):
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    zipfile.ZipFile(wheel).extractall(site)
    elsewhere.mkdir()
    package, *listed = run(USE, elsewhere, site)
    assert Path(package).is_relative_to(site)
    assert [line.split()[1] for line in listed if line.startswith("policy")] == list(list_policies())
