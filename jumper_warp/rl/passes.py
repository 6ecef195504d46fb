"""Forward and backward pass of a multilayer perceptron, written out.

The backward pass needs of a layer its outputs only, so that nothing else is kept, and has no bookkeeping on the host.
With y the layer's output, x its input and s = ∂L/∂(Wx + b): ∂L/∂W = sᵀx, ∂L/∂b = Σs, ∂L/∂x = sW, and the slope of
each activation follows from y alone: elu' = 1 + min(y, 0), relu' = [y > 0], tanh' = 1 - y².
"""

from __future__ import annotations

import torch
from torch.nn import functional

from jumper_warp.rl.flat import Layers
from jumper_warp.rl.mirror import Symmetry

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
"""What the hidden layers compute in, by `PpoCfg.precision`."""


def forward(layers: Layers, x: torch.Tensor, dtype: torch.dtype) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Return a network's output, float32, and what each of its layers saw.

    The last layer computes in float32, the others in `dtype`; x: (batch, columns of the first weight), float32.
    """
    seen = []
    activation = getattr(functional, layers.activation)
    for weight, bias in zip(layers.weights[:-1], layers.biases[:-1], strict=True):
        seen.append(x.to(dtype))
        x = activation(functional.linear(seen[-1], weight.to(dtype), bias.to(dtype)))
    seen.append(x.float())
    return functional.linear(seen[-1], layers.weights[-1], layers.biases[-1]), seen


def backward(layers: Layers, seen: list[torch.Tensor], slope: torch.Tensor, dtype: torch.dtype) -> list[torch.Tensor]:
    """Return the gradients of weight and bias of each layer, first to last, float32.

    seen: as `forward` gave it; slope: (batch, outputs) of the loss with respect to the network's output.
    """
    found: list[torch.Tensor] = []
    for index in reversed(range(len(seen))):
        x = seen[index]
        slope = slope.to(x.dtype)
        found = [(slope.t() @ x).float(), slope.sum(0, dtype=torch.float32), *found]
        if index > 0:
            slope = _through(layers.activation, slope @ layers.weights[index].to(x.dtype), x).to(dtype)
    return found


def forward_actor(
    layers: Layers, x: torch.Tensor, symmetry: Symmetry | None, dtype: torch.dtype
) -> tuple[torch.Tensor, torch.Tensor, list[torch.Tensor]]:
    """Return the policy's mean (batch, actions), f(x) - N f(M x), 0 without symmetry, and what `backward_actor` needs.

    Arguments as of `forward`; symmetry: of the policy, in the notation of `jumper_warp.rl.mirror`.
    """
    if symmetry is None:
        mean, seen = forward(layers, x, dtype)
        return mean, torch.zeros_like(mean), seen
    output, seen = forward(layers, torch.cat([x, symmetry.obs.of(x)]), dtype)
    own, other = output.chunk(2)
    image = symmetry.action.of(other)
    return 0.5 * (own + image), own - image, seen


def backward_actor(
    layers: Layers, seen: list[torch.Tensor], slope: torch.Tensor, symmetry: Symmetry | None, dtype: torch.dtype
) -> list[torch.Tensor]:
    """Return the gradients of weights and biases; slope: of the loss with respect to the mean of `forward_actor`."""
    if symmetry is None:
        return backward(layers, seen, slope, dtype)
    half = 0.5 * slope
    return backward(layers, seen, torch.cat([half, symmetry.action.of(half)]), dtype)


def _through(activation: str, slope: torch.Tensor, output: torch.Tensor) -> torch.Tensor:
    """Return the slope before an activation from that behind it."""
    if activation == "elu":
        return torch.addcmul(slope, slope, output.clamp(max=0.0))
    if activation == "relu":
        return slope * (output > 0.0)
    return torch.addcmul(slope, slope, output.square(), value=-1.0)
