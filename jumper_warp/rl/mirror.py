"""Symmetric actor: mirror maps, and conversion of its network to and from a plain network.

A mirror map takes a vector x to its mirror image `signs * x[order]`; it is its own inverse. Let M be the mirror map of
observations, N the mirror map of actions, and f the network. The policy's mean is (f(x) + N f(M x)) / 2. For any
weights it maps M x to the mirror image of its output for x. An actor that is symmetric about two planes has the same
form for the second plane, where its mean for the first one takes the place of f: a mean over four images of x.

A plain network computes the same if each hidden layer holds those of f(x) and f(M x), one above the other: the first
layer has the weights W and W M, later ones blocks W on the diagonal, the last one (W, N W) / 2. Policies are saved in
this form, which needs no mirror maps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from jumper_warp.envs.vec_env import MirroredVecEnv, VecEnv
from jumper_warp.utils.errors import InputError

Weights = list[tuple[torch.Tensor, torch.Tensor]]
"""Weight (out, in) and bias (out,) of each layer of a network, first to last."""
PLANES = {"off": (), "actor": ("left-right",), "both": ("left-right", "front-back")}
"""Planes of symmetry by `PpoCfg.symmetry`."""
Vector = Sequence[float] | np.ndarray | torch.Tensor  # Numbers (n,) in any container


class MirrorMap(NamedTuple):
    """Mirror map of vectors (..., n): a signed permutation that is its own inverse."""

    order: torch.Tensor  # (n,) int64, the entry of x that each entry of the image comes from
    signs: torch.Tensor  # (n,) float32, 1 or -1

    def apply(self, x: torch.Tensor) -> torch.Tensor:
        """Return the mirror image of x (..., n)."""
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
    """Mirror maps of the actor's observation and action for one plane."""

    obs: MirrorMap
    action: MirrorMap


Symmetries = tuple[Symmetry, ...]
"""Symmetries of an actor: none, left-right, or left-right and front-back."""


def images(mirrors: Iterable[MirrorMap], size: int) -> MirrorMap:
    """Return the maps to all images of vectors (size,) by mirrors, the identity first, as order and signs (k, size)."""
    order, signs = torch.arange(size)[None], torch.ones(1, size)
    for mirror in mirrors:
        index, sign = mirror.order.cpu(), mirror.signs.cpu()
        order, signs = torch.cat([order, order[:, index]]), torch.cat([signs, sign * signs[:, index]])
    return MirrorMap(order, signs)


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


def make_symmetries(
    symmetry: str, mirror: Callable[[str, str], tuple[Vector, Vector]], device: Any = None
) -> Symmetries:
    """Return the mirror maps that a function `mirror` gives; symmetry: as in `PpoCfg`, mirror: as in `MirroredVecEnv`.

    Raises InputError: a map is not its own inverse.
    """
    symmetries = []
    for plane in PLANES[symmetry]:
        obs, action = (mirror_map(*mirror(name, plane), name, device) for name in ("observation", "action"))
        symmetries.append(Symmetry(obs, action))
    return tuple(symmetries)


def symmetries_of(env: VecEnv, symmetry: str) -> Symmetries:
    """Return the mirror maps of an environment's observation and action, on its device; symmetry: as in `PpoCfg`.

    Raises InputError: the environment defines none, or a map is not its own inverse or has another size.
    """
    if symmetry == "off":
        return ()
    if not isinstance(env, MirroredVecEnv):
        raise InputError("symmetry needs an environment that defines mirror images of observation and action")
    symmetries = make_symmetries(symmetry, env.mirror, env.device)
    if any((len(each.obs.order), len(each.action.order)) != (env.num_obs, env.num_actions) for each in symmetries):
        raise InputError("the sizes of the mirror images differ from this environment's observation and action")
    return symmetries


def symmetries_in(model: Mapping[str, torch.Tensor]) -> Symmetries:
    """Return the symmetries in a model's buffers `mirror_obs_order`, `mirror_obs_signs` and those of action, (k, n).

    In checkpoints of earlier versions, buffers of the one symmetry are (n,).
    """
    if "mirror_obs_order" not in model:
        return ()
    parts = [[torch.atleast_2d(model[f"mirror_{name}_{p}"]) for p in MirrorMap._fields] for name in Symmetry._fields]
    obs, action = (list(map(MirrorMap, *part)) for part in parts)
    return tuple(map(Symmetry, obs, action))


def expand_layers(layers: Weights, symmetries: Symmetries) -> Weights:
    """Convert a symmetric actor to a plain network, for each symmetry of twice the hidden widths; return its layers.

    Both have the same output.
    layers: those of f, with activations between. A symmetric policy is saved and exported in this form.
    """
    for obs, action in ((each.obs.matrix(), each.action.matrix()) for each in symmetries):
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
        layers = expanded
    return layers


def contract_layers(layers: Weights, symmetries: Symmetries, tolerance: float = 1.0e-6) -> Weights | None:
    """Recover the layers of a symmetric actor's network f from its equivalent plain network of wider layers.

    They are those whose plain network is nearest (least squares): blocks that must be equal are averaged. f's last bias
    is recovered up to a part that cancels in the policy. layers: at least two, hidden layers of widths that the number
    of images divides. Returns None if a layer differs from the nearest one by more than tolerance times its norm.
    """
    contracted = layers
    for each in reversed(symmetries):
        obs, action = each.obs.matrix().to(layers[0][0]), each.action.matrix().to(layers[0][0])
        halves = []
        for index, (weight, bias) in enumerate(contracted):
            rows, columns = weight.shape[0] // 2, weight.shape[1] // 2
            if index == len(layers) - 1:
                halves.append((weight[:, :columns] + action @ weight[:, columns:], bias.clone()))
                continue
            half = weight[rows:] @ obs if index == 0 else weight[rows:, columns:]
            half = half + (weight[:rows] if index == 0 else weight[:rows, :columns])
            halves.append((0.5 * half, 0.5 * (bias[:rows] + bias[rows:])))
        contracted = halves
    for layer, nearest in zip(layers, expand_layers(contracted, symmetries), strict=True):
        if any((ours - theirs).norm() > tolerance * ours.norm() for ours, theirs in zip(layer, nearest, strict=True)):
            return None
    return contracted
