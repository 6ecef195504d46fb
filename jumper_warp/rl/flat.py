"""Weights, gradients and Adam's moments of actor and critic, each one vector in memory."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from jumper_warp.rl.networks import ActorCritic

ALIGNMENT = 32
"""Every parameter begins at a multiple of so many numbers: 128 bytes, a GPU's cache line."""
ROW_ALIGNMENT = 8
"""Columns of an input layer's weight, and of what it multiplies, are filled up with zeros to a multiple of this."""


def aligned(count: int, to: int) -> int:
    """Return the next multiple of `to` that is not less than `count`."""
    return -(-count // to) * to


class Layers(NamedTuple):
    """A network as tensors; layer i maps (batch, columns of weights[i]) to (batch, rows of weights[i])."""

    weights: tuple[torch.Tensor, ...]
    """(outputs, inputs) each; the first has zero columns up to a multiple of ROW_ALIGNMENT."""
    biases: tuple[torch.Tensor, ...]
    """(outputs,) each."""
    activation: str
    """Of all layers but the last: elu, relu or tanh."""


class Segment(NamedTuple):
    """Where a parameter lies in the vector."""

    first: int
    stored: tuple[int, ...]
    """Shape, zero columns included."""
    shape: tuple[int, ...]
    """Its own shape."""

    @property
    def size(self) -> int:
        """Numbers up to the next parameter."""
        return aligned(math.prod(self.stored), ALIGNMENT)

    def view(self, vector: torch.Tensor) -> torch.Tensor:
        """Return the parameter's part of a vector, zero columns included."""
        return vector[self.first : self.first + math.prod(self.stored)].view(self.stored)

    def own(self, vector: torch.Tensor) -> torch.Tensor:
        """Return the parameter's part of a vector in its own shape."""
        view = self.view(vector)
        return view[:, : self.shape[1]] if len(self.shape) == 2 else view


class FlatParameters:
    """All parameters of an `ActorCritic` as views of `value`, their gradients as views of `gradient`.

    The order is actor, noise, critic; `gradient` has ALIGNMENT more numbers, the last of which is free for a figure
    that travels between ranks with the gradients. Between the parameters all numbers are zero, and stay so.
    """

    def __init__(self, model: ActorCritic, activation: str) -> None:
        """Move the parameters of a model, on the device where it is, into one vector."""
        actor = [*model.actor.parameters(), model.log_std]
        self.params = [*actor, *model.critic.parameters()]
        inputs = (model.actor[0].weight, model.critic[0].weight)
        self.segments: list[Segment] = []
        first = 0
        for param in self.params:
            shape = tuple(param.shape)
            wide = any(param is each for each in inputs)
            stored = (shape[0], aligned(shape[1], ROW_ALIGNMENT)) if wide else shape
            self.segments.append(Segment(first, stored, shape))
            first += self.segments[-1].size
        self.actor_size = self.segments[len(actor)].first
        """Numbers of actor and noise; the critic's follow."""
        self.size = first
        device = model.log_std.device
        self.value = torch.zeros(self.size, device=device)
        self.gradient = torch.zeros(self.size + ALIGNMENT, device=device)
        self._num_actor, self._activation = len(actor), activation
        for param, segment in zip(self.params, self.segments, strict=True):
            own = segment.own(self.value)
            own.copy_(param.data)
            param.data, param.grad = own, segment.own(self.gradient)

    def actor(self, vector: torch.Tensor) -> tuple[Layers, torch.Tensor]:
        """Return layers and log standard deviations of the actor that the first `actor_size` numbers describe."""
        *network, log_std = [segment.view(vector) for segment in self.segments[: self._num_actor]]
        return _layers(network, self._activation), log_std

    def critic(self) -> Layers:
        """Return the critic's layers."""
        return _layers([each.view(self.value) for each in self.segments[self._num_actor :]], self._activation)

    def gradients(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the actor's and the critic's part of the gradient."""
        return self.gradient[: self.actor_size], self.gradient[self.actor_size : self.size]


def joined(parts: list[torch.Tensor]) -> torch.Tensor:
    """Return the gradients of consecutive parameters, zero columns included, as one part of the vector."""
    pieces = []
    for part in parts:
        pieces.append(part.flatten())
        if gap := aligned(part.numel(), ALIGNMENT) - part.numel():
            pieces.append(part.new_zeros(gap))
    return torch.cat(pieces)


def _layers(params: list[torch.Tensor], activation: str) -> Layers:
    return Layers(tuple(params[::2]), tuple(params[1::2]), activation)
