"""Picture and page of a comparison."""

from __future__ import annotations

import base64
import difflib
import json
import math
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.compare.comparison import Comparison, Row
from jumper_warp.compare.statistics import FEWEST_SEEDS, bands, interquartile_mean
from jumper_warp.utils.files import json_bytes, write_atomically
from jumper_warp.utils.metrics import format_value, split_unit
from jumper_warp.utils.output import output_dir
from jumper_warp.viz.plots import figure

PICTURE, PAGE, DATA = "comparison.png", "comparison.md", "comparison.json"
HEADER = ("metric", "arm", "seeds", "IQM", "95 % interval", "P(better)", "95 % interval", "p (Holm)", "verdict")
SHOWN = ("Episode_Reward/", "Episode_Sum/", "Episode_Termination/", "Metrics/", "Train/")
"""Begins of the logged names that `print_side_by_side` prints."""
SENTENCES = {"better": "better than", "worse": "worse than"}  # By `Row.verdict`
MOST_VERDICTS = 4  # Largest number of arms whose results are above the plots
STYLE = """body { max-width: 70em; margin: 2em auto; font-family: sans-serif } table { border-collapse: collapse }
td, th { border: 1px solid #ccc; padding: 0.2em 0.6em } img { max-width: 100% }"""


def write_report(comparison: Comparison, folder: Path | None = None, *, html: bool = False) -> Path:
    """Write picture, Markdown page and data (JSON) of a comparison, perhaps HTML too, and return the path of the page.

    folder: default outputs/compare/<time>.
    """
    folder = output_dir("compare", folder)
    plot(comparison, folder / PICTURE)
    text = markdown(comparison)
    page = folder / PAGE
    write_atomically(page, text.encode())
    rows = [{**row._asdict(), "values": row.values.tolist()} for row in comparison.table]
    content = {"title": comparison.title, "primary": comparison.primary_name, "rows": rows}
    write_atomically(folder / DATA, json_bytes(content))
    if html:
        page = page.with_suffix(".html")
        write_atomically(page, html_page(text, (folder / PICTURE).read_bytes()).encode())
    return page


def plot(comparison: Comparison, path: Path, *, verdict: bool = True) -> None:
    """Plot learning curves over steps and time, the primary metric of every seed, and the last reward terms.

    verdict: whether the line above the plots has the results of the tests of up to MOST_VERDICTS arms.
    """
    arms = [arm.name for arm in comparison.arms]
    terms = len({row.metric for row in comparison.rewards})
    settings: Any = {"figsize": (13, max(9.5, (0.1 * len(arms) + 0.16) * terms)), "title": comparison.title}
    with figure(path, 3, 2, conditions=subtitle(comparison, verdict=verdict), **settings) as axes:
        for axis, number, label, scale in (
            (axes[0, 0], 0, "policy steps [million]", 1.0e-6),
            (axes[1, 0], 1, "training time [s]", 1.0),
        ):
            for index, arm in enumerate(comparison.arms):
                x, values = arm.curves(comparison.curve_metric, number)
                if not len(x):
                    continue
                low, high = bands(values)
                axis.plot(scale * x, interquartile_mean(values, axis=0), color=f"C{index}", label=arm.name)
                axis.fill_between(scale * x, low, high, color=f"C{index}", alpha=0.2)
            axis.set(xlabel=label, ylabel=words(comparison.curve_metric), xlim=(0.0, None))
        plot_rows(axes[2, 0], comparison.primary, arms)
        right = axes[0, 0].figure.add_subplot(axes[0, 0].get_gridspec()[:, 1])
        for axis in axes[:, 1]:
            axis.remove()
        plot_terms(right, comparison.rewards, arms)


def subtitle(comparison: Comparison, *, verdict: bool) -> str:
    """Return the line below the title: results of the tests, number of seeds and meaning of bands."""
    base, *others = comparison.primary
    words = [f"{row.arm}: {sentence(row, base)}, p = {row.p_value:.2g}" for row in others[:MOST_VERDICTS] if verdict]
    seeds = ", ".join(f"{arm.name} {len(arm.members)}" for arm in comparison.arms)
    return "; ".join([*words, f"interquartile means with 95 % bootstrap intervals; seeds: {seeds}"])


def sentence(row: Row, base: Row) -> str:
    """Return the result of an arm's test in words."""
    return f"{SENTENCES.get(row.verdict, 'no difference shown from')} {base.arm}"


def words(metric: str) -> str:
    """Return a metric's name for an axis, with its unit."""
    name, unit = split_unit(metric.split("/")[-1])
    return f"{name.replace('_', ' ')} [{unit or '1'}]"


