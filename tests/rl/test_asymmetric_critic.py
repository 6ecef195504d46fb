import dataclasses

import pytest
import torch

from jumper_warp.rl.torch.ppo import Ppo
from toy_task import SMALL, PushTask, fill

SHORT = dataclasses.replace(SMALL, num_steps=8)


def test_actor_and_critic_get_their_own_observations():
    ppo = Ppo(PushTask(4, episode_length=3), SHORT)
    ppo.env.reset()
    ppo.collect()
    obs, critic_obs, final = ppo.rollout.obs, ppo.rollout.critic_obs, ppo.rollout.final_critic_obs
    assert torch.equal(critic_obs, torch.cat([obs, obs[..., :1].abs()], dim=-1))
    assert torch.equal(critic_obs[3, :, :2], ppo.env.start)  # an episode has 3 steps, so a new one has begun
    assert torch.equal(final[:2], critic_obs[1:3])
    torch.testing.assert_close(final[2, :, 0], critic_obs[2, :, 0] + 0.2 * final[2, :, 1])  # end of the old episode


def test_actor_and_critic_get_their_own_statistics():
    ppo = Ppo(PushTask(16), SHORT)
    fill(ppo, slice(None), 16)
    ppo.batch()
    batch = ppo.batch()  # normalised with the statistics after the first call
    obs, critic_obs = ppo.rollout.obs[:-1].flatten(0, 1), ppo.rollout.critic_obs[:-1].flatten(0, 1)
    for features, raw in ((batch.features, obs), (batch.critic_features, critic_obs)):
        torch.testing.assert_close(features, (raw - raw.mean(0)) / raw.std(0, correction=0), atol=1e-4, rtol=1e-4)


def test_critic_without_privileged_observation_gets_the_actors_observation():
    ppo = Ppo(PushTask(4, episode_length=3), dataclasses.replace(SHORT, asymmetric_critic=False))
    ppo.env.reset()
    ppo.collect()
    assert torch.equal(ppo.rollout.critic_obs, ppo.rollout.obs)
    assert torch.equal(ppo.rollout.final_critic_obs[-1], ppo.env.final_obs)


class HiddenRewardTask(PushTask):
    """Task whose odd worlds give a reward of 1 per step, which only the critic observes."""

    def show_critic(self, critic_obs, obs):
        """Write the critic's observation of `obs`, with the reward in place of the distance."""
        super().show_critic(critic_obs, obs)
        critic_obs[:, 2] = torch.arange(self.num_envs) % 2

    def step(self, action):
        """Step the task, and overwrite its reward."""
        super().step(action)
        self.reward.copy_(self.critic_obs[:, 2])


@pytest.mark.parametrize("asymmetric_critic", [True, False])
def test_only_an_asymmetric_critic_learns_a_value_hidden_from_the_actor(asymmetric_critic):
    torch.manual_seed(0)
    cfg = dataclasses.replace(SMALL, gamma=0.5, lam=0.0, asymmetric_critic=asymmetric_critic)
    ppo = Ppo(HiddenRewardTask(128), cfg)
    ppo.env.reset()
    for _ in range(20):
        ppo.collect()
        ppo.update()
    with torch.no_grad():
        value = ppo.model.value(ppo.rollout.critic_obs).mean(0)
    difference = (value[1::2].mean() - value[::2].mean()).item()
    # A reward of 1 per step, times reward_scale 0.6, has the value 0.6 / (1 - gamma) = 1.2.
    assert difference == pytest.approx(1.2 if asymmetric_critic else 0.0, abs=0.1)
