"""Files on a full disk: no writer leaves a part of a file, waits for ever, or names another file than its own."""

import pytest

from box_robot import box_recording, walk
from full_disk import full_disk
from jumper_warp.viz.film import write_film
from jumper_warp.viz.rerun import write_rrd


def film(path):
    """Write a small film of a box to a path."""
    write_film(box_recording(walk(1.0, seconds=0.2)), path, size=(96, 64))


WRITERS = {"box.rrd": lambda path: write_rrd(box_recording(walk(1.0)), path), "box.gif": film, "box.mp4": film}


@pytest.mark.parametrize("name", WRITERS)
def test_full_disk_is_an_error_about_the_file_and_leaves_nothing(tmp_path, name):
    folder = tmp_path / "full"
    folder.mkdir()
    with full_disk(300), pytest.raises(OSError) as caught:  # byte
        WRITERS[name](folder / name)
    assert caught.value.filename == str(folder / name) and not list(folder.iterdir())
