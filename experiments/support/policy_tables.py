"""Markdown tables of the results of the shipped policies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from jumper_warp.evaluation.attitude import HARDWARE_TIME, TURN_METRICS
from jumper_warp.evaluation.jump_metrics import HEIGHT_METRICS, PLACE_METRICS
from jumper_warp.evaluation.velocities import AXES, UNITS, VELOCITY_METRICS
from jumper_warp.tasks.cfg import TaskCfg
from jumper_warp.utils.metrics import MetricValue, unit_of
from support.policy_conditions import CONDITIONS, undefined
from support.policy_results import Row, saved_rows
from support.policy_tests import TESTS

RMSE_AXES = tuple(f"{axis}_{unit}" for axis, unit in zip(AXES, UNITS, strict=True))
SHOWN = ("nominal", "randomised", "mujoco", "friction_0.4")  # Conditions in a policy's main table
SHORT = ("nominal", "randomised", "SolverMuJoCo", "friction 0.4")  # Their titles there


class TableColumn(NamedTuple):
    """Title and metrics of a column of a table of results, or of a row of a policy's main table."""

    title: str
    keys: tuple[str, ...]  # Metrics, separated by slashes
    interval: bool = False  # Whether the cell has the confidence interval


def columns(*pairs: tuple[str, str]) -> tuple[TableColumn, ...]:
    """Return table columns of one metric each, from pairs (title, key of the metric)."""
    return tuple(TableColumn(title, (key,)) for title, key in pairs)


SUCCESS, FALLS = TableColumn("success", ("success_rate",), True), TableColumn("falls", ("fall_rate",))
PARTS = columns(("reached", "goal_reached_rate"), ("landed", "landed_rate"), ("no paw lifted", "no_paw_lift_rate"))
COLUMNS = {
    "height": (
        SUCCESS, *PARTS,
        TableColumn("apex error, size / signed [m]", ("apex_error_abs_mean_m", "apex_error_signed_mean_m")), FALLS,
    ),
    "place": (
        SUCCESS, *PARTS,
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
        *columns(("settling time [s]", "settling_time_mean_s"), ("error at the end [deg]", "error_at_end_mean_deg"),
                 ("collisions", "collision_rate")),
    ),
}  # fmt: skip
"""Columns of the tables of all conditions by `kind_of` a task."""
MAIN = {
    "height": columns(
        ("success", "success_rate"), ("reached", "goal_reached_rate"), ("error [m]", "apex_error_abs_mean_m"),
        ("success, in range", "in_range_success_rate"), ("error, in range [m]", "in_range_apex_error_abs_mean_m"),
        ("no paw lifted", "no_paw_lift_rate"), ("falls", "fall_rate"),
    ),
    "place": columns(
        ("success", "success_rate"), ("error at rest [m]", "goal_distance_at_rest_mean_m"),
        ("error at touchdown [m]", "goal_distance_at_touchdown_mean_m"), ("no paw lifted", "no_paw_lift_rate"),
        ("falls", "fall_rate"),
    ),
    "velocity": (
        *columns(("RMSE ahead, slewed [m/s]", "slewed_rmse_vx_m_s"), ("to the side [m/s]", "slewed_rmse_vy_m_s"),
                 ("turning [rad/s]", "slewed_rmse_yaw_rate_rad_s")),
        TableColumn("the same, settled", tuple(f"settled_rmse_{axis}" for axis in RMSE_AXES)),
        *columns(("drift standing, 9 s [m]", "standing_drift_mean_m"), ("falls", "fall_rate")),
    ),
    "attitude": tuple(column._replace(interval=False) for column in COLUMNS["attitude"]),
}  # fmt: skip
"""Rows of a policy's main table by `kind_of` its task."""
SIMULATION = {"height": "paper, simulation", "place": "paper, simulation",
              "velocity": "paper, robot, commands by a person"}  # fmt: skip
