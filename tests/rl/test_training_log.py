import dataclasses
import errno
import json
import threading

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from full_disk import full_disk
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.rl.logger import TrainingLog
from jumper_warp.rl.metrics_file import METRICS_FILE, MetricsFile
from jumper_warp.rl.runner import CHECKPOINTS, train
from jumper_warp.utils.errors import InputError
from toy_task import PushTask, push_cfg

LOGGED = TrainCfg(num_envs=1250, max_iterations=10, tensorboard=False, ppo=PpoCfg(num_steps=40))  # 50,000 steps each

METRICS = {"Perf/total_fps": 1234.0, "Perf/elapsed_s": 5.0, "Metrics/success": 0.5}  # steps per second, time, fraction


@pytest.fixture
def cfg(tmp_path):
    """Settings of 6 iterations of 16 steps, all logged; every second one is saved."""
    return push_cfg(tmp_path / "logs", max_iterations=6, log_interval=1)


def iterations(path):
    """Return the iteration of each line of a metrics file."""
    return [json.loads(line)["iteration"] for line in path.read_text().splitlines()]


def event_steps(folder):
    """Return the iteration of each TensorBoard event of Loss/value."""
    events = EventAccumulator(str(folder))
    events.Reload()
    return [event.step for event in events.Scalars("Loss/value")]


def test_metric_that_is_not_finite_is_logged_as_null(tmp_path):
    terms = {"Episode_Reward/tilt": float("nan"), "hop/Episode_Reward/fall": float("inf")}
    with TrainingLog(tmp_path, {}, LOGGED) as log:
        log.log(1, METRICS | {"Episode_Reward/tilt": 0.5}, remaining=5.0)
        for iteration in (2, 3):
            log.log(iteration, METRICS | terms | {"Loss/value": 1.0}, remaining=5.0)

    def fail(constant):
        raise AssertionError(constant)  # NaN or Infinity in the file

    saved = [json.loads(line, parse_constant=fail) for line in (tmp_path / METRICS_FILE).read_text().splitlines()]
    assert [line["iteration"] for line in saved] == [1, 2, 3]
    assert saved[1]["Episode_Reward/tilt"] is None and saved[1]["Loss/value"] == 1.0


def test_line_shows_steps_mean_curriculum_level_and_time_left(tmp_path, capsys):
    levels = {f"Curriculum/fraction_at_level_{i}": part for i, part in enumerate((0.2, 0.6, 0.2))}
    with TrainingLog(tmp_path, {}, LOGGED) as log:
        log.log(3, METRICS | levels, remaining=240.0)
    line = "iteration 3/10, 0.15 M steps: 1,234 steps/s, success 50.0 % at mean level 1.0 of 2, 4 min left"
    assert capsys.readouterr().err.splitlines() == [line]


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("code", [errno.EPIPE, errno.EIO])
def test_broken_pipe_or_closed_terminal_does_not_stop_logging(tmp_path, monkeypatch, terminal, code):
    class Broken:
        def write(self, _):
            raise OSError(code, "")

        flush = fileno = isatty = lambda self: 0

    monkeypatch.setenv("FORCE_COLOR", "1" if terminal else "")
    with TrainingLog(tmp_path, {}, LOGGED) as log:
        log.console._console.file = Broken()
        for iteration in (1, 2):
            log.log(iteration, METRICS, remaining=5.0)
    assert iterations(tmp_path / METRICS_FILE) == [1, 2]


def test_resumed_run_drops_partial_lines_and_later_iterations(cfg, capsys):
    half = train(dataclasses.replace(cfg, max_iterations=4), PushTask)
    path = half.folder / METRICS_FILE
    kept = path.read_text().splitlines()[:2]
    path.write_bytes(path.read_bytes()[:-30])
    resume = str(half.folder / CHECKPOINTS / "iteration_000002.pt")
    capsys.readouterr()
    train(dataclasses.replace(cfg, resume=resume), PushTask)
    assert iterations(path) == [1, 2, 3, 4, 5, 6]
    assert path.read_text().splitlines()[:2] == kept
    stderr = [line for line in capsys.readouterr().err.splitlines() if str(path) in line]
    assert stderr == [f"{path}: removed 2 incomplete or later lines"]


@pytest.mark.parametrize(
    ("content", "kept"),
    [
        (b'{"iteration": 1}\n{"iterat', [1]),
        (b'{"iteration": 1}\n{"iter{"iteration": 2}\n{"iteration": 2}\n', [1, 2]),
        (b'{"iteration": 1}\n{"iteration": 3}\n{"iteration": 2}\n', [1, 2]),  # 3 is after the resumed iteration 2
        (b'{"iteration": null}\n[1]\n7\n\xff\xfe\n\n', []),
    ],
)
def test_metrics_file_is_repaired_on_opening(tmp_path, content, kept):
    path = tmp_path / METRICS_FILE
    path.write_bytes(content)
    MetricsFile(path, 2).add(3, {})
    assert iterations(path) == [*kept, 3]


def test_metrics_file_that_is_not_regular_is_refused(tmp_path):
    path = tmp_path / METRICS_FILE
    path.symlink_to("/dev/zero")
    with pytest.raises(InputError, match="not a regular file"):
        MetricsFile(path, 2)


def test_resume_hides_tensorboard_events_of_later_iterations(cfg):
    cfg = dataclasses.replace(cfg, tensorboard=True)
    half = train(dataclasses.replace(cfg, max_iterations=4), PushTask)
    train(dataclasses.replace(cfg, resume=str(half.folder / CHECKPOINTS / "iteration_000002.pt")), PushTask)
    assert event_steps(half.folder) == [1, 2, 3, 4, 5, 6]


def test_events_that_cannot_be_written_end_with_one_line_and_the_log_continues(tmp_path, capsys, monkeypatch):
    tracebacks = []
    monkeypatch.setattr(threading, "excepthook", tracebacks.append)
    with TrainingLog(tmp_path, {"train": {}, "env": {}}, dataclasses.replace(LOGGED, tensorboard=True)) as log:
        log.log(1, METRICS | {"Loss/value": 1.0}, remaining=5.0)
        with full_disk():
            for iteration in (2, 3):
                log.log(iteration, METRICS, remaining=5.0)
        log.log(4, METRICS, remaining=5.0)
    stderr = capsys.readouterr().err
    assert stderr.count("no TensorBoard events from iteration 2 on") == stderr.count("TensorBoard") == 1
    assert tracebacks == []
    assert iterations(tmp_path / METRICS_FILE) == [1, 2, 3, 4]
    assert event_steps(tmp_path) == [1]
