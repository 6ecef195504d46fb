"""What PPO trains: actor, critic, exploration noise, and the running statistics that scale observations and values."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import nn

from jumper_warp.envs.vec_env import sanitise
from jumper_warp.rl.distributed import average_over_ranks, world_size
from jumper_warp.rl.mirror import Image, Symmetry, Weights
from jumper_warp.utils.normalise import normalise

NORMALISED_LIMIT = 10.0
"""The networks see observations within plus and minus this many standard deviations."""
EPS = 1.0e-5
"""Added to a variance before its root is taken."""
ACTIVATIONS = {"elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh}
"""Activations by the name that a configuration gives."""


Moments = tuple[torch.Tensor, torch.Tensor, int]
"""Mean and population variance of some columns, float64, and the number of samples."""


def joint_moments(own: Sequence[tuple[torch.Tensor, torch.Tensor]], size: int) -> list[Moments]:
    """Return the moments over all ranks' batches, all in one exchange.

    own: mean and population variance of each of some quantities over this rank's batch, of any shape; size: of the
    batch, the same on every rank. E[x²] - E[x]² loses nothing that counts in float64.
    """
    moments = [(mean.double(), var.double()) for mean, var in own]
    if world_size() > 1:
        vector = torch.cat([part.flatten() for mean, var in moments for part in (mean, var + mean.square())])
        parts = average_over_ranks(vector).split([mean.numel() for mean, _ in moments for _ in range(2)])
        pairs = zip(parts[::2], parts[1::2], moments, strict=True)
        moments = [(a.view_as(like), (b - a.square()).clamp(min=0.0).view_as(like)) for a, b, (like, _) in pairs]
    return [(mean, var, size * world_size()) for mean, var in moments]


def own_moments(x: torch.Tensor, rows: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mean and population variance over the first axis of this rank's batch (batch, ...).

    rows: taken at a time, in two passes, which takes a CPU a sixth of the time (default: all, in one).
    """
    if rows is None:
        var, mean = torch.var_mean(x, dim=0, correction=0)
        return mean, var
    mean = x.mean(0)
    return mean, torch.stack([(part - mean).square().sum(0) for part in x.split(rows)]).sum(0) / x.shape[0]


