"""Output files of an identification: a robot overlay, and a report as self-contained HTML and as JSON."""

from __future__ import annotations

import base64
import html
import io
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

UNITS = {"angle": ("deg", 180.0 / math.pi), "rate": ("rad/s", 1.0), "torque": ("N m", 1.0), "position": ("m", 1.0),
         "orientation": ("deg", 180.0 / math.pi)}  # fmt: skip
"""(unit in the report, factor from SI to this unit) by channel."""
RATIO_ROWS = {
    "link_mass": "link_mass", "kp": "gains", "kd": "damping_gains", "armature": "armature",
    "no_load_speed": "no_load_speed", "cutoff_speed": "cutoff_speed",
}  # fmt: skip
"""Row of `RandomizationCfg` that scales a quantity of `RobotValues`, by quantity."""
TITLE = "System identification"
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 68rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: 0.15rem 0.8rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
.open { color: #999; } img { max-width: 100%; } .note { background: #fff6e0; padding: 0.6rem 1rem; }
"""


def to_json(result: Identification) -> dict[str, Any]:
    """Return the content of `report.json`: identified and undetermined parameters, fit, steps and effort."""
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
    """Write the identified robot (a robot overlay), `report.json` and `report.html` to a folder. Raises OSError.

    The overlay is `identified.json`, or `inconsistent.json` if the fit is not consistent; an earlier one of the other
    name is removed. source: origin of the data, saved in the overlay.
    """
    names = ("identified.json", "inconsistent.json")
    name, other = names if result.consistent else names[::-1]
    (folder / other).unlink(missing_ok=True)
    source += "" if result.consistent else f"; the fit is not consistent: {result.inconsistency}"
    identified_overlay(result, source).save(folder / name)
    write_atomically(folder / "report.json", (json.dumps(to_json(result), indent=2) + "\n").encode())
    write_html(result, folder)


def identified_overlay(result: Identification, source: str = "") -> RobotOverlay:
    """Return the identified robot as a robot overlay, with 95 % intervals as randomisation ranges.

    source: text on the origin of the values, for the overlay.
    """
    quantities = tuple(dict.fromkeys(parameter.quantity for parameter in result.parameters))
    return overlay_of(result.robots(), quantities, randomization=randomization_ranges(result), source=source)


def randomization_ranges(result: Identification) -> dict[str, tuple[float, float]]:
    """Return randomisation ranges of the environment that contain the 95 % intervals of all identified parameters.

    (low, high) by row of `RandomizationCfg`, in its units. Ratios, masses [kg], com [m] and offsets [deg] are relative
    to the identified values; friction and latency [ms] not.
    """
    rows: dict[str, tuple[float, float]] = {}

    def widen(row: str, low: float, high: float) -> None:
        old_low, old_high = rows.get(row, (low, high))
        rows[row] = (min(low, old_low), max(high, old_high))

    for parameter, value, (low, high) in zip(result.parameters, result.values, result.intervals, strict=True):
        quantity, value, low, high = parameter.quantity, float(value), float(low), float(high)
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


def write_html(result: Identification, folder: Path) -> None:
    """Write `report.html` to a folder, with embedded plots. Raises OSError."""
    parts = [
        f"<h1>{TITLE}</h1>",
        summary(result),
        open_directions(result),
        "<h2>Parameters</h2>",
        f"<p>{image(parameter_plot(result))}</p>",
        parameter_table(result),
        "<h2>Fit</h2>",
        fit_table(result),
        f"<p>{image(progress_plot(result))}</p>",
    ]
    for motion, start in zip(result.motions, result.initial_states, strict=True):
        parts.append(f"<h3>{html.escape(motion.motion.name)}</h3><p>{image(motion_plot(result, motion, start))}</p>")
    page = f"<!doctype html><html lang=en><meta charset=utf-8><title>{TITLE}</title><style>{STYLE}</style>"
    write_atomically(folder / "report.html", (page + "\n".join(parts) + "</html>\n").encode())


def summary(result: Identification) -> str:
    """Return the paragraphs at the top of the HTML report: counts, χ², effort and warnings."""
    text = (
        f"{int(result.identified.sum())} of {len(result.parameters)} parameters are identified from {result.count} "
        f"measured values. Mean squared weighed residual {result.chi2:.3f} (as described {result.nominal_chi2:.4g}). "
        f"{result.effort.seconds:.1f} s, {result.effort.cpu_seconds:.1f} s of CPU, "
        f"{result.effort.world_steps / 1e6:.2f} million physics steps of {1e3 * result.dt:.3g} ms."
    )
    if result.mismatch > 1.0:
        text += (
            f"</p><p class=note>The model does not fit the data within the noise: intervals are "
            f"{result.mismatch:.3g} times as wide as from noise alone."
        )
    doubts = [f"The fit is not consistent: {result.inconsistency}."] if result.inconsistency else []
    notes = "".join(f"<p class=note>{html.escape(line)}</p>" for line in (*doubts, *result.warnings))
    return f"<p>{text}</p>{notes}<p>{html.escape(starts_line(result))}</p>"


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


def open_directions(result: Identification) -> str:
    """Return an HTML list of the combinations of parameters that the data does not determine."""
    if not result.directions:
        return "<p>The data determines every combination of the parameters.</p>"
    lines = "".join(f"<li>{html.escape(words)}</li>" for words in dict.fromkeys(d.words for d in result.directions))
    return f"<h2>Undetermined combinations of parameters</h2><ul>{lines}</ul>"


def html_table(heads: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]]) -> str:
    """Return an HTML table; heads: HTML of the head cells; rows: (CSS class or "", texts of the cells)."""
    page = "<table><tr>" + "".join(f"<th>{head}</th>" for head in heads) + "</tr>"
    for css, cells in rows:
        page += f"<tr{css and ' class='}{css}>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>"
    return page + "</table>"


def parameter_table(result: Identification) -> str:
    """Return the HTML table of all parameters with their 95 % intervals; rows that are not identified are grey."""
    rows = []
    for parameter, value, (low, high), identified in zip(
        result.parameters, result.values, result.intervals, result.identified, strict=True
    ):
        cells = (parameter.name, parameter.unit, *(f"{x:.5g}" for x in (parameter.nominal, value, low, high)))
        rows.append(("" if identified else "open", cells))
    heads = ("parameter", "unit", "described", "found", "from", "to (95 %)")
    return html_table(heads, rows) + "<p class=open>Grey: not identified, the prior determines the value.</p>"


def fit_table(result: Identification) -> str:
    """Return the HTML table of how well each motion and channel fits (χ², its limit, rms error) and of failed tests."""
    rows, fits = [], {(fit.motion, fit.channel): fit for fit in result.fits}
    for test in result.tests:
        cells = (f"{test.chi2:.3f}", f"{test.limit:.3f}", "yes" if test.passed else "no")
        if fit := fits.get((test.motion, test.channel)):
            unit, factor = UNITS[fit.channel]
            rows.append(
                ("", (test.motion, test.channel, f"{fit.nominal_chi2:.4g}", *cells, f"{factor * fit.rms:.3g} {unit}"))
            )
        elif not test.channel or not test.passed:
            rows.append(("", (test.motion, test.channel or "all channels", "", *cells, "")))
    note = f"<p>If the model is right, any of these χ² exceeds its limit with probability {FAMILY_LEVEL:g}. "
    note += (
        "Rows <i>parameters by</i> a sensor, which compare its parameters with all others, are shown if they fail.</p>"
    )
    heads = ("motion", "channel", "described χ²", "found χ²", "limit", "consistent", "rms error")
    return html_table(heads, rows) + note


def image(figure: Any) -> str:
    """Embed a Matplotlib figure as a PNG image in HTML."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110, bbox_inches="tight")
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}">'


