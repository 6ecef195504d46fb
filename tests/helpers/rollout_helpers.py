"""Jumps with four different legs, a random weighted sum of their trajectory, and its gradients and differences."""

import dataclasses
import math
from functools import cache

import numpy as np

from jumper_warp.diff.rollout import Rollout, compact
from jumper_warp.robot.description import load_description
from jumper_warp.robot.grounds import uneven
from jumper_warp.robot.model import build_model, standing_configuration
from jumper_warp.robot.motors import jumping_motors, vertical_jump_filter

DT = 1.0 / 240.0
SUBSTEPS = 4
TICKS = 34
SQUAT = math.radians(85.0)
OUTPUTS = ("q", "qd", "torque", "impulse")


def squat() -> tuple[np.ndarray, np.ndarray]:
    """Return q (19,) and qd (18,) of a squat on the ground with small velocities."""
    description = dataclasses.replace(load_description(), poses={"squat": (0.0, SQUAT)})
    q, qd = (row[:, 0] for row in compact(standing_configuration(description, "squat"), np.zeros(38)))
    q[2] -= 1.0e-4
    qd[:6] = [0.1, 0.05, 0.0, 0.02, -0.03, 0.1]
    return q, qd


def push_off(ticks: int = TICKS) -> np.ndarray:
    """Return the motor targets [rad] of a push-off, (ticks, 12)."""
    targets = np.zeros((ticks, 4, 3))
    targets[:2, :, 1:] = SQUAT
    targets[2:] = np.radians([[1.0, -5.0, -8.0], [-1.0, -3.0, -9.0], [2.0, 2.0, -8.0], [0.0, 1.0, -4.0]])
    return targets.reshape(ticks, 12)


@cache
def rollout(num_worlds: int = 1, double: bool = True, every: int = SUBSTEPS, ground: str = "plane") -> Rollout:
    """Return a cached rollout of the jump."""
    surface = uneven(0.03, seed=3, flat_radius=0.0) if ground == "uneven" else ground
    model = build_model(num_worlds, visuals=False, ground=surface)
    return Rollout(
        model, jumping_motors(), vertical_jump_filter(), double=double, dt=DT, substeps=SUBSTEPS, every=every, threads=1
    )


@cache
def nominal() -> dict[str, np.ndarray]:
    """Return the default parameters of a rollout, without the axis of worlds."""
    new = Rollout(build_model(1, visuals=False), jumping_motors(), vertical_jump_filter(), double=True)
    return {name: array.numpy()[..., 0].astype(float) for name, array in new.parameters.items()}


def defaults() -> dict[str, np.ndarray]:
    """Return the inputs of a jump by name, without the axis of worlds."""
    q, qd = squat()
    values = {"targets": push_off(), "q": q, "qd": qd, "initial_target": q[7:], "wrench": np.zeros((TICKS, 6))}
    return values | {name: value.copy() for name, value in nominal().items()}


def run(of: Rollout, values: dict[str, np.ndarray]):
    """Return the trajectory of inputs by name, without the axis of worlds or with it last."""
    for name, array in of.parameters.items():
        value = np.asarray(values[name])
        array.assign(np.broadcast_to(value[..., None], array.shape) if value.ndim < array.ndim else value)
    commands = {name: values[name] for name in ("targets", "q", "qd", "initial_target", "wrench")}
    return of.run(**commands)


def weights(trajectory, kinds=OUTPUTS, seed: int = 0) -> dict[str, np.ndarray]:
    """Return random weights of states, torques and impulses at all times, for one world."""
    rng = np.random.default_rng(seed)
    sizes = {"q": 1.0, "qd": 0.1, "torque": 1.0e-3, "impulse": 0.01}
    drawn = {name: sizes[name] * rng.normal(size=getattr(trajectory, name).numpy().shape) for name in OUTPUTS}
    return {name: drawn[name] for name in kinds}


def weighted_sum(trajectory, by: dict[str, np.ndarray]) -> np.ndarray:
    """Return the weighted sum of each world's trajectory, (num_worlds,)."""
    n = trajectory.q.shape[-1]
    total = np.zeros(n)
    for name, weight in by.items():
        values = getattr(trajectory, name).numpy()
        if name == "impulse":
            values, weight = np.moveaxis(values, 2, -1), np.moveaxis(weight, 2, -1)
        total += (values * weight).reshape(-1, n).sum(axis=0)
    return total


def gradients(of: Rollout, values: dict[str, np.ndarray], by: dict[str, np.ndarray] | None = None):
    """Return the weights and the gradients of the weighted sum by name, for one world, without its axis."""
    trajectory = run(of, values)
    by = weights(trajectory) if by is None else by
    cotangents = {name: (of.vectors if name == "impulse" else of.array)(weight) for name, weight in by.items()}
    by_inputs = of.backward(trajectory, **cotangents)
    by_inputs["initial_target"] = by_inputs["initial_target"][-1]  # the latest of several
    return by, {name: array.numpy()[..., 0].astype(float).copy() for name, array in by_inputs.items()}


def differences(values, by, name: str, entries: list, h: float, **setup) -> np.ndarray:
    """Return fourth-order central differences of the weighted sum by entries of one input, in parallel worlds."""
    steps = np.array([-2.0, -1.0, 1.0, 2.0])
    ends = np.repeat(np.asarray(values[name], dtype=float)[..., None], 4 * len(entries), axis=-1)
    for i, entry in enumerate(entries):
        ends[entry][4 * i : 4 * i + 4] += h * steps
    worlds = {
        key: np.repeat(np.asarray(value)[..., None], 4 * len(entries), axis=-1) for key, value in values.items()
    } | {name: ends}
    sums = weighted_sum(run(rollout(4 * len(entries), **setup), worlds), by).reshape(-1, 4)
    return sums @ np.array([1.0, -8.0, 8.0, -1.0]) / (12.0 * h)
