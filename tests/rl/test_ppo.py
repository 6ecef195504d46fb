import dataclasses

import pytest
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.flat import adapted_lr
from jumper_warp.rl.learner import STATISTICS
from jumper_warp.rl.samples import Batch
from jumper_warp.rl.torch.ppo import Ppo
from toy_task import SMALL, PushTask, fill, free_port, local_order, update_half

PLAIN = PpoCfg(
    num_steps=8, epochs=1, minibatches=1, hidden=(16, 8), normalise_value=False, reward_scale=1.0, max_grad_norm=1e9
)


def groups(obs, critic_obs):
    """Return observations (num_envs, n) of actor and critic as rsl-rl's observation groups."""
    return TensorDict({"actor": obs, "critic": critic_obs}, batch_size=[obs.shape[0]])


def as_rsl_rl(ppo):
    """Return rsl-rl's PPO with the weights and settings of our PPO."""
    cfg, env, ours = ppo.cfg, ppo.env, ppo.model
    obs = groups(torch.zeros(env.num_envs, 2), torch.zeros(env.num_envs, 3))
    sets = {"actor": ["actor"], "critic": ["critic"]}
    noise = {"class_name": "GaussianDistribution", "init_std": cfg.init_std, "std_type": "log"}
    actor = MLPModel(obs, sets, "actor", 1, cfg.hidden, "elu", distribution_cfg=noise)
    critic = MLPModel(obs, sets, "critic", 1, cfg.hidden, "elu")
    theirs = PPO(
        actor, critic, RolloutStorage("rl", env.num_envs, cfg.num_steps, obs, [1]), num_learning_epochs=1,
        num_mini_batches=1, gamma=cfg.gamma, lam=cfg.lam, value_loss_coef=cfg.value_coef, max_grad_norm=1e9,
        entropy_coef=cfg.entropy_coef, schedule="adaptive", desired_kl=cfg.desired_kl, learning_rate=cfg.lr,
    )  # fmt: skip
    copy_weights(ours, theirs)
    return theirs


def copy_weights(ours, theirs):
    """Copy actor, critic and noise of our model to rsl-rl's PPO."""
    theirs.actor.mlp.load_state_dict(ours.actor.state_dict())
    theirs.critic.mlp.load_state_dict(ours.critic.state_dict())
    theirs.actor.distribution.log_std_param.data.copy_(ours.log_std.data)


def feed(theirs, rollout):
    """Store our rollout in rsl-rl's PPO, and compute its returns."""
    for step in range(rollout.reward.shape[0]):
        obs = groups(rollout.obs[step], rollout.critic_obs[step])
        theirs.act(obs)
        transition = theirs.transition
        transition.actions = rollout.action[step]
        transition.actions_log_prob = theirs.actor.get_output_log_prob(rollout.action[step]).detach()
        theirs.process_env_step(obs, rollout.reward[step], rollout.done[step], {})
    theirs.compute_returns(groups(rollout.obs[-1], rollout.critic_obs[-1]))


def test_update_agrees_with_rsl_rl():
    """Returns, advantages, losses, gradients and the adapted rate are equal after one update on the same samples.

    The weights differ from the weights that acted, so that the probability ratio is not 1.
    """
    torch.manual_seed(0)
    ppo = Ppo(PushTask(16), PLAIN)
    fill(ppo, slice(None), 16)
    ppo.rollout.timeout.zero_()
    theirs = as_rsl_rl(ppo)
    feed(theirs, ppo.rollout)
    batch = Batch(*(part.clone() for part in ppo.batch()))
    with torch.no_grad():
        for param in ppo.model.parameters():
            param.add_(0.1 * torch.randn_like(param))
    copy_weights(ppo.model, theirs)
    their_losses = theirs.update()
    ppo.minibatch_step(ppo.packer.rows)
    statistics = ppo.statistics()
    close = {"atol": 1e-5, "rtol": 1e-5}
    torch.testing.assert_close(batch.target, theirs.storage.returns.flatten(), **close)
    torch.testing.assert_close(batch.advantage, theirs.storage.advantages.flatten(), **close)
    for name in ("surrogate", "value", "entropy"):
        assert statistics[f"Loss/{name}"] == pytest.approx(their_losses[name], abs=1e-5, rel=1e-5)
    pairs = [(ppo.model.log_std, theirs.actor.distribution.log_std_param)]
    for ours, other in ((ppo.model.actor, theirs.actor.mlp), (ppo.model.critic, theirs.critic.mlp)):
        pairs += zip(ours.parameters(), other.parameters(), strict=True)
    for param, their_param in pairs:
        torch.testing.assert_close(param.grad, their_param.grad, **close)
    assert ppo.flat.gradient.norm() > 0.1
    assert statistics["Loss/kl"] > 0.02  # above twice desired_kl, so the rate changes
    assert ppo.lr.item() == pytest.approx(theirs.learning_rate)


