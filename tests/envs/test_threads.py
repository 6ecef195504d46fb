"""CPU threads: results do not depend on their number bitwise, and errors reach the caller."""

import dataclasses
import threading
import time

import numpy as np
import pytest
import torch
import warp as wp

import hold_height
from jump_helpers import random_actions
from jumper_warp.envs.env import Env
from jumper_warp.kernels.jump.state import JumpState
from jumper_warp.kernels.mdp.view import RobotView
from jumper_warp.registry import make_task
from jumper_warp.rl.cfg import PpoCfg, TrainCfg
from jumper_warp.rl.checkpoint import load_checkpoint
from jumper_warp.rl.runner import CHECKPOINTS, train
from jumper_warp.robot.motors import vertical_jump_filter
from jumper_warp.sim.dynamics import MIN_WORLDS, WorldRange, slices_of
from jumper_warp.sim.simulation import Simulation
from jumper_warp.tasks.cfg import Handover
from jumper_warp.tasks.randomization import RandomizationCfg
from jumper_warp.utils import threads as pool
from mdp_helpers import write
from skill_helpers import begin_hold, begin_jump, jump_requested

N = 3 * MIN_WORLDS + 2
JUMP = dataclasses.replace(
    make_task("vertical-jump"), randomization=RandomizationCfg.walking(), action_scale=(40.0, 90.0)
)
HOLD = hold_height.hold_height()


@wp.func
def in_the_air(robot: RobotView, state: JumpState, requested: bool) -> bool:
    """Return whether no paw touches the ground."""
    return robot.contacts == 0


@pytest.fixture(autouse=True)
def all_cores():
    """Give the threads of all cores back after a test."""
    yield
    pool.set_threads(None)


def run(threads, steps=240, task=JUMP, **arguments):
    """Step with random actions; return results (steps, N, columns), the state and metrics at the end, and the Env."""
    env = Env(task, N, seed=3, device="cpu", threads=threads, **arguments)
    assert len(env.sim.slices) == threads
    for skill in env.skills:
        number = skill.task.params.index(f"curriculum.{skill.task.curriculum.name}.promote_after")
        write(skill.params.values, number, 0.0)  # every counted episode promotes
    env.reset()
    found = []
    for step, action in enumerate(random_actions(N, steps)):
        if len(env.tasks) > 1 and step % 40 == 10:
            env.request(0)
        env.step(action.repeat(len(env.tasks), 1, 1) if len(env.tasks) > 1 else action)
        rows = [*env._step.obs.values(), *env.skills[0].final_obs.values(), env.reward, env.done, env.timeout]
        found.append(torch.cat([row.reshape(N, -1) for row in rows], dim=1))
    return torch.stack(found), env.state_dict(), [skill.metrics() for skill in env.skills], env


def assert_same(found, expected):
    """Assert that two results of `run` are bitwise equal."""
    assert torch.equal(found[0], expected[0])
    for name, value in found[1].items():
        np.testing.assert_array_equal(value.numpy(), expected[1][name].numpy(), err_msg=name)
    assert found[2] == expected[2]


@pytest.fixture(scope="module")
def alone():
    """Return the results of `run` on one thread."""
    return run(1)


@pytest.mark.parametrize("threads", [2, 3])
def test_an_environment_is_bitwise_equal_on_any_number_of_threads(alone, threads):
    """The environment is randomised, with noise, pushes, ended episodes and a curriculum."""
    rows, env = alone[0], alone[-1]
    assert (rows[..., -2].sum(0) > 1).all() and rows[..., -2].sum(0).unique().numel() > 1
    assert len(np.unique(env.parameters.push.numpy(), axis=0)) > N // 4
    assert env.episodes.level.numpy().max() > 0
    assert_same(run(threads), alone)


def test_handovers_are_bitwise_equal_on_any_number_of_threads():
    there, back = Handover(HOLD, JUMP, jump_requested, begin_jump), Handover(JUMP, HOLD, in_the_air, begin_hold)
    expected, found = (
        run(threads, 120, (JUMP, HOLD), skill=np.arange(N) % 2, handovers=(there, back)) for threads in (1, 3)
    )
    assert len(np.unique(expected[1]["env.skill"])) == 2
    assert not np.array_equal(expected[1]["env.skill"], np.arange(N) % 2)
    assert_same(found, expected)


