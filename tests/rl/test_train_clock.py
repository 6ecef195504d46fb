"""Time limit and remaining time of a training, on a clock that the test controls."""

import dataclasses
import time

import pytest
import torch
from test_train import final_state

from jumper_warp.rl.runner import train
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


WAITING = ", or restart with OMP_NUM_THREADS=1, since torch's threads wait for them"


@pytest.mark.parametrize(
    ("threads", "expected", "advice"),
    [(2, 66.0, [f"close other programs that use the cores{WAITING}"]),
     (1, 66.0, ["close other programs that use the cores"]), (2, 63.0, [])],
)  # fmt: skip
def test_low_step_rate_is_reported_once_in_the_first_iteration(cfg, monkeypatch, capsys, threads, expected, advice):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    slowed = dataclasses.replace(cfg, max_iterations=4, log_interval=3)
    train_clocked(monkeypatch, slowed, [1.0] * 4 * 16, expected_rate=expected)  # 32 steps of all worlds per second
    usual = f"slow: below 33 steps/s, {expected:.0f} are usual on two cores"
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith(("slow", "measured"))]
    assert lines == [*(f"{usual}; {words}" for words in advice), "measured speed: 32 steps/s, about 48 s left"]


def test_speed_after_a_short_first_iteration_is_measured_in_the_second(cfg, monkeypatch, capsys):
    timed = dataclasses.replace(cfg, max_iterations=4, log_interval=3)
    train_clocked(monkeypatch, timed, [0.25] * 16 + [0.125] * 48, expected_rate=513.0)  # 512 steps in 4 s, then in 2 s
    lines = capsys.readouterr().err.splitlines()
    assert lines[1] == "measured speed: 256 steps/s, about 4 s left" and lines[2].startswith("slow: below 256 steps/s")
    assert lines[3].startswith("iteration 3/4, ") and not any("measured" in line for line in lines[3:])
