"""Picture and page of a sweep: its trials, the importance of each parameter, and the best settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jumper_warp.compare.report import table, words
from jumper_warp.compare.sweep import RUN, Sweep, flags_of, open_study
from jumper_warp.utils.files import write_atomically
from jumper_warp.utils.metrics import format_value
from jumper_warp.viz.plots import figure

PICTURE, PAGE = "sweep.png", "sweep.md"


def write_sweep_report(sweep: Sweep) -> Path:
    """Write picture and page of a sweep into its folder, and return the page's path."""
    from optuna.trial import TrialState

    study = open_study(sweep)
    trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))
    sign = -1.0 if sweep.direction == "maximize" else 1.0
    trials.sort(key=lambda trial: (trial.state == TrialState.PRUNED, sign * (trial.value or 0.0)))
    weights = importances(study)
    rows = []
    for trial in trials:
        params = map(format_value, trial.params.values())
        rows.append([trial.user_attrs[RUN], trial.state.name.lower(), format_value(trial.value), *params])
    best = flags_of(trials[0].params) if trials else ""
    parts = [
        f"# Sweep {sweep.name}",
        f"Task `{sweep.task}`, {len(sweep.seeds)} seeds a trial, {len(trials)} trials of {sweep.trials}. "
        f"Metric: `{sweep.metric}`, interquartile mean of the seeds, {sweep.direction}. Best flags: `{best}`",
        f"![Sweep]({PICTURE})",
        "## Trials", table(("run", "state", sweep.metric, *sweep.parameters), rows),
        "## Importance of the parameters",
        table(("parameter", "importance"), ([name, f"{value:.2f}"] for name, value in weights.items()))
        if weights else "Too few finished trials.",
        "The best of many trials is better than the same settings will be with other seeds. Train the best settings "
        "and the base with new seeds, and compare them:",
        f"```bash\njumper compare {sweep.folder / sweep.task}\n```",
    ]  # fmt: skip
    plot_sweep(trials, weights, sweep)
    write_atomically(sweep.folder / PAGE, ("\n\n".join(parts) + "\n").encode())
    return sweep.folder / PAGE


def importances(study: Any) -> dict[str, float]:
    """Return the importance of each parameter for the metric (PED-ANOVA), their sum 1; empty: too few trials."""
    import optuna
    from optuna.trial import TrialState

    finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    if len({trial.value for trial in finished}) < 2:
        return {}
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    return optuna.importance.get_param_importances(study, evaluator=evaluator)


def plot_sweep(trials: list[Any], weights: dict[str, float], sweep: Sweep) -> None:
    """Plot the metric of all trials over each parameter; titles have the parameters' importances."""
    names = list(sweep.parameters)
    settings: Any = {"figsize": (max(4.2 * len(names), 7.0), 4.4), "sharey": True, "squeeze": False}
    with figure(sweep.folder / PICTURE, 1, len(names), title=f"Sweep {sweep.name}", **settings) as axes:
        for axis, name in zip(axes[0], names, strict=True):
            for state, style, label in (("COMPLETE", "o", "finished"), ("PRUNED", "x", "pruned, last value")):
                chosen = [trial for trial in trials if trial.state.name == state]
                values = [trial.params[name] for trial in chosen]
                values = values if all(isinstance(value, int | float) for value in values) else list(map(str, values))
                results = [trial.value if trial.value is not None else np.nan for trial in chosen]
                color = "C0" if style == "o" else "0.5"
                axis.plot(values, results, style, label=label if chosen else None, color=color)
            importance = f"importance {weights[name]:.2f}" if name in weights else ""
            spec = sweep.parameters[name]
            axis.set(xlabel=name, title=importance, xscale="log" if spec.get("log") else "linear")
            if spec.get("log"):
                ticks = [part * 10.0**power for power in range(-12, 13) for part in (1, 2, 5)]
                ticks = [tick for tick in ticks if spec["low"] <= tick <= spec["high"]]
                axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
                axis.minorticks_off()
            if "low" in spec:
                axis.set_xlim(spec["low"], spec["high"])
        axes[0, 0].set(ylabel=words(sweep.metric))
