"""How far what was identified can be trusted: mismatch of the model, and what the data does not tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jumper_warp.identification.least_squares import Normal
from jumper_warp.identification.parameters import Parameter, ParameterSet

WEAK = 3.0
"""Information, in the prior's, below which a direction counts as open: data and prior together halve it then."""
TORQUE_SCALE = (
    "base_mass", "link_mass", "kp", "kd", "saturation", "armature", "motor_friction", "knee_damping",
)  # fmt: skip
"""Quantities that may all grow by the same factor without any effect on angles."""
MOST_LAGS = 200
ADVICE = {
    "no_load_speed": "no motor comes close to its no-load speed: add a fast motion, or measure torque against speed",
    "cutoff_speed": "no motor exceeds its cutoff speed at full torque: add a fast motion, or a test bench",
    "saturation": "the torque limit is not reached: add a jump or large steps of the target",
    "paw_friction": "the paws hardly slip: add a motion in which they do, or a pull with a scale",
    "base_com": "the base hardly tilts or is not measured: add a motion on the ground with its pose",
    "base_mass": "the base is held or not measured: add a motion on the ground, or a weighed mass",
    "base_inertia": "the base hardly turns: add a motion on the ground that tilts it",
    "motor_friction": "the motors hardly move slowly: add a slow motion in the air",
    "armature": "armature and the inertia of the links are not told apart: add a fast motion, or torques",
    "link_mass": "masses of neighbouring links are not told apart: weigh a leg's links",
    "knee_damping": "the knees' damping hides behind the gains: add a motion with the motors off",
    "kd": "damping by the motors and other losses are not told apart: add torques",
    "kp": "gains are not told apart from what the legs carry: add a weighed mass or torques",
    "latency": "the targets hardly change: add steps or a faster motion",
    "offset": "the motions do not tell the sensors' zeros: add the pose of the base, or another pose of the legs",
}


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that the data leaves open."""

    information: float
    """Of the data, in units of the prior's: 0 where only the prior speaks."""
    weights: tuple[tuple[str, float], ...]
    """Largest components of the unit vector in prior deviations, by the name of the parameter."""
    words: str
    """What it is, and what would help."""


def mismatch_factor(tables: Sequence[np.ndarray]) -> float:
    """Return how much wider than noise alone the model's errors make the intervals, at least 1.

    tables: weighed residuals of each motion, (n, columns), NaN where nothing is measured. Errors that last count again
    in each row, though they are one error: with mean square chi2 and a sum of autocorrelations tau, the information is
    smaller by chi2 tau than that of white noise of the stated size.
    """
    squares = np.concatenate([table[np.isfinite(table)] for table in tables]) ** 2
    chi2 = float(np.mean(squares))
    lags = np.zeros(MOST_LAGS + 1)
    for table in tables:
        for column in table.T:
            values = column[np.isfinite(column)]
            if len(values) < 8:
                continue
            n = len(values)
            spectrum = np.fft.rfft(values, 2 * n)
            found = np.fft.irfft(np.abs(spectrum) ** 2)[: min(n, MOST_LAGS + 1)]
            lags[: len(found)] += found
    correlation = lags[1:] / max(lags[0], 1.0e-300)
    # the sum ends where noise takes over
    below = np.flatnonzero(correlation < 3.0 / np.sqrt(len(squares)))
    tau = 1.0 + 2.0 * float(np.sum(correlation[: below[0] if len(below) else len(correlation)]))
    excess = max(chi2, 1.0) * max(tau, 1.0)
    # as far as chance alone may go, noise is all there is
    return float(np.sqrt(excess)) if excess > 1.0 + 6.0 * np.sqrt(2.0 / len(squares)) else 1.0


