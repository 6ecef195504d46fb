"""Gauss-Newton steps on the weights of a policy's network, in a trust region around its original actions.

With errors e, weighed with W, their Jacobian J by the weights, and the network's actions a over given observations, a
step d solves by conjugate gradients

    (J^T W J + A^T S A + c I) d = -(J^T W e + A^T S (a - a0)),

where A is the derivative of a by the weights and S = 1 / (m s^2), with m observations and s the allowed change of the
actions. The second terms are Gauss-Newton's of the mean squared change of the actions, which is up to a factor the KL
divergence from the original policy, and A^T S A the metric of the natural gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch.func import jvp, vjp
from torch.nn import functional

from jumper_warp.utils.normalise import normalise

ACTIVATIONS = {"elu": functional.elu, "relu": functional.relu, "tanh": torch.tanh}

Tape = list[list[tuple[torch.Tensor, torch.Tensor]]]
"""Input (worlds, in) and pre-activation output (worlds, out) of every layer, by policy step and layer."""


class Actor(Protocol):
    """A policy's weights, normaliser and interface, as `jumper_warp.policies.policy.Policy` has them."""

    mean: torch.Tensor
    std: torch.Tensor
    interface: Any

    @property
    def layers(self) -> Sequence[tuple[torch.Tensor, torch.Tensor]]:
        """Weight and bias of each layer."""
        ...


class Network:
    """A policy's network as a function of the vector of its weights."""

    def __init__(self, policy: Actor, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> None:
        """Copy weights and normaliser."""
        interface = policy.interface
        self.limits = interface.observation_limit, interface.normalised_limit
        self.mean, self.std = (tensor.to(device, dtype, copy=True) for tensor in (policy.mean, policy.std))
        self.activation = ACTIVATIONS[interface.activation]
        self.shapes = [tensor.shape for layer in policy.layers for tensor in layer]
        parts = [tensor.detach().flatten() for layer in policy.layers for tensor in layer]
        self.weights = torch.cat(parts).to(device, dtype, copy=True)

    def layers(self, weights: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Return weight (out, in) and bias (out,) of each layer as views of a weight vector."""
        parts = weights.split([math.prod(shape) for shape in self.shapes])
        views = [part.view(shape) for part, shape in zip(parts, self.shapes, strict=True)]
        return list(zip(views[::2], views[1::2], strict=True))

    def act(self, obs: torch.Tensor, weights: torch.Tensor | None = None, tape: Tape | None = None) -> torch.Tensor:
        """Return actions (n, 12), clamped to ±1, for raw observations (n, num_obs).

        weights: by default the network's. tape: gets one entry with inputs and outputs of the layers.
        """
        limit, normalised = self.limits
        x = normalise(obs.clamp(-limit, limit), self.mean, self.std, normalised)
        layers, recorded = self.layers(self.weights if weights is None else weights), []
        for i, (weight, bias) in enumerate(layers):
            out = functional.linear(x, weight, bias)
            if tape is not None and not out.requires_grad:
                out.requires_grad_()  # the inputs of the first step have no gradient
            recorded.append((x, out))
            x = out if i == len(layers) - 1 else self.activation(out)
        if tape is not None:
            tape.append(recorded)
        return x.clamp(-1.0, 1.0)


def per_world_gradients(total: torch.Tensor, tape: Tape) -> torch.Tensor:
    """Return the gradient of each world's loss by the weights, (worlds, weights), in the order of `Network.weights`.

    total: the sum of the losses of all worlds, each a function of that world's steps alone; its graph is kept.
    """
    outs = [out for layers in tape for _, out in layers]
    by_out = torch.autograd.grad(total, outs, retain_graph=True, allow_unused=True)
    depth, parts = len(tape[0]), []
    for layer in range(depth):
        steps = [(layers[layer][0].detach(), by) for layers, by in zip(tape, by_out[layer::depth], strict=True)
                 if by is not None]  # fmt: skip
        ins, by_outs = (torch.stack(each) for each in zip(*steps, strict=True))
        parts += [torch.einsum("tno,tni->noi", by_outs, ins).flatten(1), by_outs.sum(0)]
    return torch.cat(parts, 1)


def conjugate_gradients(
    apply: Callable[[torch.Tensor], torch.Tensor], right: torch.Tensor, iterations: int, accuracy: float
) -> torch.Tensor:
    """Return x with A x = right, for the positive definite A that `apply` multiplies by.

    Ends after so many iterations, or where the residual's norm is the accuracy times that of `right`.
    """
    x, residual = torch.zeros_like(right), right.clone()
    direction, size = residual.clone(), residual @ residual
    start = size
    for _ in range(iterations):
        if size <= accuracy**2 * start:
            break
        along = apply(direction)
        length = size / (direction @ along)
        x += length * direction
        residual -= length * along
        new = residual @ residual
        direction, size = residual + new / size * direction, new
    return x


class Anchor:
    """Trust region: observations at which a network should keep its original actions."""

    def __init__(self, network: Network, obs: torch.Tensor, action_std: torch.Tensor) -> None:
        """Record the network's present actions.

        obs: (m, num_obs), raw. action_std: (m,) norm of the change of the actions [1] that costs as much as a weighed
        error of 1 if it occurs at all observations.
        """
        self.network, self.obs = network, obs
        self.scale = 1.0 / (action_std[:, None] * math.sqrt(len(obs)))
        with torch.no_grad():
            self.actions = network.act(obs)

    def residuals(self, weights: torch.Tensor) -> torch.Tensor:
        """Return the weighed changes of the actions, (m, 12)."""
        return self.scale * (self.network.act(self.obs, weights) - self.actions)

    def cost(self, weights: torch.Tensor) -> float:
        """Return half the sum of squared `residuals`."""
        with torch.no_grad():
            return 0.5 * float(self.residuals(weights).square().sum())

    def change(self, weights: torch.Tensor) -> float:
        """Return the root mean square change of the actions over observations and motors [1]."""
        with torch.no_grad():
            return float((self.network.act(self.obs, weights) - self.actions).square().mean().sqrt())


def gauss_newton_step(
    weights: torch.Tensor,
    jacobians: Sequence[torch.Tensor],
    errors: Sequence[torch.Tensor],
    importance: Sequence[torch.Tensor],
    anchor: Anchor,
    damping: float,
    iterations: int = 40,
    accuracy: float = 1.0e-3,
) -> torch.Tensor:
    """Return the step d (weights,) of the module's equation, solved by `conjugate_gradients`.

    jacobians: J of each group of worlds, (n, weights); errors: e, (n,); importance: the diagonal of W, (n,).
    """
    change, back = vjp(anchor.residuals, weights)[:2]
    right = -back(change)[0]
    for jacobian, error, weight in zip(jacobians, errors, importance, strict=True):
        right = right - jacobian.T @ (weight * error)

    def apply(v: torch.Tensor) -> torch.Tensor:
        out = damping * v + back(jvp(anchor.residuals, (weights,), (v,))[1])[0]
        for jacobian, weight in zip(jacobians, importance, strict=True):
            out = out + jacobian.T @ (weight * (jacobian @ v))
        return out

    return conjugate_gradients(apply, right, iterations, accuracy)
