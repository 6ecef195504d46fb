"""Learning curves: schedule and evaluations of a training, and the comparison of two trainers."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import warp as wp

from support import learning
from support.learning import LearningCurve, compare, train_and_evaluate


class Clock:
    """Clock that stands until it is advanced; replaces `time.perf_counter`."""

    def __init__(self, monkeypatch):
        self.now = 1000.0
        monkeypatch.setattr(time, "perf_counter", lambda: self.now)


class Trainer:
    """Stub of a trainer whose iterations take 1/128 s of a clock; records the progress (0 to 1) that is set."""

    batch_size = 64

    def __init__(self, clock):
        self.progress, self.clock = [], clock

    def compile(self):
        pass

    def set_progress(self, progress):
        self.progress.append(progress)

    def iterate(self):
        self.clock.now += 1.0 / 128.0


@pytest.fixture
def env():
    """Stub of an environment."""
    return SimpleNamespace(
        num_envs=2, num_actions=12, device=torch.device("cpu"), wp_device=wp.get_device("cpu"), reset=lambda: None,
        step=lambda action: None, metrics=dict,
    )  # fmt: skip


def test_timed_training_sets_progress_from_0_to_1_without_evaluation_time(env, monkeypatch):
    evaluated, clock = [], Clock(monkeypatch)

    def evaluate(trainer, eval_env, limits):
        evaluated.append(limits)
        clock.now += 0.05
        return 0.5

    monkeypatch.setattr(learning, "success_rate", evaluate)
    trainer = Trainer(clock)
    curve = train_and_evaluate(env, trainer, None, 0.375, 0.125, (0.5, 0.9))
    assert trainer.progress == [i / 48.0 for i in range(48)]  # evaluations do not count
    assert curve.seconds == [0.125, 0.25, 0.375] and curve.steps == [64 * 16, 64 * 32, 64 * 48]
    assert curve.iterations == 48 and curve.success == [0.5] * 3 and evaluated == [(0.5, 0.9)] * 3


def test_training_of_a_number_of_iterations_is_evaluated_at_equal_steps(env, monkeypatch):
    monkeypatch.setattr(learning, "success_rate", lambda *_: 0.5)
    trainer = Trainer(Clock(monkeypatch))
    curve = train_and_evaluate(env, trainer, None, 5, 2, by_iterations=True)
    assert trainer.progress == [0.0, 0.2, 0.4, 0.6, 0.8]
    assert (curve.iterations, curve.steps) == (5, [128, 256, 320])


@pytest.mark.parametrize(
    ("kind", "limits", "goals"),
    [
        ("height", None, [[0.0, 0.0, 0.5], [0.0, 0.0, 0.8], [0.0, 0.0, 1.1]]),
        ("place", None, [[0.3, 0.0, 0.0], [0.9, 0.0, 0.0], [1.5, 0.0, 0.0]]),
        ("place", (1.0, 2.0), [[1.0, 0.0, 0.0], [1.5, 0.0, 0.0], [2.0, 0.0, 0.0]]),
    ],
)
def test_evaluated_jumps_are_to_heights_or_to_places_ahead(kind, limits, goals, monkeypatch):
    logs = []

    def jump(act, env, jumps):
        logs.append(jumps.goals)
        jumps.end[:] = jumps.terminations.index("success")

    monkeypatch.setattr(learning, "run_evaluation", jump)
    task = SimpleNamespace(evaluation=SimpleNamespace(kind=kind), termination_names=("success",))
    trainer = SimpleNamespace(model=SimpleNamespace(act=None))
    assert learning.success_rate(trainer, SimpleNamespace(task=task, num_envs=3), limits) == 0.0  # never at rest
    np.testing.assert_allclose(logs[0][:, 0], goals)


def test_reached_returns_first_evaluation_with_the_rate():
    curve = LearningCurve([1.0, 2.0, 3.0], [0.2, 0.96, 0.9])
    assert curve.reached(0.95) == 1 and curve.reached(1.0) is None


def curves(steps, final):
    """Return learning curves that reach 96 % after some steps (None: never), and a final success."""
    ends = zip(steps, final, strict=True)
    return [LearningCurve([1.0, 2.0], [0.96 if n else 0.1, success], [n or 1, 500]) for n, success in ends]


def test_trainers_that_never_overlap_differ_and_equal_ones_do_not():
    slow, low = [210, 220, 230, None], [0.5, 0.6, 0.7, 0.8]
    first = curves([10, 20, 30, 40], [0.91, 0.92, 0.93, 0.94])
    p = compare(first, curves(slow, [0.915, 0.925, 0.935, 0.905]))
    assert p["p_steps_to_95_percent"] == pytest.approx(4.0 / 70.0)  # 2 of 70 orders are this extreme, two tests
    assert p["p_final_success"] > 0.5
    assert list(compare(first, curves(slow, low)).values()) == [pytest.approx(4.0 / 70.0)] * 2
    assert compare(first, first) == {"p_steps_to_95_percent": 1.0, "p_final_success": 1.0}
