"""Actor, critic, exploration noise, and the running statistics that normalise observations and values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import nn

from jumper_warp.rl.distributed import all_reduce_mean, world_size
from jumper_warp.rl.mirror import MirrorMap, Symmetries, Symmetry, Weights, symmetries_in
from jumper_warp.utils.normalise import normalise

NORMALISED_LIMIT = 10.0  # Normalised observations are clipped to ± this many standard deviations
VARIANCE_EPS = 1.0e-5  # Constant added to a variance under the square root
ACTIVATIONS = {"elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh}  # Activation modules by `PpoCfg.activation`


class Moments(NamedTuple):
    """Mean, population variance and count of a batch of samples; mean and variance have the shape of one sample."""

    mean: torch.Tensor
    var: torch.Tensor  # population variance (divided by count, not count - 1)
    count: int  # number of samples

    @staticmethod
    def from_samples(x: torch.Tensor, chunk_size: int | None = None) -> Moments:
        """Return mean, population variance and count over the first axis of x (batch, ...).

        chunk_size: rows per chunk, in two passes, six times as fast on a CPU (default: all rows, in one pass). Squared
        differences from the mean do not cancel, unlike the mean square minus the squared mean.
        """
        if chunk_size is None:
            var, mean = torch.var_mean(x, dim=0, correction=0)
        else:
            mean = x.mean(0)
            squares = [(chunk - mean).square().sum(0) for chunk in x.split(chunk_size)]
            var = torch.stack(squares).sum(0) / x.shape[0]
        return Moments(mean, var, x.shape[0])


class Scaling(NamedTuple):
    """Normalisation of samples by a mean and a standard deviation, float32, each of one sample's shape."""

    mean: torch.Tensor
    std: torch.Tensor

    def normalise(self, x: torch.Tensor) -> torch.Tensor:
        """Return x normalised: (x - mean) / std."""
        return (x - self.mean) / self.std

    def denormalise(self, x: torch.Tensor) -> torch.Tensor:
        """Return normalised values x in their original unit: x · std + mean."""
        return x * self.std + self.mean

    def features(self, obs: torch.Tensor) -> torch.Tensor:
        """Return observations (..., n) normalised, and clipped to ±NORMALISED_LIMIT."""
        return normalise(obs, self.mean, self.std, NORMALISED_LIMIT)


def all_reduce_moments(local: Sequence[Moments]) -> list[Moments]:
    """Combine the moments of each quantity over the batches of all ranks, in one all-reduce; return them in float64.

    local: moments of quantities of any shape over this rank's batch, which has the same size on every rank. In float64
    the cancellation in E[x²] - E[x]² is negligible.
    """
    moments = [(mean.double(), var.double()) for mean, var, _ in local]
    if world_size() > 1:
        vector = torch.cat([part.flatten() for mean, var in moments for part in (mean, var + mean.square())])
        parts = all_reduce_mean(vector).split([mean.numel() for mean, _ in moments for _ in range(2)])
        pairs = zip(parts[::2], parts[1::2], moments, strict=True)
        moments = [(a.view_as(like), (b - a.square()).clamp(min=0.0).view_as(like)) for a, b, (like, _) in pairs]
    return [Moments(*pair, each.count * world_size()) for pair, each in zip(moments, local, strict=True)]