def plot_rows(axis: Any, rows: Sequence[Row], arms: Sequence[str]) -> None:
    """Plot a metric of every seed as dots, and their interquartile means with intervals, an arm a line."""
    for row in rows:
        index = arms.index(row.arm)
        axis.plot(row.values, index + 0.15 * np.linspace(-1.0, 1.0, len(row.values)), "o", color="0.6", zorder=1)
        interval = np.abs(np.array(row.interval) - row.mean)[:, None]
        axis.errorbar(row.mean, index, xerr=interval, fmt="D", color=f"C{index}", capsize=4.0, markersize=7.0)
    axis.set(yticks=range(len(arms)), ylim=(len(arms) - 0.5, -0.5), xlabel=f"{words(rows[0].metric)}, grey: seeds")
    axis.set_yticklabels(arms)


def plot_terms(axis: Any, rows: Sequence[Row], arms: Sequence[str]) -> None:
    """Plot the reward terms of each arm, interquartile means with intervals, a term a line."""
    names = list(dict.fromkeys(row.metric for row in rows))
    for row in rows:
        index = arms.index(row.arm)
        y = names.index(row.metric) + 0.6 * ((index + 0.5) / len(arms) - 0.5)
        interval = np.abs(np.array(row.interval) - row.mean)[:, None]
        axis.errorbar(row.mean, y, xerr=interval, fmt="o", color=f"C{index}", markersize=4.0)
    if not rows:
        axis.set_axis_off()
        return
    axis.axvline(0.0, color="0.5", linewidth=0.8)
    axis.set_xscale("symlog", linthresh=max(10.0 ** math.floor(math.log10(largest(rows) / 300.0)), 1.0e-6))
    unit = "1/s" if names[0].startswith("Episode_Reward/") else "1"
    axis.set(yticks=range(len(names)), ylim=(len(names) - 0.5, -0.5), xlabel=f"last reward terms [{unit}]")
    axis.set_yticklabels([name.split("/")[-1].replace("_", " ") for name in names], fontsize=9)


def largest(rows: Iterable[Row]) -> float:
    """Return the largest absolute mean of rows, at least 1e-6."""
    return max(1.0e-6, *(abs(row.mean) for row in rows))


def markdown(comparison: Comparison) -> str:
    """Return the page of a comparison."""
    arms = [arm.name for arm in comparison.arms]
    seeds = [[arm.name, ", ".join(map(str, arm.seeds)), str(arm.members[0].folder)] for arm in comparison.arms]
    values = ([row.arm, numbers(row.values)] for row in comparison.primary)
    parts = [
        f"# {comparison.title}", *verdicts(comparison), f"![Comparison]({PICTURE})",
        "## Primary metric", table(HEADER, map(cells, comparison.primary)),
        "Each arm is tested against the first one by an exact two-sided rank test of the seeds, with Holm's correction "
        f"for {len(arms) - 1} test{'s' * (len(arms) > 2)}. IQM: interquartile mean over seeds. P(better): probability "
        "that a seed is better than one of the first arm.",
        "## Every seed", table(("arm", comparison.metric), values),
        "## Exploratory",
        "These metrics were not chosen before the trainings, and are not tested: interquartile mean over seeds, 95 % "
        "interval, and the probability that a seed has a larger value than one of the first arm.",
    ]  # fmt: skip
    for title, rows in (("Evaluation", comparison.exploratory), ("Reward terms, last logged", comparison.rewards)):
        parts += [f"### {title}", wide_table(rows, arms)] if rows else []
    changed = [[name, *(json.dumps(value) for value in values)] for name, values in comparison.differences.items()]
    parts += ["## Different settings", table(("setting", *arms), changed) if changed else "None."]
    parts += [block for arm in comparison.arms[1:] for block in file_changes(comparison, arm.name)]
    known = {name: value for name, value in comparison.conditions.items() if value is not None}
    command = shlex.join(["jumper", *sys.argv[1:]])
    parts += ["## Reproduce", f"```bash\n{command}\n```",
              table(("arm", "seeds", "first run or policy"), seeds)]  # fmt: skip
    parts += [f"Evaluation: {', '.join(f'{name} {value}' for name, value in known.items())}."] if known else []
    return "\n\n".join(parts) + "\n"


def wide_table(rows: Sequence[Row], arms: Sequence[str]) -> str:
    """Return a Markdown table of metrics with a line for each metric and a column for each arm."""
    lines: dict[str, dict[str, str]] = {}
    for row in rows:
        low, high = map(format_value, row.interval)
        larger = "" if row.improvement is None else f", P {row.improvement:.2f}"
        lines.setdefault(row.metric, {})[row.arm] = f"{format_value(row.mean)} ({low} to {high}){larger}"
    return table(("metric", *arms), ([name, *(cells.get(arm, "") for arm in arms)] for name, cells in lines.items()))


