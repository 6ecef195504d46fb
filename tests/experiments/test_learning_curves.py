"""Learning curves: the schedule of the training that is timed, and what is told of it."""

import time
from types import SimpleNamespace

import torch
import warp as wp

from support import learning
from support.learning import Curve, train_and_evaluate


class Trainer:
    """Takes 10 ms an iteration, and remembers how far it was told that the training is."""

    batch_size = 64

    def __init__(self):
        self.progress = []

    def prepare(self):
        pass

    def set_progress(self, progress):
        self.progress.append(progress)

    def iterate(self):
        time.sleep(0.01)


def test_a_timed_training_runs_through_the_schedule_of_one_of_that_length(monkeypatch):
    env = SimpleNamespace(
        num_envs=2, num_actions=12, device=torch.device("cpu"), wp_device=wp.get_device("cpu"), reset=lambda: None,
        step=lambda action: None, metrics=dict,
    )  # fmt: skip
    asked = []
    monkeypatch.setattr(
        learning, "success", lambda ppo, judge, heights: asked.append(heights) or time.sleep(0.05) or 0.5
    )
    trainer = Trainer()
    curve = train_and_evaluate(env, trainer, None, 0.3, 0.1, (0.5, 0.9))
    assert trainer.progress == sorted(trainer.progress) and trainer.progress[0] < 0.02
    assert 0.8 < trainer.progress[-1] < 1.0  # evaluations do not count: with them it would be beyond 1
    assert curve.iterations == len(trainer.progress) and curve.steps[-1] == 64 * curve.iterations
    assert len(curve.seconds) == len(curve.success) == len(asked) == 3 and asked[0] == (0.5, 0.9)


def test_the_time_to_a_success_is_that_of_the_first_evaluation_that_had_it():
    curve = Curve([1.0, 2.0, 3.0], [0.2, 0.96, 0.9])
    assert curve.seconds_to(0.95) == 2.0 and curve.seconds_to(1.0) is None
