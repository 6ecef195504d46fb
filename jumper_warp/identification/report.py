"""The report of an identification: one HTML file without anything from outside, and the same as JSON."""

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

from jumper_warp.identification.findings import Identification
from jumper_warp.identification.replay import Replay
from jumper_warp.identification.residuals import MotionResiduals
from jumper_warp.robot.description import MOTOR_JOINTS
from jumper_warp.utils.files import write_atomically

UNITS = {"angle": ("deg", 180.0 / math.pi), "rate": ("rad/s", 1.0), "torque": ("N m", 1.0), "position": ("m", 1.0),
         "orientation": ("deg", 180.0 / math.pi)}  # fmt: skip
"""Unit that a channel is shown in, and its factor."""
TITLE = "System identification"
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 68rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: 0.15rem 0.8rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
.open { color: #999; } img { max-width: 100%; } .note { background: #fff6e0; padding: 0.6rem 1rem; }
"""


def to_json(found: Identification) -> dict[str, Any]:
    """Return everything that was found, as JSON can hold it."""
    rows = []
    for i, parameter in enumerate(found.parameters):
        low, high = found.intervals[i]
        rows.append(
            {
                "name": parameter.name,
                "unit": parameter.unit,
                "nominal": parameter.nominal,
                "value": float(found.values[i]),
                "interval_95": [float(low), float(high)],
                "deviation_of_prior": float(found.deviations[i]),
                "identified": bool(found.identified[i]),
            }
        )
    return {
        "parameters": rows,
        "chi2": found.chi2,
        "nominal_chi2": found.nominal_chi2,
        "mismatch": found.mismatch,
        "doubts": list(found.doubts),
        "count": found.count,
        "dt_s": found.dt,
        "wall_s": found.seconds,
        "cpu_s": found.cpu_seconds,
        "world_steps": found.world_steps,
        "fits": [vars(fit) for fit in found.fits],
        "open_directions": [
            {"information": d.information, "words": d.words, "weights": dict(d.weights)} for d in found.directions
        ],
        "steps": [vars(step) for step in found.steps],
    }


def write_results(found: Identification, folder: Path, source: str) -> None:
    """Write the overlay `identified.json`, whose source is noted, `report.json` and `report.html`. Raises OSError."""
    found.overlay(source).save(folder / "identified.json")
    write_atomically(folder / "report.json", (json.dumps(to_json(found), indent=2) + "\n").encode())
    write_report(found, folder)


def write_report(found: Identification, folder: Path) -> None:
    """Write `report.html`. Raises OSError."""
    parts = [
        f"<h1>{TITLE}</h1>",
        summary(found),
        open_directions(found),
        "<h2>Parameters</h2>",
        f"<p>{image(parameter_plot(found))}</p>",
        parameter_table(found),
        "<h2>Fit</h2>",
        fit_table(found),
        f"<p>{image(progress_plot(found))}</p>",
    ]
    for motion, start in zip(found.motions, found.starts, strict=True):
        parts.append(f"<h3>{html.escape(motion.motion.name)}</h3><p>{image(motion_plot(found, motion, start))}</p>")
    page = f"<!doctype html><html lang=en><meta charset=utf-8><title>{TITLE}</title><style>{STYLE}</style>"
    write_atomically(folder / "report.html", (page + "\n".join(parts) + "</html>\n").encode())


def summary(found: Identification) -> str:
    """Return the first paragraph."""
    sure, count = int(found.identified.sum()), len(found.parameters)
    text = (
        f"{sure} of {count} parameters are identified from {found.count} measured values. Mean squared weighed "
        f"residual {found.chi2:.3f} (as described {found.nominal_chi2:.4g}). {found.seconds:.1f} s, "
        f"{found.cpu_seconds:.1f} s of CPU, {found.world_steps / 1e6:.2f} million physics steps of "
        f"{1e3 * found.dt:.3g} ms."
    )
    if found.mismatch > 1.0:
        text += (
            f"</p><p class=note>The model does not explain the data to its noise: intervals are "
            f"{found.mismatch:.3g} times as wide as noise alone would make them."
        )
    notes = "".join(f"<p class=note>{html.escape(line)}</p>" for line in found.doubts)
    return f"<p>{text}</p>{notes}"


def open_directions(found: Identification) -> str:
    """Return what the data leaves open, in words."""
    if not found.directions:
        return "<p>The data determines every combination of the parameters.</p>"
    lines = "".join(f"<li>{html.escape(words)}</li>" for words in dict.fromkeys(d.words for d in found.directions))
    return f"<h2>What the data leaves open</h2><ul>{lines}</ul>"


def table(heads: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]]) -> str:
    """Return a table; rows: class, or nothing, and cells of each."""
    text = "<table><tr>" + "".join(f"<th>{head}</th>" for head in heads) + "</tr>"
    for kind, cells in rows:
        text += f"<tr{kind and ' class='}{kind}>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>"
    return text + "</table>"


def parameter_table(found: Identification) -> str:
    """Return all parameters with their intervals."""
    rows = []
    for parameter, value, (low, high), sure in zip(
        found.parameters, found.values, found.intervals, found.identified, strict=True
    ):
        cells = (parameter.name, parameter.unit, *(f"{x:.5g}" for x in (parameter.nominal, value, low, high)))
        rows.append(("" if sure else "open", cells))
    heads = ("parameter", "unit", "described", "found", "from", "to (95 %)")
    return table(heads, rows) + "<p class=open>Grey: the prior says more than the data.</p>"


def fit_table(found: Identification) -> str:
    """Return how well each channel is explained."""
    rows = []
    for fit in found.fits:
        unit, factor = UNITS[fit.channel]
        values = (f"{fit.nominal_chi2:.4g}", f"{fit.chi2:.3f}", f"{factor * fit.rms:.3g} {unit}")
        rows.append(("", (fit.motion, fit.channel, *values)))
    return table(("motion", "channel", "described χ²", "found χ²", "rms error"), rows)


def image(figure: Any) -> str:
    """Return a figure as an image within the page."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110, bbox_inches="tight")
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}">'


