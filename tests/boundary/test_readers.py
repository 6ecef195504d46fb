"""Readers of files that a user supplies refuse damaged ones in one line, without waiting or filling the memory."""

import os
import zipfile

import pytest

from jumper_warp.identification.motions import load_motions
from jumper_warp.policies.policy import load_policy
from jumper_warp.robot.overlay import load_overlay
from jumper_warp.utils.dumps import load_dump
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.output import read_values
from jumper_warp.viz.recording import load_npz

READERS = {
    "dump.npz": load_dump,
    "motion.npz": lambda path: load_motions([path]),
    "motion.csv": lambda path: load_motions([path]),
    "robot.json": load_overlay,
    "recording.npz": load_npz,
    "metrics.json": lambda path: read_values(path.parent),
    "policy/manifest.json": lambda path: load_policy(path.parent),
}


@pytest.fixture(params=READERS)
def damaged(request, tmp_path):
    """Path of a file, in an existing folder, and a function without arguments that reads it."""
    path = tmp_path / request.param
    path.parent.mkdir(exist_ok=True)
    return path, lambda: READERS[request.param](path)


@pytest.mark.parametrize(
    "content", [b"", b"\x00" * 100, b"PK\x03\x04 no archive", b"\xff\xfe{", b"[" * 5000, b"{}", b"1,2\n"]
)
def test_damaged_content_is_refused_in_one_line(damaged, content):
    path, read = damaged
    path.write_bytes(content)
    with pytest.raises(InputError) as refusal:
        read()
    assert path.name in str(refusal.value) and "\n" not in str(refusal.value)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: os.symlink("/dev/zero", path)])
def test_file_that_is_not_regular_is_refused(damaged, make):
    path, read = damaged
    make(path)
    with pytest.raises(InputError, match="not a regular file"):
        read()


def test_file_whose_reading_fails_is_refused_in_one_line(damaged):
    path, read = damaged
    path.symlink_to("/proc/self/mem")
    with pytest.raises(InputError) as refusal:
        read()
    assert path.name in str(refusal.value) and "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", ["dump.npz", "motion.npz", "recording.npz"])
def test_archive_is_refused_before_it_is_unpacked_to_gigabytes(name, tmp_path):
    path = tmp_path / name
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("header.npy", b"")
        archive.filelist[0].file_size = 2**30 + 1  # [byte] as the archive's directory states it
    with pytest.raises(InputError, match="MiB"):
        READERS[name](path)
