"""Warnings about commands beyond the range of a training."""

import pytest

from jumper_warp.evaluation.jump_metrics import HeightPlayFlags, LandingPlayFlags
from jumper_warp.evaluation.trained import trained_success, warn_beyond_training
from jumper_warp.evaluation.velocities import VelocityPlayFlags
from jumper_warp.registry import make_task


@pytest.mark.parametrize(
    ("task", "flags", "words"),
    [
        ("velocity-flat", VelocityPlayFlags(velocity=((0.5, -1.5, 2.0), (0.0, 0.0, 0.0))),
         "velocity to the left -1.5 m/s (trained -1 to 1), yaw rate 2 rad/s (trained -1.4 to 1.4)"),
        ("horizontal-jump", LandingPlayFlags(goal=((0.9, 0.0),), next_goals=((0.8, 3.0),)), "distance to the left 3 m"),
    ],
)  # fmt: skip
def test_command_beyond_the_training_is_named_in_one_line(task, flags, words, capsys):
    warn_beyond_training(make_task(task), flags.log(make_task(task)).all_commands())
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"jumper: beyond the training of {task}: {words}")


def test_success_is_counted_within_and_beyond_the_training():
    task = make_task("vertical-jump")  # trained 0.45 to 1.15 m
    log = HeightPlayFlags((0.3, 0.45, 0.9, 1.1499, 1.3)).log(task)
    log.end[:, 0] = log.terminations.index("success")
    log.apex[:, 0], log.heading[:], log.rest_speed[:] = [0.3, 0.5, 0.9, 0.7, 0.7], 0.0, 0.0
    metrics = trained_success(task, log)
    counts = {key.split("_")[0]: (metric.value, metric.trials, metric.over) for key, metric in metrics.items()}
    assert counts == {
        "within": (pytest.approx(2 / 3), 3, "jumps with goals of trained 0.45 to 1.15 m"),
        "beyond": (0.5, 2, "jumps beyond training"),
    }
    assert not trained_success(task, HeightPlayFlags((0.5, 0.9)).log(task))  # nothing to compare
    assert not trained_success(make_task("attitude"), log)  # no range of goals
