import dataclasses
import json
import math
import os
import signal
import threading
from contextlib import nullcontext

import pytest
import torch
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from full_disk import full_disk
from jumper_warp.envs.rsl_rl import RslRlVecEnv
from jumper_warp.rl import training_run
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.rl.checkpoint import MANIFEST, CheckpointError, find_checkpoints, load_checkpoint, save_checkpoint
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.logger import Scores, TrainingConsole
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.rsl_rl import rsl_rl_config
from jumper_warp.rl.run_folder import CONFIG
from jumper_warp.rl.runner import CHECKPOINTS, train
from jumper_warp.rl.training_run import TrainingRun
from toy_task import SMALL, PushTask, equal, free_port, push_cfg, train_twice


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


def test_training_continues_while_a_checkpoint_is_written(cfg, monkeypatch):
    continued = threading.Event()

    class LaterTask(PushTask):  # reports the third iteration of 16 steps
        def step(self, action):
            super().step(action)
            if self.steps > 32:
                continued.set()

    def save(folder, state, *rest):
        assert continued.wait(60.0)
        return save_checkpoint(folder, state, *rest)

    monkeypatch.setattr(training_run, "save_checkpoint", save)
    result = train(cfg, lambda *args: LaterTask(*args, episode_length=16))
    saved = load_checkpoint(result.folder / CHECKPOINTS / "iteration_000002.pt")
    assert not equal(saved["ppo"]["model"], final_state(result)["ppo"]["model"])


def test_training_warns_of_a_full_disk_and_fails_at_the_last_checkpoint(cfg, capsys):
    with full_disk(12_000), pytest.raises(CheckpointError, match="not saved: File too large"):
        train(cfg, make_env)
    assert capsys.readouterr().err.count("not saved, retried later") == 1


def test_refuses_a_checkpoint_of_other_networks_in_one_line(cfg):
    result = train(cfg, make_env)
    other = dataclasses.replace(cfg, resume=str(result.folder), ppo=dataclasses.replace(SMALL, hidden=(16, 16)))
    with pytest.raises(CheckpointError, match="does not fit these settings") as caught:
        train(other, make_env)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_finishes_the_iteration_saves_and_prints_the_resume_command(cfg, number, capsys):
    class SignallingTask(PushTask):  # sends the signal to this process
        def step(self, action):
            super().step(action)
            if self.steps == 40:  # in the third iteration of 16 steps
                os.kill(os.getpid(), number)

    ignored = signal.signal(number, signal.SIG_DFL)  # a job in the background ignores SIGINT, one of nohup SIGHUP
    try:
        with pytest.raises(SystemExit) as caught:
            train(dataclasses.replace(cfg, max_iterations=100), SignallingTask)
        assert caught.value.code == 130
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, ignored)
    (path,) = cfg.log_root.glob("push/*/checkpoints/iteration_000003.pt")
    assert load_checkpoint(path)["env"]["steps"] == 48
    *_, cause, last = capsys.readouterr().err.splitlines()
    assert cause == "ended by an interruption after 0.00 M of 0.05 M steps"
    assert last == f"saved {path}, continue with: jumper train push --resume {path.parent.parent}"


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
    ("kind", "change", "message"),
    [
        (TrainCfg, {"max_iterations": 0}, "max_iterations must be a whole number of 1 to 1000000000, got 0"),
        (TrainCfg, {"max_seconds": -1.0}, "max_seconds must be finite and not negative, got -1.0"),
        (TrainCfg, {"seed": -1}, r"seed must be in 0 \.\. 2147483647, got -1"),
        (TrainCfg, {"seeds": (1, 1)}, "seeds must be distinct"),
        (TrainCfg, {"run_name": "a/b"}, "task, run_name and tags"),
        (PpoCfg, {"gamma": 1.5}, "gamma must be in"),
        (PpoCfg, {"num_steps": 0}, "num_steps must be in 1 to 10000, got 0"),
        (PpoCfg, {"lr": 1.0}, "min_lr <= lr <= max_lr"),
        (PpoCfg, {"hidden": ()}, "hidden must name"),
        (PpoCfg, {"activation": "gelu"}, "activation must be one of elu, relu, tanh, got 'gelu'"),
    ],
)
def test_refuses_settings_out_of_range(kind, change, message):
    with pytest.raises(ValueError, match=message):
        kind(**change)


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


