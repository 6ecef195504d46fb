"""Processes on several machines, and restarts by torchrun when one dies: agents on the loopback interface."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import elastic_task
from jumper_warp.rl.checkpoint import load_checkpoint
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.runner import CHECKPOINTS
from toy_task import free_port

STEPS = elastic_task.STEPS


def start(folder, nodes, *deaths, restarts=0):
    """Begin to train on so many nodes, two processes in all; `{node}` in the folder's name is that of the node."""
    here = Path(elastic_task.__file__)
    paths = [str(here.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    env = os.environ | {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo", "PYTHONPATH": os.pathsep.join(paths)}
    env["TORCH_DISABLE_SHARE_RDZV_TCP_STORE"] = "1"  # else restarted processes read addresses of those that are gone
    command = [
        sys.executable, "-m", "torch.distributed.run", f"--nnodes={nodes}", f"--nproc-per-node={2 // nodes}",
        f"--max-restarts={restarts}", "--rdzv-backend=c10d", f"--rdzv-endpoint=127.0.0.1:{free_port()}",
        "--rdzv-id=jumper", "--local-addr=127.0.0.1", "--monitor-interval=0.1", str(here),
    ]  # fmt: skip
    return [
        subprocess.Popen([*command, str(folder).format(node=node), *deaths], env=env, stderr=subprocess.PIPE, text=True)
        for node in range(nodes)
    ]


def torchrun(folder, nodes, *deaths, restarts=0):
    """Train on so many nodes, two processes in all, and return the folder of the only run."""
    agents = start(folder, nodes, *deaths, restarts=restarts)
    told = [agent.communicate(timeout=240)[1] for agent in agents]
    assert [agent.returncode for agent in agents] == [0] * nodes, "\n".join(told)
    (run,) = folder.glob("push/*")
    return run


def assert_same_training(found, expected):
    """Two runs have learnt the same bit for bit, and logged the same."""
    one, other = (load_checkpoint(run / CHECKPOINTS / "iteration_000006.pt") for run in (found, expected))
    for part in ("ppo", "env", "rng", "others"):
        assert_equal(one[part], other[part], part)
    lines = [[json.loads(line) for line in (run / METRICS_FILE).read_text().splitlines()] for run in (found, expected)]
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


def test_two_nodes_learn_what_one_node_learns_though_a_process_is_killed_and_restarted(one_node, tmp_path):
    """In the fifth iteration, after the second checkpoint of three: only unfinished iterations are lost."""
    run = torchrun(tmp_path, 2, f"0,1,{4 * STEPS + 5}", restarts=1)
    assert [path.name for path in sorted((run / CHECKPOINTS).glob("*.pt"))] == [
        f"iteration_00000{i}.pt" for i in (2, 4, 6)
    ]
    assert_same_training(run, one_node)


def test_processes_that_find_different_checkpoints_are_refused(one_node, tmp_path):
    """Each node sees a folder of its own, and a run that can be resumed is in one of them alone."""
    shutil.copytree(one_node.parents[1], tmp_path / "0")
    (tmp_path / "1").mkdir()
    agents = start(tmp_path / "{node}", 2)
    told = [agent.communicate(timeout=240)[1] for agent in agents]
    assert [agent.returncode for agent in agents] == [1, 1]
    assert any("the processes found different checkpoints" in text for text in told)
