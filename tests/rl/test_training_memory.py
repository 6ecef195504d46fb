import dataclasses
import os

import pytest
import torch

from experiments.measure_memory import array_bytes
from jump_helpers import make_env
from jumper_warp.cli import training_memory
from jumper_warp.cli.training_memory import (
    ENV_BYTES,
    RECORD_BYTES,
    check_memory,
    free_main_memory,
    learning_need,
    rollout_bytes,
)
from jumper_warp.registry import TASKS, make_task, trainer_settings
from jumper_warp.rl.ppo import Ppo
from toy_task import SMALL

TASK, PPO = make_task("vertical-jump"), trainer_settings("vertical-jump")
CPU = torch.device("cpu")


def limit_memory(monkeypatch, main, gpu=10**15):
    """Replace the free main memory and the free memory of every GPU [byte]."""
    monkeypatch.setattr(training_memory, "free_main_memory", lambda: int(main))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (int(gpu), 2 * int(gpu)))


@pytest.fixture(scope="module")
def envs():
    """Environments of 8 and 40 worlds on one thread, each with the bytes of the arrays that it allocated."""
    return [allocated(count) for count in (8, 40)]


def allocated(count, threads=1):
    """Return an environment, and the bytes of the arrays that it allocated."""
    before = array_bytes()
    env = make_env(count, task=TASK, randomize=True, threads=threads)
    return env, array_bytes() - before


def test_memory_per_world_agrees_with_the_environments_arrays(envs):
    (_, bytes_of_8), (_, bytes_of_40) = envs
    assert (bytes_of_40 - bytes_of_8) / (40 - 8) == pytest.approx(ENV_BYTES["jumper"], rel=0.05)


def test_memory_per_thread_agrees_with_the_environments_arrays(envs):
    _, bytes_of_one = envs[1]
    _, bytes_of_two = allocated(40, threads=2)
    assert bytes_of_two - bytes_of_one == pytest.approx(RECORD_BYTES, rel=0.15)


@pytest.mark.parametrize("asymmetric_critic", [True, False])
def test_memory_per_world_agrees_with_the_rollout_buffer(envs, asymmetric_critic):
    cfg = dataclasses.replace(SMALL, asymmetric_critic=asymmetric_critic)
    for env, _ in envs:
        ppo = Ppo(env, cfg)
        buffers = sum(x.numel() * x.element_size() for name, x in ppo.rollout._asdict().items() if name != "log_std")
        critic_obs = env.num_critic_obs if asymmetric_critic else env.num_obs
        assert buffers == env.num_envs * rollout_bytes(cfg.num_steps, env.num_obs, critic_obs)
        need = learning_need(cfg, env.num_obs, env.num_critic_obs)
        adam = 4 * 4 * sum(p.numel() for p in ppo.model.parameters())  # weight, gradient and two moments
        assert need.fixed == pytest.approx(adam, rel=0.01)
        assert buffers / env.num_envs < need.per_world < 10 * buffers / env.num_envs


@pytest.mark.parametrize(
    ("main", "gpu", "device", "memory"),  # free bytes of both, and the name of the memory that is too small
    [
        (4e9, 0.0, "cpu", "main memory"),
        (4e9, 80e9, "cuda:0", "main memory"),
        (400e9, 3e9, "cuda:0", "memory of cuda:0"),
    ],
)
def test_refuses_too_many_worlds_with_a_number_that_fits(monkeypatch, main, gpu, device, memory):
    limit_memory(monkeypatch, main, gpu)
    device = torch.device(device)
    pattern = rf"num_envs 1000000000 needs about [\d,]+\.\d GB of {memory} in each process, [34]\.0 GB are free: "
    with pytest.raises(ValueError, match=pattern + r"num_envs (\d+) would fit$") as caught:
        check_memory(TASK, PPO, "jumper", 10**9, device)
    fit = suggested_worlds(caught)
    assert 10_000 < fit < 100_000
    check_memory(TASK, PPO, "jumper", fit, device)
    with pytest.raises(ValueError, match=f"num_envs {fit} would fit"):
        check_memory(TASK, PPO, "jumper", fit + 8, device)


def suggested_worlds(caught):
    """Return the number of worlds in an error message that ends in "num_envs N would fit"."""
    return int(str(caught.value).split()[-3])


def test_number_of_worlds_that_fits_makes_a_valid_batch(monkeypatch):
    limit_memory(monkeypatch, 1e9)
    ppo = dataclasses.replace(PPO, num_steps=6, minibatches=21)
    with pytest.raises(ValueError, match="would fit") as caught:
        check_memory(TASK, ppo, "jumper", 10**9, CPU)
    assert ppo.batch_size(suggested_worlds(caught))  # raises if the minibatches do not divide the samples


@pytest.mark.parametrize("changes", [{"hidden": (65536, 65536)}, {"hidden": (8192,) * 64}])
def test_refuses_settings_that_no_world_has_memory_for(monkeypatch, changes):
    limit_memory(monkeypatch, 4e9)
    with pytest.raises(ValueError, match="GB are free: none would fit"):
        check_memory(TASK, dataclasses.replace(PPO, **changes), "jumper", 8, CPU)


def test_processes_of_one_host_share_its_memory(monkeypatch):
    limit_memory(monkeypatch, 4e9)
    with pytest.raises(ValueError, match=r"4\.0 GB are free") as alone:
        check_memory(TASK, PPO, "jumper", 10**9, CPU)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    with pytest.raises(ValueError, match=r"1\.0 GB are free") as shared:
        check_memory(TASK, PPO, "jumper", 10**9, CPU)
    assert suggested_worlds(alone) == pytest.approx(4 * suggested_worlds(shared), rel=0.01)


def test_default_trainings_fit_in_memory(monkeypatch):
    limit_memory(monkeypatch, 16e9, 8e9)
    for name in TASKS:
        check_memory(make_task(name), trainer_settings(name), "jumper", 8192, torch.device("cuda", 0))


def test_free_memory_is_at_most_the_total_memory():
    assert 0 < free_main_memory() <= os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