"""Words for `Evaluation.paper` by `Evaluation.kind`."""
ROBOT: dict[str, tuple[tuple[str, dict[str, float]], ...]] = {
    "height": (
        ("paper, robot, three jumps to 0.75 m", {"apex_error_abs_mean_m": 0.023}),
        ("paper, robot, one jump to 1 m", {"apex_error_abs_mean_m": 0.01, "apex_error_signed_mean_m": 0.01}),
    ),
    "place": (
        ("paper, robot, one jump to 1.25 m", {"goal_distance_at_rest_mean_m": 0.004}),
        ("paper, robot, two jumps to 0.75 m, 0.35 m aside", {"goal_distance_at_rest_mean_m": 0.0015}),
        ("paper, robot, jumps to 0.85 m, 0.1 m aside", {"goal_distance_at_rest_mean_m": 0.005}),
    ),
    "attitude": (("authors' robot, turn by 90°", {"settling_time_mean_s": HARDWARE_TIME}),),
}  # fmt: skip
"""Published values of the real robot that no evaluation prints, by `Evaluation.kind`."""
ON_ROBOT = "paper, robot, "  # Beginning of the words of results on the paper's robot
KEYS = {"heights": HEIGHT_METRICS, "places": PLACE_METRICS, "walks": VELOCITY_METRICS, "turns": TURN_METRICS}


def published(task: TaskCfg) -> list[tuple[str, dict[str, MetricValue]]]:
    """Return the published results of a task, each as a description and its metrics by key."""
    evaluation = task.evaluation
    kind = evaluation.kind if evaluation == type(evaluation)() else ""  # else other tests than the published ones
    known = [(SIMULATION[kind], evaluation.paper)] if kind in SIMULATION else []
    return [(words, {key: MetricValue(value) for key, value in values.items()})
            for words, values in (*known, *ROBOT.get(kind, ()))]  # fmt: skip


def kind_of(task: TaskCfg) -> str:
    """Return the kind of a task that selects the columns of its table, a key of COLUMNS."""
    return task.evaluation.kind


def trained_on(task: TaskCfg, values: Mapping[str, Any]) -> str:
    """Return the range of commands that a task samples in training, as text; values: conditions of a row."""
    if pair := values.get("trained_range_m"):
        levels: Any = task.levels
        aside, back = max(level.goal_upper[1] for level in levels), -min(level.goal_lower[0] for level in levels)
        if kind_of(task) == "height":
            return "{:g} to {:g} m".format(*pair)
        if back > 0.0:
            return f"up to {pair[1]:g} m ahead, {aside:g} m aside, {back:g} m back"
        return f"{pair[0]:g} to {pair[1]:g} m ahead, {aside:g} m aside"
    if limits := values.get("trained_velocities"):
        return "{:g} / -{:g} m/s, ±{:g} m/s, ±{:g} rad/s".format(*limits)
    angles = [angle for level in task.levels for angle in level.angle]
    return f"{min(angles):g} to {max(angles):g}°"


def number(key: str, value: Any) -> str:
    """Format a metric's value: rates in per cent, others with one, two or four decimals, which depend on the key."""
    if value is None:
        return "–"
    if key.endswith("_rate"):
        return f"{100.0 * value:.1f} %"
    if key.startswith("reliable_") or unit_of(key) == "N":
        return f"{value:.1f}"
    return f"{value:.2f}" if key.endswith(("_s", "_deg")) and "rmse" not in key else f"{value:.4f}"


def cell(column: TableColumn, metrics: Mapping[str, MetricValue]) -> str:
    """Format a cell of a table; empty if the metrics lack all of the column's keys."""
    known = [key for key in column.keys if key in metrics]
    text = " / ".join(number(key, metrics[key].value) for key in known)
    interval = metrics[known[0]].interval if known and column.interval else None
    return text if interval is None else text + " ({} to {})".format(*(f"{100.0 * limit:.1f}" for limit in interval))


