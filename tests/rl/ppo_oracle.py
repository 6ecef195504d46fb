"""PPO's losses with autograd and torch.distributions, an oracle of the hand-written gradients."""

import torch


def averaged(act, mirror):
    """Return the policy (act(x) + N act(M x)) / 2, in the notation of `jumper_warp.rl.mirror`."""
    return lambda x: 0.5 * (act(x) + mirror.action.apply(act(mirror.obs.apply(x))))


def reference_losses(model, part, old_log_std, cfg):
    """Return surrogate, value loss, entropy and KL divergence, each (), by torch.distributions.

    part: a minibatch, (samples, ...) by the fields of `Batch`. old_log_std: (num_actions,) of the policy that acted.
    """
    means = model.actor
    for mirror in model.symmetries:
        means = averaged(means, mirror)
    mean = means(part["features"])
    policy = torch.distributions.Normal(mean, model.log_std.exp())
    old = torch.distributions.Normal(part["mean"], old_log_std.exp())
    ratio = (policy.log_prob(part["action"]) - old.log_prob(part["action"])).sum(-1).exp()
    clipped = ratio.clamp(1 - cfg.clip, 1 + cfg.clip)
    surrogate = -torch.min(ratio * part["advantage"], clipped * part["advantage"]).mean()
    value = model.critic(part["critic_features"])[:, 0]
    loss = (value - part["target"]) ** 2
    if cfg.clip_value:
        clipped_value = part["value"] + (value - part["value"]).clamp(-cfg.clip, cfg.clip)
        loss = torch.max(loss, (clipped_value - part["target"]) ** 2)
    entropy = policy.entropy()[0].sum()
    kl = torch.distributions.kl_divergence(old, policy).sum(-1).mean()
    return surrogate, loss.mean(), entropy, kl.detach()
