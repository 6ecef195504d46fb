"""Make the tables in docs/ and the policies' pages from files with metrics; nothing is simulated.

    python -m docs.policy_tables

A table stands between two comments, of which the first names it: `main POLICY`, `all POLICY`, `test NAME`, `keys NAME`,
`choice`, `measured NAME` or `recipe TASK`. `experiments/policy_pages.toml` defines columns and tests of policies; their
values come from the policies' metrics.json. `measured` tables come from docs/results/measurements.json, whose rows have
a machine, a commit and a date. `recipe` tables come from the trainings of the paper's recipe in docs/results/paper.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.support.policy_results import (
    CONDITIONS,
    METRICS,
    PAGES,
    RESULTS,
    TESTS,
    Row,
    saved_rows,
    tasks_of,
    undefined,
)
from jumper_warp.evaluation.attitude import TURN_METRICS
from jumper_warp.evaluation.jump_metrics import HEIGHT_METRICS, PLACE_METRICS
from jumper_warp.evaluation.velocities import VELOCITY_METRICS
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.assets import POLICIES, policy_tasks
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.files import Json, write_atomically
from jumper_warp.utils.metrics import MetricValue, unit_of

BLOCK = re.compile(r"(<!-- table: (?P<name>choice|\w+ [\w. -]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)
TABLES: dict[str, Json] = PAGES["tables"]  # Tables of tests by name
SHOWN = {"nominal": "nominal", "randomised": "randomised", "mujoco": "SolverMuJoCo", "friction_0.4": "friction 0.4"}
"""Conditions in a policy's main table, and their titles there."""
SIMULATION = {"height": "paper, simulation", "place": "paper, simulation",
              "velocity": "paper, robot, commands by a person"}  # fmt: skip
"""Words for `Evaluation.paper` by `Evaluation.kind`."""
ON_ROBOT = "paper, robot, "  # Beginning of the words of results on the paper's robot
BOTH = [metric for metric in HEIGHT_METRICS if metric in PLACE_METRICS]
KEYS = {"jumps": BOTH, "heights": [metric for metric in HEIGHT_METRICS if metric not in BOTH],
        "places": [metric for metric in PLACE_METRICS if metric not in BOTH],
        "walks": VELOCITY_METRICS, "turns": TURN_METRICS}  # fmt: skip
POLICY_PAGES = {"height": "vertical_jump", "place": "horizontal_jump", "velocity": "walking", "attitude": "attitude"}
RATES = {"velocity": "fall_rate", "attitude": "settled_without_collision_rate"}  # By kind; else that in range
ERRORS = {
    "height": ("in_range_apex_error_abs_mean_m", 1000.0, "{:.1f} mm"),
    "place": ("in_range_goal_distance_at_rest_mean_m", 1000.0, "{:.1f} mm"),
    "velocity": ("settled_rmse_vx_m_s", 1.0, "{:.3f} m/s"),
    "attitude": ("error_at_end_mean_deg", 1.0, "{:.1f}°"),
}
"""Key of the error, factor and format by kind."""
COMMANDED = {"velocity": " (ahead, left, yaw)"}  # Names of the components of a command by kind
MEASURED: dict[str, Json] = json.loads((RESULTS / "measurements.json").read_text(encoding="utf-8"))["tables"]
ARMS = {"full": "full", "no_initialisation": "no initialisation", "no_estimates": "no estimates",
        "no_curriculum": "no curriculum"}  # fmt: skip
"""Titles of the trainings in docs/results/paper, by the beginning of their folders' names."""
Results = Mapping[str, MetricValue]  # Metrics by key


def published(task: TaskCfg) -> list[tuple[str, Results]]:
    """Return the published results of a task, each as a description and its metrics by key."""
    evaluation = task.evaluation
    kind = evaluation.kind if evaluation == type(evaluation)() else ""  # else other tests than the published ones
    known = [(SIMULATION[kind], evaluation.paper)] if kind in SIMULATION else []
    return [
        (words, {key: MetricValue(value) for key, value in values.items()})
        for words, values in (*known, *PAGES["robot"].get(kind, ()))
    ]


def kind_of(task: TaskCfg) -> str:
    """Return the kind of a task that selects the columns of its table: height, place, velocity or attitude."""
    return task.evaluation.kind


