"""Updates of a policy's folder that are interrupted, fail on a full disk, or run at the same time."""

import errno
import os
from concurrent.futures import ThreadPoolExecutor

import pytest

from jumper_warp.policies.catalog import add_files
from jumper_warp.policies.policy import Policy, save_policy
from jumper_warp.utils.files import write_atomically
from landing_helpers import still_policy

OLD = {"metrics.json": b"{}", "run.json": b"{}"}
NEW = {"metrics.json": b'{"new": 1}', "run.json": b'{"new": 2}', "plot.txt": b"new"}


class RenameFault:
    """Replacement of os.replace that raises an exception instead of rename number `stop`, from 0, or after it."""

    def __init__(self, stop, error, *, after=False):
        self.stop, self.error, self.after, self.count, self.replace = stop, error, after, 0, os.replace

    def __call__(self, source, target):
        self.count += 1
        stops = self.count == self.stop + 1
        if self.after or not stops:
            self.replace(source, target)
        if stops:
            raise self.error


@pytest.fixture
def folder(tmp_path):
    """Folder of a policy with the files `OLD`."""
    return save_policy(tmp_path / "jump", still_policy("vertical-jump"), files=OLD)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))])
@pytest.mark.parametrize("stop", range(5))  # of the renames to both manifests and three files
def test_policy_loads_after_an_update_that_was_stopped_at_any_file(folder, monkeypatch, stop, error):
    fault = RenameFault(stop, error)
    monkeypatch.setattr(os, "replace", fault)
    with pytest.raises(type(error)):
        add_files(folder, NEW)
    Policy.load(folder)
    for name, data in NEW.items():
        assert not (folder / name).exists() or (folder / name).read_bytes() in (OLD.get(name), data)
    assert [path.name for path in folder.iterdir() if path.name.endswith(".part")] == []
    add_files(folder, NEW)
    Policy.load(folder)
    (folder / "metrics.json").write_bytes(OLD["metrics.json"])  # an altered file after a complete update
    with pytest.raises(ValueError, match=r"metrics\.json: truncated or altered"):
        Policy.load(folder)


def test_two_writers_and_a_reader_of_a_policy_leave_it_loadable(folder):
    def write(writer):
        for i in range(15):
            add_files(folder, {"metrics.json": f"[{writer}, {i}]".encode(), f"{writer}.json": b"%d" % i})

    def read(_):
        for _ in range(60):
            Policy.load(folder)

    with ThreadPoolExecutor(3) as threads:
        jobs = [threads.submit(write, 1), threads.submit(write, 2), threads.submit(read, 0)]
        for job in jobs:
            job.result()
    Policy.load(folder)
    assert (folder / "1.json").read_bytes() == (folder / "2.json").read_bytes() == b"14"
    for name in ("1.json", "2.json"):  # both are in the manifest
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(b"altered")
        with pytest.raises(ValueError, match="truncated or altered"):
            Policy.load(folder)
        (folder / name).write_bytes(content)


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("stop", range(6))  # of the renames to four files and of two folders
def test_policy_loads_after_its_replacement_was_stopped_at_any_file(folder, monkeypatch, stop, after):
    monkeypatch.setattr(os, "replace", RenameFault(stop, KeyboardInterrupt(), after=after))
    with pytest.raises(KeyboardInterrupt):
        save_policy(folder, still_policy("vertical-jump"), overwrite=True)
    Policy.load(folder)
    kept = not (after and stop == 5)
    assert (folder / "metrics.json").exists() is kept
    assert [path.name for path in folder.parent.iterdir()] == ["jump"]


def test_part_of_a_killed_write_is_replaced(tmp_path):
    (tmp_path / "file.part").write_bytes(b"partial and longer")
    write_atomically(tmp_path / "file", b"whole")
    assert (tmp_path / "file").read_bytes() == b"whole" and [each.name for each in tmp_path.iterdir()] == ["file"]
