"""Left-right symmetry of the actor.

The mirror image of a vector x is `signs * x[order]`, and twice mirrored is as before. Let M be the image of an
observation, N that of an action, and f the network. The policy's mean is (f(x) + N f(M x)) / 2, so that it answers M x
by the image of its answer to x whatever the weights.

The passes run once over twice the rows, x and M x. As N is a permutation with signs and its own inverse, the slope of a
loss with respect to f(M x) is N of that with respect to N f(M x).
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
Vector = Sequence[float] | np.ndarray | torch.Tensor


class MirrorMap(NamedTuple):
    """The mirror image of vectors (..., n)."""

    order: torch.Tensor
    """(n,) int64"""
    signs: torch.Tensor
    """(n,) float32, 1 or -1"""

    def of(self, x: torch.Tensor) -> torch.Tensor:
        """Return the image of x (..., n)."""
        return self.signs * x[..., self.order]

    def moments(self, mean: torch.Tensor, var: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and population variance (n,) of samples that come with their images, from those of the samples.

        They are their own images to the last bit.
        """
        image = self.signs.to(mean.dtype) * mean[self.order]
        return 0.5 * (mean + image), 0.5 * (var + var[self.order]) + 0.25 * (mean - image).square()

    def padded(self, columns: int) -> MirrorMap:
        """Return the image of vectors that are filled up to so many columns, which stay where they are."""
        more = torch.arange(len(self.order), columns, device=self.order.device)
        return MirrorMap(
            torch.cat([self.order, more]), torch.cat([self.signs, torch.ones_like(more, dtype=torch.float32)])
        )

    def matrix(self) -> torch.Tensor:
        """Return the image as a matrix (n, n)."""
        return self.signs[:, None] * torch.eye(len(self.order), device=self.signs.device)[self.order]


class Symmetry(NamedTuple):
    """Mirror images of what the actor sees and does."""

    obs: MirrorMap
    action: MirrorMap

    def padded(self, columns: int) -> Symmetry:
        """Return the same for observations that are filled up to so many columns."""
        return Symmetry(self.obs.padded(columns), self.action)


def mirror_map(order: Vector, signs: Vector, name: str, device: Any = None) -> MirrorMap:
    """Return the image of vectors called `name`. Raises ValueError: mirroring twice does not give back what was."""
    places = torch.as_tensor(order, dtype=torch.int64, device=device)
    flips = torch.as_tensor(signs, dtype=torch.float32, device=device)
    fits = places.ndim == 1 and places.shape == flips.shape and bool(((places >= 0) & (places < len(places))).all())
    each = torch.arange(len(places), device=device) if fits else None
    if not (fits and bool((places[places] == each).all()) and bool((flips * flips[places] == 1.0).all())):
        raise InputError(f"the mirror image of {name} is not its own inverse")
    return MirrorMap(places, flips)


def symmetry_of(env: VecEnv) -> Symmetry:
    """Return the mirror images of an environment, on its device.

    Raises ValueError: it tells none, or one that is not its own inverse or of other vectors.
    """
    if not isinstance(env, MirroredVecEnv):
        raise InputError("symmetry needs an environment that tells mirror images of observation and action")
    obs, action = (mirror_map(*env.mirror(name), name, env.device) for name in ("observation", "action"))
    if (len(obs.order), len(action.order)) != (env.num_obs, env.num_actions):
        raise InputError("the mirror images are not of this environment's observation and action")
    return Symmetry(obs, action)


def expand_symmetric_layers(layers: Weights, symmetry: Symmetry) -> Weights:
    """Return weights and biases of a plain network that answers as the symmetric actor, of twice the widths.

    layers: those of f, with activations between. So a symmetric policy is saved and exported as any other.
    """
    obs, action = symmetry.obs.matrix(), symmetry.action.matrix()
    found = []
    for index, (weight, bias) in enumerate(layers):
        if len(layers) == 1:
            weight, bias = 0.5 * (weight + action @ weight @ obs), 0.5 * (bias + action @ bias)
        elif index == 0:
            weight, bias = torch.cat([weight, weight @ obs]), torch.cat([bias, bias])
        elif index < len(layers) - 1:
            weight, bias = torch.block_diag(weight, weight), torch.cat([bias, bias])
        else:
            weight, bias = 0.5 * torch.cat([weight, action @ weight], dim=1), 0.5 * (bias + action @ bias)
        found.append((weight, bias))
    return found


def nearest_expanded_layers(layers: Weights, symmetry: Symmetry) -> Weights:
    """Return the layers of the form of `expand_symmetric_layers` that are nearest to these, of the same shapes.

    layers: at least two, hidden ones of even widths. The nearest by the sum of squared differences: what must be equal
    is the mean, what must be 0 is dropped.
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
    return expand_symmetric_layers(halves, symmetry)


def contract_expanded_layers(layers: Weights, symmetry: Symmetry) -> Weights:
    """Return weights and biases of f, of half the widths, from those that `expand_symmetric_layers` made of them; copies.

    Of f's last bias only the symmetric part is left, which answers alike. Raises InputError: the layers are not of that
    form.
    """
    found = []
    for index, (weight, bias) in enumerate(layers):
        rows, columns = weight.shape
        first, last = index == 0, index == len(layers) - 1
        rows, columns = rows if last else rows // 2, columns if first else columns // 2
        factor = 2.0 if last and not first else 1.0
        found.append((factor * weight[:rows, :columns], bias[:rows].clone()))
    sizes = (layers[0][0].shape[1], layers[-1][0].shape[0])
    again = (
        expand_symmetric_layers(found, symmetry)
        if sizes == (len(symmetry.obs.order), len(symmetry.action.order))
        else []
    )
    if len(again) != len(layers) or not all(
        one.shape == other.shape and torch.allclose(one, other, rtol=1e-6, atol=1e-6)
        for own, made in zip(layers, again, strict=True)
        for one, other in zip(own, made, strict=True)
    ):
        raise InputError("the layers are not those of a mirror-symmetric actor")
    return found
