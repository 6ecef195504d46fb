import dataclasses
import json
import math
import os
import signal
import time
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from jumper_warp.envs.rsl_rl import RslRlVecEnv
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.checkpoint import MANIFEST, CheckpointError, load_checkpoint, save_checkpoint
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.rsl_rl import train_rsl_rl
from jumper_warp.rl.runner import CHECKPOINTS, CONFIG, StopRequest, TrainingRun, train
from toy_task import SMALL, PushTask, equal, free_port, push_cfg, train_rank, train_twice


def make_env(num_envs, seed, device):
    """Return the task with episodes of one iteration."""
    return PushTask(num_envs, seed, device, episode_length=SMALL.num_steps)


@pytest.fixture
def cfg(tmp_path):
    """Settings of 4 iterations on 32 worlds; every second one is logged and saved."""
    return push_cfg(tmp_path / "logs")


def final_state(result):
    """Return the state in the last checkpoint of a `TrainResult`."""
    return load_checkpoint(result.folder / CHECKPOINTS / f"iteration_{result.iteration:06d}.pt")


def test_run_writes_config_metrics_and_checkpoints(cfg):
    result = train(cfg, make_env)
    assert result.folder.parent == cfg.log_root / "push"
    settings = json.loads((result.folder / CONFIG).read_text())
    assert settings["train"]["ppo"]["num_steps"] == 16
    assert settings["env"] == {"episode_length": 16}
    assert settings["versions"]["torch"].split("+")[0] == torch.__version__.split("+")[0]
    lines = [json.loads(line) for line in (result.folder / METRICS_FILE).read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [2, 4]
    assert lines[-1]["Train/mean_episode_length"] == 16.0
    assert {"Loss/kl", "Metrics/success", "Perf/elapsed_s"} <= lines[0].keys()
    seconds = lines[0]["Perf/collection_time"] + lines[0]["Perf/learning_time"]
    assert lines[0]["Perf/total_fps"] * seconds == pytest.approx(16 * 32)
    manifest = json.loads((result.folder / CHECKPOINTS / MANIFEST).read_text())
    assert manifest.keys() == {"iteration_000002.pt", "iteration_000004.pt"}
    assert json.loads(final_state(result)["config"]) == settings


def resume_after(cfg, seconds, limit):
    """Resume a checkpoint of 2 iterations; return the `TrainingRun` and its result.

    seconds: training time in the checkpoint [s]; limit: max_seconds [s].
    """
    half = train(dataclasses.replace(cfg, max_iterations=2), make_env)
    state = final_state(half)
    assert 0.0 < state.pop("seconds") <= half.seconds
    save_checkpoint(half.folder / CHECKPOINTS, {**state, "seconds": seconds})
    cfg = dataclasses.replace(cfg, max_iterations=100_000, max_seconds=limit, resume=str(half.folder))
    run = TrainingRun(cfg, make_env(cfg.num_envs, 1, "cpu"), Rank(0, 1, torch.device("cpu")))
    with StopRequest() as stop:
        return run, run.iterate(stop)


def test_resumed_run_continues_the_training_time(cfg):
    run, result = resume_after(cfg, 99.7, limit=100.0)
    assert result.iteration > 2 and result.seconds < 5.0
    assert final_state(result)["seconds"] >= result.metrics["Perf/elapsed_s"] >= 100.0
    final_kl = cfg.ppo.final_desired_kl  # progress counts the saved time, and is near 1
    assert run.ppo._desired_kl.item() == pytest.approx(final_kl, rel=0.05)


def test_resumed_run_past_its_time_limit_ends_immediately(cfg):
    assert resume_after(cfg, 100.0, limit=100.0)[1].iteration == 2


def test_resume_latest_skips_a_damaged_checkpoint(cfg, capsys):
    result = train(cfg, make_env)
    (result.folder / CHECKPOINTS / "iteration_000004.pt").write_bytes(b"cut")
    resumed = train(dataclasses.replace(cfg, resume="latest", max_iterations=3), make_env)
    assert (resumed.folder, resumed.iteration) == (result.folder, 3)
    stderr = capsys.readouterr().err
    assert "skipped: " in stderr
    assert "iteration_000002.pt" in stderr


@pytest.mark.parametrize("change", [{"hidden": (16, 16)}, {"asymmetric_critic": False}])
def test_refuses_a_checkpoint_of_other_networks_in_one_line(cfg, change):
    result = train(cfg, make_env)
    other = dataclasses.replace(cfg, resume=str(result.folder), ppo=dataclasses.replace(SMALL, **change))
    with pytest.raises(CheckpointError, match="does not fit these settings") as caught:
        train(other, make_env)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_finishes_the_iteration_saves_and_prints_the_resume_command(cfg, number, capsys):
    class SignallingTask(PushTask):  # sends the signal to this process
        def step(self, action):
            super().step(action)
            if self.steps == 40:  # in the third iteration of 16 steps
                os.kill(os.getpid(), number)

    before = signal.getsignal(number)
    with pytest.raises(SystemExit) as caught:
        train(dataclasses.replace(cfg, max_iterations=100), SignallingTask)
    assert caught.value.code == 130
    assert signal.getsignal(number) is before
    (path,) = cfg.log_root.glob("push/*/checkpoints/iteration_000003.pt")
    assert load_checkpoint(path)["env"]["steps"] == 48
    *_, cause, last = capsys.readouterr().err.splitlines()
    assert cause == "ended by an interruption after 0.00 M of 0.05 M steps"
    assert last == f"saved {path}, continue with: jumper train push --resume {path.parent.parent}"


def test_time_limit_ends_the_training_with_a_checkpoint(cfg):
    begin = time.perf_counter()
    result = train(dataclasses.replace(cfg, max_iterations=100_000, max_seconds=0.5), make_env)
    assert time.perf_counter() - begin < 10.0
    assert 0.5 <= result.seconds < 5.0
    assert final_state(result)["iteration"] == result.iteration


def test_tensorboard_gets_the_metrics(cfg):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    result = train(dataclasses.replace(cfg, tensorboard=True), make_env)
    events = EventAccumulator(str(result.folder))
    events.Reload()
    assert [event.step for event in events.Scalars("Loss/value")] == [2, 4]


def test_two_processes_train_one_policy(cfg, tmp_path):
    torch.multiprocessing.spawn(train_rank, (free_port(), cfg, str(tmp_path / "rank")), nprocs=2)
    first, second = (torch.load(tmp_path / f"rank{rank}", weights_only=True) for rank in range(2))
    assert equal(first["model"], second["model"])
    assert (first["num_envs"], second["num_envs"]) == (16, 16)
    assert (first["iteration"], second["iteration"]) == (4, 4)
    assert first["seed"] != second["seed"]
    (folder,) = cfg.log_root.glob("push/*")
    assert equal(load_checkpoint(folder / CHECKPOINTS / "iteration_000004.pt")["ppo"]["model"], first["model"])


def test_each_rank_resumes_its_own_worlds(cfg):
    torch.multiprocessing.spawn(train_twice, ((free_port(), free_port()), cfg), nprocs=2)
    (folder,) = cfg.log_root.glob(f"push/*/{CHECKPOINTS}")
    expected = torch.load(cfg.log_root / "whole.pt", weights_only=True)
    state = load_checkpoint(folder / "iteration_000004.pt")
    assert not equal(expected["env"], expected["others"][0]["env"])
    for part in ("ppo", "env", "rng", "others"):
        assert equal(state[part], expected[part]), part
    alone = dataclasses.replace(cfg, num_envs=cfg.num_envs // 2, resume=str(folder / "iteration_000002.pt"))
    with pytest.raises(CheckpointError, match="saved by 2 processes, resumed by 1"):
        train(alone, lambda n, seed, device: PushTask(n, seed))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_iterations": 0}, "max_iterations must be a whole number of 1 to 1000000000, got 0"),
        ({"max_seconds": -1.0}, "max_seconds must be finite and not negative, got -1.0"),
        ({"seed": -1}, r"seed must be in 0 \.\. 2147483647, got -1"),
        ({"trainer": "rsl-rl", "resume": "latest"}, "resume is not supported"),
    ],
)
def test_refuses_settings_out_of_range(change, message):
    with pytest.raises(ValueError, match=message):
        TrainCfg(**change)


