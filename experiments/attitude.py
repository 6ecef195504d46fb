"""Measure how fast a floating robot turns by its legs alone, and write metrics, a plot, a picture and a recording.

    python experiments/attitude.py --policy attitude --num-turns 60 --out outputs/attitude
    python experiments/attitude.py --policy logs/attitude/<run> --randomize --angle 60

Robots float at rest in the default pose, in zero gravity. Each is commanded to turn by 90 degrees about a body axis or,
in a second test, about a random axis. The settling time is the time from which the error stays within a tolerance until
the end. A turn succeeds if it settles without a collision. The authors' robot turned by 90 degrees in 2.6 s.

No external torque acts, so the angular momentum should stay 0. Two metrics measure its drift: the largest value of all
robots, and the turn that it causes (its integral over the moment of inertia in the default pose). By default the
simulation conserves momentum. `--no-keep-momentum` disables this, `--refine 4` divides the physics step by 4, and
`--solver mujoco` uses physics that the policy was not trained on and that does not conserve momentum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jumper_warp.evaluation.attitude import DIRECTIONS, TURN_METRICS, AttitudeFlags, AttitudeLog, random_turns
from jumper_warp.evaluation.run import EvaluationArgs, EvaluationRun
from jumper_warp.tasks.attitude.cfg import AttitudeEvaluation
from jumper_warp.utils.metrics import measure
from jumper_warp.viz.plots import figure
from support.momentum import MomentumRecorder, rotational_inertia
from support.scripts import run_script

HARDWARE = {"settling_time_mean_s": 2.6}  # [s] Settling time of the authors' robot after 90 degrees
SUMMARY = ("settled_without_collision_rate", *HARDWARE, "any_axis_settling_time_mean_s", "turn_by_drift_max_deg")


@dataclass(frozen=True)
class Args(EvaluationArgs, AttitudeFlags):
    """Flags of the test of a floating robot: `num_turns` rotations about body axes, and as many about random axes."""

    policy: str = "attitude"
    keep_momentum: bool = True  # Conserve the momentum of free flight exactly, regardless of the training's setting
    refine: int = 1  # [1] Factor by which the physics step is smaller than that of the training
    num_recorded: int = 6
    """Number of turns to record for the Rerun viewer and, one of them, as a picture; 0: none."""

    def __post_init__(self) -> None:
        """Raise InputError as `EvaluationArgs` and `AttitudeFlags`."""
        super().__post_init__()
        AttitudeFlags.__post_init__(self)


def plot_turns(run: EvaluationRun, turns: AttitudeLog, conditions: str) -> None:
    """Plot angles to the goal and settling times of turns about body axes into `turns.png`, with a color per axis."""
    errors = np.degrees(np.array(turns.errors))
    time = (np.arange(len(errors)) + 1) * turns.step_dt
    with figure(run.folder / "turns.png", 1, 2, figsize=(11, 5), title="Turns", conditions=conditions) as axes:
        for i, name in enumerate(DIRECTIONS):
            style = {"color": f"C{i // 2}", "linestyle": "-" if i % 2 == 0 else "--"}
            axes[0].plot(time, errors[:, i::6], alpha=0.15 if errors.shape[1] > 6 else 0.0, linewidth=0.6, **style)
            axes[0].plot(time, np.nanmean(errors[:, i::6], axis=1), label=name.replace("_", " "), **style)
            settled = turns.settling_time[i::6]
            axes[1].scatter(np.full(len(settled), i), settled, color=f"C{i // 2}")
        axes[0].axhline(turns.tolerance, color="0.6", linewidth=0.8)
        axes[0].set(xlabel="time [s]", ylabel="angle to the goal [deg]")
        axes[1].axhline(*HARDWARE.values(), color="0.4", linestyle=":", label="robot, 90 degrees")
        axes[1].set_xticks(range(6), [name.replace("_", " ") for name in DIRECTIONS], rotation=30, ha="right")
        axes[1].set(ylabel="time to settle [s]", ylim=(0.0, turns.seconds))


def main(args: Args) -> dict:
    """Run turns about body axes and about random axes, write plots and recording, and return the metrics."""
    run = EvaluationRun.from_args("attitude", args, AttitudeEvaluation)
    env = run.env(args.num_turns, lambda task: replace(task, keep_momentum=args.keep_momentum), refine=args.refine)
    run.settings |= {"physics_step_s": env.physics_dt, "keep_momentum": args.keep_momentum}
    turns = args.log(run.task, args.stream_seed)
    momentum = MomentumRecorder(env)
    inertia = rotational_inertia(env.sim)
    run.run_episodes(env, turns, film="turn", on_step=momentum)
    values = args.metrics(turns) | momentum.metrics(turns.diverged, inertia)
    plot_turns(run, turns, f"{run.title}, {args.num_turns} turns by {args.angle:g} degrees")
    others = AttitudeLog(random_turns(args.num_turns, args.angle, args.stream_seed), args.tolerance, args.seconds)
    run.run_episodes(env, others)
    values |= measure(TURN_METRICS, others, prefix="any_axis_", note="about any axis")
    return run.report(values, HARDWARE, SUMMARY)


if __name__ == "__main__":
    run_script(main, Args)
