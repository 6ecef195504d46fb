"""Left-right symmetric actor: mirror maps, and conversion of its network to and from a plain network.

A mirror map takes a vector x to its mirror image `signs * x[order]`; it is its own inverse. Let M be the mirror map of
observations, N the mirror map of actions, and f the network. The policy's mean is (f(x) + N f(M x)) / 2. For any
weights it maps M x to the mirror image of its output for x.

A plain network computes the same if each hidden layer holds those of f(x) and f(M x), one above the other: the first
layer has the weights W and W M, later ones blocks W on the diagonal, the last one (W, N W) / 2. Policies are saved in
this form, which needs no mirror maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from jumper_warp.envs.vec_env import MirroredVecEnv, VecEnv
from jumper_warp.utils.errors import InputError

Weights = list[tuple[torch.Tensor, torch.Tensor]]
"""Weight (out, in) and bias (out,) of each layer of a network, first to last."""
Vector = Sequence[float] | np.ndarray | torch.Tensor  # Numbers (n,) in any container


class MirrorMap(NamedTuple):
    """Left-right mirror map of vectors (..., n): a signed permutation that is its own inverse."""

    order: torch.Tensor  # (n,) int64, the entry of x that each entry of the image comes from
    signs: torch.Tensor  # (n,) float32, 1 or -1

    def apply(self, x: torch.Tensor) -> torch.Tensor:
        """Return the left-right mirror image of x (..., n)."""
        return self.signs * x[..., self.order]

    def symmetrise_moments(self, mean: torch.Tensor, var: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and population variance (n,) of samples together with their mirror images.

        mean, var: (n,) of the samples alone. The results are bitwise mirror-symmetric.
        """
        image = self.signs.to(mean.dtype) * mean[self.order]
        return 0.5 * (mean + image), 0.5 * (var + var[self.order]) + 0.25 * (mean - image).square()

    def matrix(self) -> torch.Tensor:
        """Return the mirror map as a matrix (n, n), whose product with x is the mirror image."""
        return self.signs[:, None] * torch.eye(len(self.order), device=self.signs.device)[self.order]


class Symmetry(NamedTuple):
    """Left-right mirror maps of the actor's observation and action."""

    obs: MirrorMap
    action: MirrorMap


def mirror_map(order: Vector, signs: Vector, name: str, device: Any = None) -> MirrorMap:
    """Build the mirror map `signs * x[order]`, and check that it is its own inverse.

    order, signs: (n,); name: of the vectors, for messages.
    Raises InputError, a ValueError: it is not its own inverse.
    """
    index = torch.as_tensor(order, dtype=torch.int64, device=device)
    sign = torch.as_tensor(signs, dtype=torch.float32, device=device)
    valid = index.ndim == 1 and index.shape == sign.shape and bool(((index >= 0) & (index < len(index))).all())
    identity = torch.arange(len(index), device=device) if valid else None
    if not (valid and bool((index[index] == identity).all()) and bool((sign * sign[index] == 1.0).all())):
        raise InputError(f"the mirror image of {name} is not its own inverse")
    return MirrorMap(index, sign)


def symmetry_of(env: VecEnv) -> Symmetry:
    """Return the mirror maps of an environment's observation and action, on its device.

    Raises InputError: the environment defines none, or a map is not its own inverse or has another size.
    """
    if not isinstance(env, MirroredVecEnv):
        raise InputError("symmetry needs an environment that defines mirror images of observation and action")
    obs, action = (mirror_map(*env.mirror(name), name, env.device) for name in ("observation", "action"))
    if (len(obs.order), len(action.order)) != (env.num_obs, env.num_actions):
        raise InputError("the sizes of the mirror images differ from this environment's observation and action")
    return Symmetry(obs, action)


def expand_layers(layers: Weights, symmetry: Symmetry) -> Weights:
    """Convert a symmetric actor to a plain network of twice the hidden widths; return its layers.

    Both have the same output.
    layers: those of f, with activations between. A symmetric policy is saved and exported in this form.
    """
    obs, action = symmetry.obs.matrix(), symmetry.action.matrix()
    expanded = []
    for index, (weight, bias) in enumerate(layers):
        if len(layers) == 1:
            weight, bias = 0.5 * (weight + action @ weight @ obs), 0.5 * (bias + action @ bias)
        elif index == 0:
            weight, bias = torch.cat([weight, weight @ obs]), torch.cat([bias, bias])
        elif index < len(layers) - 1:
            weight, bias = torch.block_diag(weight, weight), torch.cat([bias, bias])
        else:
            weight, bias = 0.5 * torch.cat([weight, action @ weight], dim=1), 0.5 * (bias + action @ bias)
        expanded.append((weight, bias))
    return expanded


def nearest_expanded_layers(layers: Weights, symmetry: Symmetry) -> Weights:
    """Project the layers of a plain network to the nearest ones (least squares) that represent a symmetric actor.

    layers: at least two, hidden layers of even widths. Blocks that must be equal are averaged, the others set to 0.
    """
    obs, action = symmetry.obs.matrix().to(layers[0][0]), symmetry.action.matrix().to(layers[0][0])
    halves = []
    for index, (weight, bias) in enumerate(layers):
        rows, columns = weight.shape[0] // 2, weight.shape[1] // 2
        if index == len(layers) - 1:
            halves.append((weight[:, :columns] + action @ weight[:, columns:], bias))
            continue
        first = index == 0
        half = weight[:rows] + weight[rows:] @ obs if first else weight[:rows, :columns] + weight[rows:, columns:]
        halves.append((0.5 * half, 0.5 * (bias[:rows] + bias[rows:])))
    return expand_layers(halves, symmetry)


def contract_layers(layers: Weights, symmetry: Symmetry) -> Weights:
    """Recover the layers of a symmetric actor's network f from its equivalent plain network of twice the widths.

    The result is a copy.
    f's last bias is recovered up to a part that cancels in the policy. Raises InputError: layers have another form.
    """
    contracted = []
    for index, (weight, bias) in enumerate(layers):
        rows, columns = weight.shape
        first, last = index == 0, index == len(layers) - 1
        rows, columns = rows if last else rows // 2, columns if first else columns // 2
        factor = 2.0 if last and not first else 1.0
        contracted.append((factor * weight[:rows, :columns], bias[:rows].clone()))
    sizes_fit = (layers[0][0].shape[1], layers[-1][0].shape[0]) == (len(symmetry.obs.order), len(symmetry.action.order))
    again = expand_layers(contracted, symmetry) if sizes_fit else []
    if len(again) != len(layers) or not all(
        tensor.shape == result.shape and torch.allclose(tensor, result, rtol=1e-6, atol=1e-6)
        for layer, expanded in zip(layers, again, strict=True)
        for tensor, result in zip(layer, expanded, strict=True)
    ):
        raise InputError("the layers are not those of a mirror-symmetric actor")
    return contracted
