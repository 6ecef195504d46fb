"""Uncertainty of an identification: effects of model errors, and undetermined combinations of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jumper_warp.identification.least_squares import NormalEquations
from jumper_warp.identification.parameters import Parameter, ParameterSet

WEAK = 3.0
"""[1] Data over prior information below which a direction is undetermined: at 3 the std is half the prior's."""
TORQUE_SCALE = ("base_mass", "link_mass", "kp", "kd", "saturation", "armature", "motor_friction", "knee_damping")
"""Quantities of `RobotValues` that may all grow by the same factor without any effect on motor angles."""
MAX_LAGS = 200  # Largest lag [rows] of the summed autocorrelations
ADVICE = {
    "no_load_speed": "no motor comes close to its no-load speed: add a fast motion, or measure torque against speed",
    "cutoff_speed": "no motor exceeds its cutoff speed at full torque: add a fast motion, or a test bench",
    "saturation": "the torque limit is not reached: add a jump or large steps of the target",
    "paw_friction": "the paws hardly slip: add a motion in which they do, or a pull with a scale",
    "base_com": "the base hardly tilts or is not measured: add a motion on the ground with its pose",
    "base_mass": "the base is held or not measured: add a motion on the ground, or a weighed mass",
    "base_inertia": "the base hardly turns: add a motion on the ground that tilts it",
    "motor_friction": "the motors hardly move slowly: add a slow motion in the air",
    "armature": "armature and the inertia of the links cannot be separated: add a fast motion, or torques",
    "link_mass": "masses of neighbouring links cannot be separated: weigh a leg's links",
    "knee_damping": "the knees' damping cannot be separated from the gains: add a motion with the motors off",
    "kd": "damping by the motors and other losses cannot be separated: add torques",
    "kp": "gains cannot be separated from the load of the legs: add a weighed mass or torques",
    "latency": "the targets hardly change: add steps or a faster motion",
    "offset": "the motions do not determine the sensors' zeros: add the pose of the base, or another pose of the legs",
}
"""Reason why the data does not determine a quantity, and a measurement that would determine it, by quantity."""


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that the recorded motions do not determine."""

    information: float
    """[1] Fisher information of the data along the direction over the prior's; 0: only the prior determines it."""
    weights: tuple[tuple[str, float], ...]
    """(parameter name, component) of up to six largest components of the unit vector in normalised parameters."""
    words: str  # description in English, with a measurement that would determine the combination


def mismatch_factor(tables: Sequence[np.ndarray]) -> float:
    """Return the factor [1], at least 1, by which model errors widen intervals that are computed from noise alone.

    tables: residuals of each motion over their noise, (n rows, columns), NaN where nothing is measured. Residuals with
    mean square chi2 and correlation time tau [rows] carry 1 / (chi2 tau) of the information of white noise.
    """
    squares = np.concatenate([table[np.isfinite(table)] for table in tables]) ** 2
    chi2 = float(np.mean(squares))
    correlation = autocorrelation([column[np.isfinite(column)] for table in tables for column in table.T])
    tau = 1.0 + 2.0 * float(np.sum(correlation))
    excess = max(chi2, 1.0) * max(tau, 1.0)
    # an excess within six standard deviations of chance is noise
    return float(np.sqrt(excess)) if excess > 1.0 + 6.0 * np.sqrt(2.0 / len(squares)) else 1.0


def trapped_variance(moves: np.ndarray, excess: np.ndarray, std: float) -> float:
    """Return a parameter's additional variance from values that fit better than the linear model (std) predicts.

    While a paw slips, its friction is determined; yet a greater friction, at which it sticks, may fit as well. The
    parameter's density is that of the linear model, plus what other values' likelihoods exceed it. moves: changes of
    the parameter from the fit in equal steps, (K,), in the unit of std. excess: cost above the fit's at each, (K,).
    """
    likelihood = np.exp(-0.5 * np.maximum(excess, 0.0))
    missed = np.maximum(likelihood - np.exp(-0.5 * (moves / std) ** 2), 0.0) * np.gradient(moves)
    return float(missed @ moves**2 / (std * np.sqrt(2.0 * np.pi) + missed.sum()))