def gaussian_log_prob(x: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """Return the log density (...) of independent Gaussians at x (..., n), with mean (..., n) and log_std (n,)."""
    z = (x - mean) * torch.exp(-log_std)
    return (-0.5 * z.square() - log_std - 0.5 * math.log(2.0 * math.pi)).sum(-1)


def gaussian_kl(
    mean: torch.Tensor, log_std: torch.Tensor, new_mean: torch.Tensor, new_log_std: torch.Tensor
) -> torch.Tensor:
    """Return the KL divergence from old to new independent Gaussians [nat], KL(old ‖ new), (...).

    means: (..., n); log_std: (n,).
    """
    var_ratio = (2.0 * (log_std - new_log_std)).exp()
    mean_term = ((mean - new_mean) * torch.exp(-new_log_std)).square()
    return (new_log_std - log_std + 0.5 * (var_ratio + mean_term - 1.0)).sum(-1)


class RunningMoments(nn.Module):
    """Running mean and variance of all samples so far, in float64; before the first sample, scaling has no effect."""

    mean: torch.Tensor  # shape of one sample
    var: torch.Tensor  # shape of one sample, population variance
    count: torch.Tensor  # () number of samples

    def __init__(self, shape: Sequence[int] = ()) -> None:
        """Create running moments without samples; shape: that of one sample, () for a scalar."""
        super().__init__()
        self.register_buffer("mean", torch.zeros(tuple(shape), dtype=torch.float64))
        self.register_buffer("var", torch.full(tuple(shape), 1.0 - VARIANCE_EPS, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, x: torch.Tensor) -> None:
        """Update mean and variance with a batch of finite samples (batch, *shape) of every rank."""
        self.update_from_moments(all_reduce_moments([Moments.from_samples(x)])[0])

    @torch.no_grad()
    def update_from_moments(self, moments: Moments) -> None:
        """Update mean and variance with the moments of a batch of finite samples, combined over all ranks."""
        mean, var, size = moments
        weight = size / (self.count + size)
        delta = mean - self.mean
        self.var.lerp_(var, weight).add_(delta.square() * weight * (1.0 - weight))
        self.mean.add_(delta * weight)
        self.count.add_(size)

    def scaling(self) -> Scaling:
        """Return the normalisation by the running mean and standard deviation, float32."""
        return Scaling(self.mean.float(), (self.var + VARIANCE_EPS).sqrt().float())


def mlp(sizes: Sequence[int], activation: str, out_gain: float) -> nn.Sequential:
    """Return a multilayer perceptron with orthogonal weights and zero biases; no activation after the last layer.

    sizes: widths of input, hidden layers and output. activation: a key of ACTIVATIONS. out_gain: of the last layer.
    """
    layers: list[nn.Module] = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # so that the last digits of orthogonal weights do not depend on it
    for index, (num_in, num_out) in enumerate(pairwise(sizes)):
        last = index == len(sizes) - 2
        linear = nn.Linear(num_in, num_out)
        nn.init.orthogonal_(linear.weight, out_gain if last else math.sqrt(2.0))
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, ACTIVATIONS[activation]()]
    torch.set_num_threads(threads)
    return nn.Sequential(*layers)


def linear_layers(network: nn.Module) -> Weights:
    """Return weight (out, in) and bias (out,) of each linear layer of a network."""
    return [(module.weight, module.bias) for module in network.children() if isinstance(module, nn.Linear)]


class ActorCritic(nn.Module):
    """Actor and critic as separate networks with normalised observations, and state-independent exploration noise."""

    def __init__(
        self, num_obs: int, num_actions: int, hidden: Sequence[int], activation: str = "elu", init_std: float = 1.0,
        num_critic_obs: int | None = None, symmetries: Symmetries = (),
    ) -> None:  # fmt: skip
        """Create actor and critic with random weights and without observation statistics.

        num_obs, num_critic_obs (default: num_obs): sizes of the observations of actor and critic. hidden: widths of
        the hidden layers of both networks. activation: a key of ACTIVATIONS. init_std: initial standard deviation of
        the noise on every action. symmetries: of the policy.
        """
        super().__init__()
        num_critic_obs = num_obs if num_critic_obs is None else num_critic_obs
        self.actor = mlp((num_obs, *hidden, num_actions), activation, out_gain=0.01)
        self.critic = mlp((num_critic_obs, *hidden, 1), activation, out_gain=1.0)
        self.log_std = nn.Parameter(torch.full((num_actions,), math.log(init_std)))
        self.obs_moments = RunningMoments((num_obs,))
        self.critic_moments = RunningMoments((num_critic_obs,))
        self.value_moments = RunningMoments()
        for name in Symmetry._fields if symmetries else ():
            for part in MirrorMap._fields:
                maps = [getattr(getattr(each, name), part) for each in symmetries]
                self.register_buffer(f"mirror_{name}_{part}", torch.stack(maps))

    @property
    def symmetries(self) -> Symmetries:
        """Mirror maps of the policy, on the device of the weights."""
        return symmetries_in(dict(self.named_buffers(recurse=False)))

    def mean(self, features: torch.Tensor) -> torch.Tensor:
        """Return the policy's mean action, (..., num_actions), for normalised observations (..., num_obs)."""
        symmetries, x = self.symmetries, features[None]
        for each in symmetries:
            x = torch.cat([x, each.obs.apply(x)])
        mean = self.actor(x)
        for each in reversed(symmetries):
            direct, image = mean.chunk(2)
            mean = 0.5 * (direct + each.action.apply(image))
        return mean[0]

    def features(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the actor's input for raw observations (..., num_obs): normalised, within ±NORMALISED_LIMIT."""
        return self.obs_moments.scaling().features(obs)

    def critic_features(self, critic_obs: torch.Tensor) -> torch.Tensor:
        """Return the critic's input for raw observations (..., num_critic_obs): normalised and clipped."""
        return self.critic_moments.scaling().features(critic_obs)

    def value_head(self, critic_features: torch.Tensor) -> torch.Tensor:
        """Return the critic's output (...), a normalised return, for normalised observations (..., num_critic_obs)."""
        return self.critic(critic_features).squeeze(-1)

    def value(self, critic_obs: torch.Tensor) -> torch.Tensor:
        """Return the expected return (...) for the critic's raw observations (..., num_critic_obs)."""
        return self.value_moments.scaling().denormalise(self.value_head(self.critic_features(critic_obs)))

    @torch.no_grad()
    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the mean action clipped to ±1, (..., num_actions), for raw observations (..., num_obs)."""
        return self.mean(self.features(obs)).clamp(-1.0, 1.0)