def markdown(titles: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table with column titles and lines of cells."""
    table = [titles, ["---"] * len(titles), *lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in table) + "\n"


def trials_of(row: Row) -> int:
    """Return the largest number of trials of a row's metrics."""
    return max(value.trials or 0 for value in row.metrics.values())


def first_seed(policy: str) -> dict[str, Row]:
    """Return the saved rows of a policy with the smallest seed, by condition."""
    return {row.condition: row for row in reversed(saved_rows(policy))}


def main_table(policy: str, task: TaskCfg) -> str:
    """Return the main table of a policy: metrics as rows, conditions and published results as columns."""
    rows, paper = first_seed(policy), published(task)
    shown = [(title, rows[name].metrics) for name, title in zip(SHOWN, SHORT, strict=True) if name in rows]
    tests = [words.removeprefix(ON_ROBOT) for words, _ in paper if words.startswith(ON_ROBOT)]
    titles = ["", *dict.fromkeys(ON_ROBOT.strip(", ") if words.startswith(ON_ROBOT) else words
                                 for words, _ in (*shown, *paper))]  # fmt: skip
    lines = []
    for line in MAIN[kind_of(task)]:
        cells = [cell(line, metrics) for words, metrics in (*shown, *paper) if not words.startswith(ON_ROBOT)]
        robot = [cell(line, metrics) for words, metrics in paper if words.startswith(ON_ROBOT)]
        lines.append([line.title, *cells, *([" / ".join(filter(None, robot))] if tests else [])])
    nominal = rows["nominal"]
    note = f"{trials_of(nominal):,} trials a column; commands: {nominal.values['commands']}"
    if kind_of(task) == "height":
        note += "; in range: " + str(nominal.metrics["in_range_success_rate"].over).partition("goals of ")[2]
    note += f".\n{ON_ROBOT.strip(', ').capitalize()}: {' / '.join(tests)}" if tests else ""
    return markdown(titles, lines) + f"\n{note}.\n"


def all_conditions(policy: str, task: TaskCfg) -> str:
    """Return the table of a policy in all conditions, with 95 % intervals, and the reasons for missing conditions."""
    rows, wide = first_seed(policy), COLUMNS[kind_of(task)]
    lines = [[CONDITIONS[name].title, *(cell(column, rows[name].metrics) for column in wide)]
             for name in CONDITIONS if name in rows]  # fmt: skip
    lines += [[words, *(cell(column, metrics) for column in wide)] for words, metrics in published(task)]
    values = rows["nominal"].values
    reasons = [f"Not measured: {CONDITIONS[name].title}, since {reason}.\n"
               for name in CONDITIONS if (reason := undefined(task, name))]  # fmt: skip
    note = f"{trials_of(rows['nominal']):,} trials a row; commands: {values['commands']}.\n"
    note += f"Trained on {trained_on(task, values)}.\n"
    return "\n".join([markdown(["condition", *(column.title for column in wide)], lines), note, *reasons])


class TestTable(NamedTuple):
    """Definition of a Markdown table of tests, with a line for each policy and test."""

    tests: tuple[str, ...]  # Keys of TESTS or CONDITIONS
    columns: tuple[TableColumn, ...]
    policies: tuple[str, ...] = ()  # Default: those of the first test

    __test__ = False  # not a test class of pytest


TRIALS = TableColumn("trials", ())
GOALS = (SUCCESS, *columns(("no paw lifted", "no_paw_lift_rate"), ("error at rest [m]", "goal_distance_at_rest_mean_m"),
                           ("falls", "fall_rate"), ("missed", "miss_rate")), TRIALS)  # fmt: skip
SIDEWAYS = (*GOALS[:-1], *columns(("no jump", "no_jump_rate")), TRIALS)
REACH = columns(("success [m]", "reliable_distance_m"), ("success without hop [m]", "reliable_distance_without_hop_m"),
                ("success, no paw lifted [m]", "reliable_distance_without_paw_lift_m"))  # fmt: skip
GROUNDS = {"flat": "flat", "uneven": "bumps", "waves": "waves", "slope": "down a slope", "bowl": "up a slope",
           "stairs": "down steps", "pit": "up steps", "blocks": "blocks"}  # fmt: skip
TEST_TABLES = {
    "slippery": TestTable(("friction_0.4", "diagonal_friction_0.4", "diagonal_friction_0.4_randomised",
                           "friction_0.3"), GOALS,
                          ("slippery_jump", "slippery_waiting_jump", "horizontal_jump", "sighted_jump")),
    "side": TestTable(("side", "side_friction_0.4", "side_friction_0.4_randomised"), SIDEWAYS),
    "diagonal": TestTable(("diagonal",), GOALS),
    "paper": TestTable(("grid", "consecutive"), (SUCCESS, *columns(
        ("error at rest [m]", "goal_distance_at_rest_mean_m"), ("ten in a row, all succeed", "row_all_success_rate")))),
    "grounds": TestTable(("grounds_0.35", "grounds_0.45", "grounds_0.50"), columns(
        ("onto a block", "block_success_rate"), ("off a platform", "platform_success_rate"),
        ("uneven ground", "uneven_success_rate"), ("falls, block", "block_fall_rate"))),
    "farthest": TestTable(("farthest", "farthest_randomised", "farthest_ahead", "farthest_left", "farthest_back",
                           "farthest_ahead_randomised", "farthest_left_randomised", "farthest_back_randomised"),
                          REACH,
                          ("horizontal_jump", "sighted_jump", "slippery_jump", "slippery_waiting_jump",
                           "omnidirectional_jump")),
    "farthest_mars": TestTable(("farthest_mars",), REACH),
    "wait": TestTable(("wait", "wait_randomised"), columns(
        ("hold 3 s", "holding_rate"), ("range of the paw force, mean [N]", "paw_force_range_mean_n"),
        ("ripple of the torque, mean [N m]", "torque_ripple_mean_nm"))),
    "terrain": TestTable(("terrain", "terrain_randomised"), columns(
        *((words, f"{kind}_fall_rate") for kind, words in GROUNDS.items()))),
    "tracking": TestTable(("tracking", "tracking_randomised"), columns(
        ("within 0.1 m/s after [s]", "settling_time_median_s"), ("top speed ahead [m/s]", "top_ahead_m_s"),
        ("back", "top_back_m_s"), ("sideways", "top_sideways_m_s"), ("turning [rad/s]", "top_turning_rad_s"),
        ("falls after a push of 0.5 m/s", "kicked_fall_rate"), ("cost of transport", "cost_of_transport"))),
    "flights": TestTable(("flight_15_ms", "flight_25_ms", "flight_jump", "flight_jump_randomised"), columns(
        ("upright", "landed_upright_rate"), ("upright without turning", "without_turning_landed_upright_rate"),
        ("tilt at touchdown [deg]", "touchdown_tilt_mean_deg"),
        ("without turning [deg]", "without_turning_touchdown_tilt_mean_deg"))),
    "combined": TestTable(("walk_jump_walk", "walk_jump_walk_randomised", "walk_jump_walk_mujoco",
                           "course_level", "course_level_randomised", "course", "course_randomised"), columns(
        ("finished", "finished_rate"), ("all jumps on goal", "finished_on_goal_rate"), ("falls", "fall_rate"),
        ("apex error [m]", "apex_error_abs_mean_m"), ("error of the place [m]", "goal_distance_at_handover_mean_m"),
        ("RMSE settled, ahead [m/s]", "settled_slewed_rmse_vx_m_s"), ("aside [m/s]", "settled_slewed_rmse_vy_m_s"),
        ("turning [rad/s]", "settled_slewed_rmse_yaw_rate_rad_s"))),
}  # fmt: skip
"""Tables of tests by name."""


def test_table(name: str) -> str:
    """Return the Markdown table `name` of TEST_TABLES, a line per policy and test; unmeasured tests are left out."""
    tests, wide, policies = TEST_TABLES[name]
    policies = policies or TESTS[tests[0]].policies
    lines = []
    for policy in policies:
        rows = first_seed(policy)
        for test in (test for test in tests if test in rows):
            words = TESTS[test].words if test in TESTS else f"{rows[test].values['commands']}, {CONDITIONS[test].title}"
            cells = (f"{trials_of(rows[test]):,}" if x is TRIALS else cell(x, rows[test].metrics) for x in wide)
            lines.append([policy, words, *cells])
    titles = ["policy", "test", *(column.title for column in wide)]
    if len(policies) == 1:
        titles, lines = titles[1:], [line[1:] for line in lines]
    return markdown(titles, lines)


def key_table(name: str) -> str:
    """Return a table of an evaluation's metrics: key, unit, statistic and trials that count; name: of KEYS."""
    lines = [[f"`{metric.key}`", "1" if metric.key.endswith("_rate") else unit_of(metric.key) or "1",
              metric.statistic.__name__, metric.over] for metric in KEYS[name]]  # fmt: skip
    return markdown(("key", "unit", "statistic", "over"), lines)