def verdicts(comparison: Comparison) -> list[str]:
    """Return a sentence for each arm but the first about the primary metric, and a note if there are few seeds."""
    base, *others = comparison.primary
    lines = [
        f"**{row.arm}**: {sentence(row, base)} in `{row.metric}`, "
        f"{format_value(row.mean)} and {format_value(base.mean)}; probability of improvement "
        f"{row.improvement:.2f}, p = {row.p_value:.2g}."
        for row in others
    ]
    ends = {arm.name: [each.log[-1]["iteration"] for each in arm.members if each.log] for arm in comparison.arms}
    lengths = {name: min(end) for name, end in ends.items() if end}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        lines.append(f"**Trainings of different lengths**, iterations: {listed}. Logged metrics are those of iteration "
                     f"{min(lengths.values())}.")  # fmt: skip
    if len({value for row in comparison.primary for value in row.values}) == 1:
        lines.append(f"**All seeds have the same {comparison.metric}**: train longer, or choose another metric by "
                     "--primary.")  # fmt: skip
    if comparison.fewest_seeds < FEWEST_SEEDS:
        lines.append(f"**Fewer than {FEWEST_SEEDS} seeds** in an arm: intervals are unreliable, and a test can miss "
                     "any difference.")  # fmt: skip
    return lines


def cells(row: Row) -> list[str]:
    """Return the cells of a row of the primary metric's table."""
    improvement = "" if row.improvement is None else f"{row.improvement:.2f}"
    interval = "" if row.improvement_interval is None else "{:.2f} to {:.2f}".format(*row.improvement_interval)
    p = "" if row.p_value is None else f"{row.p_value:.2g}"
    mean = " to ".join(f"{end:.3g}" for end in row.interval) if len(row.values) > 1 else ""
    few = "" if len(row.values) >= FEWEST_SEEDS else " (few)"
    return [row.metric, row.arm, f"{len(row.values)}{few}", format_value(row.mean), mean, improvement, interval, p,
            row.verdict]  # fmt: skip


def numbers(values: np.ndarray) -> str:
    """Return the values of all seeds as text."""
    return ", ".join(format_value(float(value)) for value in values)


def table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join(str(cell).replace('|', '/') for cell in line)} |" for line in lines)


def file_changes(comparison: Comparison, name: str) -> list[str]:
    """Return a heading and a diff for each user file of an arm that differs from the first arm's."""
    base, arm = (next(arm for arm in comparison.arms if arm.name == each) for each in (comparison.arms[0].name, name))
    blocks = []
    for file in dict.fromkeys([*base.sources, *arm.sources]):
        old, new = (each.sources.get(file, "").splitlines() for each in (base, arm))
        if lines := list(difflib.unified_diff(old, new, base.name, arm.name, lineterm="", n=2)):
            blocks.append(f"### {file} of {arm.name}\n\n```diff\n" + "\n".join(lines) + "\n```")
    return blocks


def html_page(text: str, picture: bytes) -> str:
    """Return a page as one HTML file that contains its picture."""
    from markdown_it import MarkdownIt

    body = MarkdownIt("commonmark").enable("table").render(text)
    data = f"data:image/png;base64,{base64.b64encode(picture).decode()}"
    return f'<!doctype html><meta charset="utf-8"><style>{STYLE}</style>\n{body.replace(PICTURE, data, 1)}'


def lines(comparison: Comparison) -> list[str]:
    """Return the lines that `jumper compare` prints: verdicts and the primary metric's table."""
    from rich.table import Table

    from jumper_warp.utils.tables import table_lines

    rich = Table("arm", "seeds", comparison.metric, "95 % interval", "P(better)", "p", "verdict", box=None)
    for row in comparison.primary:
        _, arm, seeds, mean, interval, better, _, p, verdict = cells(row)
        rich.add_row(arm, seeds, mean, interval, better, p, verdict)
    note = [line.replace("*", "") for line in verdicts(comparison)[len(comparison.arms) - 1 :]]
    return [*table_lines(rich), *note]


def print_side_by_side(comparison: Comparison) -> None:
    """Print reward terms and metrics of the log of all arms, interquartile means over seeds, without a test."""
    from rich.table import Column, Table

    from jumper_warp.utils.tables import print_table

    arms = [arm.name for arm in comparison.arms]
    rich = Table(Column("last logged, mean of the seeds", no_wrap=True), *arms, box=None)
    for metric in dict.fromkeys(name for arm in comparison.arms for name in arm.members[0].last):
        if metric.startswith(SHOWN):
            values = (arm.last(metric) for arm in comparison.arms)
            rich.add_row(
                metric, *("–" if not len(each) else format_value(float(interquartile_mean(each))) for each in values)
            )
    print_table(rich)
    print("short trainings show whether terms act as intended, not which task is better")
