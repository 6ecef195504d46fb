"""An actor whose answer to a mirrored observation is the mirrored action, whatever its weights."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from jumper_warp.utils.errors import InputError


class MirrorActor(nn.Module):
    """The mean of a network's action and the mirror image of its action on the mirrored observation.

    Observations are normalised before they come here: for exact symmetry their statistics must be symmetric too, which
    `symmetrised` makes them.
    """

    obs_order: torch.Tensor
    obs_signs: torch.Tensor
    action_order: torch.Tensor
    action_signs: torch.Tensor

    def __init__(
        self,
        network: nn.Module,
        obs: tuple[Sequence[int], Sequence[float]],
        action: tuple[Sequence[int], Sequence[float]],
    ) -> None:
        """Args:

        network: Observations (..., num_obs) to actions (..., num_actions).
        obs: Order and signs of a mirrored observation, as of `jumper_warp.tasks.velocity.mirror.mirror_of`.
        action: Likewise of an action.

        Raises:
            ValueError: Mirroring twice does not give back what was mirrored.
        """
        super().__init__()
        self.network = network
        for name, (order, signs) in (("obs", obs), ("action", action)):
            places = torch.as_tensor(order, dtype=torch.long)
            flips = torch.as_tensor(signs, dtype=torch.float32)
            twice = places.shape == flips.shape and bool((places[places] == torch.arange(len(places))).all())
            if not (twice and bool((flips * flips[places] == 1.0).all())):
                raise InputError(f"the mirror image of {name} is not its own inverse")
            self.register_buffer(f"{name}_order", places, persistent=False)
            self.register_buffer(f"{name}_signs", flips, persistent=False)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Return actions (..., num_actions) for observations (..., num_obs)."""
        other = self.network(self.obs_signs * obs[..., self.obs_order])
        return 0.5 * (self.network(obs) + self.action_signs * other[..., self.action_order])

    def symmetrised(self, mean: torch.Tensor, var: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and variance (num_obs,) of observations that come with their mirror images, one for one."""
        mirrored = self.obs_signs * mean[self.obs_order]
        middle = 0.5 * (mean + mirrored)
        spread = 0.5 * (var + var[self.obs_order]) + 0.25 * (mean - mirrored).square()
        return middle, spread

    def layers(self) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Return weights and biases of a plain network that answers alike, twice as wide, activations between as here.

        With them a mirrored policy is saved and exported as any other. The network must be linear layers in a row with
        activations between.
        """
        linear = [layer for layer in self.network if isinstance(layer, nn.Linear)]
        obs, action = _matrix(self.obs_order, self.obs_signs), _matrix(self.action_order, self.action_signs)
        found = []
        for index, layer in enumerate(linear):
            weight, bias = layer.weight.detach(), layer.bias.detach()
            if len(linear) == 1:
                weight, bias = 0.5 * (weight + action @ weight @ obs), 0.5 * (bias + action @ bias)
            elif index == 0:
                weight, bias = torch.cat([weight, weight @ obs]), torch.cat([bias, bias])
            elif index < len(linear) - 1:
                weight, bias = torch.block_diag(weight, weight), torch.cat([bias, bias])
            else:
                weight, bias = 0.5 * torch.cat([weight, action @ weight], dim=1), 0.5 * (bias + action @ bias)
            found.append((weight, bias))
        return found


def _matrix(order: torch.Tensor, signs: torch.Tensor) -> torch.Tensor:
    """Return the matrix of a mirror image."""
    return signs[:, None] * torch.eye(len(order), device=signs.device)[order]
