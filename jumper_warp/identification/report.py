"""Output files of an identification: a robot overlay, a report as JSON, and plots."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.identification.consistency import FAMILY_LEVEL
from jumper_warp.identification.replay import MotionReplay
from jumper_warp.identification.residuals import MotionResiduals
from jumper_warp.identification.results import Identification
from jumper_warp.robot.description import MOTOR_JOINTS
from jumper_warp.robot.overlay import RobotOverlay, overlay_of
from jumper_warp.utils.files import write_atomically
from jumper_warp.viz.plots import figure

UNITS = {"angle": ("deg", 180.0 / math.pi), "rate": ("rad/s", 1.0), "torque": ("N m", 1.0), "position": ("m", 1.0),
         "orientation": ("deg", 180.0 / math.pi)}  # fmt: skip
"""(unit in the report, factor from SI to this unit) by channel."""
RATIO_ROWS = {
    "link_mass": "link_mass", "kp": "gains", "kd": "damping_gains", "armature": "armature",
    "no_load_speed": "no_load_speed", "cutoff_speed": "cutoff_speed",
}  # fmt: skip
"""Row of `RandomizationCfg` that scales a quantity of `RobotValues`, by quantity."""


def to_json(result: Identification) -> dict[str, Any]:
    """Return the content of `report.json`: identified and undetermined parameters, fit, steps and effort.

    Values and their intervals are in the parameter's unit. deviation_of_prior: standard deviation over that of the
    prior, 1: nothing was learnt. mismatch: factor by which errors of the model widen the intervals.
    """
    rows = []
    for i, parameter in enumerate(result.parameters):
        low, high = result.intervals[i]
        rows.append(
            {
                "name": parameter.name,
                "unit": parameter.unit,
                "nominal": parameter.nominal,
                "value": float(result.values[i]),
                "interval_95": [float(low), float(high)],
                "deviation_of_prior": float(result.std[i]),
                "identified": bool(result.identified[i]),
            }
        )
    return {
        "parameters": rows,
        "chi2": result.chi2,
        "nominal_chi2": result.nominal_chi2,
        "mismatch": result.mismatch,
        "consistent": result.consistent,
        "inconsistency": result.inconsistency,
        "doubts": list(result.warnings),
        "count": result.count,
        "dt_s": result.dt,
        "wall_s": result.effort.seconds,
        "cpu_s": result.effort.cpu_seconds,
        "world_steps": result.effort.world_steps,
        "fits": [vars(fit) for fit in result.fits],
        "family_level": FAMILY_LEVEL,
        "tests": [vars(test) | {"passed": test.passed} for test in result.tests],
        "starts": [vars(start) for start in result.starts],
        "starts_agree": result.starts_agree,
        "open_directions": [
            {"information": d.information, "words": d.words, "weights": dict(d.weights)} for d in result.directions
        ],
        "steps": [vars(step) for step in result.steps],
    }


def write_results(result: Identification, folder: Path, source: str) -> None:
    """Write the identified robot (a robot overlay), `report.json` and plots to a folder. Raises OSError.

    The overlay is `identified.json`, or `inconsistent.json` if the fit is not consistent; an earlier one of the other
    name is removed. source: origin of the data, saved in the overlay.
    """
    names = ("identified.json", "inconsistent.json")
    name, other = names if result.consistent else names[::-1]
    (folder / other).unlink(missing_ok=True)
    source += "" if result.consistent else f"; the fit is not consistent: {result.inconsistency}"
    identified_overlay(result, source).save(folder / name)
    write_atomically(folder / "report.json", (json.dumps(to_json(result), indent=2) + "\n").encode())
    plot_results(result, folder)


def identified_overlay(result: Identification, source: str = "") -> RobotOverlay:
    """Return the identified robot as a robot overlay, with 95 % intervals as randomisation ranges.

    source: text on the origin of the values, for the overlay.
    """
    quantities = tuple(dict.fromkeys(parameter.quantity for parameter in result.parameters))
    fields = {"randomization": randomization_ranges(result), "source": source}
    return overlay_of(result.robots(), quantities, robot=result.motions[0].description.table, **fields)


def randomization_ranges(result: Identification) -> dict[str, tuple[float, float]]:
    """Return randomisation ranges of the environment that contain the 95 % intervals of all identified parameters.

    (low, high) by row of `RandomizationCfg`, in its units. Ratios, masses [kg], com [m] and offsets [deg] are relative
    to the identified values; friction and latency [ms] not.
    """
    rows: dict[str, tuple[float, float]] = {}

    def widen(row: str, low: float, high: float) -> None:
        """Extend a row's range to contain [low, high], as several parameters (motors, links) share a row."""
        old_low, old_high = rows.get(row, (low, high))
        rows[row] = (min(low, old_low), max(high, old_high))

    for parameter, value, (low, high) in zip(result.parameters, result.values, result.intervals, strict=True):
        quantity = parameter.quantity
        value = float(value)
        low = float(low)
        high = float(high)
        if quantity in RATIO_ROWS:
            widen(RATIO_ROWS[quantity], low / value, high / value)
        elif quantity == "base_mass":
            widen("base_mass", low - value, high - value)
        elif quantity == "base_com":
            widen("com_shift", low - value, high - value)
        elif quantity == "offset":
            widen("joint_offset", math.degrees(low - value), math.degrees(high - value))
        elif quantity == "motor_friction":
            widen("motor_friction", low, high)
        elif quantity == "paw_friction":
            widen("dynamic_friction", low, high)
            widen("static_friction", low, high)
        elif quantity == "latency":
            widen("latency", 1.0e3 * low, 1.0e3 * high)
    return rows


