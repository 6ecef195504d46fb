"""One process at a time writes a run's folder; reading needs no lock."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest

from jumper_warp.rl.checkpoint import latest_checkpoint
from jumper_warp.rl.runner import CHECKPOINTS, train
from jumper_warp.utils.errors import InputError
from toy_task import PushTask, push_cfg

HOLDER = """
import sys, time
from pathlib import Path
from jumper_warp.utils.locks import write_lock
with write_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def cfg(tmp_path):
    """Settings that resume a run of two iterations, to the fourth."""
    cfg = push_cfg(tmp_path / "logs")
    folder = train(dataclasses.replace(cfg, max_iterations=2), PushTask).folder
    return dataclasses.replace(cfg, resume=str(folder))


@pytest.fixture
def holder(cfg):
    """A process that holds the lock of the run."""
    command = [sys.executable, "-c", HOLDER, cfg.resume]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_second_writer_is_refused_and_changes_nothing(cfg, holder):
    folder = Path(cfg.resume)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=f"^{re.escape(cfg.resume)}: another process is writing this folder"):
        train(cfg, PushTask)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert latest_checkpoint(folder / CHECKPOINTS).state["iteration"] == 2  # readers need no lock
