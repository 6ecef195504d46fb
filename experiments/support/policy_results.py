"""Results of the shipped policies: rows of metrics by condition, read from and saved to metrics.json."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.policies.folder import add_files
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.assets import POLICIES
from jumper_warp.utils.files import write_atomically
from jumper_warp.utils.metrics import MetricValue
from support.policy_conditions import CONDITIONS, undefined
from support.policy_tests import COMBINED, TESTS

METRICS = "metrics.json"  # Name of a row's file, and of a policy's
SCHEMA = "jumper-warp policy metrics"  # Value of `schema` in a policy's file
RESULTS = Path(__file__).parents[2] / "docs/results"  # Pages with results


class Row(NamedTuple):
    """Measured metrics of a policy in one condition with one seed."""

    policy: str
    condition: str  # Key of CONDITIONS or TESTS
    seed: int
    values: dict[str, Any]  # Conditions by name, as in metrics.json
    metrics: dict[str, MetricValue]
    entries: dict[str, Any]  # The same metrics as metrics.json has them


def metrics_file(policy: str) -> Path:
    """Return the path of the saved metrics of a policy, or of the tests with three policies (COMBINED)."""
    return RESULTS / "combined.json" if policy == COMBINED else POLICIES / policy / METRICS


def make_row(policy: str, condition: str, seed: int, saved: dict[str, Any]) -> Row:
    """Return a row from its JSON data with keys `conditions` and `metrics`."""
    metrics = {
        key: MetricValue(entry["value"], entry["trials"], entry["interval"] and tuple(entry["interval"]), entry["over"])
        for key, entry in saved["metrics"].items()
    }
    return Row(policy, condition, seed, saved["conditions"], metrics, saved["metrics"])


def ordered(rows: Iterable[Row]) -> list[Row]:
    """Sort rows by policy, by condition in the order of CONDITIONS and TESTS, and by seed."""
    order = [*CONDITIONS, *TESTS]
    return sorted(rows, key=lambda row: (row.policy, order.index(row.condition), row.seed))


def read_rows(folder: Path, policies: Sequence[str]) -> list[Row]:
    """Read the measured results of policies in the output folder of a measurement, sorted as `ordered`."""
    rows = []
    for policy in policies:
        for path in (folder / policy).glob(f"*/{METRICS}"):
            condition, _, seed = path.parent.name.rpartition("-")
            rows.append(make_row(policy, condition, int(seed), json.loads(path.read_text())))
    return ordered(rows)


def saved_rows(policy: str) -> list[Row]:
    """Read the saved rows of metrics of a policy, or of the tests with three policies (COMBINED); [] without a file."""
    path = metrics_file(policy)
    saved = json.loads(path.read_text())["rows"] if path.is_file() else []
    return ordered(make_row(policy, row["condition"], row["seed"], row) for row in saved)


def tasks_of(policies: Iterable[str]) -> dict[str, TaskCfg]:
    """Return the tasks of policies by name of the policy, without COMBINED."""
    return {policy: EvaluationRun(policy).task for policy in policies if policy != COMBINED}


def earlier_metrics(policy: str) -> dict[str, Any]:
    """Return the saved metrics of a policy that were measured under earlier definitions, by suite."""
    path = metrics_file(policy)
    return json.loads(path.read_text())["earlier"]["suites"] if path.is_file() else {}


def save_to_policies(rows: Sequence[Row], tasks: dict[str, TaskCfg]) -> None:
    """Write measured results into the saved metrics of policies, and update the policies' manifests.

    Saved rows of other conditions and seeds, and the earlier metrics, are kept.
    """
    for policy in dict.fromkeys(row.policy for row in rows):
        known = {row[:3]: row for row in (*saved_rows(policy), *(row for row in rows if row.policy == policy))}
        reasons = {name: undefined(tasks[policy], name) for name in CONDITIONS} if policy in tasks else {}
        document = {
            "schema": SCHEMA,
            "version": 1,
            "undefined": {name: reason for name, reason in reasons.items() if reason},
            "earlier": {"definition": "old definition", "suites": earlier_metrics(policy)},
        }
        lines = [json.dumps(_saved(row), ensure_ascii=False, allow_nan=False) for row in ordered(known.values())]
        head = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False).removesuffix("\n}")
        text = f'{head},\n  "rows": [\n    ' + ",\n    ".join(lines) + "\n  ]\n}\n"
        if policy == COMBINED:
            write_atomically(metrics_file(policy), text.encode())
        else:
            add_files(metrics_file(policy).parent, {METRICS: text.encode()})


def _saved(row: Row) -> dict[str, Any]:
    """Convert a result to its JSON object in metrics.json, without the path of a payload's overlay."""
    values = {name: value for name, value in row.values.items() if name != "robot" or "payload_kg" not in row.values}
    if row.condition in TESTS:
        values["commands"] = TESTS[row.condition].words
    return {"condition": row.condition, "seed": row.seed, "conditions": values, "metrics": row.entries}
