"""What PPO trains: actor, critic, exploration noise, and the running statistics that scale observations and values.

The passes of a multilayer perceptron are also here without autograd, as functions of tensors that compile into few
kernels. The backward pass needs of a layer its outputs only, so that nothing else is kept, and has no bookkeeping on
the host. With y the layer's output, x its input and s = ∂L/∂(Wx + b): ∂L/∂W = sᵀx, ∂L/∂b = Σs, ∂L/∂x = sW, and the
slope of each activation follows from y alone: elu' = 1 + min(y, 0), relu' = [y > 0], tanh' = 1 - y².
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import nn
from torch.nn import functional

from jumper_warp.envs.vec_env import sanitise
from jumper_warp.rl.distributed import all_reduce_mean, world_size
from jumper_warp.rl.mirror import MirrorMap, Symmetry, Weights
from jumper_warp.utils.normalise import normalise

NORMALISED_LIMIT = 10.0
"""The networks see observations within plus and minus this many standard deviations."""
EPS = 1.0e-5
"""Added to a variance before its root is taken."""
ACTIVATIONS = {"elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh}
"""Activations by the name that a configuration gives."""
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
"""What the hidden layers compute in, by `PpoCfg.precision`."""


class Moments(NamedTuple):
    """Moments of a batch of samples, each of one sample's shape."""

    mean: torch.Tensor
    var: torch.Tensor
    """Population variance."""
    count: int
    """Number of samples."""

    @staticmethod
    def of(x: torch.Tensor, rows: int | None = None) -> Moments:
        """Return the moments over the first axis of x (batch, ...).

        rows: taken at a time, in two passes, which takes a CPU a sixth of the time (default: all, in one).
        """
        if rows is None:
            var, mean = torch.var_mean(x, dim=0, correction=0)
        else:
            mean = x.mean(0)
            var = torch.stack([(part - mean).square().sum(0) for part in x.split(rows)]).sum(0) / x.shape[0]
        return Moments(mean, var, x.shape[0])


class Scaling(NamedTuple):
    """What samples are scaled by, each float32 and of one sample's shape."""

    mean: torch.Tensor
    std: torch.Tensor

    def normalise(self, x: torch.Tensor) -> torch.Tensor:
        """Return (x - mean) / std."""
        return (x - self.mean) / self.std

    def restore(self, x: torch.Tensor) -> torch.Tensor:
        """Return x · std + mean, the inverse of `normalise`."""
        return x * self.std + self.mean

    def features(self, obs: torch.Tensor, columns: int) -> torch.Tensor:
        """Return sanitised observations (..., n) scaled, limited, and filled up with zeros to so many columns."""
        features = normalise(obs, self.mean, self.std, NORMALISED_LIMIT)
        return functional.pad(features, (0, columns - obs.shape[-1]))


def all_reduce_moments(own: Sequence[Moments]) -> list[Moments]:
    """Return the moments, float64, over all ranks' batches, all in one exchange.

    own: of some quantities of any shape over this rank's batch, which has the same size on every rank. E[x²] - E[x]²
    loses nothing that counts in float64.
    """
    moments = [(mean.double(), var.double()) for mean, var, _ in own]
    if world_size() > 1:
        vector = torch.cat([part.flatten() for mean, var in moments for part in (mean, var + mean.square())])
        parts = all_reduce_mean(vector).split([mean.numel() for mean, _ in moments for _ in range(2)])
        pairs = zip(parts[::2], parts[1::2], moments, strict=True)
        moments = [(a.view_as(like), (b - a.square()).clamp(min=0.0).view_as(like)) for a, b, (like, _) in pairs]
    return [Moments(*pair, each.count * world_size()) for pair, each in zip(moments, own, strict=True)]


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
        self.take(all_reduce_moments([Moments.of(x)])[0])

    @torch.no_grad()
    def take(self, moments: Moments) -> None:
        """Take in the moments of a batch of finite samples over all ranks."""
        mean, var, size = moments
        share = size / (self.count + size)
        delta = mean - self.mean
        self.var.lerp_(var, share).add_(delta.square() * share * (1.0 - share))
        self.mean.add_(delta * share)
        self.count.add_(size)

    def scaling(self) -> Scaling:
        """Return mean and standard deviation."""
        return Scaling(self.mean.float(), (self.var + EPS).sqrt().float())


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


