"""Jacobians of policy steps, by the reverse pass of single steps: every step is a world of one batch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jumper_warp.diff.rollout import Rollout, Trajectory
from jumper_warp.utils.errors import InputError

STATE = ("q", "qd")


def step_jacobians(
    steps: Rollout, trajectory: Trajectory, world: int = 0, by: Sequence[str] = ("q", "qd", "targets")
) -> dict[str, np.ndarray]:
    """Return the derivatives of the state after each policy step of one world.

    Args:
        steps: A rollout with a world for each of the T policy steps, whose parameters are those of that world, and with
            the physics step and substeps of the one that made the trajectory; its latency must be below a policy step.
        trajectory: One with a row a policy step.
        world: Which.
        by: Names of what `Rollout.backward` returns.

    Returns by name (T, 37, ...): derivatives of the 19 entries of q and the 18 of qd, each by the entries of the input
    at the step's start, without worlds; its cost does not grow with `by`. Raises InputError for other numbers of worlds
    or rows, a world that is not there, a latency of a policy step or more, or another name.
    """
    count = trajectory.safe.shape[0]
    if steps.num_worlds != count or trajectory.q.shape[0] != count + 1 or steps.every != steps.substeps:
        raise InputError(f"{count} policy steps need as many worlds and a row each, got {steps.num_worlds} worlds")
    if not steps.parameters["latency"].numpy().max() < steps.substeps * steps.dt:
        raise InputError(f"Jacobians of steps need a latency below a policy step, {steps.substeps * steps.dt:.4g} s")
    if world not in range(trajectory.q.shape[2]):
        raise InputError(f"world must be below {trajectory.q.shape[2]}, got {world!r:.20}")
    inputs = {"targets", "q", "qd", "before", "wrench", "geometry", *steps.parameters}
    if unknown := set(by) - inputs:
        raise InputError(f"a rollout has no input {min(unknown)!r:.40}; it has {', '.join(sorted(inputs))}")
    q, qd = (getattr(trajectory, name).numpy()[:-1, :, world].T for name in STATE)
    targets = trajectory.commands.target.numpy()[:, :, world].T[None]
    wrench = trajectory.commands.wrench.numpy()[:, :, world].T[None]
    commands, last = trajectory.commands, steps.substeps - 1
    before = [commands.before.numpy()[None, :, world], trajectory.safe.numpy()[:-1, :, world]]
    impulse = [
        commands.impulse.numpy()[None, :, world],
        trajectory.impulse.numpy()[last : -1 : steps.substeps, :, world],
    ]
    made = steps.run(
        targets, q, qd, before=np.concatenate(before).T, wrench=wrench,
        impulse=steps.vectors(np.swapaxes(np.concatenate(impulse), 0, 1)),
    )  # fmt: skip
    found: dict[str, list[np.ndarray]] = {name: [] for name in by}
    for output, size in zip(STATE, (19, 18), strict=True):
        for entry in range(size):
            seed = np.zeros((2, size, count))
            seed[1, entry] = 1.0
            gradient = steps.backward(made, **{output: steps.array(seed)})
            for name in by:
                values = gradient[name].numpy()
                found[name].append(np.moveaxis(values, -1, 0).copy())
    return {name: np.stack(rows, axis=1) for name, rows in found.items()}
