"""Table and learning curves of the trainings of the paper's tasks beside the paper's results, from metric files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.utils.output import read_values
from jumper_warp.viz.plots import figure
from support.paper_runs import ARMS

GAP, NEVER = "not measured", "not reached"
ROWS = (
    ("vertical-jump-paper", "0.5–1.2 m, success", "nominal_sweep_goal_reached_rate", "0.91"),
    ("vertical-jump-paper", "0.5–1.1 m, success", "nominal_sweep_in_range_goal_reached_rate", "1.00"),
    ("vertical-jump-paper", "0.5–1.2 m, also on command, landed, at rest", "nominal_sweep_success_rate", "–"),
    ("vertical-jump-paper", "mean error [m]", "nominal_sweep_apex_error_abs_mean_m", "0.040"),
    ("vertical-jump-paper", "steps to 50 % [million]", "steps_to_50_percent", "–"),
    ("horizontal-jump-paper", "0.3–1.5 m, success", "nominal_straight_goal_reached_rate", "0.97"),
    ("horizontal-jump-paper", "0.3–1.4 m, success", "nominal_straight_in_range_goal_reached_rate", "1.00"),
    ("horizontal-jump-paper", "0.3–1.5 m, also landed, at rest", "nominal_straight_success_rate", "–"),
    ("horizontal-jump-paper", "mean error, all jumps [m]", "nominal_straight_goal_distance_at_end_mean_m", "0.026"),
    ("horizontal-jump-paper", "mean error, at rest [m]", "nominal_straight_goal_distance_at_rest_mean_m", "0.026"),
    ("horizontal-jump-paper", "grid, success", "nominal_grid_goal_reached_rate", "0.968"),
    ("horizontal-jump-paper", "grid, mean error [m]", "nominal_grid_goal_distance_at_end_mean_m", "0.025"),
    ("horizontal-jump-paper", "steps to 50 % [million]", "steps_to_50_percent", "–"),
    ("velocity-paper", "RMSE ahead [m/s]", "nominal_walk_slewed_rmse_vx_m_s", "0.17"),
    ("velocity-paper", "RMSE left [m/s]", "nominal_walk_slewed_rmse_vy_m_s", "0.05"),
    ("velocity-paper", "RMSE yaw rate [rad/s]", "nominal_walk_slewed_rmse_yaw_rate_rad_s", "0.12"),
    ("velocity-paper", "falls", "nominal_walk_fall_rate", "–"),
)
"""Task, words, metric and the paper's value of each row; the paper's walk is one of its robot."""
CURVES = (
    ("vertical-jump-paper", "success, 0.5–1.2 m", 0.91),
    ("horizontal-jump-paper", "success, 0.3–1.5 m", 0.97),
    ("velocity-paper", "RMSE ahead [m/s]", 0.17),
)
"""Task, label of the primary metric and the paper's value of each plot of `plot_curves`."""


def finished(folder: Path, task: str, arm: str) -> list[dict[str, Any]]:
    """Return the metrics of all finished trainings of a task with an ablation (arm), one dict per seed."""
    files = sorted((folder / task).glob(f"{arm}_*/metrics.json"))
    return [values for path in files if "curve_steps" in (values := read_values(path.parent))]


def cell(folder: Path, task: str, arm: str, key: str) -> str:
    """Format a metric of an ablation (arm): mean and range over seeds, and how many have a value if not all do.

    GAP: no seed has it, NEVER: none reached it.
    """
    seeds = finished(folder, task, arm)
    found = [values[key] for values in seeds if values.get(key) is not None]
    if not found:
        return NEVER if seeds and key.startswith("steps") else GAP
    values = np.array(found) * (1.0e-6 if key.startswith("steps") else 1.0)
    spread = f" ({values.min():.3g}–{values.max():.3g})" if len(values) > 1 else ""
    return f"{values.mean():.3g}{spread}" + f", {len(values)} of {len(seeds)}" * (len(values) < len(seeds))


def results_table(folder: Path) -> str:
    """Return a Markdown table of the paper's results and those of all ablations that were trained in a folder."""
    lines = [f"| task | test | paper | {' | '.join(arm.replace('_', ' ') for arm in ARMS)} |", "|---" * 7 + "|"]
    for task, words, key, paper in ROWS:
        arms = ARMS if task != "velocity-paper" else ARMS[:1]
        cells = [cell(folder, task, arm, key) for arm in arms] + ["–"] * (len(ARMS) - len(arms))
        lines.append(f"| `{task}` | {words} | {paper} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def plot_curves(folder: Path, path: Path) -> None:
    """Plot learning curves (primary metric of nominal robots) to a file: a line per training, thick ones for means."""
    with figure(path, 1, len(CURVES), figsize=(11, 4), title="Learning curves of the paper's tasks") as axes:
        for axis, (task, label, paper) in zip(axes, CURVES, strict=True):
            for i, arm in enumerate(ARMS):
                curves = [(values["curve_steps"], values["curve_values"]) for values in finished(folder, task, arm)]
                if not curves:
                    continue
                steps = max((steps for steps, _ in curves), key=len)
                means = np.mean([np.interp(steps, *curve) for curve in curves], axis=0)
                for those, curve in curves:
                    axis.plot(np.array(those) * 1.0e-6, curve, color=f"C{i}", linewidth=0.7, alpha=0.5)
                axis.plot(np.array(steps) * 1.0e-6, means, color=f"C{i}", linewidth=2.5, label=arm.replace("_", " "))
            axis.axhline(paper, color="black", linestyle=":", label="the paper")
            axis.set(title=task, xlabel="policy steps [million]", ylabel=label, xlim=(0.0, None), ylim=(0.0, None))