def test_rsl_rl_learns_to_push_the_mass_to_the_origin():
    torch.manual_seed(0)
    env = PushTask(128)
    adapter = RslRlVecEnv(env, SMALL.num_steps)
    adapter.reset()
    runner = OnPolicyRunner(adapter, rsl_rl_config(SMALL, 100, 0), log_dir=None, device="cpu")
    runner.learn(30)
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
    scores = Scores("Metrics/success")
    for success in (0.9, math.nan, 0.7):
        scores.add({"Metrics/success": success, **levels})
    assert scores.mean() == (score and pytest.approx(score))
    scores.clear()
    assert scores.mean() is None  # no value since the checkpoint before


def logged(folder):
    """Return the logged metrics by iteration, without measured times."""
    lines = [json.loads(line) for line in (folder / METRICS_FILE).read_text().splitlines()]
    return {line["iteration"]: {name: x for name, x in line.items() if not name.startswith("Perf/")} for line in lines}


def test_iterations_with_a_checkpoint_are_logged_and_scored(cfg):
    folder = train(dataclasses.replace(cfg, log_interval=3, max_iterations=5), make_env).folder
    metrics = logged(folder)
    assert metrics.keys() == {2, 3, 4, 5}
    manifest = json.loads((folder / CHECKPOINTS / MANIFEST).read_text())
    success = {iteration: line["Metrics/success"] for iteration, line in metrics.items()}
    scores = {entry["iteration"]: entry["score"] for entry in manifest.values()}
    assert scores == {2: success[2], 4: pytest.approx((success[3] + success[4]) / 2.0), 5: success[5]}


def test_next_metrics_after_a_resume_are_those_of_an_uninterrupted_training(cfg):
    cfg = dataclasses.replace(cfg, log_interval=3, max_iterations=6)
    folder = train(cfg, PushTask).folder
    expected = logged(folder)
    checkpoint = folder / CHECKPOINTS / "iteration_000004.pt"
    assert logged(train(dataclasses.replace(cfg, resume=str(checkpoint)), PushTask).folder) == expected


def resumed_state(cfg, folder, **ppo):
    """Resume a training with other settings of PPO for no iteration; return its `Ppo` and printed notes."""
    cfg = dataclasses.replace(cfg, resume=str(folder), ppo=dataclasses.replace(cfg.ppo, **ppo))
    (checkpoint,) = find_checkpoints(cfg)
    env = make_env(cfg.num_envs, 1, "cpu")
    rank, console = Rank(0, 1, torch.device("cpu")), TrainingConsole(cfg)
    run = TrainingRun(cfg, env, rank, console, nullcontext(), checkpoint=checkpoint)
    return run.ppo, run.notes


def test_resume_applies_a_changed_learning_rate_and_its_bounds(cfg):
    folder = train(cfg, make_env).folder
    saved = float(load_checkpoint(folder / CHECKPOINTS / "iteration_000004.pt")["ppo"]["lr"])
    assert float(resumed_state(cfg, folder)[0].lr) == saved
    ppo, notes = resumed_state(cfg, folder, lr=1.0e-5)
    assert float(ppo.lr) == pytest.approx(1.0e-5) and "ppo.lr 0.001 -> 1e-05" in notes
    train(dataclasses.replace(cfg, resume=str(folder), max_iterations=5), make_env)  # config.json has the old rate
    assert float(resumed_state(cfg, folder, lr=0.4 * saved, max_lr=0.5 * saved)[0].lr) == pytest.approx(0.4 * saved)
    slow = dataclasses.replace(cfg, ppo=dataclasses.replace(cfg.ppo, lr=0.1 * saved))
    limited = train(slow, make_env).folder
    state = final_state(train(dataclasses.replace(slow, resume=str(limited)), make_env))
    save_checkpoint(limited / CHECKPOINTS, state | {"ppo": state["ppo"] | {"lr": torch.tensor(saved)}})
    assert float(resumed_state(slow, limited, max_lr=0.5 * saved)[0].lr) == pytest.approx(0.5 * saved)


def test_resume_refuses_settings_that_only_the_start_reads(cfg):
    folder = train(cfg, make_env).folder
    before = (folder / CONFIG).read_text()
    changed = dataclasses.replace(cfg, resume=str(folder), ppo=dataclasses.replace(SMALL, init_std=0.1))
    with pytest.raises(CheckpointError, match=r": ppo\.init-std cannot change after the start of a training"):
        train(changed, make_env)
    assert (folder / CONFIG).read_text() == before
