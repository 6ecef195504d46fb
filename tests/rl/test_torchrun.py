"""Processes on several machines, and what torchrun does when one dies: agents on the loopback interface."""

import dataclasses
import json
import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

import elastic_task
from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.checkpoint import load_checkpoint, save_checkpoint
from jumper_warp.rl.distributed import Rank
from jumper_warp.rl.elastic import MARK, mark_run, own_run
from jumper_warp.rl.logger import FIGURES
from jumper_warp.rl.rendezvous import agreed_name
from jumper_warp.rl.runner import CHECKPOINTS

STEPS = elastic_task.STEPS


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def torchrun(folder, nodes, *deaths, restarts=0):
    """Train on so many nodes, two processes in all, and return the folder of the only run."""
    here = Path(elastic_task.__file__)
    paths = [str(here.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    env = os.environ | {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo", "PYTHONPATH": os.pathsep.join(paths)}
    command = [
        sys.executable, "-m", "torch.distributed.run", f"--nnodes={nodes}", f"--nproc-per-node={2 // nodes}",
        f"--max-restarts={restarts}", "--rdzv-backend=c10d", f"--rdzv-endpoint=127.0.0.1:{free_port()}",
        "--rdzv-id=jumper", "--local-addr=127.0.0.1", "--monitor-interval=0.1", str(here), str(folder), *deaths,
    ]  # fmt: skip
    agents = [subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True) for _ in range(nodes)]
    told = [agent.communicate(timeout=240)[1] for agent in agents]
    assert [agent.returncode for agent in agents] == [0] * nodes, "\n".join(told)
    (run,) = folder.glob("push/*")
    return run


def assert_same_training(found, expected):
    """Two runs have learnt the same bit for bit, and logged the same."""
    one, other = (load_checkpoint(run / CHECKPOINTS / "iteration_000006.pt") for run in (found, expected))
    for part in ("ppo", "env", "rng", "others"):
        assert_equal(one[part], other[part], part)
    lines = [[json.loads(line) for line in (run / FIGURES).read_text().splitlines()] for run in (found, expected)]
    kept = [[(line["iteration"], line["Loss/kl"]) for line in log] for log in lines]
    assert kept[0] == kept[1] and [iteration for iteration, _ in kept[0]] == [1, 2, 3, 4, 5, 6]


def assert_equal(one, other, where):
    if isinstance(one, dict | list):
        assert len(one) == len(other), where
        for key in one if isinstance(one, dict) else range(len(one)):
            assert_equal(one[key], other[key], f"{where}.{key}")
    else:
        assert torch.equal(one, other), where


@pytest.fixture(scope="module")
def one_node(tmp_path_factory):
    return torchrun(tmp_path_factory.mktemp("one"), 1)


def test_two_nodes_learn_what_one_node_with_as_many_processes_learns(one_node, tmp_path):
    assert_same_training(torchrun(tmp_path, 2), one_node)


def test_a_killed_process_is_restarted_and_only_unfinished_iterations_are_lost(one_node, tmp_path):
    """On two nodes, in the fifth iteration, after the second checkpoint of three."""
    run = torchrun(tmp_path, 2, f"0,1,{4 * STEPS + 5}", restarts=1)
    assert [path.name for path in sorted((run / CHECKPOINTS).glob("*.pt"))] == [
        f"iteration_00000{i}.pt" for i in (2, 4, 6)
    ]
    assert_same_training(run, one_node)


@pytest.mark.parametrize("size", [1, 2, 4])
def test_processes_agree_on_a_name_that_is_new_at_each_start(size):
    store, names = torch.distributed.HashStore(), []
    for _ in range(3):  # the later ones find what the earlier ones left
        with ThreadPoolExecutor(size) as pool:
            order = range(size) if len(names) == 1 else reversed(range(size))
            found = [pool.submit(agreed_name, store, rank, size) for rank in order]
            names.append({each.result(timeout=60) for each in found})
    assert [len(each) for each in names] == [1, 1, 1] and len(set.union(*names)) == 3


# ---------------------------------------------------------------- which run is a restarted process's own

ALONE = Rank(0, 1, torch.device("cpu"))


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Return what tells settings and folder of a process that an agent starts for the so-manieth time."""

    def start(restarts, run_id="one", **settings):
        monkeypatch.setenv("TORCHELASTIC_RUN_ID", run_id)
        monkeypatch.setenv("TORCHELASTIC_RESTART_COUNT", str(restarts))
        cfg = TrainCfg(task="push", log_root=tmp_path, **settings)
        return cfg, *own_run(cfg, ALONE)

    return start


def begun(cfg, name):
    """Begin a run in a folder of its own."""
    folder = cfg.log_root / "push" / name
    folder.mkdir(parents=True)
    mark_run(folder, ALONE)
    return folder


def save(folder, iteration):
    state = {"iteration": iteration, "ppo": {}, "env": {}, "rng": {}, "config": ""}
    return save_checkpoint(folder / CHECKPOINTS, state)


def test_a_first_start_begins_a_new_run_whatever_lies_there(started):
    cfg, same, folder = started(0)
    assert (same, folder) == (cfg, None)
    save(begun(cfg, "before"), 2)
    assert started(0)[1:] == (cfg, None)


def test_a_restart_goes_on_in_its_own_run_from_the_newest_checkpoint(started):
    cfg, *_ = started(0)
    run = begun(cfg, "own")
    assert started(1)[1:] == (cfg, run)  # from the beginning: nothing was saved
    save(run, 2)
    assert started(1)[1:] == (dataclasses.replace(cfg, resume=str(run)), run)


def test_a_restart_leaves_runs_of_other_agents_alone(started, monkeypatch):
    cfg, *_ = started(0)
    own, other = begun(cfg, "own"), started(0, "two")[0]
    save(begun(other, "other, later"), 2)
    (cfg.log_root / "push" / "no run").mkdir()
    (cfg.log_root / "push" / "no run" / MARK).write_text("[1")
    assert started(1)[2] == own
    assert started(1, "three")[1:] == (cfg, None)
    monkeypatch.setattr(os, "getppid", lambda: 1)  # another agent of the same name
    assert started(1)[1:] == (cfg, None)


@pytest.mark.parametrize("depth", [0, 1, 2])
def test_a_resumed_run_that_is_restarted_keeps_to_what_it_resumed_until_it_saves(started, tmp_path, depth):
    cfg, *_ = started(0)
    folder = begun(cfg, "../elsewhere/run")
    path = save(folder, 2)
    save(folder, 4)
    mark_run(folder, ALONE)
    resumed = str((path, path.parent, folder)[depth])
    cfg, *found = started(1, resume=resumed)
    assert found == [cfg, folder]
    save(folder, 6)
    assert started(1, resume=resumed)[1].resume == str(folder)


def test_without_torchrun_nothing_is_marked(tmp_path, monkeypatch):
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    mark_run(tmp_path, ALONE)
    cfg = TrainCfg(task="push", log_root=tmp_path)
    assert own_run(cfg, ALONE) == (cfg, None) and not list(tmp_path.iterdir())
