"""Results of the shipped policies: measured metrics by condition, their tables, and the policies' metrics.json."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jumper_warp.evaluation.run import HEIGHTS, SOLVER_TITLES, EvaluationRun
from jumper_warp.policies.folder import add_files
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.assets import POLICIES
from jumper_warp.utils.metrics import MetricValue
from jumper_warp.utils.output import read_metrics
from support.policy_conditions import CONDITIONS, undefined

METRICS = "metrics.json"  # Name of a row's file, and of a policy's
SCHEMA = "jumper-warp policy metrics"  # Value of `schema` in a policy's file
RMSE_AXES = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")


class Row(NamedTuple):
    """Measured metrics of a policy in one condition with one seed."""

    policy: str
    condition: str  # Key of CONDITIONS
    seed: int
    values: dict[str, Any]  # Conditions by name, as in metrics.json
    metrics: dict[str, MetricValue]
    entries: dict[str, Any]  # The same metrics as metrics.json has them


class TableColumn(NamedTuple):
    """Column of the table of a policy's results."""

    title: str
    keys: tuple[str, ...]  # Metrics, separated by slashes
    interval: bool = False  # Whether the cell has the confidence interval


COMMON = (
    TableColumn("success", ("success_rate",), True), TableColumn("reached", ("goal_reached_rate",)),
    TableColumn("landed", ("landed_rate",)), TableColumn("still", ("no_paw_lift_rate",)),
)  # fmt: skip
FALLS = TableColumn("falls", ("fall_rate",))
COLUMNS = {
    "height": (
        *COMMON, TableColumn("apex error, size / signed [m]", ("apex_error_abs_mean_m", "apex_error_signed_mean_m")),
        FALLS,
    ),
    "place": (
        *COMMON,
        TableColumn("error at touchdown / at rest [m]",
                    ("goal_distance_at_touchdown_mean_m", "goal_distance_at_rest_mean_m")),
        TableColumn("flown / paws to paws [m]", ("distance_flown_mean_m", "paw_to_paw_distance_mean_m")), FALLS,
    ),
    "velocity": (
        *(TableColumn(f"RMSE {words} [m/s, m/s, rad/s]", tuple(f"{prefix}rmse_{axis}" for axis in RMSE_AXES))
          for words, prefix in (("all time", ""), ("settled", "settled_"), ("slewed", "slewed_"))),
        TableColumn("drift standing [m]", ("standing_drift_mean_m",)), TableColumn("falls", ("fall_rate",), True),
    ),
    "attitude": (
        TableColumn("settled, no collision", ("settled_without_collision_rate",), True),
        TableColumn("settling time [s]", ("settling_time_mean_s",)),
        TableColumn("error at the end [deg]", ("error_at_end_mean_deg",)),
        TableColumn("collisions", ("collision_rate",)),
    ),
}  # fmt: skip
"""Columns of the tables by `kind_of` a task."""
PUBLISHED: dict[str, tuple[tuple[str, dict[str, float]], ...]] = {
    "apex_height": (
        ("paper, simulation, 0.5 to 1.2 m", {"goal_reached_rate": 0.91, "apex_error_abs_mean_m": 0.04}),
        ("paper, robot, three jumps to 0.75 m", {"apex_error_abs_mean_m": 0.023}),
        ("paper, robot, one jump to 1 m", {"apex_error_abs_mean_m": 0.01, "apex_error_signed_mean_m": 0.01}),
    ),
    "landing_position": (
        ("paper, simulation, 0.3 to 1.5 m", {"success_rate": 0.97, "goal_distance_at_rest_mean_m": 0.026}),
        ("paper, robot, one jump to 1.25 m", {"goal_distance_at_rest_mean_m": 0.004}),
        ("paper, robot, two jumps to 0.75 m, 0.35 m aside", {"goal_distance_at_rest_mean_m": 0.0015}),
        ("paper, robot, jumps to 0.85 m, 0.1 m aside", {"goal_distance_at_rest_mean_m": 0.005}),
    ),
    "velocity": (("paper, robot, commands by a person", {
        "slewed_rmse_vx_m_s": 0.17, "slewed_rmse_vy_m_s": 0.05, "slewed_rmse_yaw_rate_rad_s": 0.12}),),
    "attitude": (("authors' robot, turn by 90°", {"settling_time_mean_s": 2.6}),),
}  # fmt: skip
"""Published values by `TaskCfg.evaluation_suite`; the paper's success looks at the goal and a landing."""


def read_rows(folder: Path, policies: Sequence[str]) -> list[Row]:
    """Read the measured results of policies in a folder, in the order of policies, CONDITIONS and seeds."""
    rows = []
    for policy in policies:
        for path in (folder / policy).glob(f"*/{METRICS}"):
            condition, _, seed = path.parent.name.rpartition("-")
            saved, metrics = json.loads(path.read_text()), read_metrics(path.parent)
            rows.append(Row(policy, condition, int(seed), saved["conditions"], metrics, saved["metrics"]))
    order = list(CONDITIONS)
    return sorted(rows, key=lambda row: (policies.index(row.policy), order.index(row.condition), row.seed))