@pytest.mark.parametrize("filtered", [False, True])
def test_a_simulation_is_bitwise_equal_on_any_number_of_threads(filtered):
    def moved(threads):
        command_filter = vertical_jump_filter() if filtered else None
        sim = Simulation(N, command_filter=command_filter, visuals=False, device="cpu", threads=threads)
        target = sim.target.numpy()
        for step in range(60):
            degrees = np.linspace(90.0, 110.0, N) if step < 30 else np.linspace(-10.0, 10.0, N)
            target[np.arange(12) % 3 > 0] = np.radians(degrees)
            sim.target.assign(target)
            sim.step()
            sim.physics_step()
        arrays = (sim.state.joint_q, sim.state.joint_qd, sim.state.body_q, sim.state.body_qd, sim.torque)
        return [array.numpy().copy() for array in (*arrays, sim.paw_force, sim.peak_force)]

    expected = moved(1)
    assert np.ptp(expected[0].reshape(N, -1)[:, 2]) > 0.01
    for threads in (2, 3):
        for array, wanted in zip(moved(threads), expected, strict=True):
            np.testing.assert_array_equal(array, wanted)


def test_a_training_is_bitwise_equal_on_any_number_of_threads(tmp_path, one_thread):
    def trained(threads):
        cfg = TrainCfg(
            num_envs=N, max_iterations=3, device="cpu", threads=threads, log_root=tmp_path / str(threads),
            tensorboard=False, ppo=PpoCfg(num_steps=8, minibatches=4, epochs=2, hidden=(32, 32)),
        )  # fmt: skip
        sizes = []

        def make_env(num_envs, seed, device):
            env = Env(JUMP, num_envs, seed=seed, device=str(device))
            sizes.append(len(env.sim.slices))
            return env

        result = train(cfg, make_env)
        assert sizes == [threads]
        return load_checkpoint(result.folder / CHECKPOINTS / "iteration_000003.pt")

    expected, found = trained(1), trained(2)
    for part in ("model", "optimiser"):
        for name, value in flat(found["ppo"][part]).items():
            assert torch.equal(value, flat(expected["ppo"][part])[name]), name
    for name, value in found["env"].items():
        assert torch.equal(value, expected["env"][name]), name


def flat(state, prefix=""):
    """Return the tensors of nested dictionaries by path."""
    if isinstance(state, torch.Tensor):
        return {prefix: state}
    return {k: v for key, each in state.items() for k, v in flat(each, f"{prefix}.{key}").items()}


# ---------------------------------------------------------------- slices


@pytest.mark.parametrize(("worlds", "threads"), [(1, 8), (31, 2), (32, 2), (50, 3), (1000, 7), (4096, 64), (20, 1)])
def test_slices_contain_each_world_once_and_are_about_equal(worlds, threads):
    slices = slices_of(worlds, threads)
    assert [world for each in slices for world in range(each.first, each.first + each.count)] == list(range(worlds))
    assert len(slices) == max(1, min(threads, worlds // MIN_WORLDS))
    assert all(each.first % MIN_WORLDS == 0 for each in slices)
    counts = [each.count for each in slices]
    assert max(counts) - min(counts) < 2 * MIN_WORLDS
    assert worlds >= 2 * MIN_WORLDS or slices == [WorldRange(0, worlds)]


# ---------------------------------------------------------------- threads


@pytest.mark.parametrize("failing", [0, 1])
def test_the_exception_of_a_job_is_raised_after_all_started_jobs_have_ended(failing):
    started, ended = threading.Barrier(2, timeout=30.0), []

    def fail():
        started.wait()
        raise FloatingPointError("a slice failed")

    def take_time():
        started.wait()
        time.sleep(0.05)
        ended.append(True)

    jobs = [take_time, take_time]
    jobs[failing] = fail
    with pytest.raises(FloatingPointError, match="a slice failed"):
        pool.run_in_parallel(jobs, 2)
    assert ended == [True]
    pool.run_in_parallel([lambda: ended.append(True)] * 2, 2)  # the threads still run
    assert len(ended) == 3
