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
from jumper_warp.rl.samples import Batch, gae
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


@pytest.fixture(scope="module")
def pair():
    """Return our PPO and batch, rsl-rl's PPO and losses, and our statistics, after one update on the same samples.

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
    return ppo, batch, theirs, their_losses, ppo.statistics()


def test_returns_and_advantages_agree_with_rsl_rl(pair):
    _, batch, theirs, _, _ = pair
    torch.testing.assert_close(batch.target, theirs.storage.returns.flatten(), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(batch.advantage, theirs.storage.advantages.flatten(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", ["surrogate", "value", "entropy"])
def test_losses_agree_with_rsl_rl(pair, name):
    _, _, _, their_losses, ours = pair
    assert ours[f"Loss/{name}"] == pytest.approx(their_losses[name], abs=1e-5, rel=1e-5)


def test_gradients_agree_with_rsl_rl(pair):
    ppo, _, theirs, _, _ = pair
    ours = {**dict(ppo.model.actor.named_parameters()), "noise": ppo.model.log_std}
    their_actor = {**dict(theirs.actor.mlp.named_parameters()), "noise": theirs.actor.distribution.log_std_param}
    for name, param in ours.items():
        torch.testing.assert_close(param.grad, their_actor[name].grad, atol=1e-5, rtol=1e-5)
    for param, their_param in zip(ppo.model.critic.parameters(), theirs.critic.mlp.parameters(), strict=True):
        torch.testing.assert_close(param.grad, their_param.grad, atol=1e-5, rtol=1e-5)
    assert ppo.flat.gradient.norm() > 0.1


def test_adapted_learning_rate_agrees_with_rsl_rl(pair):
    ppo, _, theirs, _, statistics = pair
    assert statistics["Loss/kl"] > 0.02  # above twice desired_kl, so the rate changes
    assert ppo.lr.item() == pytest.approx(theirs.learning_rate)


def test_gae_agrees_with_hand_calculation():
    # The second step ends an episode. delta: 1 + 0.5*4 - 2 = 1;  2 - 4 = -2;  3 + 0.5*8 - 6 = 1.
    # Advantage: 1 - 0.25*2 = 0.5; -2; 1. Return: advantage + value.
    reward, done = torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([[0.0], [1.0], [0.0]])
    advantage, returns = gae(reward, done, value=torch.tensor([[2.0], [4.0], [6.0], [8.0]]), gamma=0.5, lam=0.5)
    assert advantage.flatten().tolist() == [0.5, -2.0, 1.0]
    assert returns.flatten().tolist() == [2.5, 2.0, 7.0]


def test_timeout_adds_the_value_of_the_final_observation():
    cfg = dataclasses.replace(PLAIN, num_steps=1, gamma=0.5)
    ppo = Ppo(PushTask(2), cfg)
    for linear in ppo.model.critic[:-1:2]:
        torch.nn.init.zeros_(linear.weight)
    torch.nn.init.constant_(ppo.model.critic[-1].bias, 10.0)  # every state has value 10
    ppo.rollout.reward.copy_(torch.tensor([[1.0, 1.0]]))
    ppo.rollout.done.copy_(torch.tensor([[1.0, 1.0]]))
    ppo.rollout.timeout.copy_(torch.tensor([[0.0, 1.0]]))
    assert ppo.batch().target.tolist() == pytest.approx([1.0, 6.0])  # 1 and 1 + 0.5 * 10


def test_timeout_uses_the_final_observation_of_the_old_episode():
    ppo = Ppo(PushTask(2), dataclasses.replace(PLAIN, num_steps=1))
    ppo.rollout.done.fill_(1.0)
    ppo.rollout.timeout.fill_(1.0)
    ppo.rollout.critic_obs[1] = 7.0  # first observation of the new episode
    ppo.rollout.final_critic_obs.copy_(torch.tensor([[[0.5, -0.5, 3.0], [2.0, 1.0, 0.0]]]))
    expected = PLAIN.gamma * ppo.model.value(ppo.rollout.final_critic_obs[0])
    torch.testing.assert_close(ppo.batch().target, expected.detach())


@pytest.mark.parametrize(
    ("lr", "kl", "expected"),
    [
        (1e-3, 0.021, 1e-3 / 1.5),  # above 0.02
        (1e-3, 0.004, 1.5e-3),  # below 0.005
        (1e-3, 0.010, 1e-3),  # between
        (1e-3, 0.0, 1e-3),  # no information
        (1.2e-5, 1.0, 1e-5),  # lower bound
        (9e-3, 0.001, 1e-2),  # upper bound
        (1e-3, float("nan"), 1e-3),
    ],
)
def test_learning_rate_adapts_to_the_kl_divergence(lr, kl, expected):
    result = adapted_lr(torch.tensor(lr), torch.tensor(kl), PpoCfg(desired_kl=0.01, min_lr=1.0e-5), 0.01)
    assert result.item() == pytest.approx(expected)


def test_learning_rate_is_fixed_without_desired_kl():
    cfg = PpoCfg(desired_kl=0.0)
    assert adapted_lr(torch.tensor(1e-3), torch.tensor(9.0), cfg, 0.0).item() == pytest.approx(1e-3)


def trained(iterations):
    """Return PPO after some iterations on 128 worlds, and the statistics of each iteration."""
    torch.manual_seed(1)
    ppo = Ppo(PushTask(128), SMALL)
    ppo.env.reset()
    history = []
    for _ in range(iterations):
        ppo.collect()
        ppo.update()
        history.append(ppo.statistics())
    return ppo, history


def test_training_learns_to_push_the_mass_to_the_origin():
    ppo, history = trained(30)
    returns = [metrics["Train/mean_reward"] for metrics in history if "Train/mean_reward" in metrics]
    assert returns[0] < 25.0
    assert returns[-1] > 44.0  # the maximum is 1 for each of 50 steps
    env = ppo.env
    env.reset()
    for _ in range(40):
        env.step(ppo.model.act(env.obs))
    assert env.obs[:, 0].abs().max() < 0.2  # distance from the origin


def test_critic_learns_the_normalised_return():
    ppo, history = trained(30)
    # A mass that stays at the origin gets the scaled reward 0.6 in every step: 0.6 / (1 - 0.985) = 40.
    expected = 40.0 * history[-2]["Train/mean_reward"] / 50.0
    with torch.no_grad():
        head = ppo.model.value_head(ppo.model.critic_features(ppo.rollout.critic_obs))
        value = ppo.model.value(ppo.rollout.critic_obs)
    assert value.mean().item() == pytest.approx(expected, rel=0.1)
    assert head.abs().max() < 5.0


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


def test_load_state_dict_resumes_bitwise():
    ppo, _ = trained(2)
    torch.manual_seed(99)
    other = Ppo(PushTask(128), SMALL)
    other.load_state_dict(ppo.state_dict())
    for each in (ppo, other):
        torch.manual_seed(5)
        each.generator.manual_seed(6)
        each.env.reset()
        each.collect()
        each.update()
    ours, theirs = ppo.model.state_dict(), other.model.state_dict()
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gamma": 1.5}, "gamma must be in"),
        ({"num_steps": 0}, "num_steps must be in 1 to 10000, got 0"),
        ({"lr": 1.0}, "min_lr <= lr <= max_lr"),
        ({"hidden": ()}, "hidden must name"),
        ({"activation": "gelu"}, "activation must be one of elu, relu, tanh, got 'gelu'"),
        ({"clip": float("nan")}, "clip must be in 1e-06 to 100, got nan"),
    ],
)
def test_refuses_settings_out_of_range(change, message):
    with pytest.raises(ValueError, match=message):
        PpoCfg(**change)


def test_refuses_minibatches_that_do_not_divide_the_batch():
    with pytest.raises(ValueError, match="7 minibatches do not divide 8 x 16"):
        Ppo(PushTask(16), dataclasses.replace(PLAIN, minibatches=7))