@pytest.mark.parametrize(
    ("lr", "kl", "desired", "expected"),
    [
        (1e-3, 0.021, 0.01, 1e-3 / 1.5),  # above 0.02
        (1e-3, 0.004, 0.01, 1.5e-3),  # below 0.005
        (1e-3, 0.010, 0.01, 1e-3),  # between
        (1e-3, 0.0, 0.01, 1e-3),  # no information
        (1.2e-5, 1.0, 0.01, 1e-5),  # lower bound
        (9e-3, 0.001, 0.01, 1e-2),  # upper bound
        (1e-3, float("nan"), 0.01, 1e-3),
        (1e-3, 9.0, 0.0, 1e-3),  # a fixed rate
    ],
)
def test_learning_rate_adapts_to_the_kl_divergence(lr, kl, desired, expected):
    result = adapted_lr(torch.tensor(lr), torch.tensor(kl), PpoCfg(desired_kl=desired, min_lr=1.0e-5), desired)
    assert result.item() == pytest.approx(expected)


def test_training_learns_to_push_the_mass_to_the_origin_and_its_return():
    torch.manual_seed(1)
    ppo, history = Ppo(PushTask(128), SMALL), []
    ppo.env.reset()
    for _ in range(30):
        ppo.collect()
        ppo.update()
        history.append(ppo.statistics())
    # a mass that stays at the origin gets the scaled reward 0.6 in every step: 0.6 / (1 - 0.985) = 40
    expected = 40.0 * history[-2]["Train/mean_reward"] / 50.0
    with torch.no_grad():
        head = ppo.model.value_head(ppo.model.critic_features(ppo.rollout.critic_obs))
        value = ppo.model.value(ppo.rollout.critic_obs)
    assert value.mean().item() == pytest.approx(expected, rel=0.1)
    assert head.abs().max() < 5.0
    returns = [metrics["Train/mean_reward"] for metrics in history if "Train/mean_reward" in metrics]
    assert returns[0] < 25.0
    assert returns[-1] > 44.0  # the maximum is 1 for each of 50 steps
    env = ppo.env
    env.reset()
    for _ in range(40):
        env.step(ppo.model.act(env.obs))
    assert env.obs[:, 0].abs().max() < 0.2  # distance from the origin


class DivergingTask(PushTask):
    """Task whose worlds 0 and 1 have rewards that are not finite."""

    def step(self, action):
        """Step the task, and write NaN and infinity to two rewards."""
        super().step(action)
        self.reward[:2] = torch.tensor([float("nan"), float("inf")])


def test_rewards_that_are_not_finite_reach_neither_networks_nor_statistics():
    torch.manual_seed(0)
    ppo = Ppo(DivergingTask(128), SMALL)
    ppo.env.reset()
    for _ in range(3):
        ppo.collect()
        ppo.update()
    assert ppo.rollout.reward.isfinite().all()
    assert all(value.isfinite().all() for value in ppo.model.state_dict().values())
    assert ppo.model.features(torch.full((1, 2), 1e30)).abs().max() <= 10.0
    assert ppo.model.critic_features(torch.full((1, 3), 1e30)).abs().max() <= 10.0
    assert ppo.statistics()["Loss/skipped"] == 0.0


def test_non_finite_gradient_changes_no_parameter():
    ppo = Ppo(PushTask(16), PLAIN)
    fill(ppo, slice(None), 16)
    batch = ppo.batch()
    before = {name: value.clone() for name, value in ppo.model.named_parameters()}
    batch.advantage.mul_(float("nan"))
    batch.target.mul_(float("inf"))
    assert ppo.minibatch_step(ppo.packer.rows).skipped == 1.0
    assert all(torch.equal(value, before[name]) for name, value in ppo.model.named_parameters())
    assert ppo.statistics()["Loss/skipped"] == 1.0


