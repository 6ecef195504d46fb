"""A rollout that runs beside the update: which weights act when, and that a training can be saved and resumed."""

import dataclasses
import os
import signal

import pytest
import torch

from jumper_warp.rl.cfg import TrainCfg
from jumper_warp.rl.checkpoint import load_checkpoint
from jumper_warp.rl.ppo import Ppo
from jumper_warp.rl.runner import CHECKPOINTS, train
from toy_task import SMALL, PushTask

OVERLAP = dataclasses.replace(SMALL, overlap=True, lr=3e-3)


def make_ppo(cfg):
    torch.manual_seed(4)
    ppo = Ppo(PushTask(32, episode_length=20), cfg)
    ppo.env.reset()
    return ppo


def state(ppo):
    return {name: value.clone() for name, value in ppo.model.state_dict().items()}


def same(ours, theirs):
    return all(torch.equal(value, theirs[name]) for name, value in ours.items())


def lagging(iterations):
    """The weights after each iteration, with rollouts by those of one iteration before, one thing after the other."""
    ppo = make_ppo(dataclasses.replace(OVERLAP, overlap=False))
    history = []
    ppo.collect()
    for _ in range(iterations):
        ppo.batch()
        acting = state(ppo)
        ppo._learn()
        history.append(state(ppo))
        ppo.model.load_state_dict(acting)
        ppo.collect()
        ppo.model.load_state_dict(history[-1])
    return history


def test_a_rollout_is_of_the_weights_of_one_iteration_before():
    history = lagging(4)
    ppo = make_ppo(OVERLAP)
    for expected in history:
        ppo.iterate()
        assert ppo.ahead
        assert same(state(ppo), expected)


def test_it_does_not_matter_which_of_both_ends_first():
    ours = make_ppo(OVERLAP)
    for _ in range(3):
        ours.iterate()
    theirs = make_ppo(OVERLAP)
    theirs.collect()
    for _ in range(3):
        theirs.batch()
        theirs.collector.hand_over()
        theirs.collector.roll()  # before the update
        theirs._learn()
    assert same(state(ours), state(theirs))
    for name in ("obs", "action", "mean", "reward"):
        assert torch.equal(getattr(ours.rollout, name), getattr(theirs.rollout, name))
    assert ours.statistics() == theirs.statistics()


def test_a_drained_iteration_is_followed_by_one_with_the_newest_weights():
    ppo = make_ppo(OVERLAP)
    ppo.iterate()
    with pytest.raises(RuntimeError, match="drained"):
        ppo.state_dict()
    ppo.iterate(drain=True)
    assert not ppo.ahead
    steps, newest = ppo.env.steps.item(), ppo.flat.value[: ppo.flat.actor_size].clone()
    assert steps == 2 * OVERLAP.num_steps
    acted = []
    roll = ppo.collector.roll
    ppo._roll = lambda: (acted.append(ppo.collector._policy.clone()), roll())
    ppo.iterate()
    assert torch.equal(acted[0], newest) and torch.equal(acted[1], newest)
    assert ppo.env.steps.item() == steps + 2 * OVERLAP.num_steps


def test_without_overlap_draining_changes_nothing():
    found = []
    for drain in (False, True):
        ppo = make_ppo(dataclasses.replace(OVERLAP, overlap=False))
        for _ in range(2):
            ppo.iterate(drain)
        found.append(state(ppo))
    assert same(*found)


def test_it_learns():
    torch.manual_seed(1)
    ppo = Ppo(PushTask(128), dataclasses.replace(SMALL, overlap=True))
    ppo.env.reset()
    for _ in range(30):
        ppo.iterate()
    env = ppo.env
    env.reset()
    for _ in range(40):
        env.step(ppo.model.act(env.obs))
    assert env.obs[:, 0].abs().max() < 0.2


@pytest.fixture
def cfg(tmp_path):
    return TrainCfg(
        task="push", num_envs=32, iterations=6, device="cpu", log_root=tmp_path / "logs", log_interval=1,
        save_interval=2, tensorboard=False, ppo=OVERLAP,
    )  # fmt: skip


def make_env(num_envs, seed, device):
    return PushTask(num_envs, seed, device, episode_length=20)


def saved(folder, iteration):
    return load_checkpoint(folder / CHECKPOINTS / f"iteration_{iteration:06d}.pt")


def equal(a, b):
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    return torch.equal(a, b)


def test_a_resumed_run_equals_an_uninterrupted_one(cfg):
    whole = saved(train(cfg, make_env).folder, 6)
    half = train(dataclasses.replace(cfg, iterations=4), make_env)
    resumed = train(dataclasses.replace(cfg, resume=str(half.folder)), make_env)
    for part in ("ppo", "env", "rng"):
        assert equal(saved(resumed.folder, 6)[part], whole[part]), part
    plain = train(dataclasses.replace(cfg, ppo=dataclasses.replace(OVERLAP, overlap=False)), make_env)
    assert not equal(saved(plain.folder, 6)["ppo"], whole["ppo"])


def test_a_signal_ends_after_the_rollout_that_is_ahead_has_been_learnt_from(cfg):
    class Signalled(PushTask):
        def step(self, action):
            super().step(action)
            if self.steps == 40:  # in the third rollout, ahead in the second iteration
                os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(SystemExit):
        train(dataclasses.replace(cfg, iterations=100, save_interval=50), lambda n, *_: Signalled(n))
    (path,) = cfg.log_root.glob("push/*/checkpoints/iteration_000003.pt")
    assert load_checkpoint(path)["env"]["steps"] == 48
