"""Table of the page "Which policy should I use?"."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from jumper_warp.tasks.cfg import TaskCfg
from support.policy_results import Row
from support.policy_tables import first_seed, kind_of, markdown, number, trained_on


class Need(NamedTuple):
    """Need of a user, the policy for it, and when not to use that policy."""

    words: str
    policy: str
    unless: str
    tests: tuple[str, str, str] = ("nominal", "randomised", "friction_0.4")
    """Conditions of the three columns of success and error; an empty name leaves a cell empty."""


SIDE = ("side", "side_friction_0.4_randomised", "side_friction_0.4")
NEEDS = (
    Need("jump up", "vertical_jump", "heights above 1.08 m"),
    Need("jump to a place ahead", "horizontal_jump", "slippery floor; sideways; back"),
    Need("jump in any direction", "omnidirectional_jump", "goals outside its training"),
    Need("jump sideways, also on a slippery floor", "omnidirectional_jump", "goals outside its training", SIDE),
    Need("jump ahead on a slippery floor", "slippery_jump", "commands later than 0.7 s after the reset"),
    Need("jump diagonally on a slippery floor", "slippery_jump", "sideways goals",
         ("diagonal", "diagonal_friction_0.4_randomised", "diagonal_friction_0.4")),
    Need("wait, then jump on a slippery floor", "slippery_waiting_jump", "friction below 0.35"),
    Need("jump onto or off blocks ahead", "sighted_jump", "slippery floor"),
    Need("walk on level ground", "walking_flat", "steps of 6 cm; slopes"),
    Need("walk on rough ground", "walking_rough", "speeds above 0.8 m/s", ("terrain", "terrain_randomised", "")),
    Need("jump up on Mars", "mars_vertical_jump", "the command filter of Earth"),
    Need("jump ahead on Mars", "mars_horizontal_jump", "latency of 25 ms; friction 0.4"),
    Need("jump ahead on Mars with leg springs", "mars_springs_jump", "latency of 25 ms"),
    Need("turn in flight", "attitude", "angles above 140°; on the ground"),
)  # fmt: skip
"""Needs in the order of the table; links of policies are made from their names."""
PAGES = {"height": "vertical_jump", "place": "horizontal_jump", "velocity": "walking", "attitude": "attitude"}
RATES = {"velocity": "fall_rate", "attitude": "settled_without_collision_rate"}  # By kind; else success_rate
ERRORS = {
    "height": ("in_range_apex_error_abs_mean_m", 1000.0, "{:.1f} mm"),
    "place": ("goal_distance_at_rest_mean_m", 1000.0, "{:.1f} mm"),
    "velocity": ("settled_rmse_vx_m_s", 1.0, "{:.3f} m/s"),
    "attitude": ("error_at_end_mean_deg", 1.0, "{:.1f}°"),
}
"""Key of the error, factor and format by kind."""


def choice_table(tasks: Mapping[str, TaskCfg]) -> str:
    """Return a Markdown table with a policy for each of NEEDS: tested and trained commands, success, error, limits."""
    lines = []
    for words, policy, unless, tests in NEEDS:
        rows, task = first_seed(policy), tasks[policy]
        kind = kind_of(task)
        page = "mars" if policy.startswith("mars") else PAGES[kind]
        trained = trained_on(task, rows["nominal"].values)
        cells = [_success(rows.get(test), kind) for test in tests]
        tested = _tested_on(rows[tests[0]])
        lines.append([words, f"[{policy}]({page}.md)", tested, *cells, trained, unless])
    titles = ("need", "policy", "tested on", "nominal", "randomised", "friction 0.4", "trained on", "not for")
    return markdown(titles, lines)


def _tested_on(row: Row) -> str:
    """Return the commands of a row; for a test of terrains the speed."""
    if "speed_m_s" in row.values:
        return f"bumps, slopes, steps at {row.values['speed_m_s']} m/s"
    return str(row.values["commands"])


def _success(row: Row | None, kind: str) -> str:
    """Format success, for walking the falls, and mean error of a row; empty if it was not measured.

    Of a test of terrains it is the share that falls on the worst one.
    """
    if row is None:
        return ""
    if "speed_m_s" in row.values:
        rates = (metric.value for name, metric in row.metrics.items() if name.endswith("_fall_rate"))
        worst = max(rate for rate in rates if isinstance(rate, float))
        return f"{number('fall_rate', worst)} fall".replace(" ", "\N{NO-BREAK SPACE}")
    rate, (key, factor, text) = RATES.get(kind, "success_rate"), ERRORS[kind]
    value = row.metrics[key].value
    assert isinstance(value, float)
    falls = " fall" if kind == "velocity" else ""
    share = f"{number(rate, row.metrics[rate].value).replace('100.0', '100')}{falls}"
    return ", ".join(part.replace(" ", "\N{NO-BREAK SPACE}") for part in (share, text.format(factor * value)))