def autocorrelation(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Return the common autocorrelation [1] of series of residuals at lags 1, 2, ... up to where noise dominates.

    The last lag is before the first with an autocorrelation below three standard deviations of its chance value, and
    at most `MAX_LAGS`. It is computed by a Fourier transform of twice the length, so that the series' ends do not
    overlap. columns: (n,) each; series of less than 8 values do not count.
    """
    lags = np.zeros(MAX_LAGS + 1)
    for values in columns:
        n = len(values)
        if n < 8:
            continue
        spectrum = np.fft.rfft(values, 2 * n)
        products = np.fft.irfft(np.abs(spectrum) ** 2)[: min(n, MAX_LAGS + 1)]
        lags[: len(products)] += products
    correlation = lags[1:] / max(lags[0], 1.0e-300)
    below = np.flatnonzero(correlation < 3.0 / np.sqrt(max(sum(map(len, columns)), 1)))
    return correlation[: below[0] if len(below) else len(correlation)]


def systematic_std(normal: NormalEquations, columns: Sequence[np.ndarray], covariance: np.ndarray) -> np.ndarray:
    """Return the standard deviations (P,) of normalised parameters from contradictions of channels and of motions.

    An error of the model repeats in each row, so the clusters are each channel of each motion (such as a motor's
    angle), and each motion. The changes by leaving one cluster out, to first order, give the jackknife's estimate
    (CR3: Bell & McCaffrey 2002). The variances of channels and motions are added, as an error may be alike in all
    channels of a motion.

    columns: by motion, the measurement column (such as a motor's angle) of each residual, (m,). covariance: (P, P), of
    normalised parameters, with the priors: its inverse is `NormalEquations.information` plus the identity matrix.
    """
    size = len(covariance)
    information = np.linalg.inv(covariance)
    channels: list[np.ndarray] = []
    motions: list[np.ndarray] = []
    parts = zip(normal.linearised, normal.weights, normal.start_matrices, normal.cross_matrices, columns, strict=True)
    for linear, weight, start_matrix, cross, column in parts:
        root = np.sqrt(weight)
        # (m, P) derivatives by the parameters while the motion's best initial state follows them (marginalised)
        marginal = linear.jacobian[:, :size] - linear.jacobian[:, size:] @ np.linalg.solve(start_matrix, cross.T)
        jacobian = root[:, None] * marginal
        residual = root * linear.residual
        for i in np.unique(column):
            channels.append(_leave_out_change(information, jacobian[column == i], residual[column == i]))
        motions.append(_leave_out_change(information, jacobian, residual))
    return np.sqrt(_jackknife_variance(channels) + _jackknife_variance(motions))


def _leave_out_change(information: np.ndarray, jacobian: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return the first-order change (P,) of the fitted parameters when some residuals are left out.

    The residuals (m,) have the Jacobian (m, P). information: Fisher information of all data and priors, (P, P).
    """
    return np.linalg.solve(information - jacobian.T @ jacobian, jacobian.T @ residual)


def _jackknife_variance(changes: Sequence[np.ndarray]) -> np.ndarray:
    """Return the jackknife variance (P,) from the change (P,) by leaving out each cluster; 0 for a single cluster."""
    return (len(changes) - 1.0) / len(changes) * np.sum(np.square(changes), axis=0)


def weak_directions(parameters: ParameterSet, information: np.ndarray) -> tuple[Direction, ...]:
    """Return the combinations of parameters that the data does not determine (below `WEAK`), most uncertain first.

    information: Fisher information of the data about the normalised parameters, without priors, (P, P).
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
        directions.append(Direction(max(float(value), 0.0), weights, describe_direction(parameters, vector)))
    return tuple(directions)


def describe_direction(parameters: ParameterSet, vector: np.ndarray) -> str:
    """Describe an undetermined combination of parameters in English, with a measurement that would determine it.

    vector: unit vector in normalised parameters, (P,).
    """
    scale = np.array([p.z_per_growth if p.quantity in TORQUE_SCALE else 0.0 for p in parameters])
    size = np.linalg.norm(scale)
    if np.count_nonzero(scale) > 1 and size > 0.0 and abs(scale @ vector) / size > 0.6:
        parts = sorted({p.quantity for p in parameters if p.quantity in TORQUE_SCALE}, key=TORQUE_SCALE.index)
        return f"{', '.join(english_name(part) for part in parts)} share a scale: add a weighed mass, or torques"
    fractions: dict[str, float] = {}
    for parameter, component in zip(parameters, vector, strict=True):
        fractions[parameter.quantity] = fractions.get(parameter.quantity, 0.0) + float(component) ** 2
    quantities = sorted(fractions, key=fractions.__getitem__, reverse=True)
    quantities = [quantity for quantity in quantities if fractions[quantity] > 0.15][:3] or quantities[:1]
    names = largest_members(parameters.parameters, vector, quantities[0])
    subject = " and ".join(english_name(quantity) for quantity in quantities)
    return f"{subject}{names}: {ADVICE.get(quantities[0], 'the data does not determine it')}"


def largest_members(parameters: Sequence[Parameter], vector: np.ndarray, quantity: str) -> str:
    """Return as text which parameters of a quantity, up to four, dominate an undetermined combination.

    vector: (P,). Empty if the quantity has only one parameter or all its components are below 0.3.
    """
    components = [
        (abs(c), p.name.partition("/")[2]) for p, c in zip(parameters, vector, strict=True) if p.quantity == quantity
    ]
    names = [name for size, name in sorted(components, reverse=True) if size > 0.3 and name]
    return f" ({', '.join(names[:4])})" if names and len(components) > 1 else ""


def english_name(quantity: str) -> str:
    """Return the English name of a quantity of `RobotValues`, such as `torque limit` for `saturation`."""
    words = {"kp": "proportional gain", "kd": "derivative gain", "base_com": "centre of mass of the base",
             "offset": "sensor offset", "saturation": "torque limit"}  # fmt: skip
    return words.get(quantity, quantity.replace("_", " "))
