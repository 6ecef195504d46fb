"""PPO's update against a reference with autograd, torch.optim.Adam and a loop over time."""

import dataclasses

import pytest
import torch

from jumper_warp.rl.cfg import PpoCfg
from jumper_warp.rl.networks import ActorCritic, gaussian_log_prob
from jumper_warp.rl.torch.ppo import Ppo
from ppo_oracle import reference_losses
from toy_task import PushTask, fill

CFG = PpoCfg(num_steps=8, epochs=3, minibatches=4, hidden=(16, 9), max_grad_norm=0.3, lr=3e-3)
WORLDS = 16


def reference_update(model, batch, old_log_std, orders, cfg):
    """Run Adam steps with clipped gradients for all minibatches; return the optimiser and each minibatch's losses.

    orders: (epochs, batch_size) indices of samples. Losses: `reference_losses`, then gradient norms of actor, critic.
    """
    actor, critic = [*model.actor.parameters(), model.log_std], list(model.critic.parameters())
    optimiser = torch.optim.Adam([*actor, *critic], lr=cfg.lr)
    history = []
    for order in orders:
        for samples in order.chunk(cfg.minibatches):
            part = {name: value[samples] for name, value in batch.items()}
            surrogate, value, entropy, kl = reference_losses(model, part, old_log_std, cfg)
            optimiser.zero_grad()
            loss = surrogate + cfg.value_coef * value - cfg.entropy_coef * entropy
            loss.backward()
            norms = [torch.nn.utils.clip_grad_norm_(each, cfg.max_grad_norm) for each in (actor, critic)]
            group = optimiser.param_groups[0]
            if kl > 2 * cfg.desired_kl:
                group["lr"] = max(group["lr"] / 1.5, cfg.min_lr)
            elif 1e-6 * cfg.desired_kl < kl < cfg.desired_kl / 2:
                group["lr"] = min(group["lr"] * 1.5, cfg.max_lr)
            optimiser.step()
            history.append([float(x.detach()) for x in (surrogate, value, entropy, kl, *norms)])
    return optimiser, history


def updated_ppo(cfg, device="cpu"):
    """Return PPO after an update on synthetic samples, the model before, the samples, their orders per epoch."""
    torch.manual_seed(0)
    ppo = Ppo(PushTask(WORLDS, device=device), cfg)
    fill(ppo, slice(None), WORLDS)
    torch.manual_seed(1)
    ppo.batch()  # running statistics other than the identity
    before = ActorCritic(2, 1, cfg.hidden, cfg.activation, num_critic_obs=3, symmetries=ppo.model.symmetries)
    before.load_state_dict(ppo.state_dict()["model"])
    torch.manual_seed(1)
    ppo.update()
    batch = {name: part.clone() for name, part in ppo.packer.layout.split(ppo.packer.rows)._asdict().items()}
    return ppo, before, batch, ppo._orders.clone()


@pytest.mark.parametrize("chunk_size", [1, 7, None])
def test_packed_rows_do_not_depend_on_the_chunk_size(chunk_size):
    torch.manual_seed(0)
    ppo = Ppo(PushTask(WORLDS), CFG)
    fill(ppo, slice(None), WORLDS)
    fresh = {name: value.clone() for name, value in ppo.model.state_dict().items()}
    ppo.batch()
    at_once = ppo.packer.rows.clone()
    ppo.model.load_state_dict(fresh)
    ppo.packer.rows.zero_()
    ppo.packer._chunk_size = chunk_size
    ppo.batch()
    torch.testing.assert_close(ppo.packer.rows, at_once, atol=1e-5, rtol=1e-5)
    assert at_once.abs().max() > 0.5


@pytest.mark.parametrize(
    "change",
    [{}, {"clip_value": False}, {"activation": "relu"}, {"activation": "tanh"}, {"clip": 0.02}, {"symmetry": "actor"}],
)
def test_update_agrees_with_autograd_and_adam(change):
    cfg = dataclasses.replace(CFG, **change)
    ppo, model, batch, orders = updated_ppo(cfg)
    optimiser, history = reference_update(model, batch, ppo.rollout.log_std, orders, cfg)
    ours = dict(ppo.model.named_parameters())
    for name, param in model.named_parameters():
        torch.testing.assert_close(ours[name], param, atol=2e-5, rtol=1e-4, msg=name)
    metrics = ppo.statistics()
    means = torch.tensor(history).mean(0).tolist()
    names = ("surrogate", "value", "entropy", "kl", "gradient_actor", "gradient_critic")
    for name, mean in zip(names, means, strict=True):
        assert metrics[f"Loss/{name}"] == pytest.approx(mean, rel=1e-3, abs=1e-5), name
    assert metrics["Loss/learning_rate"] == pytest.approx(optimiser.param_groups[0]["lr"])
    assert max(row[4] for row in history) > cfg.max_grad_norm  # some gradients of the actor were clipped
    their_state = optimiser.state_dict()["state"]
    for index, state in ppo.optimiser.state_dict().items():
        for name in ("step", "exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(state[name], their_state[index][name], atol=2e-5, rtol=1e-3)


def test_samples_agree_with_a_loop_over_time():
    ppo, model, batch, _ = updated_ppo(CFG)
    rollout, cfg = ppo.rollout, CFG

    with torch.no_grad():
        values, final_values = model.value(rollout.critic_obs), model.value(rollout.final_critic_obs)
    next_advantage, advantages = torch.zeros(WORLDS), []
    for step in reversed(range(cfg.num_steps)):
        alive = 1 - rollout.done[step]
        reward = rollout.reward[step] + cfg.gamma * rollout.timeout[step] * final_values[step]
        delta = reward + cfg.gamma * alive * values[step + 1] - values[step]
        next_advantage = delta + cfg.gamma * cfg.lam * alive * next_advantage
        advantages.insert(0, next_advantage)
    advantage = torch.stack(advantages).flatten()
    close = {"atol": 1e-5, "rtol": 1e-4}
    torch.testing.assert_close(batch["advantage"], (advantage - advantage.mean()) / advantage.std(), **close)
    returns = advantage + values[:-1].flatten()
    torch.testing.assert_close(ppo.model.value_moments.scaling().denormalise(batch["target"]), returns, **close)
    torch.testing.assert_close(batch["features"], model.features(rollout.obs[:-1]).flatten(0, 1), **close)
    critic_features = model.critic_features(rollout.critic_obs[:-1])
    torch.testing.assert_close(batch["critic_features"], critic_features.flatten(0, 1), **close)
    head = model.value_head(critic_features).flatten().detach()
    torch.testing.assert_close(batch["value"], head, **close)
    log_prob = gaussian_log_prob(rollout.action, rollout.mean, rollout.log_std).flatten()
    torch.testing.assert_close(batch["log_prob"], log_prob, **close)