def new_figure(width: float, height: float) -> Any:
    """Return a figure that no window shows."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def parameter_plot(found: Identification) -> Any:
    """Draw all parameters with their intervals, in deviations of their priors."""
    figure = new_figure(10.0, 3.2)
    axis = figure.subplots()
    place = np.arange(len(found.z))
    axis.axhspan(-1.0, 1.0, color="0.92", label="prior")
    axis.errorbar(place, found.z, yerr=1.96 * found.deviations, fmt=".", capsize=2, label="found, 95 %")
    names = [parameter.quantity for parameter in found.parameters]
    edges = [i for i in place if i == 0 or names[i] != names[i - 1]]
    axis.set_xticks(edges, [names[i] for i in edges], rotation=50, ha="right", fontsize=8)
    axis.set(ylabel="deviations of the prior", xlim=(-1, len(place)))
    axis.legend(fontsize=8)
    return figure


def progress_plot(found: Identification) -> Any:
    """Draw how the fit became better."""
    figure = new_figure(6.0, 2.6)
    axis = figure.subplots()
    for stage in sorted({step.stage for step in found.steps}):
        steps = [step for step in found.steps if step.stage == stage]
        label = "all, to the end" if stage == found.steps[-1].stage else f"stage {stage}"
        axis.semilogy([s.world_steps / 1e6 for s in steps], [s.chi2 for s in steps], "o-", label=label)
    axis.set(xlabel="million physics steps of all worlds", ylabel="χ² per value")
    axis.legend(fontsize=8)
    return figure


def motion_plot(found: Identification, motion: MotionResiduals, start: np.ndarray) -> Any:
    """Draw measurement and model of three motors, and all residuals, of one motion."""
    figure = new_figure(10.0, 4.6)
    axes = figure.subplots(2, 3, sharex=True)
    replay = Replay(description=motion.description, threads=1)
    record, robots = motion.run(replay, found.z[None], start[None])
    model = motion.predicted(record, robots)[..., 0]
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
    """Return the three channels whose residuals are drawn."""
    order = {name: i for i, name in enumerate(("angle", "rate", "torque", "position", "orientation"))}
    return sorted(channels, key=lambda channel: order[channel[0]])[:3]
