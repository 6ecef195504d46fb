"""Python threads with an environment each, and forked processes."""

import itertools
import threading
from concurrent.futures import ThreadPoolExecutor

import torch

from hold_height import hold_height
from jump_helpers import random_actions
from jumper_warp.envs.env import Env
from jumper_warp.registry import make_task
from jumper_warp.robot.model import build_model
from jumper_warp.sim.dynamics import MIN_WORLDS
from jumper_warp.sim.simulation import Simulation
from jumper_warp.sim.solver import SolverJumper

N = 2 * MIN_WORLDS
ACTIONS = random_actions(N, 8)


def stepped_env(seed, task):
    """Build an environment on two CPU threads, step it, and return its observations and metrics."""
    env = Env(task, N, seed=seed, device="cpu", threads=2)
    env.reset()
    rows = [torch.cat([*env.step(action).obs.values()], dim=1).clone() for action in ACTIONS]
    env.set(f"rewards.{task.rewards[0].name}.weight", 1.0)
    return torch.stack(rows), env.metrics()


def stepped_simulation(*_):
    """Build a simulation, step it, and return its joint coordinates."""
    sim = Simulation(N, device="cpu", threads=2, visuals=False)
    sim.set_targets(sim.target.numpy()[:, :1] + 0.1 * torch.ones(12, N).numpy())
    for _ in range(6):
        sim.step()
    sim.reset()
    sim.physics_step()
    return torch.from_numpy(sim.joint_q().copy()), {}


def stepped_solver(*_):
    """Build a model and a solver, step it, and return the joint coordinates."""
    model = build_model(N, device="cpu", visuals=False)
    solver, states = SolverJumper(model), [model.state(), model.state()]
    for _ in range(6):
        solver.step(*states, None, None, 1.0 / 480.0)
        states.reverse()
    return torch.from_numpy(states[0].joint_q.numpy().copy()), {}


JOBS = [
    (stepped_env, 1, make_task("vertical-jump")), (stepped_env, 2, hold_height()), (stepped_simulation, 0, None),
    (stepped_solver, 0, None),
]  # fmt: skip


def test_threads_with_an_environment_each_have_the_results_of_a_single_thread():
    expected = [job(seed, task) for job, seed, task in JOBS]
    turns = [[(i + turn) % len(JOBS) for turn in range(4)] for i in range(4)]  # each thread begins elsewhere
    start = threading.Barrier(4, timeout=60.0)

    def run(turns):
        start.wait()
        return [(i, JOBS[i][0](*JOBS[i][1:])) for i in turns]

    with ThreadPoolExecutor(4) as pool:
        found = list(itertools.chain(*pool.map(run, turns)))
    assert len(found) == 16
    for i, (rows, metrics) in found:
        assert torch.equal(rows, expected[i][0]) and metrics == expected[i][1]
