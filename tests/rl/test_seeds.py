"""Several seeds in one process have the results of single trainings; their folders, checkpoints and failures."""

import dataclasses
import json

import pytest
import torch

from jumper_warp.policies.catalog import newest_run
from jumper_warp.rl.checkpoint import MANIFEST, find_checkpoints, load_checkpoint
from jumper_warp.rl.learner import Learner
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.run_names import FROZEN, seed_folders
from jumper_warp.rl.runner import CHECKPOINTS, train
from jumper_warp.utils.errors import InputError
from toy_task import PushTask, equal, free_port, push_cfg, train_seeds_rank


class SeededTask(PushTask):
    """Task whose start depends on the seed, so that every seed has another training."""

    def __init__(self, num_envs, seed=0, device="cpu"):
        super().__init__(num_envs, seed, device)
        self.start *= 1.0 + 0.1 * seed


@pytest.fixture
def cfg(tmp_path):
    """Settings of 4 iterations of three seeds on 32 worlds each; every second one is logged and saved."""
    return push_cfg(tmp_path / "logs", seeds=(7, 1, 4))


def state(folder, iteration=4):
    """Return the parts of a seed's checkpoint that a training changes."""
    saved = load_checkpoint(folder / CHECKPOINTS / f"iteration_{iteration:06d}.pt")
    return {part: saved[part] for part in ("ppo", "env", "rng")}


def test_every_seed_has_bitwise_the_results_of_a_single_training(cfg, tmp_path):
    result = train(cfg, SeededTask)
    folders = seed_folders(result.folder)
    assert list(folders) == [1, 4, 7] and result.iteration == 4
    for seed, folder in folders.items():
        single = train(push_cfg(tmp_path / "single", seed=seed), SeededTask)
        ours, theirs = state(folder), state(single.folder)
        theirs["rng"].pop("cpu"), ours["rng"].pop("cpu")  # torch's generator, which this task does not use
        assert equal(ours, theirs)
        lines = [json.loads((path / METRICS_FILE).read_text().splitlines()[-1]) for path in (folder, single.folder)]
        assert [line["Metrics/success"] for line in lines] == [result.seeds[seed].metrics["Metrics/success"]] * 2
    weights = [state(folder)["ppo"]["model"]["log_std"] for folder in folders.values()]
    assert not torch.equal(weights[0], weights[1]) and not torch.equal(weights[1], weights[2])


def test_resume_continues_all_seeds_bitwise(cfg):
    whole = train(cfg, SeededTask)
    half = train(dataclasses.replace(cfg, max_iterations=2), SeededTask)
    again = train(dataclasses.replace(cfg, resume=str(half.folder)), SeededTask)
    assert again.folder == half.folder
    for seed, folder in seed_folders(whole.folder).items():
        ours, theirs = state(folder), state(again.folder / f"seed_{seed}")
        assert equal(ours["ppo"], theirs["ppo"]) and equal(ours["env"], theirs["env"])
        assert torch.equal(ours["rng"]["learner_cpu"], theirs["rng"]["learner_cpu"])


def test_two_processes_share_the_seeds_without_changing_their_results(cfg, tmp_path):
    shared = dataclasses.replace(cfg, log_root=tmp_path / "shared", threads=1)
    torch.multiprocessing.spawn(train_seeds_rank, (free_port(), shared), nprocs=2)
    (run,) = shared.log_root.glob("push/*")
    alone = train(dataclasses.replace(cfg, threads=1), PushTask)
    assert list(seed_folders(run)) == [1, 4, 7]
    for seed, folder in seed_folders(run).items():
        assert equal(state(folder)["ppo"], state(alone.folder / f"seed_{seed}")["ppo"])
    with pytest.raises(InputError, match="2 processes need as many seeds, got 1"):
        dataclasses.replace(cfg, seeds=(1,)).check_processes(2)


