import itertools
import math
import os
import pickle

import pytest
import torch

from jumper_warp.rl.checkpoint import (
    MANIFEST,
    CheckpointError,
    best_checkpoint,
    latest_checkpoint,
    load_checkpoint,
    save_checkpoint,
)


def state(iteration):
    """Return a checkpoint's state; its only tensor holds the iteration."""
    parts = {"ppo": {"weight": torch.full((3,), float(iteration))}, "env": {}, "rng": {}, "config": "{}"}
    return {"iteration": iteration, **parts}


def test_load_returns_the_saved_state(tmp_path):
    path = save_checkpoint(tmp_path / "new", state(7))
    assert path.name == "iteration_000007.pt"
    assert load_checkpoint(path)["ppo"]["weight"].tolist() == [7.0, 7.0, 7.0]
    assert sorted(entry.name for entry in path.parent.iterdir()) == [path.name, MANIFEST]


def test_newest_and_best_checkpoints_are_kept(tmp_path):
    for iteration, score in enumerate([0.1, 0.9, math.nan, None, 0.2], start=1):
        save_checkpoint(tmp_path, state(iteration), score, max_checkpoints=2)
    assert sorted(path.stem for path in tmp_path.glob("*.pt")) == [f"iteration_00000{i}" for i in (2, 4, 5)]
    assert best_checkpoint(tmp_path).stem == "iteration_000002"


def test_checkpoints_after_the_one_that_was_resumed_are_removed(tmp_path):
    for iteration in (100, 200, 300, 110, 300, 120):  # resumed from 100 after 300, and from 110
        newest = save_checkpoint(tmp_path, state(iteration), 0.001 * iteration, max_checkpoints=2)
        assert latest_checkpoint(tmp_path)[0] == best_checkpoint(tmp_path) == newest
    assert sorted(path.stem for path in tmp_path.glob("*.pt")) == ["iteration_000110", "iteration_000120"]


def flip(path):
    """Flip a bit in the middle of a file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def cut(path):
    """Remove the last 100 bytes of a file."""
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize(
    ("damage", "message"), [(flip, "differs from its checksum"), (os.remove, "no such file .checkpoint of a training")]
)
def test_refuses_a_damaged_checkpoint_in_one_line(tmp_path, damage, message):
    path = save_checkpoint(tmp_path, state(2))
    damage(path)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_checkpoint(path)
    assert "\n" not in str(caught.value)


class Payload:
    """Object that creates the file `executed` in the current folder when unpickled."""

    def __reduce__(self):
        return os.system, ("touch executed",)


def test_loading_a_checkpoint_executes_no_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = save_checkpoint(tmp_path, {**state(1), "env": Payload()})
    with pytest.raises(CheckpointError, match="not readable as tensors"):
        load_checkpoint(path)
    assert not (tmp_path / "executed").exists()
    pickle.loads(pickle.dumps(Payload()))  # ordinary unpickling does
    assert (tmp_path / "executed").exists()


def test_latest_checkpoint_skips_damaged_ones(tmp_path):
    paths = [save_checkpoint(tmp_path, state(iteration)) for iteration in (1, 2, 3)]
    cut(paths[2])
    flip(paths[1])
    path, loaded, skipped, _ = latest_checkpoint(tmp_path)
    assert (path, loaded["iteration"]) == (paths[0], 1)
    assert [reason.split(":")[0] for reason in skipped] == [str(paths[2]), str(paths[1])]


@pytest.mark.parametrize("stop", range(3))  # of the renames to the manifest, the checkpoint and the manifest
def test_only_checkpoint_stays_usable_if_saving_it_again_is_stopped(tmp_path, monkeypatch, stop):
    save_checkpoint(tmp_path, state(1), max_checkpoints=1)
    renames, replace = itertools.count(), os.replace

    def stopped(source, target):
        if next(renames) == stop:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", stopped)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(tmp_path, state(1) | {"seconds": 2.0}, max_checkpoints=1)
    assert latest_checkpoint(tmp_path).state["iteration"] == 1