def kind_of(task: TaskCfg) -> str:
    """Return the kind of a task that selects the columns of its table, a key of COLUMNS."""
    suite = task.evaluation_suite
    return suite if suite in COLUMNS else "height" if suite in HEIGHTS else "place"


def trained_on(task: TaskCfg, values: dict[str, Any]) -> str:
    """Return the range of commands that a task samples in training, as text; values: conditions of a row."""
    if pair := values.get("trained_range_m"):
        return "{:g} to {:g} m".format(*pair)
    if limits := values.get("trained_velocities"):
        return "{:g} / -{:g} m/s, ±{:g} m/s, ±{:g} rad/s".format(*limits)
    angles = [angle for level in task.levels for angle in level.angle]
    return f"{min(angles):g} to {max(angles):g}°"


def number(key: str, value: Any) -> str:
    """Format a metric's value: a rate in per cent, seconds and degrees with two decimals, else four."""
    if value is None:
        return "–"
    if key.endswith("_rate"):
        return f"{100.0 * value:.1f} %"
    return f"{value:.2f}" if key.endswith(("_s", "_deg")) and "rmse" not in key else f"{value:.4f}"


def cell(column: TableColumn, metrics: dict[str, MetricValue]) -> str:
    """Format a cell of a policy's table; empty if the metrics lack all of the column's keys."""
    known = [key for key in column.keys if key in metrics]
    text = " / ".join(number(key, metrics[key].value) for key in known)
    interval = metrics[known[0]].interval if known and column.interval else None
    return text if interval is None else text + " ({} to {})".format(*(f"{100.0 * limit:.1f}" for limit in interval))


def markdown(titles: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table with column titles and lines of cells."""
    table = [titles, ["---"] * len(titles), *lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in table) + "\n"


def policy_section(policy: str, task: TaskCfg, rows: Sequence[Row]) -> str:
    """Return a policy's section of the page: heading, table, and conditions that are undefined for it.

    rows: its results with one seed.
    """
    columns = COLUMNS[kind_of(task)]
    lines = [
        [CONDITIONS[row.condition].words, SOLVER_TITLES[row.values["solver"]], str(row.values["commands"]),
         trained_on(task, row.values), *(cell(column, row.metrics) for column in columns)]
        for row in rows
    ]  # fmt: skip
    for words, known in PUBLISHED.get(task.evaluation_suite, ()):
        metrics = {key: MetricValue(value) for key, value in known.items()}
        lines.append([words, "", "", "", *(cell(column, metrics) for column in columns)])
    trials = max(value.trials or 0 for value in rows[0].metrics.values())
    titles = ["condition", "solver", "commands", "trained on", *(column.title for column in columns)]
    reasons = [f"Not measured: {CONDITIONS[name].words}, since {reason}.\n"
               for name in CONDITIONS if (reason := undefined(task, name))]  # fmt: skip
    return "\n".join([f"## {policy}\n", f"{trials:,} trials a row.\n", markdown(titles, lines), *reasons])


def tasks_of(policies: Sequence[str]) -> dict[str, TaskCfg]:
    """Return the tasks of policies by name."""
    return {policy: EvaluationRun(policy).task for policy in policies}


def earlier_metrics(policy: str) -> dict[str, Any]:
    """Return the metrics of a shipped policy under the definitions before version 1 of metrics.json, by suite."""
    saved = json.loads((POLICIES / policy / METRICS).read_text())
    return saved["earlier"]["suites"] if saved.get("schema") == SCHEMA else saved


def save_to_policies(rows: Sequence[Row], tasks: dict[str, TaskCfg]) -> None:
    """Write measured results into metrics.json of the policies' folders, and update their manifests.

    The earlier metrics are kept.
    """
    for policy, task in tasks.items():
        document = {
            "schema": SCHEMA,
            "version": 1,
            "undefined": {name: reason for name in CONDITIONS if (reason := undefined(task, name))},
            "earlier": {"definition": "old definition", "suites": earlier_metrics(policy)},
        }
        lines = [json.dumps(_saved(row), ensure_ascii=False, allow_nan=False) for row in rows if row.policy == policy]
        head = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False).removesuffix("\n}")
        text = f'{head},\n  "rows": [\n    ' + ",\n    ".join(lines) + "\n  ]\n}\n"
        add_files(POLICIES / policy, {METRICS: text.encode()})


def _saved(row: Row) -> dict[str, Any]:
    """Convert a result to its JSON object in metrics.json, without the path of a payload's overlay."""
    values = {name: value for name, value in row.values.items() if name != "robot" or "payload_kg" not in row.values}
    return {"condition": row.condition, "seed": row.seed, "conditions": values, "metrics": row.entries}
