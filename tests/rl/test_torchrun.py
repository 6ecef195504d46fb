"""Training on several nodes, and restarts by torchrun after a process died, with agents on the loopback interface."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import elastic_task
from jumper_warp.rl.checkpoint import load_checkpoint
from jumper_warp.rl.metrics_file import METRICS_FILE
from jumper_warp.rl.runner import CHECKPOINTS
from toy_task import equal, free_port

STEPS = elastic_task.STEPS


def start(folder, nodes, *deaths, restarts=0):
    """Return torchrun agents (Popen, one a node) of a training with two processes on one or two nodes.

    folder: for the logs; {node} in it is replaced. deaths: arguments of elastic_task, processes that die. restarts:
    allowed restarts.
    """
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
    """Train with two processes on `nodes` nodes, and return the run's folder; arguments as for `start`."""
    agents = start(folder, nodes, *deaths, restarts=restarts)
    stderr = [agent.communicate(timeout=240)[1] for agent in agents]
    assert [agent.returncode for agent in agents] == [0] * nodes, "\n".join(stderr)
    (run,) = folder.glob("push/*")
    return run


def assert_same_training(run, other_run):
    """Assert that two runs have bitwise equal last checkpoints, and the same logged iterations and KL divergences."""
    runs = (run, other_run)
    first, second = (load_checkpoint(run / CHECKPOINTS / "iteration_000006.pt") for run in runs)
    for part in ("ppo", "env", "rng", "others"):
        assert equal(first[part], second[part]), part
    lines = [[json.loads(line) for line in (run / METRICS_FILE).read_text().splitlines()] for run in runs]
    losses = [[(line["iteration"], line["Loss/kl"]) for line in log] for log in lines]
    assert losses[0] == losses[1] and [iteration for iteration, _ in losses[0]] == [1, 2, 3, 4, 5, 6]


@pytest.fixture(scope="module")
def one_node(tmp_path_factory):
    """Folder of an uninterrupted run on one node."""
    return torchrun(tmp_path_factory.mktemp("one"), 1)


def test_two_nodes_with_a_killed_process_agree_with_one_node(one_node, tmp_path):
    """A process is killed in the fifth iteration, after the second of three checkpoints."""
    run = torchrun(tmp_path, 2, f"0,1,{4 * STEPS + 5}", restarts=1)
    names = sorted(path.name for path in (run / CHECKPOINTS).glob("*.pt"))
    assert names == [f"iteration_00000{i}.pt" for i in (2, 4, 6)]
    assert_same_training(run, one_node)