def test_every_logged_metric_can_be_the_best_metric(cfg):
    """A training is set up with the name of each metric that another one logged; a wrong name raises an error."""
    metrics = train(cfg, make_env).metrics
    for name in metrics:
        TrainingRun(dataclasses.replace(cfg, best_metric=name), make_env(32, 1, "cpu"), Rank(0, 1, torch.device("cpu")))
    assert {"Train/mean_reward", "Perf/total_fps", "Loss/kl", "Metrics/success"} <= metrics.keys()


def test_rsl_rl_adapter_counts_steps_and_logs_metrics_once_per_iteration():
    env = PushTask(3, episode_length=3)
    env.reset()
    adapter = RslRlVecEnv(env, metrics_every=2)
    logs, lengths = [], []
    for _ in range(4):
        extras = adapter.step(torch.zeros(3, 1))[3]
        logs.append("log" in extras)
        lengths.append(adapter.episode_length_buf[0].item())
    assert logs == [False, True, False, True]
    assert lengths == [1, 2, 0, 1]  # an episode has 3 steps
    adapter.episode_length_buf = torch.tensor([5, 6, 7])
    assert adapter.episode_length_buf.tolist() == [5, 6, 7]
    adapter.reset()
    assert not adapter.episode_length_buf.any()


def test_train_with_rsl_rl_writes_model_and_config(cfg, tmp_path):
    result = train(dataclasses.replace(cfg, trainer="rsl-rl", max_iterations=2), make_env, as_rsl_rl=RslRlVecEnv)
    assert (result.folder / "model_1.pt").exists()
    assert (result.folder / CONFIG).exists()