def plot_results(result: Identification, folder: Path) -> None:
    """Write plots to a folder: `parameters.png`, `progress.png`, and `motion_<index>_<name>.png` of each motion.

    Raises OSError.
    """
    plot_parameters(result, folder / "parameters.png")
    plot_progress(result, folder / "progress.png")
    for i, (motion, start) in enumerate(zip(result.motions, result.initial_states, strict=True)):
        plot_motion(result, motion, start, folder / f"motion_{i}_{motion.motion.name}.png")


def starts_line(result: Identification) -> str:
    """Return one line of text on whether the best two starting points of the optimisation reached the same cost."""
    if result.starts_agree is None:
        return "one start"
    others = ", ".join(
        f"+{start.excess:.1f} (parameters within {start.difference:.2g} standard deviations)"
        for start in result.starts[1:]
    )
    verb = "agree" if result.starts_agree else "do not agree"
    return f"starts {verb}: cost of the others {others}"


def plot_parameters(result: Identification, path: Path) -> None:
    """Plot all parameters with 95 % intervals, in prior standard deviations, into a file."""
    place = np.arange(len(result.z))
    names = [parameter.quantity for parameter in result.parameters]
    edges = [i for i in place if i == 0 or names[i] != names[i - 1]]
    with figure(path, figsize=(10.0, 3.6), title="Identified parameters") as axis:
        axis.axhspan(-1.0, 1.0, color="0.92", label="prior")
        axis.errorbar(place, result.z, yerr=1.96 * result.std, fmt=".", capsize=2, label="found, 95 %")
        axis.set_xticks(edges, [names[i] for i in edges], rotation=50, ha="right", fontsize=8)
        axis.set(ylabel="deviations of the prior", xlim=(-1, len(place)))


def plot_progress(result: Identification, path: Path) -> None:
    """Plot χ² over the physics steps, with a curve for each stage of the fit, into a file."""
    with figure(path, figsize=(6.0, 3.0), title="Progress of the fit") as axis:
        for stage in sorted({step.stage for step in result.steps}):
            steps = [step for step in result.steps if step.stage == stage]
            label = "final" if stage == result.steps[-1].stage else f"stage {stage}"
            axis.semilogy([s.world_steps / 1e6 for s in steps], [s.chi2 for s in steps], "o-", label=label)
        axis.set(xlabel="million physics steps of all worlds", ylabel="χ² per value")


def plot_motion(result: Identification, motion: MotionResiduals, start: np.ndarray, path: Path) -> None:
    """Plot one motion, measured and simulated, and its residuals, into a file.

    start: fitted coordinates of the initial state, (I,), see `MotionResiduals`.
    Above: measured and simulated values of the first channel at three motors (or axes). Below: residuals of channels.
    """
    replay = MotionReplay(description=motion.description, threads=1)
    record, robots = motion.run(replay, result.z[None], start[None])
    model = motion.sensor_readings(record, robots)[..., 0]
    time = motion.motion.time - motion.motion.time[0]
    first, columns = motion.channels[0]
    unit, factor = UNITS[first]
    with figure(path, 2, 3, figsize=(10.0, 5.0), sharex=True, title=motion.motion.name) as axes:
        for i, axis in enumerate(axes[0]):
            column = columns.start + min(i, columns.stop - columns.start - 1)
            name = MOTOR_JOINTS[i] if columns.stop - columns.start == 12 else "xyz"[i]
            axis.plot(time, factor * motion.measured[:, column], ".", ms=2, label="measured")
            axis.plot(time, factor * model[:, column], lw=1, label="model")
            axis.set(title=f"{name} {first} [{unit}]")
        for axis, (name, columns) in zip(axes[1], shown_channels(motion.channels), strict=False):
            error = (motion.measured - model)[:, columns] / motion.sigma[columns]
            axis.plot(time, np.where(motion.valid[:, columns], error, math.nan), ".", ms=1)
            axis.set(title=f"{name}: residuals [noise std]", xlabel="time [s]")


def shown_channels(channels: Sequence[tuple[str, slice]]) -> list[tuple[str, slice]]:
    """Choose up to three measured channels (name, columns) whose residuals the report plots."""
    order = {name: i for i, name in enumerate(("angle", "rate", "torque", "position", "orientation"))}
    return sorted(channels, key=lambda channel: order[channel[0]])[:3]
