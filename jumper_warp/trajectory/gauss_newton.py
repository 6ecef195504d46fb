"""Gauss-Newton steps on the weights of a policy's network, in a trust region around its original actions.

With errors e, their importance W, their Jacobian J w.r.t. the network's weights, the network's actions a over recorded
observations, original actions a0 and damping c, a step d solves by conjugate gradients

    (J^T W J + A^T S A + c I) d = -(J^T W e + A^T S (a - a0)),

where A is the derivative of a w.r.t. the weights and S = 1 / (m s^2), with m observations and s the allowed change of
the actions. The terms with S are the Gauss-Newton terms of the mean squared change of the actions, which is
proportional to the KL divergence from the original policy; A^T S A is the metric of the natural gradient. They keep the
policy close to the one that was trained for robustness, as few recorded jumps do not determine all weights.
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
"""Tape[step][layer]: input (worlds, in) and pre-activation output (worlds, out) of a layer in a policy step."""


class Actor(Protocol):
    """Interface of a policy whose network is optimised, such as `jumper_warp.policies.policy.Policy`."""

    mean: torch.Tensor  # (num_obs,) of the observations' normaliser
    std: torch.Tensor  # (num_obs,) of the observations' normaliser
    interface: Any  # has the network's `activation`, `observation_limit` and `normalised_limit`

    @property
    def layers(self) -> Sequence[tuple[torch.Tensor, torch.Tensor]]:
        """Weight (out, in) and bias (out,) of each layer of the policy's network."""
        ...


class Network:
    """A policy's network as a function of the flat vector of all its weights and biases, `weights`."""

    def __init__(self, policy: Actor, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> None:
        """Copy weights and normaliser of a policy; later changes of the policy have no effect."""
        interface = policy.interface
        self.limits = interface.observation_limit, interface.normalised_limit
        self.mean, self.std = (tensor.to(device, dtype, copy=True) for tensor in (policy.mean, policy.std))
        self.activation = ACTIVATIONS[interface.activation]
        self.shapes = [tensor.shape for layer in policy.layers for tensor in layer]
        parts = [tensor.detach().flatten() for layer in policy.layers for tensor in layer]
        self.weights = torch.cat(parts).to(device, dtype, copy=True)

    def layers(self, weights: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Return weight (out, in) and bias (out,) of each network layer as views of a weight vector (num_weights,)."""
        parts = weights.split([math.prod(shape) for shape in self.shapes])
        views = [part.view(shape) for part, shape in zip(parts, self.shapes, strict=True)]
        return list(zip(views[::2], views[1::2], strict=True))

    def act(self, obs: torch.Tensor, weights: torch.Tensor | None = None, tape: Tape | None = None) -> torch.Tensor:
        """Return actions (n, 12), clamped to ±1, for raw observations (n, num_obs).

        weights: (num_weights,), by default the network's. tape: receives one entry, inputs and outputs of the layers.
        """
        limit, normalised = self.limits
        x = normalise(obs.clamp(-limit, limit), self.mean, self.std, normalised)
        layers = self.layers(self.weights if weights is None else weights)
        recorded = []
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
    """Return the gradient of each world's loss w.r.t. `Network.weights`, (worlds, num_weights).

    total: scalar sum of the losses of all worlds, each a function of that world's steps alone; its graph is kept.
    tape: of all policy steps, filled by `Network.act`. One backward pass gives the gradient w.r.t. the outputs of every
    layer, which still has a row per world; a layer's weight gradient in a world is the sum over steps of the outer
    product of that row and the layer's input.
    """
    outs = [out for layers in tape for _, out in layers]
    by_out = torch.autograd.grad(total, outs, retain_graph=True, allow_unused=True)
    depth = len(tape[0])
    parts = []
    for layer in range(depth):
        steps = [(layers[layer][0].detach(), by) for layers, by in zip(tape, by_out[layer::depth], strict=True)
                 if by is not None]  # fmt: skip
        ins, by_outs = (torch.stack(tensors) for tensors in zip(*steps, strict=True))
        parts += [torch.einsum("tno,tni->noi", by_outs, ins).flatten(1), by_outs.sum(0)]
    return torch.cat(parts, 1)


def conjugate_gradients(
    apply: Callable[[torch.Tensor], torch.Tensor], right: torch.Tensor, iterations: int, accuracy: float
) -> torch.Tensor:
    """Solve A x = right for a positive definite matrix A by conjugate gradients.

    x, right: (n,); apply: returns A v for v (n,). Stops after `iterations`, or when the residual's norm is below
    `accuracy` times the norm of `right`.
    """
    x = torch.zeros_like(right)
    residual = right.clone()
    direction = residual.clone()
    size = residual @ residual
    start = size
    for _ in range(iterations):
        if size <= accuracy**2 * start:
            break
        along = apply(direction)
        length = size / (direction @ along)
        x += length * direction
        residual -= length * along
        new = residual @ residual
        direction = residual + new / size * direction
        size = new
    return x


class Anchor:
    """Trust region of an optimisation: a penalty on changes of a network's actions at recorded observations."""

    def __init__(self, network: Network, obs: torch.Tensor, action_std: torch.Tensor) -> None:
        """Record the network's actions at raw observations obs (m, num_obs) as the original actions.

        action_std: (m,) allowed change s of the actions, as the norm over motors [1]; if it occurs at all observations,
        `cost` is 1/2, as for a weighted error of 1.
        """
        self.network, self.obs = network, obs
        self.scale = 1.0 / (action_std[:, None] * math.sqrt(len(obs)))
        with torch.no_grad():
            self.actions = network.act(obs)

    def residuals(self, weights: torch.Tensor) -> torch.Tensor:
        """Return changes of the network's actions from the original, divided by action_std sqrt(m), (m, 12).

        m: number of recorded observations, so that the sum of squares does not grow with their number.
        """
        return self.scale * (self.network.act(self.obs, weights) - self.actions)

    def cost(self, weights: torch.Tensor) -> float:
        """Return the penalty on changed actions: half the sum of squared `residuals`."""
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
    """Return the Gauss-Newton step of a network's weights in the trust region of an `Anchor`.

    The step d (num_weights,) from `weights` solves the module's equation by `conjugate_gradients`. By group of worlds:
    jacobians: J, (n, num_weights); errors: e, (n,); importance: the diagonal of W, (n,). damping: c [1]. iterations,
    accuracy: limits of the conjugate gradients.
    """
    change, back = vjp(anchor.residuals, weights)[:2]
    right = -back(change)[0]
    for jacobian, error, weight in zip(jacobians, errors, importance, strict=True):
        right = right - jacobian.T @ (weight * error)

    def apply(v: torch.Tensor) -> torch.Tensor:
        """Return the product of the equation's matrix and a vector v (num_weights,), without forming the matrix."""
        out = damping * v + back(jvp(anchor.residuals, (weights,), (v,))[1])[0]
        for jacobian, weight in zip(jacobians, importance, strict=True):
            out = out + jacobian.T @ (weight * (jacobian @ v))
        return out

    return conjugate_gradients(apply, right, iterations, accuracy)
