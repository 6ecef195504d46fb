"""Time limit and remaining time of a training, on a clock that the test controls."""

import dataclasses
import time

import pytest

from jumper_warp.rl.runner import train
from test_train import final_state
from toy_task import SMALL, PushTask, push_cfg


@pytest.fixture
def cfg(tmp_path):
    """Settings of up to 100 iterations of 16 steps; every second one is logged."""
    return push_cfg(tmp_path / "logs", max_iterations=100, save_interval=100)


class ClockedTask(PushTask):
    """Task whose steps advance the clock `now` by successive `durations` [s]; IndexError when they run out."""

    def __init__(self, *args, durations, **arguments):
        """durations: of the steps, in order [s]; other arguments: as for `PushTask`."""
        super().__init__(*args, **arguments)
        self.durations, self.now = list(durations), 1000.0

    def step(self, action):
        """Step the task, and advance the clock."""
        super().step(action)
        self.now += self.durations.pop(0)


def train_clocked(monkeypatch, cfg, durations, **arguments):
    """Return the result of a training on a clock that only the task's steps move; durations: of all steps [s]."""
    env = ClockedTask(cfg.num_envs, durations=durations, episode_length=SMALL.num_steps)
    monkeypatch.setattr(time, "perf_counter", lambda: env.now)
    return train(cfg, lambda *_: env, **arguments)


def test_time_limit_counts_from_the_end_of_the_first_iteration(cfg, monkeypatch, capsys):
    limited = dataclasses.replace(cfg, max_seconds=60.0)
    result = train_clocked(monkeypatch, limited, [500.0] + [1.0] * 79)  # 5 iterations of 16 steps; the first compiles
    assert (result.iteration, result.seconds) == (5, 515.0 + 4 * 16.0)
    assert (result.metrics["Perf/elapsed_s"], final_state(result)["seconds"]) == (64.0, 64.0)
    assert capsys.readouterr().err.splitlines()[-2] == "ended by --max-seconds 60 after 0.00 M of 0.05 M steps"
    longer = dataclasses.replace(limited, max_seconds=80.0, resume=str(result.folder))
    resumed = train_clocked(monkeypatch, longer, [700.0] + [1.0] * 31)  # one warm-up iteration, and one of 16 s
    assert (resumed.iteration, final_state(resumed)["seconds"]) == (7, 80.0)


@pytest.mark.parametrize(
    ("seconds", "limit", "left"),
    [(1.0, 0.0, "27 min"), (3.0, 0.0, "1 h 20 min"), (1.0, 90.0, "58 s"), (0.01, 0.0, "16 s")],  # 100 iterations left
)
def test_remaining_time_follows_iteration_time_and_time_limit(cfg, monkeypatch, capsys, seconds, limit, left):
    limited = dataclasses.replace(cfg, max_iterations=103, max_seconds=limit, log_interval=3)
    with pytest.raises(IndexError):  # after three iterations no durations are left
        train_clocked(monkeypatch, limited, [9000.0, *[seconds] * 3 * 16])
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("iteration 3/103")]
    assert line.endswith(f", {left} left")