def test_time_limit_ends_a_training_with_rsl_rl_with_a_checkpoint(cfg):
    cfg = dataclasses.replace(cfg, trainer="rsl-rl", max_seconds=1.0e-6, max_iterations=9)
    result = train(cfg, make_env, as_rsl_rl=RslRlVecEnv)
    assert result.iteration == 2  # the clock starts at the end of the first iteration
    assert (result.folder / "model_1.pt").exists() and not (result.folder / "model_2.pt").exists()


def test_rsl_rl_learns_to_push_the_mass_to_the_origin():
    torch.manual_seed(0)
    env = PushTask(128)
    adapter = RslRlVecEnv(env, SMALL.num_steps)
    adapter.reset()
    runner = train_rsl_rl(adapter, SMALL, iterations=30, save_interval=100, seed=0)
    env.reset()
    actor = runner.alg.get_policy().eval()
    with torch.inference_mode():
        for _ in range(40):
            env.step(actor(TensorDict({"actor": env.obs}, batch_size=[128])))
    assert env.obs[:, 0].abs().max() < 0.3  # distance from the origin


@pytest.mark.parametrize(
    ("fractions", "score"), [((1.0,), 0.8), ((0.6, 0.3, 0.1, 0.0), None), ((0.1, 0.3, 0.4, 0.2), 0.8), ((), 0.8)]
)
def test_checkpoint_has_the_mean_score_once_half_of_the_worlds_are_at_the_last_level(fractions, score):
    levels = {f"Curriculum/fraction_at_level_{i}": fraction for i, fraction in enumerate(fractions)}
    run = SimpleNamespace(cfg=TrainCfg(task="t"), _scores=[])
    for success in (0.9, math.nan, 0.7):
        run.metrics = {"Metrics/success": success, **levels}
        TrainingRun._add_score(run)
    assert TrainingRun._score(run) == (score and pytest.approx(score))
    assert TrainingRun._score(run) is None  # no value since the checkpoint before


def test_saved_score_is_the_mean_of_the_logged_metric_since_the_checkpoint_before(tmp_path):
    train(push_cfg(tmp_path, log_interval=1, best_metric="Loss/value"), PushTask)
    (folder,) = tmp_path.glob("push/*")
    logged = [json.loads(line)["Loss/value"] for line in (folder / METRICS_FILE).read_text().splitlines()]
    manifest = json.loads((folder / CHECKPOINTS / MANIFEST).read_text())
    means = [(logged[0] + logged[1]) / 2.0, (logged[2] + logged[3]) / 2.0]
    assert [entry["score"] for entry in manifest.values()] == pytest.approx(means)
    assert means[0] != pytest.approx(logged[1])