def test_update_of_two_ranks_agrees_with_one_rank_with_all_worlds(tmp_path):
    cfg = PpoCfg(num_steps=8, epochs=2, minibatches=2, hidden=(16, 8))
    processes = torch.multiprocessing.spawn(
        update_half, (free_port(), cfg, str(tmp_path / "half")), nprocs=2, join=False
    )
    torch.manual_seed(0)
    whole = Ppo(PushTask(8), cfg)
    fill(whole, slice(None), 8)
    orders = [local_order(rank, 32).chunk(2) for rank in range(2)]
    parts = [
        order // 4 * 8 + order % 4 + 4 * rank  # rank's sample of 4 worlds to the sample of all 8 worlds, time-major
        for pair in zip(*orders, strict=True) for rank, order in enumerate(pair)
    ]  # fmt: skip
    whole.order = lambda: torch.cat(parts)
    whole.set_progress(0.7)
    start = {name: value.clone() for name, value in whole.model.state_dict().items()}
    whole.update()
    while not processes.join():
        pass
    expected = whole.state_dict()
    for rank in range(2):
        result = torch.load(tmp_path / f"half{rank}", weights_only=True)
        for name, value in expected["model"].items():
            torch.testing.assert_close(result["model"][name], value, atol=1e-5, rtol=1e-5, msg=name)
            assert not torch.equal(value, start[name]), name
        torch.testing.assert_close(result["lr"], expected["lr"])
        torch.testing.assert_close(result["desired_kl"], whole._desired_kl)


FLOAT32_COUNT_LIMIT = 2.0**24
"""Largest count in float32: adding 1 changes nothing."""


def test_counters_are_exact_beyond_the_range_of_float32():
    ppo = Ppo(PushTask(1, episode_length=5), dataclasses.replace(PLAIN, num_steps=16, epochs=1, minibatches=1))
    ppo.env.reset()
    for count in (ppo.collector.episode, ppo.collector.finished, ppo._sums):
        count.fill_(FLOAT32_COUNT_LIMIT)
    ppo.collect()
    ppo.update()
    lengths, number = ppo.collector.finished[1:, 0].tolist()
    assert (lengths, number) == (2.0 * FLOAT32_COUNT_LIMIT + 15.0, FLOAT32_COUNT_LIMIT + 3.0)  # of three episodes
    assert ppo.collector.episode[1].tolist() == [1.0]
    assert ppo._sums[-1].item() == FLOAT32_COUNT_LIMIT + 1.0
    sums = [ppo._sums[STATISTICS.index(name)].item() for name in ("entropy", "skipped")]
    entropy, skipped = (value - FLOAT32_COUNT_LIMIT for value in sums)
    assert 0.0 < abs(entropy) < 10.0 and entropy != round(entropy) and skipped == 0.0


def noise_gradient(ppo, progress):
    """Return the gradient by log_std, (num_actions,), at a progress 0 to 1; the learning rate is 0."""
    ppo.set_progress(progress)
    ppo.lr.zero_()
    ppo.minibatch_step(ppo.packer.rows)
    return ppo.model.log_std.grad.clone()


@pytest.mark.parametrize(("final", "late"), [(0.004, 0.012), (None, 0.02)])
def test_entropy_bonus_decays_over_the_second_half(final, late):
    torch.manual_seed(0)
    ppo = Ppo(PushTask(16), dataclasses.replace(PLAIN, entropy_coef=0.02, final_entropy_coef=final))
    fill(ppo, slice(None), 16)
    ppo.batch()
    first, half = noise_gradient(ppo, 0.0), noise_gradient(ppo, 0.5)
    torch.testing.assert_close(half, first, atol=0.0, rtol=0.0)
    for progress, coefficient in ((0.75, late), (1.0, 0.02 if final is None else final)):
        expected = first + 0.02 - coefficient  # the bonus's own gradient is -coefficient
        torch.testing.assert_close(noise_gradient(ppo, progress), expected, atol=1e-6, rtol=0.0)


def test_refuses_minibatches_that_do_not_divide_the_batch():
    with pytest.raises(ValueError, match="7 minibatches do not divide 8 x 16"):
        Ppo(PushTask(16), dataclasses.replace(PLAIN, minibatches=7))
