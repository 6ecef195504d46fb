"""Template of an experiment: how does paw friction change the error of a jump's landing? Copy it for your question.

    python experiments/template.py --policy horizontal_jump --out outputs/template

Every policy of jumps to places works; `--help` lists the conditions. The script writes `metrics.json`, the plot
`friction.png`, and a picture and a Rerun recording of some jumps with each friction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from jumper_warp.evaluation.jump_metrics import LandingFlags
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.viz.plots import figure
from support.scripts import run_script


@dataclass(frozen=True)
class Args(EvaluationArgs):
    """Flags of the test of jumps with several frictions."""

    frictions: tuple[float, ...] = (0.3, 0.4, 0.6, 0.8)  # [1] Friction coefficients of the paws
    num_jumps: int = 50  # Number of jumps with each friction


def main(args: Args) -> dict:
    """Run jumps with each friction, plot their mean error over friction, and return the metrics."""
    run = EvaluationRun.from_args("template", args)  # the setting: policy, task, device, output folder
    flags = LandingFlags(args.num_jumps)  # goals as in `jumper evaluate`
    metrics = {}
    errors = []
    for friction in args.frictions:
        env = run.env(args.num_jumps, conditions=replace(run.conditions, friction=friction))
        log = run.run_episodes(env, flags.log(env.task, args.stream_seed), film=f"friction_{friction:g}")
        values = flags.metrics(log)
        metrics |= {f"friction_{friction:g}_{key}": value for key, value in values.items()}
        errors.append(values["goal_distance_at_end_mean_m"].value)
    with figure(run.folder / "friction.png", title="Landing error", conditions=run.title) as axis:
        axis.plot(args.frictions, errors, "o-")
        axis.set(xlabel="friction [1]", ylabel="distance from the goal at the end [m]", ylim=(0.0, None))
    return run.report(metrics, {}, [f"friction_{x:g}_goal_distance_at_end_mean_m" for x in args.frictions])


if __name__ == "__main__":
    run_script(main, Args)
