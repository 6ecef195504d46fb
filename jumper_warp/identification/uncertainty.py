"""Uncertainty of an identification: mismatch of the model, and combinations of parameters that the data leaves open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jumper_warp.identification.least_squares import NormalEquations
from jumper_warp.identification.parameters import Parameter, ParameterSet

WEAK = 3.0
"""Information relative to the prior's below which a direction counts as open; at 3 the data halves the prior's
standard deviation."""
TORQUE_SCALE = (
    "base_mass", "link_mass", "kp", "kd", "saturation", "armature", "motor_friction", "knee_damping",
)  # fmt: skip
"""Quantities that may all grow by the same factor without any effect on angles."""
MAX_LAGS = 200
"""Rows over which autocorrelations are summed, at most."""
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
"""Measurement that determines a quantity which the data leaves open."""


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that the data leaves open."""

    information: float
    """[1] Of the data, relative to the prior's; 0: only the prior determines it."""
    weights: tuple[tuple[str, float], ...]
    """Largest components of the unit vector in normalised parameters, by name of the parameter."""
    words: str
    """Description, with a measurement that would determine it."""


def mismatch_factor(tables: Sequence[np.ndarray]) -> float:
    """Return the factor by which the model's errors widen the intervals from noise alone, at least 1.

    tables: weighed residuals of each motion, (n, columns), NaN where nothing is measured. An error that lasts counts
    again in each row: with mean square chi2 and a sum of autocorrelations tau, the information is smaller by chi2 tau
    than with white noise of the stated size.
    """
    squares = np.concatenate([table[np.isfinite(table)] for table in tables]) ** 2
    chi2 = float(np.mean(squares))
    lags = np.zeros(MAX_LAGS + 1)
    for table in tables:
        for column in table.T:
            values = column[np.isfinite(column)]
            if len(values) < 8:
                continue
            n = len(values)
            spectrum = np.fft.rfft(values, 2 * n)
            correlation = np.fft.irfft(np.abs(spectrum) ** 2)[: min(n, MAX_LAGS + 1)]
            lags[: len(correlation)] += correlation
    correlation = lags[1:] / max(lags[0], 1.0e-300)
    # the sum ends where noise dominates
    below = np.flatnonzero(correlation < 3.0 / np.sqrt(len(squares)))
    tau = 1.0 + 2.0 * float(np.sum(correlation[: below[0] if len(below) else len(correlation)]))
    excess = max(chi2, 1.0) * max(tau, 1.0)
    # an excess within six standard deviations of chance is noise
    return float(np.sqrt(excess)) if excess > 1.0 + 6.0 * np.sqrt(2.0 / len(squares)) else 1.0


def systematic_std(normal: NormalEquations, columns: Sequence[np.ndarray], covariance: np.ndarray) -> np.ndarray:
    """Return cluster-robust standard deviations of the parameters (P,), from contradicting channels and motions.

    An error of the model repeats in each row, so the clusters are each channel of each motion (such as a motor's
    angle), and each motion. The changes by leaving one cluster out, to first order, give the jackknife's estimate
    (CR3: Bell & McCaffrey 2002). The variances of channels and motions are added, as an error may be alike in all
    channels of a motion.

    columns: column of each of a motion's residuals, (m,). covariance: (P, P), normalised.
    """
    size, information = len(covariance), np.linalg.inv(covariance)
    channels: list[np.ndarray] = []
    motions: list[np.ndarray] = []
    parts = zip(normal.linearised, normal.weights, normal.start_matrices, normal.cross_matrices, columns, strict=True)
    for linear, weight, start_matrix, cross, column in parts:
        root = np.sqrt(weight)
        marginal = linear.jacobian[:, :size] - linear.jacobian[:, size:] @ np.linalg.solve(start_matrix, cross.T)
        jacobian, residual = root[:, None] * marginal, root * linear.residual
        for i in np.unique(column):
            channels.append(_change_without(information, jacobian[column == i], residual[column == i]))
        motions.append(_change_without(information, jacobian, residual))
    return np.sqrt(_jackknife_variance(channels) + _jackknife_variance(motions))


def _change_without(information: np.ndarray, jacobian: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return the change (P,) of the parameters if residuals (m,) are left out; information: of all data, (P, P)."""
    return np.linalg.solve(information - jacobian.T @ jacobian, jacobian.T @ residual)


def _jackknife_variance(changes: Sequence[np.ndarray]) -> np.ndarray:
    """Return the jackknife's variance (P,) from the changes (P,) without each cluster; 0 for a single one."""
    return (len(changes) - 1.0) / len(changes) * np.sum(np.square(changes), axis=0)


def weak_directions(parameters: ParameterSet, information: np.ndarray) -> tuple[Direction, ...]:
    """Return the combinations of parameters that the data leaves open, the most uncertain first.

    information: of the data about the parameters, (P, P), normalised.
    """
    values, vectors = np.linalg.eigh(information)
    directions = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value >= WEAK:
            break
        order = np.argsort(-np.abs(vector))
        sign = np.sign(vector[order[0]])
        weights = tuple(
            (parameters.parameters[i].name, float(sign * vector[i])) for i in order[:6] if abs(vector[i]) > 0.15
        )
        directions.append(Direction(max(float(value), 0.0), weights, in_words(parameters, vector)))
    return tuple(directions)


def in_words(parameters: ParameterSet, vector: np.ndarray) -> str:
    """Return a description of a direction (P,) that the data leaves open, and what measurement would help."""
    scale = np.array([p.z_per_growth if p.quantity in TORQUE_SCALE else 0.0 for p in parameters])
    size = np.linalg.norm(scale)
    if np.count_nonzero(scale) > 1 and size > 0.0 and abs(scale @ vector) / size > 0.6:
        parts = sorted({p.quantity for p in parameters if p.quantity in TORQUE_SCALE}, key=TORQUE_SCALE.index)
        return f"{', '.join(plain(part) for part in parts)} share a scale: add a weighed mass, or torques"
    shares: dict[str, float] = {}
    for parameter, component in zip(parameters, vector, strict=True):
        shares[parameter.quantity] = shares.get(parameter.quantity, 0.0) + float(component) ** 2
    quantities = sorted(shares, key=shares.__getitem__, reverse=True)
    quantities = [quantity for quantity in quantities if shares[quantity] > 0.15][:3] or quantities[:1]
    names = members(parameters.parameters, vector, quantities[0])
    what = " and ".join(plain(quantity) for quantity in quantities)
    return f"{what}{names}: {ADVICE.get(quantities[0], 'the data says nothing of it')}"


def members(parameters: Sequence[Parameter], vector: np.ndarray, quantity: str) -> str:
    """Return the names of the parameters of a quantity in a direction (P,), in brackets; empty if there is only one."""
    components = [
        (abs(c), p.name.partition("/")[2]) for p, c in zip(parameters, vector, strict=True) if p.quantity == quantity
    ]
    names = [name for size, name in sorted(components, reverse=True) if size > 0.3 and name]
    return f" ({', '.join(names[:4])})" if names and len(components) > 1 else ""


def plain(quantity: str) -> str:
    """Return the English name of a quantity."""
    words = {"kp": "proportional gain", "kd": "derivative gain", "base_com": "centre of mass of the base",
             "offset": "sensor offset", "saturation": "torque limit"}  # fmt: skip
    return words.get(quantity, quantity.replace("_", " "))
