"""Conditions and tests of the shipped policies, and their results: rows of metrics in metrics.json."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jumper_warp.evaluation.run import EvaluationRun
from jumper_warp.policies.catalog import add_files
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.assets import POLICIES
from jumper_warp.utils.files import Json, write_atomically
from jumper_warp.utils.metrics import MetricValue

COMBINED = "combined"  # Name that stands for walking and jumping with three policies, in place of a policy's
METRICS = "metrics.json"  # Name of a row's file, and of a policy's
RESULTS = Path(__file__).parents[2] / "docs/results"  # Pages with results
RANDOMISED = {"randomize": True, "noise": True}
CONDITIONS: dict[str, tuple[str, Json]] = {
    "nominal": ("nominal", {}),
    "randomised": ("randomised", RANDOMISED),
    "mujoco": ("SolverMuJoCo", {"solver": "mujoco"}),
    "mujoco_randomised": ("randomised, SolverMuJoCo", RANDOMISED | {"solver": "mujoco"}),
    "friction_0.4": ("friction 0.4", {"friction": 0.4}),
    "payload_3_kg": ("payload of 3 kg", {"payload": 3.0}),
    "gains_0.6": ("kp and kd × 0.6", {"gain_scale": (0.6, 0.6)}),
    "sensor_offset_4_deg": ("position sensors off by up to 4°", {"sensor_offset": 4.0}),
    "latency_25_ms": ("latency 25 ms", {"latency": 25.0}),
    "push_in_flight": ("randomised, also pushed in flight", RANDOMISED | {"push_in_flight": True}),
}  # fmt: skip
"""Title in tables and fields of `Conditions` by name, in the order of the tables; `payload` [kg] is a robot overlay."""
PAGES: Json = tomllib.loads((Path(__file__).parents[1] / "policy_pages.toml").read_text(encoding="utf-8"))
TESTS: dict[str, Json] = PAGES["tests"]
"""Tests of single policies or of three in combination by name: `words` in tables, `policies`, and `command`."""


class Row(NamedTuple):
    """Measured metrics of a policy in one condition with one seed."""

    policy: str
    condition: str  # Key of CONDITIONS or TESTS
    seed: int
    values: Json  # Conditions by name, as in metrics.json
    metrics: dict[str, MetricValue]
    entries: Json  # The same metrics as metrics.json has them


def undefined(task: TaskCfg, name: str) -> str | None:
    """Return the reason why a condition of CONDITIONS is undefined for a task, None if it is defined."""
    randomization = task.randomization
    if name == "friction_0.4" and task.evaluation.kind == "attitude":
        return "the robot floats and touches no ground"
    if name == "push_in_flight" and randomization.push_force is None and randomization.push_torque is None:
        return "the task samples no pushes"
    if name == "push_in_flight" and randomization.push_in_flight:
        return "the randomised robots are pushed in flight"
    return None


def metrics_file(policy: str) -> Path:
    """Return the path of the saved metrics of a policy, or of the tests with three policies (COMBINED)."""
    return RESULTS / "combined.json" if policy == COMBINED else POLICIES / policy / METRICS


def ordered_rows(policy: str, saved: Iterable[tuple[str, int, Mapping[str, Any]]]) -> list[Row]:
    """Return rows of a policy from condition, seed and JSON data, in the order of CONDITIONS and TESTS, and by seed.

    The JSON data have the keys `conditions` and `metrics`.
    """
    rows = []
    order = [*CONDITIONS, *TESTS]
    for condition, seed, data in saved:
        metrics = {
            key: MetricValue(x["value"], x["trials"], x["interval"] and tuple(x["interval"]), x["over"])
            for key, x in data["metrics"].items()
        }
        rows.append(Row(policy, condition, seed, data["conditions"], metrics, data["metrics"]))
    return sorted(rows, key=lambda row: (order.index(row.condition), row.seed))


def read_rows(folder: Path, policies: Sequence[str]) -> list[Row]:
    """Read the measured results of policies in the output folder of a measurement, sorted by policy."""
    rows: list[Row] = []
    for policy in sorted(policies):
        saved = []
        for path in (folder / policy).glob(f"*/{METRICS}"):
            condition, _, seed = path.parent.name.rpartition("-")
            saved.append((condition, int(seed), json.loads(path.read_text())))
        rows += ordered_rows(policy, saved)
    return rows


def saved_rows(policy: str) -> list[Row]:
    """Read the saved rows of metrics of a policy, or of the tests with three policies (COMBINED); [] without a file."""
    path = metrics_file(policy)
    saved = json.loads(path.read_text())["rows"] if path.is_file() else []
    return ordered_rows(policy, [(row["condition"], row["seed"], row) for row in saved])


def tasks_of(policies: Iterable[str]) -> dict[str, TaskCfg]:
    """Return the tasks of policies by name of the policy, without COMBINED."""
    return {policy: EvaluationRun(policy).task for policy in policies if policy != COMBINED}


def save_to_policies(rows: Sequence[Row], tasks: Mapping[str, TaskCfg]) -> None:
    """Write measured results into the saved metrics of policies, and update the policies' manifests.

    Each row is one line of the file.
    Saved rows of other conditions and seeds, and metrics of earlier definitions, are kept.
    """
    for policy in dict.fromkeys(row.policy for row in rows):
        path = metrics_file(policy)
        earlier = json.loads(path.read_text())["earlier"]["suites"] if path.is_file() else {}
        reasons = {name: undefined(tasks[policy], name) for name in CONDITIONS} if policy in tasks else {}
        document = {
            "schema": "jumper-warp policy metrics", "version": 1,
            "undefined": {name: reason for name, reason in reasons.items() if reason},
            "earlier": {"definition": "old definition", "suites": earlier},
        }  # fmt: skip
        known = {row[1:3]: row for row in (*saved_rows(policy), *(row for row in rows if row.policy == policy))}
        data = {key: {"conditions": _conditions(row), "metrics": row.entries} for key, row in known.items()}
        lines = [
            json.dumps(
                {"condition": row.condition, "seed": row.seed} | data[row[1:3]], ensure_ascii=False, allow_nan=False
            )
            for row in ordered_rows(policy, [(*key, value) for key, value in data.items()])
        ]
        head = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False).removesuffix("\n}")
        text = f'{head},\n  "rows": [\n    ' + ",\n    ".join(lines) + "\n  ]\n}\n"
        if policy == COMBINED:
            write_atomically(path, text.encode())
        else:
            add_files(path.parent, {METRICS: text.encode()})


def _conditions(row: Row) -> Json:
    """Return the conditions of a result for metrics.json, without the path of a payload's overlay."""
    values = {name: value for name, value in row.values.items() if name != "robot" or "payload_kg" not in row.values}
    return values | ({"commands": TESTS[row.condition]["words"]} if row.condition in TESTS else {})