def new_figure(width: float, height: float) -> Any:
    """Return an empty Matplotlib figure without a window; width, height [inch]."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def parameter_plot(result: Identification) -> Any:
    """Return a plot (Matplotlib figure) of all parameters with 95 % intervals, in prior standard deviations."""
    figure = new_figure(10.0, 3.2)
    axis = figure.subplots()
    place = np.arange(len(result.z))
    axis.axhspan(-1.0, 1.0, color="0.92", label="prior")
    axis.errorbar(place, result.z, yerr=1.96 * result.std, fmt=".", capsize=2, label="found, 95 %")
    names = [parameter.quantity for parameter in result.parameters]
    edges = [i for i in place if i == 0 or names[i] != names[i - 1]]
    axis.set_xticks(edges, [names[i] for i in edges], rotation=50, ha="right", fontsize=8)
    axis.set(ylabel="deviations of the prior", xlim=(-1, len(place)))
    axis.legend(fontsize=8)
    return figure


def progress_plot(result: Identification) -> Any:
    """Return a plot (Matplotlib figure) of χ² over the physics steps, with a curve for each stage of the fit."""
    figure = new_figure(6.0, 2.6)
    axis = figure.subplots()
    for stage in sorted({step.stage for step in result.steps}):
        steps = [step for step in result.steps if step.stage == stage]
        label = "final" if stage == result.steps[-1].stage else f"stage {stage}"
        axis.semilogy([s.world_steps / 1e6 for s in steps], [s.chi2 for s in steps], "o-", label=label)
    axis.set(xlabel="million physics steps of all worlds", ylabel="χ² per value")
    axis.legend(fontsize=8)
    return figure


def motion_plot(result: Identification, motion: MotionResiduals, start: np.ndarray) -> Any:
    """Plot one motion, measured and simulated, and its residuals, and return a Matplotlib figure.

    start: fitted coordinates of the initial state, (I,), see `MotionResiduals`.
    Above: measured and simulated values of the first channel at three motors (or axes). Below: residuals of channels.
    """
    figure = new_figure(10.0, 4.6)
    axes = figure.subplots(2, 3, sharex=True)
    replay = MotionReplay(description=motion.description, threads=1)
    record, robots = motion.run(replay, result.z[None], start[None])
    model = motion.sensor_readings(record, robots)[..., 0]
    time = motion.motion.time - motion.motion.time[0]
    first, columns = motion.channels[0]
    unit, factor = UNITS[first]
    for i, axis in enumerate(axes[0]):
        column = columns.start + min(i, columns.stop - columns.start - 1)
        name = MOTOR_JOINTS[i] if columns.stop - columns.start == 12 else "xyz"[i]
        axis.plot(time, factor * motion.measured[:, column], ".", ms=2, label="measured")
        axis.plot(time, factor * model[:, column], lw=1, label="model")
        axis.set(title=f"{name} {first} [{unit}]")
        axis.legend(fontsize=7)
    for axis, (name, columns) in zip(axes[1], shown_channels(motion.channels), strict=False):
        error = (motion.measured - model)[:, columns] / motion.sigma[columns]
        axis.plot(time, np.where(motion.valid[:, columns], error, math.nan), ".", ms=1)
        axis.set(title=f"{name}: residuals [deviations of noise]", xlabel="time [s]")
    return figure


def shown_channels(channels: Sequence[tuple[str, slice]]) -> list[tuple[str, slice]]:
    """Choose up to three measured channels (name, columns) whose residuals the report plots."""
    order = {name: i for i, name in enumerate(("angle", "rate", "torque", "position", "orientation"))}
    return sorted(channels, key=lambda channel: order[channel[0]])[:3]
