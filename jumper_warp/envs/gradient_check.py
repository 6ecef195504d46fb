"""Check of the gradients of a task's rewards against differences."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from jumper_warp.envs.gradients import EnvGradients, StepInputs

STEPS = {"joint_q": 1.0e-4, "joint_qd": 3.0e-4, "prev_lin_vel": 3.0e-5, "prev_rate": 1.0e-2, "torque": 1.0e-2,
         "prev_torque": 1.0e-2, "paw_force": 0.1, "peak_force": 0.1}  # fmt: skip
"""Standard deviations of the inputs' changes in SI units; 1e-3 for those that are not listed (actions, targets)."""
ROUNDING = 1.0e-7  # Changes of a term below this are rounding
TOLERANCE = 0.01  # Of a gradient along a direction, relative to its largest absolute value


class GradientCheck:
    """Gradients of a task's reward terms in the steps of an `EnvGradients`, each along one random direction."""

    def __init__(self, gradients: EnvGradients, seed: int = 0) -> None:
        """Prepare an empty check; seed: of the directions."""
        self._gradients = gradients
        self._generator = torch.Generator().manual_seed(seed)
        self._steps = 0
        self._found: list[np.ndarray] = []
        self._differences: list[np.ndarray] = []

    def every(self, count: int) -> None:
        """Add every `count`-th step of the calls, and end the gradients of all steps."""
        self._steps += 1
        if self._steps % count == 0:
            self.update()
        self._gradients.restart()

    def update(self) -> None:
        """Add the last step: its gradients along a random direction of `StepInputs`, and central differences."""
        gradients = self._gradients
        arrays = gradients.arrays
        directions = {}
        for name in StepInputs._fields:
            like = wp.to_torch(arrays[name])
            noise = torch.randn(like.shape, generator=self._generator)
            directions[name] = STEPS.get(name, 1.0e-3) * noise.to(like.device)
        ends = []
        for sign in (1.0, -1.0):
            moved = {name: wp.clone(array) for name, array in arrays.items()}
            for name, direction in directions.items():
                wp.to_torch(moved[name], requires_grad=False).add_(sign * direction)
            ends.append(gradients.evaluate(moved)[0].numpy().astype(np.float64))
        self._differences.append(0.5 * (ends[0] - ends[1]))
        rewards, components = gradients.shape
        n = gradients.num_worlds
        device = gradients.env.device
        numbers = wp.to_torch(gradients.env.skills[0].params.values)
        weights = [slot.weight for slot in gradients.task.params.slots["rewards"]]
        rows = []
        for weight in weights:  # one term at a time: an infinite slope of one would reach the others
            alone = numbers.clone()
            alone[weights] = 0.0
            alone[weight] = numbers[weight]
            by_terms, nothing = torch.ones(rewards, n, device=device), torch.zeros(components, n, device=device)
            by_arrays = gradients.reverse(arrays, by_terms, nothing, alone)
            parts = [_by_world(wp.to_torch(by_arrays[name]) * along, n) for name, along in directions.items()]
            rows.append(torch.stack(parts).sum(0).cpu().numpy())
        self._found.append(np.stack(rows))

    def faults(self) -> dict[str, str]:
        """Return, by name of a reward term, what is wrong with its gradient; terms without a fault are left out.

        A term whose value never changes has no gradient, which is no fault.
        """
        faults = {}
        kinks = self.kinks()
        for name, (found, differences) in self.results().items():
            largest = np.abs(differences).max()
            if not np.isfinite(found).all():
                faults[name] = "not finite"
            elif largest > ROUNDING and not found.any():
                faults[name] = "zero everywhere, although the term changes"
            elif kinks[name] > 0.05:
                faults[name] = f"differs from differences in {100.0 * kinks[name]:.0f} % of the steps"
        return faults

    def kinks(self) -> dict[str, float]:
        """Return, by name of a reward term, the share of samples in which gradient and difference disagree.

        They differ by more than 1 % of the term's largest absolute difference, as where a branch changes between.
        """
        kinks = {}
        for name, (found, differences) in self.results().items():
            limit = TOLERANCE * np.abs(differences).max()
            kinks[name] = float((np.abs(found - differences) > limit).mean()) if limit > TOLERANCE * ROUNDING else 0.0
        return kinks

    def results(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return changes of each reward term along the directions, (steps, num_worlds): by gradient, by difference."""
        found, differences = np.stack(self._found), np.stack(self._differences)
        terms = self._gradients.task.rewards
        return {term.name: (found[:, i], differences[:, i]) for i, term in enumerate(terms)}


def _by_world(values: torch.Tensor, num_worlds: int) -> torch.Tensor:
    """Return sums of values over all axes but that of the worlds, (num_worlds,)."""
    if values.ndim == 1 or (values.ndim == 2 and values.shape[0] == num_worlds):  # world by world
        return values.reshape(num_worlds, -1).sum(1)
    return values.sum([axis for axis in range(values.ndim) if axis != 1])
