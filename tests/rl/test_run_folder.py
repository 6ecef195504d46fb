"""A training reports terms that are not finite."""

import dataclasses

import numpy as np
import pytest

from jumper_warp.rl.runner import CHECKPOINTS, train
from jumper_warp.utils.dumps import NonFiniteValue, load_dump
from toy_task import SMALL, PushTask, push_cfg

ARRAYS = {"joint_q": np.zeros(43), "joint_qd": np.zeros(38), "action": np.zeros(12), "rewards": np.array([np.nan])}
ARRAYS |= {"observations": np.zeros(0)}
FOUND = NonFiniteValue("rewards.tilt", float("nan"), 3, 21, ARRAYS, {"rewards": ["tilt"], "observations": []})
LINE = "rewards.tilt is not finite (nan) in world 3 at step 21"


class FaultyTask(PushTask):
    """Task with a term that is not finite in the second iteration."""

    def non_finite(self):
        return [FOUND] if self.steps == 2 * SMALL.num_steps else []


@pytest.fixture
def cfg(tmp_path):
    """Settings of 4 iterations, of which every second one is logged and saved."""
    return push_cfg(tmp_path / "logs")


def end_of(cfg, task):
    """Train, and return the code of the SystemExit that ends the training."""
    with pytest.raises(SystemExit) as end:
        train(cfg, task)
    return end.value.code


def test_term_that_is_not_finite_is_named_once_and_dumped(cfg, capsys):
    result = train(cfg, FaultyTask)
    path = result.folder / "non_finite" / "rewards.tilt.npz"
    lines = [line for line in capsys.readouterr().err.splitlines() if "not finite" in line]
    assert lines == [f"{LINE}; jumper play --dump {path}"]
    found, header = load_dump(path)
    assert str(found) == LINE and result.iteration == 4
    assert (header["iteration"], header["task"], header["config"]["train"]["seed"]) == (2, "push", 1)


@pytest.mark.parametrize("log_interval", [1, 10])
def test_stop_on_nan_ends_with_a_checkpoint_of_that_iteration(cfg, log_interval):
    cfg = dataclasses.replace(cfg, stop_on_nan=True, log_interval=log_interval, save_interval=100)
    assert end_of(cfg, FaultyTask) == f"jumper: --stop-on-nan: {LINE}"
    (folder,) = cfg.log_root.glob("push/*")
    assert (folder / "non_finite" / "rewards.tilt.npz").is_file()
    assert (folder / CHECKPOINTS / "iteration_000002.pt").is_file()