def gaussian_log_prob(x: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """Return the log density at x (..., n) of independent Gaussians of mean (..., n) and log_std (n,); (...)."""
    z = (x - mean) * torch.exp(-log_std)
    return (-0.5 * z.square() - log_std - 0.5 * math.log(2.0 * math.pi)).sum(-1)


def gaussian_kl(
    mean: torch.Tensor, log_std: torch.Tensor, new_mean: torch.Tensor, new_log_std: torch.Tensor
) -> torch.Tensor:
    """Return KL(old ‖ new) between independent Gaussians; means (..., n), log_std (n,); (...)."""
    ratio = (2.0 * (log_std - new_log_std)).exp()
    miss = ((mean - new_mean) * torch.exp(-new_log_std)).square()
    return (new_log_std - log_std + 0.5 * (ratio + miss - 1.0)).sum(-1)


class RunningMoments(nn.Module):
    """Mean and variance of everything seen so far, and the scaling by them. Starts as the identity."""

    mean: torch.Tensor
    var: torch.Tensor
    count: torch.Tensor

    def __init__(self, shape: Sequence[int] = ()) -> None:
        """shape: that of one sample; () for a scalar."""
        super().__init__()
        self.register_buffer("mean", torch.zeros(tuple(shape), dtype=torch.float64))
        self.register_buffer("var", torch.full(tuple(shape), 1.0 - EPS, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, x: torch.Tensor) -> None:
        """Take in a batch of finite samples (batch, *shape); those of the other ranks come with it, exactly."""
        self.take(joint_moments([own_moments(x)], x.shape[0])[0])

    @torch.no_grad()
    def take(self, moments: Moments) -> None:
        """Take in the moments of a batch of finite samples over all ranks."""
        mean, var, size = moments
        share = size / (self.count + size)
        delta = mean - self.mean
        self.var.lerp_(var, share).add_(delta.square() * share * (1.0 - share))
        self.mean.add_(delta * share)
        self.count.add_(size)

    def scaling(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and standard deviation, float32, of the sample's shape."""
        return self.mean.float(), self.scale()

    def scale(self) -> torch.Tensor:
        """Return the standard deviation, float32, of the sample's shape."""
        return (self.var + EPS).sqrt().float()

    def normalise(self, x: torch.Tensor) -> torch.Tensor:
        """Return (x - mean) / scale."""
        return (x - self.mean.float()) / self.scale()

    def restore(self, x: torch.Tensor) -> torch.Tensor:
        """Return x · scale + mean, the inverse of `normalise`."""
        return x * self.scale() + self.mean.float()


def mlp(sizes: Sequence[int], activation: str, out_gain: float) -> nn.Sequential:
    """Return linear layers of these sizes with activations between, orthogonal weights and zero biases."""
    layers: list[nn.Module] = []
    for index, (num_in, num_out) in enumerate(pairwise(sizes)):
        last = index == len(sizes) - 2
        linear = nn.Linear(num_in, num_out)
        nn.init.orthogonal_(linear.weight, out_gain if last else math.sqrt(2.0))
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, ACTIVATIONS[activation]()]
    return nn.Sequential(*layers)


def weights_of(network: nn.Module) -> Weights:
    """Return weight and bias of each linear layer of a network."""
    return [(module.weight, module.bias) for module in network.children() if isinstance(module, nn.Linear)]


class ActorCritic(nn.Module):
    """Two separate networks, each on its own normalised observation; the noise does not depend on the state."""

    def __init__(
        self,
        num_obs: int,
        num_actions: int,
        hidden: Sequence[int],
        activation: str = "elu",
        init_std: float = 1.0,
        num_critic_obs: int | None = None,
        symmetry: Symmetry | None = None,
    ) -> None:
        """num_obs, num_critic_obs (default: num_obs): entries of the observations of actor and critic.

        hidden: widths of the hidden layers of both networks. activation: a key of ACTIVATIONS. init_std: standard
        deviation of the noise on every action at the start. symmetry: of the policy, saved with the weights.
        """
        super().__init__()
        num_critic_obs = num_obs if num_critic_obs is None else num_critic_obs
        self.actor = mlp((num_obs, *hidden, num_actions), activation, out_gain=0.01)
        self.critic = mlp((num_critic_obs, *hidden, 1), activation, out_gain=1.0)
        self.log_std = nn.Parameter(torch.full((num_actions,), math.log(init_std)))
        self.obs_moments = RunningMoments((num_obs,))
        self.critic_moments = RunningMoments((num_critic_obs,))
        self.value_moments = RunningMoments()
        self._symmetric = symmetry is not None
        for name, image in symmetry._asdict().items() if symmetry is not None else ():
            self.register_buffer(f"mirror_{name}_order", image.order)
            self.register_buffer(f"mirror_{name}_signs", image.signs)

    @property
    def symmetry(self) -> Symmetry | None:
        """Symmetry of the policy, on the device of the weights."""
        if not self._symmetric:
            return None
        parts = [
            Image(*(getattr(self, f"mirror_{name}_{part}") for part in Image._fields)) for name in Symmetry._fields
        ]
        return Symmetry(*parts)

    def mean(self, features: torch.Tensor) -> torch.Tensor:
        """Return the policy's mean, (..., num_actions), for what the actor sees (..., num_obs)."""
        if (symmetry := self.symmetry) is None:
            return self.actor(features)
        return 0.5 * (self.actor(features) + symmetry.action.of(self.actor(symmetry.obs.of(features))))

    def features(self, obs: torch.Tensor) -> torch.Tensor:
        """Return what the actor sees of raw observations (..., num_obs): finite, scaled, within ±NORMALISED_LIMIT."""
        return _features(obs, self.obs_moments)

    def critic_features(self, critic_obs: torch.Tensor) -> torch.Tensor:
        """Return what the critic sees of its raw observations (..., num_critic_obs), likewise."""
        return _features(critic_obs, self.critic_moments)

    def value_head(self, critic_features: torch.Tensor) -> torch.Tensor:
        """Return the critic's output, in standard deviations of the return; (...)."""
        return self.critic(critic_features).squeeze(-1)

    def value(self, critic_obs: torch.Tensor) -> torch.Tensor:
        """Return the expected return from the critic's raw observations (..., num_critic_obs); (...)."""
        return self.value_moments.restore(self.value_head(self.critic_features(critic_obs)))

    @torch.no_grad()
    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the mean action clipped to ±1, (..., num_actions), for raw observations (..., num_obs)."""
        return self.mean(self.features(obs)).clamp(-1.0, 1.0)


def _features(obs: torch.Tensor, moments: RunningMoments) -> torch.Tensor:
    return normalise(sanitise(obs), *moments.scaling(), NORMALISED_LIMIT)
