import dataclasses
import json

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.rl.logger import TrainingConsole, TrainingLog
from jumper_warp.rl.metrics_file import METRICS_FILE, MetricsFile
from jumper_warp.rl.runner import CHECKPOINTS, train
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
    with TrainingLog(tmp_path, {}, LOGGED, TrainingConsole(LOGGED)) as log:
        log.log(1, METRICS | {"Episode_Reward/tilt": 0.5}, remaining=5.0)
        for iteration in (2, 3):
            log.log(iteration, METRICS | terms | {"Loss/value": 1.0}, remaining=5.0)

    def fail(constant):
        raise AssertionError(constant)  # NaN or Infinity in the file

    saved = [json.loads(line, parse_constant=fail) for line in (tmp_path / METRICS_FILE).read_text().splitlines()]
    assert [line["iteration"] for line in saved] == [1, 2, 3]
    assert saved[1]["Episode_Reward/tilt"] is None and saved[1]["Loss/value"] == 1.0


@pytest.mark.parametrize(
    ("success", "shown"), [(0.0, ": 1,234 steps/s, success 0.0 %, "), (float("nan"), "/s, 5 s left")]
)
def test_an_undefined_success_is_not_shown(capsys, success, shown):
    console = TrainingConsole(LOGGED)
    console.add(1, METRICS | {"Metrics/success": success}, remaining=5.0)
    console.flush()
    assert shown in capsys.readouterr().err


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


def test_resume_hides_tensorboard_events_of_later_iterations(cfg):
    cfg = dataclasses.replace(cfg, tensorboard=True)
    half = train(dataclasses.replace(cfg, max_iterations=4), PushTask)
    train(dataclasses.replace(cfg, resume=str(half.folder / CHECKPOINTS / "iteration_000002.pt")), PushTask)
    assert event_steps(half.folder) == [1, 2, 3, 4, 5, 6]