def trained_on(task: TaskCfg, values: Mapping[str, Any]) -> str:
    """Return the range of commands that a task samples in training, as text; values: conditions of a row.

    They are jumps [m], velocities, or else turns [deg].
    """
    if pair := values.get("trained_range_m"):
        levels: Any = task.levels
        aside = max(level.goal_upper[1] for level in levels)
        back = -min(level.goal_lower[0] for level in levels)
        if kind_of(task) == "height":
            return "{:g} to {:g} m".format(*pair)
        if back > 0.0:
            return f"up to {pair[1]:g} m ahead, {aside:g} m to each side, {back:g} m back"
        return f"{pair[0]:g} to {pair[1]:g} m ahead, {aside:g} m to each side"
    if limits := values.get("trained_velocities"):
        return "{1:g} m/s back to {0:g} m/s ahead, ±{2:g} m/s sideways, turns of ±{3:g} rad/s".format(*limits)
    angles = [angle for level in task.levels for angle in level.angle]
    return f"{min(angles):g} to {max(angles):g}°"


def number(key: str, value: Any) -> str:
    """Format a metric's value: rates in per cent, others with one, two or four decimals, which depend on the key."""
    if value is None:
        return "–"
    if key.endswith("_rate"):
        return f"{100.0 * value:.1f} %"
    if key.startswith(("reliable_distance_flown", "reliable_paw")):
        return f"{value:.2f}"
    if key.startswith("reliable_") or unit_of(key) == "N":
        return f"{value:.1f}"
    return f"{value:.2f}" if key.endswith(("_s", "_deg")) and "rmse" not in key else f"{value:.4f}"


def cell(column: Sequence[str], metrics: Results) -> str:
    """Format a cell of a table, empty if the metrics lack all keys; column: title and keys, ± adds the interval."""
    text = []
    interval = None
    for key in column[1:]:
        if metric := metrics.get(key.removeprefix("±")):
            text.append(number(key, metric.value))
            interval = metric.interval if key.startswith("±") else interval
    limits = "" if interval is None else " ({} to {})".format(*(f"{100.0 * limit:.1f}" for limit in interval))
    return ("–" if set(text) == {"–"} else " / ".join(text)) + limits