def linear_layers(network: nn.Module) -> Weights:
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
            MirrorMap(*(getattr(self, f"mirror_{name}_{part}") for part in MirrorMap._fields))
            for name in Symmetry._fields
        ]
        return Symmetry(*parts)

    def mean(self, features: torch.Tensor) -> torch.Tensor:
        """Return the policy's mean, (..., num_actions), for what the actor sees (..., num_obs)."""
        if (symmetry := self.symmetry) is None:
            return self.actor(features)
        return 0.5 * (self.actor(features) + symmetry.action.of(self.actor(symmetry.obs.of(features))))

    def features(self, obs: torch.Tensor) -> torch.Tensor:
        """Return what the actor sees of raw observations (..., num_obs): finite, scaled, within ±NORMALISED_LIMIT."""
        return self.obs_moments.scaling().features(sanitise(obs), obs.shape[-1])

    def critic_features(self, critic_obs: torch.Tensor) -> torch.Tensor:
        """Return what the critic sees of its raw observations (..., num_critic_obs), likewise."""
        return self.critic_moments.scaling().features(sanitise(critic_obs), critic_obs.shape[-1])

    def value_head(self, critic_features: torch.Tensor) -> torch.Tensor:
        """Return the critic's output, in standard deviations of the return; (...)."""
        return self.critic(critic_features).squeeze(-1)

    def value(self, critic_obs: torch.Tensor) -> torch.Tensor:
        """Return the expected return from the critic's raw observations (..., num_critic_obs); (...)."""
        return self.value_moments.scaling().restore(self.value_head(self.critic_features(critic_obs)))

    @torch.no_grad()
    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the mean action clipped to ±1, (..., num_actions), for raw observations (..., num_obs)."""
        return self.mean(self.features(obs)).clamp(-1.0, 1.0)


class Layers(NamedTuple):
    """A network as tensors; layer i maps (batch, columns of weights[i]) to (batch, rows of weights[i])."""

    weights: tuple[torch.Tensor, ...]
    """(outputs, inputs) each; the first has zero columns up to a multiple of `flat.ROW_ALIGNMENT`."""
    biases: tuple[torch.Tensor, ...]
    """(outputs,) each."""
    activation: str
    """Of all layers but the last: elu, relu or tanh."""

    def forward(self, x: torch.Tensor, dtype: torch.dtype) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Return the network's output, float32, and what each of its layers saw.

        The last layer computes in float32, the others in `dtype`; x: (batch, columns of the first weight), float32.
        """
        seen = []
        activation = getattr(functional, self.activation)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            seen.append(x.to(dtype))
            x = activation(functional.linear(seen[-1], weight.to(dtype), bias.to(dtype)))
        seen.append(x.float())
        return functional.linear(seen[-1], self.weights[-1], self.biases[-1]), seen

    def backward(self, seen: list[torch.Tensor], slope: torch.Tensor, dtype: torch.dtype) -> list[torch.Tensor]:
        """Return the gradients of weight and bias of each layer, first to last, float32.

        seen: as `forward` gave it; slope: (batch, outputs) of the loss with respect to the network's output.
        """
        found: list[torch.Tensor] = []
        for index in reversed(range(len(seen))):
            x = seen[index]
            slope = slope.to(x.dtype)
            found = [(slope.t() @ x).float(), slope.sum(0, dtype=torch.float32), *found]
            if index > 0:
                slope = _through(self.activation, slope @ self.weights[index].to(x.dtype), x).to(dtype)
        return found


class Actor(NamedTuple):
    """The policy as tensors, in the notation of `jumper_warp.rl.mirror`."""

    layers: Layers
    log_std: torch.Tensor
    """(num_actions,) of the noise."""
    symmetry: Symmetry | None
    """With an image of observations as wide as the first weight."""

    def forward(self, x: torch.Tensor, dtype: torch.dtype) -> ActorOutput:
        """Return the policy's output; arguments as of `Layers.forward`."""
        if self.symmetry is None:
            mean, seen = self.layers.forward(x, dtype)
            return ActorOutput(mean, torch.zeros_like(mean), seen)
        output, seen = self.layers.forward(torch.cat([x, self.symmetry.obs.of(x)]), dtype)
        own, other = output.chunk(2)
        image = self.symmetry.action.of(other)
        return ActorOutput(0.5 * (own + image), own - image, seen)

    def backward(self, seen: list[torch.Tensor], slope: torch.Tensor, dtype: torch.dtype) -> list[torch.Tensor]:
        """Return the gradients of weights and biases; slope: of the loss with respect to `ActorOutput.mean`."""
        if self.symmetry is None:
            return self.layers.backward(seen, slope, dtype)
        half = 0.5 * slope
        return self.layers.backward(seen, torch.cat([half, self.symmetry.action.of(half)]), dtype)


class ActorOutput(NamedTuple):
    """What a pass of the policy gives."""

    mean: torch.Tensor
    difference: torch.Tensor
    """f(x) - N f(M x), 0 without symmetry; (batch, num_actions) like the mean."""
    seen: list[torch.Tensor]
    """What each layer saw, for `Actor.backward`."""


def _through(activation: str, slope: torch.Tensor, output: torch.Tensor) -> torch.Tensor:
    """Return the slope before an activation from that behind it."""
    if activation == "elu":
        return torch.addcmul(slope, slope, output.clamp(max=0.0))
    if activation == "relu":
        return slope * (output > 0.0)
    return torch.addcmul(slope, slope, output.square(), value=-1.0)