def systematic_deviations(normal: Normal, columns: Sequence[np.ndarray], covariance: np.ndarray) -> np.ndarray:
    """Return standard deviations (P,) from how far single channels, and single motions, pull the parameters.

    An error of the model is no noise: it pulls again in each row. So each channel of each motion (a motor's angle, say)
    is one voice, and each motion is another; what leaving one out would change, to first order, adds up to the
    jackknife's estimate, as the cluster-robust one of regression (CR3: Bell & McCaffrey 2002). The two are added, as
    an error may be alike in all channels of a motion.

    columns: of each motion's residuals, (m,).
    """
    size, known = len(covariance), np.linalg.inv(covariance)
    channels: list[np.ndarray] = []
    motions: list[np.ndarray] = []
    parts = zip(normal.linearised, normal.weights, normal.start_matrices, normal.mixed, columns, strict=True)
    for found, weight, own, mixed, column in parts:
        root = np.sqrt(weight)
        alone = found.jacobian[:, :size] - found.jacobian[:, size:] @ np.linalg.solve(own, mixed.T)
        alone, residual = root[:, None] * alone, root * found.residual
        channels += [_pull(known, alone[column == i], residual[column == i]) for i in np.unique(column)]
        motions.append(_pull(known, alone, residual))
    return np.sqrt(_jackknife(channels) + _jackknife(motions))


def _pull(known: np.ndarray, jacobian: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return by how much (P,) parameters would change without some residuals; known: information of all, (P, P)."""
    return np.linalg.solve(known - jacobian.T @ jacobian, jacobian.T @ residual)


def _jackknife(pulls: Sequence[np.ndarray]) -> np.ndarray:
    """Return the variance (P,) of what each of some groups pulls at; 0 for a single one."""
    return (len(pulls) - 1.0) / len(pulls) * np.sum(np.square(pulls), axis=0)


def weak_directions(parameters: ParameterSet, information: np.ndarray) -> tuple[Direction, ...]:
    """Return the combinations of parameters that the data leaves open, weakest first, told in words.

    information: of the data on the parameters, (P, P), in prior deviations.
    """
    values, vectors = np.linalg.eigh(information)
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value >= WEAK:
            break
        order = np.argsort(-np.abs(vector))
        sign = np.sign(vector[order[0]])
        weights = tuple(
            (parameters.parameters[i].name, float(sign * vector[i])) for i in order[:6] if abs(vector[i]) > 0.15
        )
        found.append(Direction(max(float(value), 0.0), weights, in_words(parameters, vector)))
    return tuple(found)


def in_words(parameters: ParameterSet, vector: np.ndarray) -> str:
    """Return what a direction that the data leaves open means, and what would help."""
    scale = np.array([p.growth if p.quantity in TORQUE_SCALE else 0.0 for p in parameters])
    size = np.linalg.norm(scale)
    if np.count_nonzero(scale) > 1 and size > 0.0 and abs(scale @ vector) / size > 0.6:
        parts = sorted({p.quantity for p in parameters if p.quantity in TORQUE_SCALE}, key=TORQUE_SCALE.index)
        return f"{', '.join(plain(part) for part in parts)} share a scale: add a weighed mass, or torques"
    shares: dict[str, float] = {}
    for parameter, component in zip(parameters, vector, strict=True):
        shares[parameter.quantity] = shares.get(parameter.quantity, 0.0) + float(component) ** 2
    quantities = sorted(shares, key=shares.__getitem__, reverse=True)
    quantities = [quantity for quantity in quantities if shares[quantity] > 0.15][:3] or quantities[:1]
    who = members(parameters.parameters, vector, quantities[0])
    what = " and ".join(plain(quantity) for quantity in quantities)
    return f"{what}{who}: {ADVICE.get(quantities[0], 'the data says nothing of it')}"


def members(parameters: Sequence[Parameter], vector: np.ndarray, quantity: str) -> str:
    """Return which parameters of a quantity a direction is about, in brackets; nothing if there is only one."""
    of_it = [
        (abs(c), p.name.partition("/")[2]) for p, c in zip(parameters, vector, strict=True) if p.quantity == quantity
    ]
    names = [name for size, name in sorted(of_it, reverse=True) if size > 0.3 and name]
    return f" ({', '.join(names[:4])})" if names and len(of_it) > 1 else ""


def plain(quantity: str) -> str:
    """Return a quantity's name in words."""
    words = {"kp": "proportional gain", "kd": "derivative gain", "base_com": "centre of mass of the base",
             "offset": "sensor offset", "saturation": "torque limit"}  # fmt: skip
    return words.get(quantity, quantity.replace("_", " "))