def markdown(titles: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table with column titles and lines of cells."""
    table = [titles, ["---"] * len(titles), *lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in table) + "\n"


def trials_of(row: Row) -> str:
    """Format the largest number of trials of a row's metrics."""
    return f"{max(value.trials or 0 for value in row.metrics.values()):,}"


def trials_by_title(rows: Mapping[str, Row]) -> str:
    """Format numbers of trials: the number of the first row, and other numbers after the last part of their title."""
    usual = trials_of(next(iter(rows.values())))
    others = {title.split(", ")[-1]: trials_of(row) for title, row in rows.items() if trials_of(row) != usual}
    return usual + "".join(f"; {title}: {trials}" for title, trials in others.items())


def goals_in_range(success: MetricValue) -> str:
    """Return the range of commands, such as "0.5 to 1.1 m", over which a success rate was taken."""
    return str(success.over).partition("goals of ")[2]


def first_seed(policy: str) -> dict[str, Row]:
    """Return the saved rows of a policy with the smallest seed, by condition."""
    return {row.condition: row for row in reversed(saved_rows(policy))}


def main_table(policy: str, task: TaskCfg) -> str:
    """Return the main table of a policy: metrics as rows, conditions and published results as columns, and a note.

    Published results on a robot share a column, separated by " / ".
    """
    rows = first_seed(policy)
    paper = published(task)
    single = [(title, rows[name].metrics) for name, title in SHOWN.items() if name in rows]
    single += [(words, metrics) for words, metrics in paper if not words.startswith(ON_ROBOT)]
    robot = {words.removeprefix(ON_ROBOT): metrics for words, metrics in paper if words.startswith(ON_ROBOT)}
    titles = [title for title, _ in single]
    together = ON_ROBOT.strip(", ")
    lines = []
    for line in PAGES["main"][kind_of(task)]:
        cells = [line[0], *(cell(line, metrics) for _, metrics in single)]
        on_robot = " / ".join(filter(None, (cell(line, metrics) for metrics in robot.values())))
        lines.append([*cells, on_robot] if robot else cells)
    nominal = rows["nominal"]
    note = f"Trials: {trials_by_title({title: rows[name] for name, title in SHOWN.items() if name in rows})}. "
    note += f"Commands: {nominal.values['commands']}{COMMANDED.get(kind_of(task), '')}"
    if kind_of(task) == "height":
        note += "; *in range*: " + goals_in_range(nominal.metrics["in_range_success_rate"])
    note += f".\nColumn *{together}*: {' / '.join(robot)}" if robot else ""
    return markdown(["", *titles, *([together] if robot else [])], lines) + f"\n{note}.\n"


def all_conditions(policy: str, task: TaskCfg) -> str:
    """Return the table of a policy in all conditions, with 95 % intervals, and the reasons for missing conditions."""
    rows = first_seed(policy)
    wide = [column for column in PAGES["wide"][kind_of(task)] if cell(column, rows["nominal"].metrics)]
    results = [(title, rows[name].metrics) for name, (title, _) in CONDITIONS.items() if name in rows]
    lines = [[words, *(cell(column, metrics) for column in wide)] for words, metrics in results]
    nominal = rows["nominal"]
    trials = trials_by_title({title: rows[name] for name, (title, _) in CONDITIONS.items() if name in rows})
    note = f"Trials: {trials}. Commands: {nominal.values['commands']}{COMMANDED.get(kind_of(task), '')}.\n"
    note += f"Commands in training: {trained_on(task, nominal.values)}.\n"
    reasons = [
        f"Not measured: *{title}*, because {reason}.\n"
        for name, (title, _) in CONDITIONS.items()
        if (reason := undefined(task, name))
    ]
    return "\n".join([markdown(["condition", *(column[0] for column in wide)], lines), note, *reasons])


def test_table(name: str) -> str:
    """Return the Markdown table `name` of TABLES, a line per policy and test; unmeasured tests are left out."""
    tests, wide = TABLES[name]["tests"], TABLES[name]["columns"]
    policies = TABLES[name].get("policies") or TESTS[tests[0]]["policies"]
    lines = []
    for policy in policies:
        rows = first_seed(policy)
        for test in (test for test in tests if test in rows):
            words = TESTS[test]["words"] if test in TESTS else f"{rows[test].values['commands']}, {CONDITIONS[test][0]}"
            cells = (trials_of(rows[test]) if x == ["trials"] else cell(x, rows[test].metrics) for x in wide)
            lines.append([policy, words, *cells])
    first = 1 if len(policies) == 1 else 0
    return markdown(["policy", "test", *(x[0] for x in wide)][first:], [line[first:] for line in lines])


def key_table(name: str) -> str:
    """Return a table of an evaluation's metrics: key, statistic and trials that count; name: of KEYS."""
    lines = [[f"`{metric.key}`", metric.statistic.__name__, metric.over] for metric in KEYS[name]]
    return markdown(("key", "statistic", "over"), lines)


def measured_table(name: str) -> str:
    """Return a table of MEASURED, with machine, commit and date of each row, or below if all rows have the same."""
    table = MEASURED[name]
    rows = table["rows"]
    origins = {
        "machine": [row["machine"] for row in rows],
        "commit": [f"{row['commit']}, {row['date']}" for row in rows],
    }
    shared = [
        values[0] if title == "machine" else f"commit {values[0]}"
        for title, values in origins.items()
        if len(set(values)) == 1
    ]
    varying = {title: values for title, values in origins.items() if len(set(values)) > 1}
    lines = [[*row["cells"], *(values[i] for values in varying.values())] for i, row in enumerate(rows)]
    text = markdown((*table["columns"], *varying), lines)
    return text + (f"\nMeasured: {', '.join(shared)}.\n" if shared else "")


def recipe_table(task: str) -> str:
    """Return a table of the trainings of a task of the paper: of each metric the mean and range over the seeds."""
    paper = RESULTS / "paper" / task
    seeds = {
        title: [json.loads(path.read_text())["metrics"] for path in sorted(paper.glob(f"{arm}_*/{METRICS}"))]
        for arm, title in ARMS.items()
    }
    arms = {title: runs for title, runs in seeds.items() if runs}
    lines = [
        [test, paper, *(spread([run.get(key, {}).get("value") for run in runs]) for runs in arms.values())]
        for test, paper, key in PAGES["recipe"][task]
    ]
    return markdown(("test", "paper", *arms), lines)


def spread(values: Sequence[float | None]) -> str:
    """Format mean and range of the values of several seeds, and the number of those that have one."""
    known = np.array([value for value in values if value is not None])
    number = "{:.1f}" if known.max() > 1e5 else "{:.3g}"
    known = known / 1e6 if known.max() > 1e5 else known  # millions of policy steps
    mean, low, high = (number.format(value) for value in (known.mean(), known.min(), known.max()))
    count = "" if len(known) == len(values) else f", {len(known)} of {len(values)}"
    return f"{mean} ({low}–{high}){count}"


def choice_table(tasks: Mapping[str, TaskCfg]) -> str:
    """Return a Markdown table with a policy for each need: tested and trained commands, success, error, limits."""
    lines = []
    for need in PAGES["needs"]:
        policy = need["policy"]
        tests = need.get("tests", ("nominal", "randomised", "friction_0.4"))
        rows = first_seed(policy)
        task = tasks[policy]
        page = "mars" if policy.startswith("mars") else POLICY_PAGES[kind_of(task)]
        values = rows[tests[0]].values
        speed = values.get("speed_m_s")
        in_range = rows[tests[0]].metrics.get("in_range_success_rate")
        tested = (
            goals_in_range(in_range)
            if in_range
            else str(values["commands"])
            if speed is None
            else f"bumps, slopes, steps at {speed} m/s"
        )
        cells = [_success(rows[test], kind_of(task)) if test in rows else "" for test in tests]
        trained = trained_on(task, rows["nominal"].values)
        lines.append([need["need"], f"[{policy}]({page}.md)", tested, *cells, trained, need["unless"]])
    titles = ("need", "policy", "tested on", "nominal", "randomised", "friction 0.4", "trained on", "not for")
    return markdown(titles, lines)


def _success(row: Row, kind: str) -> str:
    """Format success, for walking the falls, and mean error of a row; of a test of terrains the falls on the worst."""
    if "speed_m_s" in row.values:
        rates = [metric.value for name, metric in row.metrics.items() if name.endswith("_fall_rate")]
        parts = [f"{number('fall_rate', max(rate for rate in rates if isinstance(rate, float)))} fall"]
    else:
        rate = RATES.get(kind, "in_range_success_rate")
        (key, factor, text) = ERRORS[kind]
        share = number(rate, row.metrics[rate].value).replace("100.0", "100")
        error = row.metrics[key].value
        assert isinstance(error, float)
        parts = [share + " fall" * (kind == "velocity"), text.format(factor * error)]
    return ", ".join(part.replace(" ", "\N{NO-BREAK SPACE}") for part in parts)


def pages() -> list[Path]:
    """Return the paths of the documentation pages and policies' READMEs that may have generated tables."""
    docs = RESULTS.parent
    own = [path for folder in ("results", "reference", "explanation", "howto", "tutorials")
           for path in sorted(docs.glob(f"{folder}/*.md"))]  # fmt: skip
    return [*own, *sorted(POLICIES.glob("*/README.md"))]


def make_table(name: str, tasks: Mapping[str, TaskCfg]) -> str:
    """Return the table `name` as Markdown. Raises InputError: there is no such table."""
    kind, _, subject = name.partition(" ")
    if kind in ("main", "all") and subject in tasks:
        return (main_table if kind == "main" else all_conditions)(subject, tasks[subject])
    if kind == "test" and subject in TABLES:
        return test_table(subject)
    if kind == "keys" and subject in KEYS:
        return key_table(subject)
    if kind == "measured" and subject in MEASURED:
        return measured_table(subject)
    if kind == "recipe" and subject in PAGES["recipe"]:
        return recipe_table(subject)
    if name == "choice":
        return choice_table(tasks)
    raise InputError(f"no table {name!r:.40}")


def filled(text: str, tasks: Mapping[str, TaskCfg]) -> str:
    """Return the text of a page with its tables made from their files; tasks: of all policies."""
    return BLOCK.sub(lambda block: f"{block[1]}\n{make_table(block['name'], tasks)}\n{block[3]}", text)


def main() -> int:
    """Make the tables of all pages, print the paths of the pages that changed, and return their number."""
    tasks = tasks_of(policy_tasks())
    changed = []
    for path in pages():
        old = path.read_text(encoding="utf-8")
        if (new := filled(old, tasks)) != old:
            write_atomically(path, new.encode())
            changed.append(path)
    print("\n".join(map(str, changed)) or "no table changed")
    return len(changed)


if __name__ == "__main__":
    main()