def test_resume_takes_the_last_iteration_that_all_seeds_have(cfg):
    folder = train(cfg, SeededTask).folder
    path = folder / "seed_4" / CHECKPOINTS / MANIFEST
    manifest = json.loads(path.read_text())
    del manifest["iteration_000004.pt"]  # as if the process was killed while it saved
    path.write_text(json.dumps(manifest))
    found = find_checkpoints(dataclasses.replace(cfg, resume="latest"))
    assert [checkpoint.state["iteration"] for checkpoint in found] == [2, 2, 2]
    before = state(folder / "seed_7")
    train(dataclasses.replace(cfg, resume="latest"), SeededTask)
    after = state(folder / "seed_7")
    assert equal(before["ppo"], after["ppo"])


def spoil(monkeypatch, spoiled, at):
    """Set the weights of some learners, counted by their making, to NaN in their update number `at`."""
    updates = {}  # number of updates of each learner
    update = Learner.update

    def spoiling(self):
        update(self)
        updates[self] = updates.get(self, 0) + 1
        if list(updates).index(self) in spoiled and updates[self] == at:
            self.flat.value.fill_(float("nan"))

    monkeypatch.setattr(Learner, "update", spoiling)


def test_the_end_of_a_run_is_that_of_a_seed_that_did_not_fail(cfg, monkeypatch, capsys):
    spoil(monkeypatch, {0}, at=1)
    train(cfg, SeededTask)
    assert "ended by --max-iterations 4, saved in" in capsys.readouterr().err


def test_a_seed_that_diverges_is_frozen_and_the_others_continue(cfg, monkeypatch, capsys):
    spoil(monkeypatch, {1}, at=3)
    result = train(cfg, SeededTask)
    iterations = {seed: each.iteration for seed, each in result.seeds.items()}
    assert iterations == {7: 4, 1: 4, 4: 4}
    assert "seed 1: frozen at iteration 4: the weights are not finite" in capsys.readouterr().err
    assert (result.folder / "seed_1" / FROZEN).read_text().startswith("iteration 4")
    assert not (result.folder / "seed_1" / CHECKPOINTS / "iteration_000004.pt").exists()
    longer = dataclasses.replace(cfg, max_iterations=6, resume=str(result.folder))
    assert {seed: each.iteration for seed, each in train(longer, SeededTask).seeds.items()} == {7: 6, 4: 6}


@pytest.mark.parametrize("single", [True, False])
def test_a_training_fails_if_all_its_seeds_diverge(cfg, monkeypatch, capsys, single):
    spoil(monkeypatch, {0, 1, 2}, at=1)
    with pytest.raises(SystemExit, match="weights are not finite"):
        train(dataclasses.replace(cfg, seeds=()) if single else cfg, SeededTask)
    assert ("ended by a failure after " in capsys.readouterr().err) != single


def test_a_seed_is_addressed_by_its_number_and_the_median_by_the_run(cfg):
    result = train(cfg, SeededTask)
    folders = seed_folders(result.folder)
    for seed, folder in folders.items():
        assert newest_run(f"{result.folder}:{seed}") == folder
        assert newest_run(f"{cfg.log_root / 'push'}:{seed}") == folder
        assert newest_run(folder) == folder
    for scores, median in (([0.3, 0.9, 0.5], 7), ([None, 0.9, 0.5], 7), ([None, 0.9, None], 1)):
        for folder, score in zip(folders.values(), scores, strict=True):
            path = folder / CHECKPOINTS / MANIFEST
            manifest = json.loads(path.read_text())
            path.write_text(json.dumps({name: entry | {"score": score} for name, entry in manifest.items()}))
        assert newest_run(result.folder) == newest_run(cfg.log_root / "push") == folders[median]
    with pytest.raises(InputError, match="no checkpoint of seed 3; seeds with checkpoints: 1, 4, 7"):
        newest_run(f"{result.folder}:3")


def test_resume_refuses_other_seeds(cfg):
    folder = str(train(dataclasses.replace(cfg, max_iterations=2), SeededTask).folder)
    with pytest.raises(InputError, match="has seeds 1, 4, 7, got seeds 1, 2"):
        train(dataclasses.replace(cfg, seeds=(1, 2), resume=folder), SeededTask)
