"""Time limit and remaining time of a training, on a clock that the test controls."""

import dataclasses
import time
from contextlib import nullcontext

import pytest
import torch

from jumper_warp.rl.checkpoint import find_checkpoints, save_checkpoint
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.logger import TrainingConsole
from jumper_warp.rl.runner import CHECKPOINTS, iterate, train
from jumper_warp.rl.training_run import TrainingRun
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


def resume_clocked(monkeypatch, cfg, seconds, limit):
    """Resume a checkpoint of 2 iterations, with 0.125 s for each further one; return the `TrainingRun` and its result.

    seconds: training time in the checkpoint [s]. limit: max_seconds [s].
    """
    half = train(dataclasses.replace(cfg, max_iterations=2), PushTask)
    state = final_state(half)
    assert 0.0 < state.pop("seconds") <= half.seconds
    save_checkpoint(half.folder / CHECKPOINTS, state | {"seconds": seconds})
    env = ClockedTask(cfg.num_envs, durations=[1.0 / 128.0] * 160)
    monkeypatch.setattr(time, "perf_counter", lambda: env.now)
    cfg = dataclasses.replace(cfg, max_seconds=limit, resume=str(half.folder))
    console, (checkpoint,) = TrainingConsole(cfg), find_checkpoints(cfg)
    run = TrainingRun(cfg, env, Rank(0, 1, torch.device("cpu")), console, nullcontext(), checkpoint=checkpoint)
    iterate([run], console)
    return run, run.result()


def test_resumed_run_continues_the_training_time(cfg, monkeypatch):
    run, result = resume_clocked(monkeypatch, cfg, 99.5, limit=100.0)
    assert result.iteration == 2 + 5  # the first iteration does not count
    assert final_state(result)["seconds"] == result.metrics["Perf/elapsed_s"] == 100.0
    final_kl = cfg.ppo.final_desired_kl  # progress counts the saved time, and is near 1
    assert run.ppo._desired_kl.item() == pytest.approx(final_kl, rel=0.05)
