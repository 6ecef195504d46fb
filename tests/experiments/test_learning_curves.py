"""Learning curves: schedule and evaluations of a timed training."""

import time
from types import SimpleNamespace

import torch
import warp as wp

from support import learning
from support.learning import LearningCurve, train_and_evaluate


class Trainer:
    """Stub of a trainer whose iterations take 10 ms; records the progress (0 to 1) that is set."""

    batch_size = 64

    def __init__(self):
        self.progress = []

    def compile(self):
        pass

    def set_progress(self, progress):
        self.progress.append(progress)

    def iterate(self):
        time.sleep(0.01)


def test_timed_training_sets_progress_from_0_to_1_without_evaluation_time(monkeypatch):
    env = SimpleNamespace(
        num_envs=2, num_actions=12, device=torch.device("cpu"), wp_device=wp.get_device("cpu"), reset=lambda: None,
        step=lambda action: None, metrics=dict,
    )  # fmt: skip
    evaluated = []

    def evaluate(trainer, eval_env, heights):
        evaluated.append(heights)
        time.sleep(0.05)
        return 0.5

    monkeypatch.setattr(learning, "success_rate", evaluate)
    trainer = Trainer()
    curve = train_and_evaluate(env, trainer, None, 0.3, 0.1, (0.5, 0.9))
    assert trainer.progress == sorted(trainer.progress) and trainer.progress[0] < 0.02
    assert 0.8 < trainer.progress[-1] < 1.0  # evaluations do not count: with them it would be beyond 1
    assert curve.iterations == len(trainer.progress) and curve.steps[-1] == 64 * curve.iterations
    assert len(curve.seconds) == len(curve.success) == len(evaluated) == 3 and evaluated[0] == (0.5, 0.9)


def test_seconds_to_returns_time_of_first_evaluation_with_the_rate():
    curve = LearningCurve([1.0, 2.0, 3.0], [0.2, 0.96, 0.9])
    assert curve.seconds_to(0.95) == 2.0 and curve.seconds_to(1.0) is None
